//! Gaussian means on the device: unscaled f32 means there, results from them here; and the probe that tells whether the
//! device's f32 arithmetic is the CPU's.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::passes::Part;
use super::taps::TapsJob;
use super::windows::pack;
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape};
use crate::kernel::Context;
use crate::kernel::gaussian;
use crate::kernel::simd::Level;

impl Gpu {
    /// The mean of [`gaussian::gaussian`], bit for bit, for inputs that [`facts::gaussian`] admits on an adapter with exact
    /// floats. What does not fit the device even one voxel at a time is computed by the CPU kernel. After a failure the
    /// device is opened anew and the call tried once more.
    ///
    /// Panics where [`gaussian::gaussian`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn gaussian(
        &self,
        src: AnyView,
        sigma: [f64; 3],
        affine: Affine,
        at: [usize; 3],
        mean: &mut AnyViewMut,
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        facts::gaussian(src.dtype(), false, false).map_err(|e| GpuError(e.into()))?;
        let dst = mean.shape();
        assert!((0..3).all(|a| at[a] + dst[a] <= src.shape()[a]), "the output box sticks out of the source");
        if dst.contains(&0) {
            return Ok(Times::default());
        }
        let job = TapsJob::new(src.dtype(), src.shape(), dst, at, sigma);
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap())?))) else {
            gaussian::gaussian(src, sigma, affine, None, at, Some(mean.reborrow()), None, cx);
            return Ok(Times::default());
        };
        let level = cx.level;
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let recording = job.record(part);
                let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, part, job.pitch(part) * job.voxel, out);
                let mut done = |bytes: Option<&[u8]>| finish(level, part, affine, bytes.unwrap_or_default(), mean);
                run_part(device, &recording, &mut fill, &mut done, &mut times)?;
            }
            Ok(times)
        })
    }

    /// Whether f32 arithmetic that shaders keep apart is the CPU's: the kernel itself, on noise on which a fused or
    /// otherwise rounded sum shows.
    pub(super) fn probe(&self) -> Result<bool, GpuError> {
        let volume = probe_volume();
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let (src, at) = (volume.view(PROBE), [0; 3]);
        let [mut cpu, mut gpu] = [0, 1].map(|_| Voxels::zeroed(DType::F32, volume.len()));
        let mean = Some(cpu.view_mut(PROBE));
        gaussian::gaussian(src, PROBE_SIGMA, Affine::IDENTITY, None, at, mean, None, &mut cx);
        self.gaussian(src, PROBE_SIGMA, Affine::IDENTITY, at, &mut gpu.view_mut(PROBE), &mut cx)?;
        Ok(cpu.as_bytes() == gpu.as_bytes())
    }
}

/// Extent and sigma of the probe.
const PROBE: Shape = [5, 8, 64];
const PROBE_SIGMA: [f64; 3] = [0.8, 1.3, 2.4];

fn probe_volume() -> Voxels {
    let mut volume = Voxels::zeroed(DType::I16, PROBE.iter().product());
    let mut state = 1u64;
    for byte in volume.as_bytes_mut() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        *byte = (state >> 56) as u8;
    }
    volume
}

fn finish(level: Level, part: &Part, affine: Affine, bytes: &[u8], mean: &mut AnyViewMut) -> Result<(), GpuError> {
    let sums: &[f32] =
        bytemuck::try_cast_slice(bytes).map_err(|e| GpuError(format!("results are not aligned: {e}")))?;
    let [nz, ny, nx] = part.dst;
    for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
        let row = &sums[(z * ny + y) * nx..][..nx];
        gaussian::shared::finish(level, row, affine, mean, [part.lo[0] + z, part.lo[1] + y, part.lo[2]]);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One row by the shader's formula, its products fused into the sums or not.
    fn row(values: &[f32], fused: bool) -> Vec<f32> {
        let (n, radius) = (values.len(), gaussian::shared::radius(PROBE_SIGMA, PROBE)[2]);
        let tap = |p: usize, k: isize| values.get(p.wrapping_add_signed(k)).copied().unwrap_or(values[p]);
        let one = |p: usize| {
            let c = values[p];
            let taps = gaussian::shared::weights(PROBE_SIGMA[2], radius, p, n).zip(1..);
            taps.fold(c, |sum, (w, k)| {
                let d = (tap(p, -k) + tap(p, k)) - (c + c);
                if fused { w.mul_add(d, sum) } else { sum + w * d }
            })
        };
        (0..n).map(one).collect()
    }

    #[test]
    fn the_probe_would_notice_a_compiler_that_fuses() {
        let volume = probe_volume();
        let values: Vec<f32> = (0..PROBE[2]).map(|i| volume.at(i) as f32).collect();
        let mut plain = vec![0.0f32; PROBE[2]];
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let shape = [1, 1, PROBE[2]];
        let mean = AnyViewMut::F32(crate::grid::ViewMut::dense(&mut plain, shape));
        let src = volume.view(PROBE);
        let AnyView::I16(src) = src else { unreachable!() };
        let src = AnyView::I16(src.part([0; 3], shape));
        gaussian::gaussian(src, PROBE_SIGMA, Affine::IDENTITY, None, [0; 3], Some(mean), None, &mut cx);
        assert_eq!(plain, row(&values, false), "the formula is the kernel's");
        assert_ne!(plain, row(&values, true), "fused sums must show");
    }
}
