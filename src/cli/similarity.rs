//! Structural similarity of streamed volumes, on all cores.

use rayon::prelude::*;

use crate::kernel::simd::Level;
use crate::kernel::ssim::{self, Params, WINDOW};

/// Rows whose windows a thread makes at a time, which it filters with ten more.
const BAND: usize = 64;

/// Mean structural similarity of two volumes whose planes are pushed in order; the last eleven of each are kept.
pub struct Ssim {
    /// Voxels per plane, `[y, x]`.
    plane: [usize; 2],
    /// Dynamic range.
    range: f64,
    /// Of both volumes: plane z at z mod 11.
    kept: [Vec<Vec<f64>>; 2],
    pushed: usize,
    /// The first finite voxel.
    params: Option<Params>,
    sum: f64,
    count: u64,
}

impl Ssim {
    /// For planes of `[y, x]` voxels and values of this dynamic range (1 for openness).
    pub fn new(plane: [usize; 2], range: f64) -> Ssim {
        Ssim { plane, range, kept: Default::default(), pushed: 0, params: None, sum: 0.0, count: 0 }
    }

    /// Adds the next plane of both volumes. Panics unless each has the plane's voxels.
    pub fn push_plane(&mut self, a: &[f64], b: &[f64]) {
        let [ny, nx] = self.plane;
        assert!(a.len() == ny * nx && b.len() == ny * nx, "a plane has {ny} x {nx} voxels");
        if ny < WINDOW || nx < WINDOW {
            return;
        }
        let range = self.range;
        let finite = || a.iter().copied().find(|v| v.is_finite()).unwrap_or(0.0);
        let params = *self.params.get_or_insert_with(|| Params::new(range, finite()));
        for (kept, plane) in self.kept.iter_mut().zip([a, b]) {
            match kept.get_mut(self.pushed % WINDOW) {
                Some(oldest) => oldest.copy_from_slice(plane),
                None => kept.push(plane.to_vec()),
            }
        }
        self.pushed += 1;
        if self.pushed >= WINDOW {
            self.windows(&params);
        }
    }

    /// Adds the windows that end at the last plane, band by band in order, so that the sum does not depend on the threads.
    fn windows(&mut self, params: &Params) {
        let [ny, nx] = self.plane;
        let level = Level::detect();
        let one = |scratch: &mut Vec<f64>, y: usize| {
            let rows = y * nx..(y + BAND + WINDOW - 1).min(ny) * nx;
            let oldest_first: [usize; WINDOW] = std::array::from_fn(|k| (self.pushed + k) % WINDOW);
            let [a, b] = [&self.kept[0], &self.kept[1]].map(|kept| oldest_first.map(|k| &kept[k][rows.clone()]));
            ssim::band(level, params, a, b, nx, scratch)
        };
        let bands: Vec<usize> = (0..ny - WINDOW + 1).step_by(BAND).collect();
        let scratch = || vec![0.0; ssim::scratch_values(nx)];
        let sums: Vec<(f64, u64)> = bands.into_par_iter().map_init(scratch, one).collect();
        for (sum, count) in sums {
            self.sum += sum;
            self.count += count;
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

    /// Bands cut rows of windows, not windows.
    #[test]
    fn bands_hold_every_window_once() {
        let [nz, ny, nx] = [13, 150, 12];
        let a: Vec<f64> = (0..nz * ny * nx).map(|i| f64::from((i * 37 % 101) as u8) / 100.0).collect();
        let b: Vec<f64> = a.iter().map(|v| v * 0.9 + 0.05).collect();
        let mut ssim = Ssim::new([ny, nx], 1.0);
        a.chunks(ny * nx).zip(b.chunks(ny * nx)).for_each(|(a, b)| ssim.push_plane(a, b));
        let (mean, count) = ssim.finish();
        assert_eq!(count, 3 * 140 * 2);
        let params = Params::new(1.0, a[0]);
        let mut scratch = vec![0.0; ssim::scratch_values(nx)];
        let mut sum = 0.0;
        for z in 0..3 {
            let at: [usize; WINDOW] = std::array::from_fn(|k| (z + k) * ny * nx);
            let (a, b) = (at.map(|s| &a[s..s + ny * nx]), at.map(|s| &b[s..s + ny * nx]));
            sum += ssim::band(Level::Baseline, &params, a, b, nx, &mut scratch).0;
        }
        assert!((mean - sum / count as f64).abs() < 1e-12);
        assert!(Ssim::new([10, 11], 1.0).finish().0.is_nan());
    }
}
