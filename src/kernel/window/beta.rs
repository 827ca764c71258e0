//! Openness by a beta distribution on [min, max] of the window's mean and variance: `I_t(a, b)`, the regularised
//! incomplete beta function, with `m = (mean - min)/range`, `k = m (1 - m) range^2 / variance - 1`, `a = m k`,
//! `b = (1 - m) k`. `cdf_power` is its case b = 1, which needs no variance and fits less.
//!
//! Eight lanes at a time, IEEE operations only, no library logarithms: every instruction set gives the same bits, and a
//! lane stops by its own values alone, so neighbours never show. Absolute error at most 1e-6 up to k = 1e6.

use super::math::{exp, ln};

/// Voxels that go together.
pub const LANES: usize = 8;
type Lanes = [f64; LANES];

/// What a voxel's window says; all in one unit, `below + above` the range, already turned around where solid is low.
#[derive(Debug, Clone, Copy)]
pub struct Terms {
    /// v - min and max - v.
    pub below: f64,
    pub above: f64,
    /// Sums of (v_i - min) and of (max - v_i).
    pub over: f64,
    pub under: f64,
    /// n^2 variance.
    pub numerator: f64,
}

/// Bounds of k: below, the distribution is two atoms; no window within 2^27 voxels reaches the upper one.
const K: [f64; 2] = [1e-9, 1e8];
/// Relative step at which the continued fraction ends, and most steps (they grow as the root of k).
const STEP: f64 = 1e-9;
const MOST: usize = 20_000;

crate::multiversion! {
    /// One row. `constant` is the openness of a window of equal values.
    pub fn beta_row[F: Fn(usize) -> Terms](terms: F, constant: f32, out: &mut [f32]) -> () = beta_inner;
}

#[inline(always)]
fn beta_inner<F: Fn(usize) -> Terms>(terms: F, constant: f32, out: &mut [f32]) {
    let len = out.len();
    for (block, out) in out.chunks_mut(LANES).enumerate() {
        let [mut x, mut y, mut a, mut b] = [[0.5; LANES], [0.5; LANES], [1.0; LANES], [1.0; LANES]];
        for l in 0..LANES {
            // Lanes beyond the row repeat its last voxel.
            let t = terms((block * LANES + l).min(len - 1));
            let range = t.below + t.above;
            let total = t.over + t.under;
            let k = t.over * t.under / t.numerator - 1.0;
            let k = if k > K[0] { k } else { K[0] };
            let k = if k < K[1] { k } else { K[1] };
            let inside = (t.below > 0.0) & (t.above > 0.0) & (t.over > 0.0) & (t.under > 0.0);
            x[l] = if inside { t.below / range } else { 0.5 };
            y[l] = if inside { t.above / range } else { 0.5 };
            a[l] = if inside { k * (t.over / total) } else { 1.0 };
            b[l] = if inside { k * (t.under / total) } else { 1.0 };
        }
        let share = incomplete(x, y, a, b);
        for (l, o) in out.iter_mut().enumerate() {
            let t = terms(block * LANES + l);
            *o = match (t.below == 0.0, t.above == 0.0) {
                (true, true) => constant,
                (true, false) => 0.0,
                (false, true) => 1.0,
                (false, false) => share[l] as f32,
            };
        }
    }
}

/// `I_x(a, b)` for `0 < x < 1`, `y = 1 - x` (given, since it may cancel), `a, b > 0`.
#[inline(always)]
fn incomplete(x: Lanes, y: Lanes, a: Lanes, b: Lanes) -> Lanes {
    // The continued fraction converges fast on the near side of the mean; from beyond it comes 1 - I_y(b, a).
    let (mut p, mut q, mut c, mut d) = (x, y, a, b);
    let mut turned = [false; LANES];
    for l in 0..LANES {
        turned[l] = x[l] * (a[l] + b[l] + 2.0) > a[l] + 1.0;
        if turned[l] {
            (p[l], q[l], c[l], d[l]) = (y[l], x[l], b[l], a[l]);
        }
    }
    let fraction = fraction(p, c, d);
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        let log = c[l] * ln(p[l]) + d[l] * ln(q[l]) + log_scale(c[l], d[l]);
        let share = exp(log) * fraction[l];
        let share = if share < 1.0 { share } else { 1.0 };
        out[l] = if turned[l] { 1.0 - share } else { share };
    }
    out
}

/// `-ln(a B(a, b)) = ln G(a + b) - ln G(a + 1) - ln G(b)`: Stirling's series seven to the right of each argument, where
/// four terms leave 2e-11, and the seven factors of the shift as one quotient.
#[inline(always)]
fn log_scale(a: f64, b: f64) -> f64 {
    const SHIFT: f64 = 7.0;
    let stirling = |z: f64| {
        let z = z + SHIFT;
        let i = 1.0 / z;
        let w = i * i;
        let series = i * (1.0 / 12.0 + w * (-1.0 / 360.0 + w * (1.0 / 1260.0 - w / 1680.0)));
        (z - 0.5) * ln(z) - z + series
    };
    let rising = |z: f64| z * (z + 1.0) * (z + 2.0) * (z + 3.0) * (z + 4.0) * (z + 5.0) * (z + 6.0);
    const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;
    // Quotients first: the products of two large arguments would be 1e112, no overflow, but small ones underflow.
    let shifts = ln(rising(a + 1.0) / rising(a + b) * rising(b));
    stirling(a + b) - stirling(a + 1.0) - stirling(b) - HALF_LN_TAU + shifts
}

/// Continued fraction of `I_x(a, b)` (Abramowitz and Stegun 26.5.8), numerators and denominators by Wallis' recurrence,
/// two coefficients a step, rescaled so that the denominator is 1.
#[inline(always)]
fn fraction(x: Lanes, a: Lanes, b: Lanes) -> Lanes {
    let (mut am, mut bm, mut az, mut bz) = ([1.0; LANES], [1.0; LANES], [1.0; LANES], [0.0; LANES]);
    for l in 0..LANES {
        bz[l] = 1.0 - (a[l] + b[l]) * x[l] / (a[l] + 1.0);
        // Rescaled like every later step.
        (am[l], bm[l], az[l]) = (1.0 / bz[l], 1.0 / bz[l], 1.0 / bz[l]);
    }
    let mut going = [true; LANES];
    for m in 1..MOST {
        let m = m as f64;
        let mut any = false;
        for l in 0..LANES {
            let (a, b, x) = (a[l], b[l], x[l]);
            let (u, v, w) = (a + 2.0 * m - 1.0, a + 2.0 * m, a + 2.0 * m + 1.0);
            let scale = x / (u * v * w);
            let even = m * (b - m) * scale * w;
            let odd = -(a + m) * (a + b + m) * scale * u;
            let (ap, bp) = (az[l] + even * am[l], 1.0 + even * bm[l]);
            let (app, bpp) = (ap + odd * az[l], bp + odd);
            let inverse = 1.0 / bpp;
            let next = app * inverse;
            // A lane that has ended keeps its values.
            let moves = (next - az[l]).abs() > STEP * next.abs();
            let keep = !going[l];
            am[l] = if keep { am[l] } else { ap * inverse };
            bm[l] = if keep { bm[l] } else { bp * inverse };
            az[l] = if keep { az[l] } else { next };
            going[l] &= moves;
            any |= going[l];
        }
        if !any {
            break;
        }
    }
    az
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(x: f64, a: f64, b: f64) -> f64 {
        incomplete([x; LANES], [1.0 - x; LANES], [a; LANES], [b; LANES])[3]
    }

    #[test]
    fn closed_forms() {
        for i in 1..100 {
            let x = i as f64 / 100.0;
            for a in [1e-6, 0.01, 0.5, 1.0, 3.5, 40.0, 900.0] {
                assert!((one(x, a, 1.0) - x.powf(a)).abs() < 1e-9, "I_{x}({a}, 1)");
                assert!((one(x, 1.0, a) - (1.0 - (1.0 - x).powf(a))).abs() < 1e-9, "I_{x}(1, {a})");
                assert!((one(x, a, 2.5) + one(1.0 - x, 2.5, a) - 1.0).abs() < 1e-9, "I_{x}({a}, 2.5)");
            }
            let arcsine = 2.0 / std::f64::consts::PI * x.sqrt().asin();
            assert!((one(x, 0.5, 0.5) - arcsine).abs() < 1e-9, "I_{x}(1/2, 1/2)");
        }
        for a in [1e-9, 1e-3, 2.0, 1e3, 1e5, 5e5] {
            assert!((one(0.5, a, a) - 0.5).abs() < 1e-6, "{a}: {}", one(0.5, a, a));
        }
    }

    #[test]
    fn lanes_do_not_touch() {
        let a = [1e-6, 0.3, 1.0, 2.0, 17.0, 300.0, 1e4, 1e6];
        let x: Lanes = std::array::from_fn(|l| 0.05 + 0.1 * l as f64);
        let y = x.map(|x| 1.0 - x);
        let b = [3.0; LANES];
        let together = incomplete(x, y, a, b);
        for l in 0..LANES {
            let alone = incomplete([x[l]; LANES], [y[l]; LANES], [a[l]; LANES], b);
            assert_eq!(together[l].to_bits(), alone[0].to_bits(), "{l}");
        }
    }
}
