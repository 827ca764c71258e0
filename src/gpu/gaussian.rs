//! Gaussian means and variances on the device: unscaled f32 there, results from them here.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::passes::Part;
use super::taps::{TapsJob, Wanted};
use super::windows::{cast, pack};
use crate::grid::{Affine, AnyView, AnyViewMut};
use crate::kernel::Context;
use crate::kernel::gaussian;
use crate::kernel::simd::Level;

impl Gpu {
    /// The mean of [`gaussian::gaussian`] bit for bit, and its variance within [`facts::tolerance::VARIANCE`], for inputs
    /// that [`facts::gaussian`] admits on an adapter with exact floats. What does not fit the device even one voxel at a time
    /// is computed by the CPU kernel. After a failure the device is opened anew and the call tried once more.
    ///
    /// Panics where [`gaussian::gaussian`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    #[allow(clippy::too_many_arguments)]
    pub fn gaussian(
        &self,
        src: AnyView,
        sigma: [f64; 3],
        affine: Affine,
        at: [usize; 3],
        mut mean: Option<AnyViewMut>,
        mut variance: Option<AnyViewMut>,
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        facts::gaussian(src.dtype(), false).map_err(|e| GpuError(e.into()))?;
        let shapes = [&mean, &variance].map(|o| o.as_ref().map(AnyViewMut::shape));
        let Some(dst) = shapes[0].or(shapes[1]) else { return Ok(Times::default()) };
        assert!(shapes.iter().flatten().all(|s| *s == dst), "extents differ");
        assert!((0..3).all(|a| at[a] + dst[a] <= src.shape()[a]), "the output box sticks out of the source");
        if dst.contains(&0) {
            return Ok(Times::default());
        }
        let wanted = Wanted { mean: mean.is_some(), variance: variance.is_some() };
        let job = TapsJob::new(src.dtype(), src.shape(), dst, at, sigma, wanted);
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap())?))) else {
            gaussian::gaussian(src, sigma, affine, None, at, mean, variance, cx);
            return Ok(Times::default());
        };
        let level = cx.level;
        let squared = Affine { slope: affine.slope * affine.slope, intercept: 0.0 };
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let recording = job.record(part);
                let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, part, job.pitch(part) * job.voxel, out);
                let mut done = |bytes: Option<&[u8]>| {
                    let bytes = bytes.unwrap_or_default();
                    if let Some(dst) = &mut mean {
                        finish(level, part, affine, cast(&bytes[job.place(part, false)])?, dst);
                    }
                    if let Some(dst) = &mut variance {
                        finish(level, part, squared, cast(&bytes[job.place(part, true)])?, dst);
                    }
                    Ok(())
                };
                run_part(device, &recording, &mut fill, &mut done, &mut times)?;
            }
            Ok(times)
        })
    }
}

fn finish(level: Level, part: &Part, affine: Affine, values: &[f32], dst: &mut AnyViewMut) {
    let [nz, ny, nx] = part.dst;
    for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
        let row = &values[(z * ny + y) * nx..][..nx];
        gaussian::shared::finish(level, row, affine, dst, [part.lo[0] + z, part.lo[1] + y, part.lo[2]]);
    }
}
