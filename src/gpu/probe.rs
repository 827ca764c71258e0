//! Holds a device to the f32 arithmetic that the shaders ask for, before anything is placed on it that needs it.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::pairs::{self, Arithmetic, Cell};
use super::passes::{self, Quantity, result_bytes};
use super::windows::{cast, pack};
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, AnyView, DType, Shape, View};
use crate::kernel::simd::Level;
use crate::kernel::{Context, gaussian};

impl Gpu {
    /// Whether f32 operations that shaders keep apart are rounded one by one, in their order: a Gaussian and moments of
    /// windows, on voxels on which a fused or reordered sum shows, against the same operations here.
    pub(super) fn probe(&self) -> Result<bool, GpuError> {
        Ok(self.probe_gaussian()? && self.probe_moments()?)
    }

    fn probe_gaussian(&self) -> Result<bool, GpuError> {
        let volume = volume();
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let (src, at) = (volume.view(EXTENT), [0; 3]);
        let [mut cpu, mut gpu] = [0, 1].map(|_| Voxels::zeroed(DType::F32, volume.len()));
        let mean = Some(cpu.view_mut(EXTENT));
        gaussian::gaussian(src, SIGMA, Affine::IDENTITY, None, at, mean, None, &mut cx);
        self.gaussian(src, SIGMA, Affine::IDENTITY, at, Some(gpu.view_mut(EXTENT)), None, &mut cx)?;
        Ok(cpu.as_bytes() == gpu.as_bytes())
    }

    fn probe_moments(&self) -> Result<bool, GpuError> {
        let (job, part) = pairs::probe_job();
        let voxels = pairs::probe_voxels();
        let src = AnyView::F32(View::dense(&voxels, pairs::PROBE));
        let expect = Arithmetic::Apart.moments(&job, &part, &voxels, true);
        let start = result_bytes(&part, Quantity::Order).next_multiple_of(256) as usize;
        let len = result_bytes(&part, Quantity::Moments { square: true }) as usize;
        let mut same = false;
        self.attempt(|device| {
            let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, &part, 4 * job.pitch(&part), out);
            let mut done = |bytes: Option<&[u8]>| {
                let words: &[u32] = cast(&bytes.unwrap_or_default()[start..start + len])?;
                let cells = words.chunks_exact(passes::cell(true)).map(Cell::from_words);
                same = cells.eq(expect.iter().copied());
                Ok(())
            };
            run_part(device, &job.record(&part), &mut fill, &mut done, &mut Times::default())
        })?;
        Ok(same)
    }
}

/// Extent and sigma of the Gaussian.
const EXTENT: Shape = [5, 8, 64];
const SIGMA: [f64; 3] = [0.8, 1.3, 2.4];

fn volume() -> Voxels {
    let mut volume = Voxels::zeroed(DType::I16, EXTENT.iter().product());
    let mut state = 1u64;
    for byte in volume.as_bytes_mut() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        *byte = (state >> 56) as u8;
    }
    volume
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{AnyViewMut, ViewMut};

    /// One row by the shader's formula, its products fused into the sums or not.
    fn row(values: &[f32], fused: bool) -> Vec<f32> {
        let (n, radius) = (values.len(), gaussian::shared::radius(SIGMA, EXTENT)[2]);
        let tap = |p: usize, k: isize| values.get(p.wrapping_add_signed(k)).copied().unwrap_or(values[p]);
        let one = |p: usize| {
            let c = values[p];
            let taps = gaussian::shared::weights(SIGMA[2], radius, p, n).zip(1..);
            taps.fold(c, |sum, (w, k)| {
                let d = (tap(p, -k) + tap(p, k)) - (c + c);
                if fused { w.mul_add(d, sum) } else { sum + w * d }
            })
        };
        (0..n).map(one).collect()
    }

    #[test]
    fn the_probe_would_notice_a_compiler_that_fuses() {
        let volume = volume();
        let values: Vec<f32> = (0..EXTENT[2]).map(|i| volume.at(i) as f32).collect();
        let mut plain = vec![0.0f32; EXTENT[2]];
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let shape = [1, 1, EXTENT[2]];
        let mean = AnyViewMut::F32(ViewMut::dense(&mut plain, shape));
        let src = volume.view(EXTENT);
        let AnyView::I16(src) = src else { unreachable!() };
        let src = AnyView::I16(src.part([0; 3], shape));
        gaussian::gaussian(src, SIGMA, Affine::IDENTITY, None, [0; 3], Some(mean), None, &mut cx);
        assert_eq!(plain, row(&values, false), "the formula is the kernel's");
        assert_ne!(plain, row(&values, true), "fused sums must show");
    }
}
