//! Gradients and windows of Gaussian means, which stay on the device.

use super::chain::{ChainJob, ChainPart, Extents, Reader};
use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::float_windows::store_all;
use super::gradient::Rows;
use super::slopes::{Fit, MARKED};
use super::windows::{cast, pack};
use crate::grid::{AnyView, DType};
use crate::kernel::gradient::GradientOut;
use crate::kernel::window::WindowOut;
use crate::stage::WindowParams;

impl Gpu {
    /// The gradient of a Gaussian mean of unscaled integers: the same as [`Gpu::gaussian`] and then [`Gpu::gradient`] of its
    /// results, bit for bit. `None` where the two must be called one by one, because means lie at the ends of f32 or the
    /// device cannot hold both; the outputs may then hold anything. After a failure the device is opened anew and the call
    /// tried once more.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn smoothed_gradient(
        &self,
        src: AnyView,
        extents: &Extents,
        sigma: [f64; 3],
        fit: &Fit,
        mut out: GradientOut,
    ) -> Result<Option<Times>, GpuError> {
        let job = ChainJob::gradient(src.dtype(), extents, sigma, fit, out.vector.is_some());
        self.chain(src, extents, job, |job, part, sums| {
            let Reader::Slopes(job) = &job.reader else { unreachable!("the chain is a gradient's") };
            Rows { job, part: &part.reader, sums }.write(1.0, &mut out);
        })
    }

    /// Windows of a Gaussian mean of unscaled integers, the first of which lies at `voxel` of the volume: as
    /// [`Gpu::smoothed_gradient`], with [`Gpu::window`].
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn smoothed_window(
        &self,
        src: AnyView,
        extents: &Extents,
        sigma: [f64; 3],
        params: &WindowParams,
        voxel: [i64; 3],
        outs: &mut [WindowOut],
    ) -> Result<Option<Times>, GpuError> {
        let channels: Vec<_> = outs.iter().map(|o| o.channel).collect();
        facts::window(DType::F32, false, &channels).map_err(|e| GpuError(e.into()))?;
        let job = ChainJob::windows(src.dtype(), extents, sigma, params, &channels, voxel);
        let job = job.filter(|_| outs.iter().all(|o| o.dst.dtype() == DType::F32));
        self.chain(src, extents, job, |_, part, results| store_all(results, &part.reader, outs))
    }

    fn chain(
        &self,
        src: AnyView,
        extents: &Extents,
        job: Option<ChainJob>,
        mut store: impl FnMut(&ChainJob, &ChainPart, &[u32]),
    ) -> Result<Option<Times>, GpuError> {
        facts::gaussian(src.dtype(), false).map_err(|e| GpuError(e.into()))?;
        assert_eq!(src.shape(), extents.src, "the source is as large as said");
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap())?))) else { return Ok(None) };
        self.attempt(|device| {
            let (mut times, mut marked) = (Times::default(), false);
            for part in &parts {
                let pitch = job.taps.pitch(&part.taps) * job.taps.voxel;
                let mut fill = |to: &mut wgpu::WriteOnly<[u8]>| pack(src, &part.taps, pitch, to);
                let mut done = |bytes: Option<&[u8]>| {
                    let results: &[u32] = cast(bytes.unwrap_or_default())?;
                    marked |= results.contains(&MARKED);
                    store(&job, part, results);
                    Ok(())
                };
                run_part(device, &job.record(part), &mut fill, &mut done, &mut times)?;
                if marked {
                    return Ok(None);
                }
            }
            Ok(Some(times))
        })
    }
}
