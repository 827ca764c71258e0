//! Openness from mean and variance (A 3.3, E 3.4) for rows of float windows, in strips: deviations and numerators by plain loops
//! in f64, then the formulas of the integers' kernel in f32 ([`super::openness`]).

use super::estimate::{Polarity, Spread};
use super::float_estimate::infinite;
use super::float_power::Centre;
use super::math;
use super::merge::Sum;
use super::openness::{CHEBYSHEV, GAUSSIAN, LITERAL, STRIP, Strip, padded, spread_strip};
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};

/// Windows of one row, all slices of one length; of `v` NaN is a missing voxel, whose result means nothing.
#[derive(Clone, Copy)]
pub struct Spreads<'a, T: Centre> {
    pub v: &'a [T],
    /// Least and greatest voxels; `None` where a window is constant if and only if its M2 is 0, as in finite f32.
    pub ends: Option<[&'a [T]; 2]>,
    pub s: &'a [T::Total],
    /// M2.
    pub m: &'a [f64],
    pub n: &'a [f64],
}

impl<'a, T: Centre> Spreads<'a, T> {
    #[inline(always)]
    fn part(&self, from: usize, to: usize) -> Self {
        let Spreads { v, ends, s, m, n } = *self;
        let ends = ends.map(|ends| ends.map(|e| &e[from..to]));
        Spreads { v: &v[from..to], ends, s: &s[from..to], m: &m[from..to], n: &n[from..to] }
    }

    /// Least and greatest of window `i`, if they are there.
    fn ends(&self, i: usize) -> Option<[f64; 2]> {
        self.ends.map(|ends| ends.map(|e| e[i].to_f64()))
    }

    fn is_constant(&self, i: usize) -> bool {
        self.ends(i).map_or(self.m[i] == 0.0, |[lo, hi]| lo == hi)
    }

    /// Whether f64 holds no numerator of window `i`, which is not constant: it holds an infinity, or the numerator vanished.
    fn is_wild(&self, i: usize) -> bool {
        let (q, v) = (self.n[i] * self.m[i], self.v[i].to_f64());
        !(is_normal(q) | self.is_constant(i) | v.is_nan())
    }
}

/// Positive, and neither subnormal nor infinite nor NaN.
#[inline(always)]
fn is_normal(q: f64) -> bool {
    let (least, infinite) = (f64::MIN_POSITIVE.to_bits(), f64::INFINITY.to_bits());
    q.to_bits().wrapping_sub(least) < infinite - least // patterns of bits are ordered as numbers are
}

crate::on_singles! {
    fn spread_at[T: Centre, const KIND: usize](row: &Spreads<T>, polarity: Polarity, out: &mut [f32], wild: &mut bool) =
        spread_inner[T, KIND];
}

/// A 3.3 and E 3.4 for a row.
pub fn spread_row<T: Centre>(level: Level, kind: Spread, row: &Spreads<T>, polarity: Polarity, out: &mut [f32]) {
    let len = out.len();
    if len < SINGLES {
        // As the first values of a row of a block.
        if len > 0 {
            let ends = row.ends.map(|ends| ends.map(|e| padded(e, len)));
            let ends = ends.as_ref().map(|[lo, hi]| [&lo[..], &hi[..]]);
            let (v, s, m, n) = (padded(row.v, len), padded(row.s, len), padded(row.m, len), padded(row.n, len));
            let mut all = [0.0; SINGLES];
            spread_row(level, kind, &Spreads { v: &v, ends, s: &s, m: &m, n: &n }, polarity, &mut all);
            out.copy_from_slice(&all[..len]);
        }
        return;
    }
    let mut wild = false;
    match kind {
        Spread::Gaussian => spread_at::<T, GAUSSIAN>(level, row, polarity, out, &mut wild),
        Spread::Chebyshev => spread_at::<T, CHEBYSHEV>(level, row, polarity, out, &mut wild),
        Spread::Literal => spread_at::<T, LITERAL>(level, row, polarity, out, &mut wild),
    }
    if wild {
        for i in (0..len).filter(|i| row.is_wild(*i)) {
            out[i] = wild_window(kind, row, i, polarity);
        }
    }
}

#[inline(always)]
fn spread_inner<L: F32x32, T: Centre, const KIND: usize>(
    row: &Spreads<T>,
    polarity: Polarity,
    out: &mut [f32],
    wild: &mut bool,
) {
    let [mut deviations, mut numerators] = [const { Strip([0.0; STRIP]) }; 2];
    let mut from = 0;
    loop {
        let to = out.len().min(from + STRIP);
        let (part, len) = (row.part(from, to), to - from);
        let (d, m) = (&mut deviations.0[..len], &mut numerators.0[..len]);
        let sign = if polarity.flipped { 1.0 } else { -1.0 };
        *wild |= match part.ends {
            Some(ends) => standard::<T, true>(&part, ends, sign, d, m),
            None => standard::<T, false>(&part, [&[]; 2], sign, d, m),
        };
        spread_strip::<L, KIND>(d, m, polarity.constant, &mut out[from..to]);
        if to == out.len() {
            break;
        }
        // A last strip of less than a block starts earlier, and makes some values again.
        from = to.min(out.len() - SINGLES);
    }
}

/// `n (v - mean)` and `n M2` of windows, brought to a numerator in 2..8 by a power of two, which changes no rounding, so that f32
/// holds both of any magnitude; of constant ones, as `ends` or M2 says, 0. Whether others are wild.
#[inline(always)]
#[allow(clippy::eq_op)]
fn standard<T: Centre, const ENDS: bool>(
    row: &Spreads<T>,
    [lo, hi]: [&[T]; 2],
    sign: f64,
    deviations: &mut [f32],
    numerators: &mut [f32],
) -> bool {
    let len = deviations.len();
    let (v, s, m, n) = (&row.v[..len], &row.s[..len], &row.m[..len], &row.n[..len]);
    let (lo, hi) = if ENDS { (&lo[..len], &hi[..len]) } else { (lo, hi) };
    let numerators = &mut numerators[..len];
    let mut wild = 0u64;
    for i in 0..len {
        let (v, q) = (v[i].to_f64(), n[i] * m[i]);
        let flat = if ENDS { lo[i] == hi[i] } else { m[i] == 0.0 };
        wild |= !(is_normal(q) | flat | (v != v)) as u64;
        // 2^(512 - e/2) for the exponent field e of q, rounded down.
        let scale = f64::from_bits((1535 - (q.to_bits() >> 53)) << 52);
        deviations[i] = (sign * s[i].less(n[i], v) * scale) as f32;
        numerators[i] = if flat { 0.0 } else { (q * scale * scale) as f32 };
    }
    wild != 0
}

/// The formulas in f64, for window `i`.
fn wild_window<T: Centre>(kind: Spread, row: &Spreads<T>, i: usize, polarity: Polarity) -> f32 {
    let v = row.v[i].to_f64();
    if let Some([lo, hi]) = row.ends(i).filter(|ends| ends.iter().any(|e| e.is_infinite())) {
        // Beyond the mean by as much as the spread: the limit hangs on how many infinities there are.
        let limits = match kind {
            Spread::Gaussian => [f32::NAN; 2],
            Spread::Chebyshev => [f32::NAN, 0.0],
            Spread::Literal => [f32::NAN, 1.0],
        };
        return infinite(v, lo, hi, polarity.flipped, limits);
    }
    let d = if polarity.flipped { 1.0 } else { -1.0 } * row.s[i].less(row.n[i], v);
    // A spread that vanished leaves only the sign.
    let z = (d / (row.n[i] * row.m[i]).max(f64::MIN_POSITIVE).sqrt()) as f32;
    let share = 1.0 / z.mul_add(z, 1.0);
    match kind {
        Spread::Gaussian => math::phi(z),
        Spread::Chebyshev => {
            if z <= 0.0 {
                0.0
            } else {
                1.0 - share
            }
        }
        Spread::Literal => {
            if z <= 0.0 {
                1.0
            } else {
                share
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::window::merge::Pair;

    /// Centres at every distance from the mean of windows of 1000 voxels that lie `spread` about it.
    fn check<T: Centre>(of: impl Fn(f64) -> T, sum: impl Fn(f64) -> T::Total, spread: f64, kind: Spread) -> f64 {
        let n = 1000.0;
        let mut worst = 0f64;
        for len in [1, 31, 32, 33, 300, 700] {
            let v: Vec<T> = (0..len).map(|i| of(spread * ((i * i * 97 % 4001) as f64 / 500.0 - 4.0))).collect();
            let (s, n, m) =
                (vec![sum(n * of(0.125 * spread).to_f64()); len], vec![n; len], vec![n * spread * spread; len]);
            let (lo, hi) = (vec![of(-9.0 * spread); len], vec![of(9.0 * spread); len]);
            for (flipped, ends) in [(false, None), (true, None), (false, Some([&lo[..], &hi[..]]))] {
                let row = Spreads { v: &v, ends, s: &s, m: &m, n: &n };
                let mut first = None;
                for level in Level::available() {
                    let mut out = vec![f32::NAN; len];
                    spread_row(level, kind, &row, Polarity { flipped, constant: 0.5 }, &mut out);
                    for (o, v) in out.iter().zip(&v) {
                        let z = (v.to_f64() - of(0.125 * spread).to_f64()) / spread * if flipped { -1.0 } else { 1.0 };
                        let expected = match kind {
                            Spread::Gaussian => math::phi(z as f32) as f64,
                            Spread::Chebyshev => z.max(0.0).powi(2) / (1.0 + z * z),
                            Spread::Literal => {
                                if z > 0.0 {
                                    1.0 / (1.0 + z * z)
                                } else {
                                    1.0
                                }
                            }
                        };
                        worst = worst.max((*o as f64 - expected).abs());
                    }
                    let bits: Vec<u32> = out.iter().map(|o| o.to_bits()).collect();
                    assert_eq!(&bits, first.get_or_insert(bits.clone()), "{level:?}");
                }
            }
        }
        worst
    }

    #[test]
    fn openness_is_within_1e6_whatever_the_magnitude() {
        for kind in [Spread::Gaussian, Spread::Chebyshev, Spread::Literal] {
            for spread in [1.0, 3e4, 1e-30, 1e30] {
                let worst = check(|v| v as f32, |s| s, spread, kind);
                assert!(worst < 1e-6, "f32, {kind:?} {spread}: {worst}");
            }
            for spread in [1.0, 1e-140, 1e140] {
                let worst = check(|v| v, |s| Pair::of(s, 0.0), spread, kind);
                assert!(worst < 1e-6, "f64, {kind:?} {spread}: {worst}");
            }
        }
    }

    /// One window of n = 8 among 40 that are ordinary: v, least, greatest, sum, M2 and what becomes of it.
    #[test]
    fn constants_infinities_and_what_vanished_are_exact() {
        let inf = f64::INFINITY;
        for (v, lo, hi, s, m, expected) in [
            (3.0, 3.0, 3.0, 24.0, 0.0, 0.25),
            (inf, inf, inf, inf, f64::NAN, 0.25),
            (inf, 0.0, inf, inf, f64::NAN, 1.0),
            (-inf, -inf, 0.0, -inf, f64::NAN, 0.0),
            (2.0, 1.0, inf, inf, f64::NAN, 0.0),
            (1e-150, 0.0, 1e-150, 1e-150, 0.0, 1.0),
            (0.0, 0.0, 1e-150, 1e-150, 0.0, 0.0),
        ] {
            for at in [0, 7, 39] {
                let row =
                    |one: f64, others: f64| (0..40).map(|i| if i == at { one } else { others }).collect::<Vec<f64>>();
                let (v, lo, hi, m, n) = (row(v, 1.0), row(lo, 0.0), row(hi, 2.0), row(m, 8.0), vec![8.0; 40]);
                let s: Vec<Pair> = row(s, 8.0).into_iter().map(|s| Pair::of(s, 0.0)).collect();
                let windows = Spreads { v: &v, ends: Some([&lo, &hi]), s: &s, m: &m, n: &n };
                for level in Level::available() {
                    let mut out = vec![f32::NAN; 40];
                    let polarity = Polarity { flipped: false, constant: 0.25 };
                    spread_row(level, Spread::Chebyshev, &windows, polarity, &mut out);
                    assert_eq!((out[at], out[20]), (expected, 0.0), "{level:?} {:?}", (v[at], lo[at], hi[at]));
                }
            }
        }
    }
}
