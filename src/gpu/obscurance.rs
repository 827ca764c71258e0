//! Obscurance on the device: integer sums of contributions there, openness from them here.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::sweep::{SweepJob, SweepPart};
use crate::grid::{AnyView, AnyViewMut, Region, ViewMut};
use crate::kernel::Context;
use crate::kernel::obscurance::{ObscuranceIo, Prepared};

impl Gpu {
    /// The openness of [`Prepared::sweep`], bit for bit, for inputs that [`facts::obscurance`] admits. Boxes that the device
    /// cannot hold, or only in parts that would read their halos too often, are computed by the CPU kernel. After a failure
    /// the device is opened anew and the call tried once more.
    ///
    /// Panics where [`Prepared::sweep`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn obscurance(
        &self,
        sweep: &Prepared,
        src: AnyView,
        src_box: Region,
        dst_box: Region,
        openness: &mut ViewMut<f32>,
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        facts::obscurance(src.dtype(), true).map_err(|e| GpuError(e.into()))?;
        assert_eq!(src.shape(), src_box.shape(), "src must cover its box");
        assert!(src_box.contains(&dst_box), "{src_box:?} must contain {dst_box:?}");
        if dst_box.is_empty() {
            return Ok(Times::default());
        }
        let job = SweepJob::new(sweep, src.dtype(), src_box, dst_box);
        let Some((job, parts)) = job.and_then(|j| j.parts(self.cap()).ok().map(|p| (j, p))) else {
            let openness = Some(AnyViewMut::F32(openness.reborrow()));
            sweep.sweep(
                src,
                src_box,
                dst_box,
                ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None },
                cx,
            );
            return Ok(Times::default());
        };
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let recording = job.record(part, self.cap());
                let mut row = vec![0; part.src.shape()[2] * job.code];
                let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(&job, part, src, &mut row, out);
                let mut done = |bytes: Option<&[u8]>| finish(&job, part, src, bytes, openness);
                run_part(device, &recording, &mut fill, &mut done, &mut times)?;
            }
            Ok(times)
        })
    }
}

/// Writes the codes of a part, rows padded to whole words; false where no code is greater than another.
fn pack(job: &SweepJob, part: &SweepPart, src: AnyView, row: &mut [u8], out: &mut wgpu::WriteOnly<[u8]>) -> bool {
    let [nz, ny, _] = part.src.shape();
    let (from, pitch) = (job.src.offset_of(&part.src), part.pitch(job.code) * job.code);
    let (mut least, mut most) = (u32::MAX, 0);
    for z in 0..nz {
        for y in 0..ny {
            let (lo, hi) = job.sweep.codes(src, [from[0] + z, from[1] + y, from[2]], row);
            (least, most) = (least.min(lo), most.max(hi));
            let start = (z * ny + y) * pitch;
            // The padding at the end of a row is never read by the shader.
            out.slice(start..start + row.len()).copy_from_slice(row);
        }
    }
    least < most
}

fn finish(
    job: &SweepJob,
    part: &SweepPart,
    src: AnyView,
    bytes: Option<&[u8]>,
    openness: &mut ViewMut<f32>,
) -> Result<(), GpuError> {
    let [nz, ny, nx] = part.dst.shape();
    let (at, to) = (job.src.offset_of(&part.dst), job.dst.offset_of(&part.dst));
    let open = vec![job.sweep.total(); nx];
    let sums: Option<&[u32]> = bytes
        .map(bytemuck::try_cast_slice)
        .transpose()
        .map_err(|e| GpuError(format!("results are not aligned: {e}")))?;
    for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
        let row = &mut openness.row_at(to[0] + z, to[1] + y)[to[2]..to[2] + nx];
        let sums = sums.map_or(&open[..], |s| &s[(z * ny + y) * nx..][..nx]);
        job.sweep.finish(sums, src, [at[0] + z, at[1] + y, at[2]], row);
    }
    Ok(())
}
