//! Box statistics and estimators on the device: exact sums and extremes, or moments of f32, and the results that they give.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::float_windows;
use super::passes::{Job, Part};
use crate::grid::{AnyView, DType, View, Voxel};
use crate::kernel::Context;
use crate::kernel::window::{self, Needs, Place, WindowOut};
use crate::stage::{WindowChannel, WindowParams};

impl Gpu {
    /// The same as [`window::window`] for inputs that [`facts::window`] admits: statistics of integers bit for bit, openness
    /// and windows of f32 within [`facts::tolerance`], the latter on an adapter with exact floats. `voxel` is the first output
    /// voxel's place in the volume. Windows too large for the device even one voxel at a time ([`Job::fits`]), and openness
    /// that is asked for as codes, are made by the CPU kernel. After a failure the device is opened anew and the call tried
    /// once more.
    ///
    /// Panics where [`window::window`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn window(
        &self,
        src: AnyView,
        params: &WindowParams,
        at: [usize; 3],
        voxel: [i64; 3],
        outs: &mut [WindowOut],
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        let channels: Vec<_> = outs.iter().map(|o| o.channel).collect();
        let missing = params.missing.is_some() && !src.dtype().is_float();
        facts::window(src.dtype(), missing, &channels).map_err(|e| GpuError(e.into()))?;
        let Some(dst) = outs.first().map(|o| o.dst.shape()) else { return Ok(Times::default()) };
        assert!((0..3).all(|a| at[a] + dst[a] <= src.shape()[a]), "output {dst:?} at {at:?} sticks out");
        if dst.contains(&0) {
            return Ok(Times::default());
        }
        let needs = Needs::of(channels.iter().copied(), src.dtype().is_float());
        let real = src.dtype() == DType::F32;
        // The shaders write f32, in which extremes of small integers have room.
        let coded = |o: &WindowOut| matches!(o.channel, WindowChannel::Openness(..)) && o.dst.dtype() == DType::U8;
        let job = Job::new(src.dtype(), src.shape(), dst, at, params.radius, needs).map(|j| {
            let made = if real && outs.iter().any(coded) { j } else { j.finished(params, &channels) };
            made.placed(voxel)
        });
        let job = job.filter(|j| real || j.finish.is_some() && !outs.iter().any(coded));
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap())?))) else {
            window::window(src, params, Place::new(at, voxel), outs, cx);
            return Ok(Times::default());
        };
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let recording = job.record(part);
                let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, part, job.pitch(part) * job.voxel, out);
                let mut done = |bytes: Option<&[u8]>| {
                    let bytes = bytes.unwrap_or_default();
                    if let AnyView::F32(v) = src {
                        return float_windows::finish(&job, part, bytes, v, params, outs, cx);
                    }
                    float_windows::store_all(cast(bytes)?, part, outs);
                    Ok(())
                };
                run_part(device, &recording, &mut fill, &mut done, &mut times)?;
            }
            Ok(times)
        })
    }
}

/// Writes the voxels that a part sees, in rows of `pitch` bytes; true: there is always work.
pub(super) fn pack(src: AnyView, part: &Part, pitch: usize, out: &mut wgpu::WriteOnly<[u8]>) -> bool {
    fn write<T: Voxel + bytemuck::Pod>(v: View<T>, part: &Part, pitch: usize, out: &mut wgpu::WriteOnly<[u8]>) {
        let v = v.part(part.from, part.src);
        for z in 0..part.src[0] {
            for y in 0..part.src[1] {
                let bytes: &[u8] = bytemuck::cast_slice(v.row_at(z, y));
                let from = (z * part.src[1] + y) * pitch;
                // Nothing that is kept is made of the padding at the end of a row.
                out.slice(from..from + bytes.len()).copy_from_slice(bytes);
            }
        }
    }
    match src {
        AnyView::U8(v) => write(v, part, pitch, out),
        AnyView::I8(v) => write(v, part, pitch, out),
        AnyView::U16(v) => write(v, part, pitch, out),
        AnyView::I16(v) => write(v, part, pitch, out),
        AnyView::F32(v) => write(v, part, pitch, out),
        other => unreachable!("no job is made of {}", other.dtype()),
    }
    true
}

/// Mapped bytes as what the device wrote.
pub(super) fn cast<T: bytemuck::Pod>(bytes: &[u8]) -> Result<&[T], GpuError> {
    bytemuck::try_cast_slice(bytes).map_err(|e| GpuError(format!("results are not aligned: {e}")))
}
