//! Structural similarity of two volumes (Wang et al. 2004, in 3-D): 11^3 Gaussian window, sigma 1.5, over bands of rows.
//!
//! Only whole windows count. Variances are E[a^2] - E[a]^2 in f64, after a pivot was subtracted from both volumes: openness lies
//! in [0, 1], where that leaves 1e-14. Rows are filtered along z, of these the last eleven along y, and each of these along x, so that
//! all but the planes stays in the cache.

use crate::multiversion;

/// Voxels of the window per axis.
pub const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
const K1: f64 = 0.01;
const K2: f64 = 0.03;
/// Filtered quantities: a, b, a^2, b^2, ab.
const MOMENTS: usize = 5;
/// Sums that are kept in registers at a time.
const LANES: usize = 16;

/// What windows are weighted by, and what keeps similarity finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Params {
    weights: [f64; WINDOW],
    c1: f64,
    c2: f64,
    /// Subtracted from both volumes before squares are taken; similarity of luminance gets it back.
    pub pivot: f64,
}

impl Params {
    /// For values of dynamic range `l` (1 for openness).
    pub fn new(l: f64, pivot: f64) -> Params {
        let bell: [f64; WINDOW] = std::array::from_fn(|k| {
            let d = k as f64 - (WINDOW / 2) as f64;
            (-d * d / (2.0 * SIGMA * SIGMA)).exp()
        });
        let total: f64 = bell.iter().sum();
        Params { weights: bell.map(|w| w / total), c1: (K1 * l) * (K1 * l), c2: (K2 * l) * (K2 * l), pivot }
    }
}

/// Values of scratch of [`band`] for rows of `nx`: eleven rows filtered along z, one along y, one along x, its similarities.
pub fn scratch_values(nx: usize) -> usize {
    (WINDOW + 2) * MOMENTS * nx + nx
}

multiversion! {
    /// Sum of the similarities of the windows of eleven planes, oldest first, of which rows of `nx` voxels are given, and how
    /// many windows were without NaN. Rows and columns without a whole window give none.
    ///
    /// Panics unless all planes have as many whole rows and `scratch` has [`scratch_values`].
    pub fn band['a](
        p: &'a Params,
        a: [&'a [f64]; WINDOW],
        b: [&'a [f64]; WINDOW],
        nx: usize,
        scratch: &'a mut [f64],
    ) -> (f64, u64) = band_of;
}

#[inline(always)]
fn band_of(p: &Params, a: [&[f64]; WINDOW], b: [&[f64]; WINDOW], nx: usize, scratch: &mut [f64]) -> (f64, u64) {
    let ny = a[0].len() / nx.max(1);
    if ny < WINDOW || nx < WINDOW {
        return (0.0, 0);
    }
    let row = MOMENTS * nx;
    let (along_z, rest) = scratch[..scratch_values(nx)].split_at_mut(WINDOW * row);
    let (along_y, rest) = rest.split_at_mut(row);
    let (along_x, similar) = rest.split_at_mut(row);
    let (mut sum, mut count) = (0.0, 0);
    for y in 0..ny {
        filter_z(p, a, b, y * nx, &mut along_z[y % WINDOW * row..][..row]);
        if y + 1 < WINDOW {
            continue;
        }
        let mut rows: [&[f64]; WINDOW] = [&[]; WINDOW];
        for k in 0..WINDOW {
            rows[k] = &along_z[(y + 1 + k) % WINDOW * row..][..row]; // the oldest first
        }
        weighted(&p.weights, rows, along_y);
        let mx = nx - WINDOW + 1;
        for moment in 0..MOMENTS {
            let from = &along_y[moment * nx..][..nx];
            for k in 0..WINDOW {
                rows[k] = &from[k..k + mx];
            }
            weighted(&p.weights, rows, &mut along_x[moment * nx..][..mx]);
        }
        similarities(p, along_x, nx, &mut similar[..mx]);
        for s in &similar[..mx] {
            if s.is_finite() {
                sum += s;
                count += 1;
            }
        }
    }
    (sum, count)
}

/// Moments of a row filtered along z, one after the other; `at`: where it starts in the planes. NaN reaches all of them.
#[inline(always)]
fn filter_z(p: &Params, a: [&[f64]; WINDOW], b: [&[f64]; WINDOW], at: usize, out: &mut [f64]) {
    let nx = out.len() / MOMENTS;
    let mut x = 0;
    while x < nx {
        // The last ones once more, where they are fewer.
        let from = x.min(nx.saturating_sub(LANES));
        let n = LANES.min(nx - from);
        let mut sums = [[0.0; LANES]; MOMENTS];
        for k in 0..WINDOW {
            let w = p.weights[k];
            let (a, b) = (&a[k][at + from..][..n], &b[k][at + from..][..n]);
            let (mut va, mut vb) = ([0.0; LANES], [0.0; LANES]);
            va[..n].copy_from_slice(a);
            vb[..n].copy_from_slice(b);
            for i in 0..LANES {
                let (a, b) = (va[i] - p.pivot, vb[i] - p.pivot);
                sums[0][i] += w * a;
                sums[1][i] += w * b;
                sums[2][i] += w * (a * a);
                sums[3][i] += w * (b * b);
                sums[4][i] += w * (a * b);
            }
        }
        for moment in 0..MOMENTS {
            out[moment * nx + from..][..n].copy_from_slice(&sums[moment][..n]);
        }
        x = from + n;
    }
}

/// Sums of eleven rows by their weights.
#[inline(always)]
fn weighted(weights: &[f64; WINDOW], rows: [&[f64]; WINDOW], out: &mut [f64]) {
    let n = out.len();
    let mut i = 0;
    while i + LANES <= n {
        let mut sums = [0.0; LANES];
        for k in 0..WINDOW {
            let row = &rows[k][i..i + LANES];
            for j in 0..LANES {
                sums[j] += weights[k] * row[j];
            }
        }
        out[i..i + LANES].copy_from_slice(&sums);
        i += LANES;
    }
    for i in i..n {
        let mut sum = 0.0;
        for k in 0..WINDOW {
            sum += weights[k] * rows[k][i];
        }
        out[i] = sum;
    }
}

/// Of filtered moments, each from a multiple of `nx` on; NaN where a window holds one.
#[inline(always)]
fn similarities(p: &Params, m: &[f64], nx: usize, out: &mut [f64]) {
    let n = out.len();
    let (ma, mb) = (&m[..n], &m[nx..][..n]);
    let (aa, bb, ab) = (&m[2 * nx..][..n], &m[3 * nx..][..n], &m[4 * nx..][..n]);
    for i in 0..n {
        let (a, b) = (ma[i], mb[i]);
        let (va, vb, cov) = ((aa[i] - a * a).max(0.0), (bb[i] - b * b).max(0.0), ab[i] - a * b);
        // `max` drops a NaN, which the means keep.
        let (a, b) = (a + p.pivot, b + p.pivot);
        out[i] = (2.0 * a * b + p.c1) * (2.0 * cov + p.c2) / ((a * a + b * b + p.c1) * (va + vb + p.c2));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hostile::Noise;
    use crate::kernel::simd::Level;

    fn run(level: Level, a: &[f64], b: &[f64], [nz, ny, nx]: [usize; 3], l: f64) -> (f64, u64) {
        let pivot = a.iter().copied().find(|v| v.is_finite()).unwrap_or(0.0);
        let p = Params::new(l, pivot);
        let mut scratch = vec![f64::NAN; scratch_values(nx)];
        let (mut sum, mut count) = (0.0, 0);
        for z in 0..(nz + 1).saturating_sub(WINDOW) {
            let at: [usize; WINDOW] = std::array::from_fn(|k| (z + k) * ny * nx);
            let (a, b) = (at.map(|s| &a[s..s + ny * nx]), at.map(|s| &b[s..s + ny * nx]));
            let (s, n) = band(level, &p, a, b, nx, &mut scratch);
            sum += s;
            count += n;
        }
        (sum / count as f64, count)
    }

    /// Every window on its own, moments about its mean.
    fn reference(a: &[f64], b: &[f64], [nz, ny, nx]: [usize; 3], l: f64) -> (f64, u64) {
        let g = |d: usize| (-(d as f64 - 5.0).powi(2) / 4.5).exp();
        let (mut sum, mut count) = (0.0, 0);
        for (z, y, x) in (0..nz - 10).flat_map(|z| (0..ny - 10).flat_map(move |y| (0..nx - 10).map(move |x| (z, y, x))))
        {
            let mut taps = Vec::new();
            for (i, j, k) in (0..11).flat_map(|i| (0..11).flat_map(move |j| (0..11).map(move |k| (i, j, k)))) {
                let p = ((z + i) * ny + y + j) * nx + x + k;
                taps.push((g(i) * g(j) * g(k), a[p], b[p]));
            }
            let total: f64 = taps.iter().map(|t| t.0).sum();
            let e = |f: &dyn Fn(f64, f64) -> f64| taps.iter().map(|t| t.0 * f(t.1, t.2)).sum::<f64>() / total;
            let (ma, mb) = (e(&|a, _| a), e(&|_, b| b));
            let (va, vb, cov) =
                (e(&|a, _| (a - ma).powi(2)), e(&|_, b| (b - mb).powi(2)), e(&|a, b| (a - ma) * (b - mb)));
            let (c1, c2) = ((0.01 * l).powi(2), (0.03 * l).powi(2));
            let s = (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
            if !s.is_nan() {
                sum += s;
                count += 1;
            }
        }
        (sum / count as f64, count)
    }

    #[test]
    fn equals_every_window_on_its_own_and_leaves_nan_out() {
        for shape in [[14, 13, 25], [11, 12, 11], [12, 11, 44]] {
            let [nz, ny, nx] = shape;
            let n = shape.iter().product::<usize>();
            let mut noise = Noise(3);
            let a: Vec<f64> = (0..n).map(|_| noise.unit()).collect();
            let mut b: Vec<f64> = a.iter().map(|a| 0.8 * a + 0.3 * noise.unit()).collect();
            for nan in [false, true] {
                if nan {
                    b[5] = f64::NAN;
                }
                let (expect, count) = reference(&a, &b, shape, 1.0);
                for level in Level::available() {
                    let (got, n) = run(level, &a, &b, shape, 1.0);
                    assert_eq!(n, count);
                    let gone = if nan { (nx - 10).min(6) as u64 } else { 0 };
                    assert_eq!(n, ((nz - 10) * (ny - 10) * (nx - 10)) as u64 - gone);
                    assert!(n == 0 || (got - expect).abs() < 1e-12, "{shape:?} {level:?}: {got} {expect}");
                }
            }
        }
    }

    #[test]
    fn equal_volumes_are_1_and_small_ones_nan() {
        let a: Vec<f64> = (0..11 * 11 * 12).map(|i| (i * 37 % 101) as f64).collect();
        for level in Level::available() {
            let run = |a: &[f64], b: &[f64], shape, l| run(level, a, b, shape, l);
            let (same, n) = run(&a, &a, [11, 11, 12], 100.0);
            assert!((same - 1.0).abs() < 1e-12 && n == 2);
            assert!(run(&a[..11 * 11 * 10], &a[..11 * 11 * 10], [11, 11, 10], 1.0).0.is_nan());
            assert!(run(&a[..10 * 11 * 11], &a[..10 * 11 * 11], [11, 10, 11], 1.0).0.is_nan());
            let (flat, n) = run(&[0.0; 1331], &[1.0; 1331], [11; 3], 1.0);
            assert!((flat - 1e-4 / 1.0001).abs() < 1e-12 && n == 1);
        }
    }
}
