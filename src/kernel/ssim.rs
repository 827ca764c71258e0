//! Structural similarity of two volumes (Wang et al. 2004, in 3-D): 11^3 Gaussian window, sigma 1.5, streamed plane by plane.
//!
//! Only whole windows count. Variances are E[a^2] - E[a]^2 in f64, after the first finite voxel was subtracted from both
//! volumes: openness lies in [0, 1], where that leaves 1e-14. Eleven planes of filtered moments are kept.

/// Voxels of the window per axis.
pub const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
const K1: f64 = 0.01;
const K2: f64 = 0.03;
/// Filtered quantities: a, b, a^2, b^2, ab.
const MOMENTS: usize = 5;

/// Mean structural similarity of two volumes whose planes are pushed in order.
pub struct Ssim {
    /// Voxels per plane, `[y, x]`.
    plane: [usize; 2],
    weights: [f64; WINDOW],
    c1: f64,
    c2: f64,
    /// A ring of planes of filtered moments, moment after moment; NaN where a window holds a NaN.
    ring: Vec<f64>,
    /// One plane filtered along x.
    rows: Vec<f64>,
    pushed: usize,
    /// Subtracted from both volumes before squares are taken; similarity of luminance gets it back.
    pivot: Option<f64>,
    sum: f64,
    count: u64,
}

impl Ssim {
    /// For planes of `[y, x]` voxels and values of dynamic range `l` (1 for openness).
    pub fn new(plane: [usize; 2], l: f64) -> Ssim {
        let bell: [f64; WINDOW] = std::array::from_fn(|k| {
            let d = k as f64 - (WINDOW / 2) as f64;
            (-d * d / (2.0 * SIGMA * SIGMA)).exp()
        });
        let total: f64 = bell.iter().sum();
        let [ny, nx] = plane;
        let kept = if ny < WINDOW || nx < WINDOW { [0, 0] } else { [ny - WINDOW + 1, nx - WINDOW + 1] };
        Ssim {
            plane,
            weights: bell.map(|w| w / total),
            c1: (K1 * l) * (K1 * l),
            c2: (K2 * l) * (K2 * l),
            ring: vec![0.0; WINDOW * MOMENTS * kept[0] * kept[1]],
            rows: vec![0.0; MOMENTS * ny * kept[1]],
            pushed: 0,
            pivot: None,
            sum: 0.0,
            count: 0,
        }
    }

    /// Adds the next plane of both volumes. Panics unless each has the plane's voxels.
    pub fn push_plane(&mut self, a: &[f64], b: &[f64]) {
        let [ny, nx] = self.plane;
        assert!(a.len() == ny * nx && b.len() == ny * nx, "a plane has {ny} x {nx} voxels");
        let slot = self.pushed % WINDOW;
        self.pushed += 1;
        if self.ring.is_empty() {
            return;
        }
        let pivot = *self.pivot.get_or_insert_with(|| a.iter().copied().find(|v| v.is_finite()).unwrap_or(0.0));
        let mx = nx - WINDOW + 1;
        for y in 0..ny {
            let (a, b) = (&a[y * nx..][..nx], &b[y * nx..][..nx]);
            for moment in 0..MOMENTS {
                let out = &mut self.rows[(moment * ny + y) * mx..][..mx];
                out.fill(0.0);
                for (k, w) in self.weights.iter().enumerate() {
                    let (a, b) = (&a[k..k + mx], &b[k..k + mx]);
                    for i in 0..mx {
                        let (a, b) = (a[i] - pivot, b[i] - pivot);
                        // a NaN in either volume leaves the window out: it reaches every moment through the first two
                        out[i] += w * [a, b, a * a, b * b, a * b][moment];
                    }
                }
            }
        }
        self.along_y(slot);
        if self.pushed >= WINDOW {
            self.windows();
        }
    }

    /// Filters the plane in `rows` along y into a slot of the ring.
    fn along_y(&mut self, slot: usize) {
        let [ny, nx] = self.plane;
        let (my, mx) = (ny - WINDOW + 1, nx - WINDOW + 1);
        for moment in 0..MOMENTS {
            for y in 0..my {
                let out = &mut self.ring[((slot * MOMENTS + moment) * my + y) * mx..][..mx];
                out.fill(0.0);
                for (k, w) in self.weights.iter().enumerate() {
                    let from = &self.rows[(moment * ny + y + k) * mx..][..mx];
                    out.iter_mut().zip(from).for_each(|(o, f)| *o += w * f);
                }
            }
        }
    }

    /// Adds the windows that end at the last plane.
    fn windows(&mut self) {
        let [my, mx] = self.plane.map(|n| n - WINDOW + 1);
        let plane = my * mx;
        let pivot = self.pivot.unwrap_or(0.0);
        for i in 0..plane {
            let mut m = [0.0; MOMENTS];
            for (k, w) in self.weights.iter().enumerate() {
                let slot = (self.pushed + k) % WINDOW; // the oldest plane first
                for (moment, m) in m.iter_mut().enumerate() {
                    *m += w * self.ring[(slot * MOMENTS + moment) * plane + i];
                }
            }
            let [a, b, aa, bb, ab] = m;
            let (va, vb, cov) = ((aa - a * a).max(0.0), (bb - b * b).max(0.0), ab - a * b);
            let (a, b) = (a + pivot, b + pivot);
            let s = (2.0 * a * b + self.c1) * (2.0 * cov + self.c2) / ((a * a + b * b + self.c1) * (va + vb + self.c2));
            if (m[0] + m[1]).is_finite() && s.is_finite() {
                self.sum += s;
                self.count += 1;
            }
        }
    }

    /// Mean over whole windows without NaN, and their number; NaN if there is none.
    pub fn finish(self) -> (f64, u64) {
        (if self.count == 0 { f64::NAN } else { self.sum / self.count as f64 }, self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hostile::Noise;

    fn run(a: &[f64], b: &[f64], [nz, ny, nx]: [usize; 3], l: f64) -> (f64, u64) {
        let mut ssim = Ssim::new([ny, nx], l);
        for z in 0..nz {
            let plane = z * ny * nx..(z + 1) * ny * nx;
            ssim.push_plane(&a[plane.clone()], &b[plane]);
        }
        ssim.finish()
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
        let shape = [14, 13, 25];
        let n = shape.iter().product::<usize>();
        let mut noise = Noise(3);
        let a: Vec<f64> = (0..n).map(|_| noise.unit()).collect();
        let mut b: Vec<f64> = a.iter().map(|a| 0.8 * a + 0.3 * noise.unit()).collect();
        for nan in [false, true] {
            if nan {
                b[5] = f64::NAN;
            }
            let (got, n) = run(&a, &b, shape, 1.0);
            let (expect, count) = reference(&a, &b, shape, 1.0);
            assert_eq!(n, count);
            assert!(n == 4 * 3 * 15 - u64::from(nan) * 6 && (got - expect).abs() < 1e-12, "{got} {expect}");
        }
    }

    #[test]
    fn equal_volumes_are_1_and_small_ones_nan() {
        let a: Vec<f64> = (0..11 * 11 * 12).map(|i| (i * 37 % 101) as f64).collect();
        let (same, n) = run(&a, &a, [11, 11, 12], 100.0);
        assert!((same - 1.0).abs() < 1e-12 && n == 2);
        assert!(run(&a[..11 * 11 * 10], &a[..11 * 11 * 10], [11, 11, 10], 1.0).0.is_nan());
        assert!(run(&a[..10 * 11 * 11], &a[..10 * 11 * 11], [10, 11, 11], 1.0).0.is_nan());
        let (flat, n) = run(&[0.0; 1331], &[1.0; 1331], [11; 3], 1.0);
        assert!((flat - 1e-4 / 1.0001).abs() < 1e-12 && n == 1);
    }
}
