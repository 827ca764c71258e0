//! Gradients on the device: weighted sums there, scaled and rounded here; windows that it marked, by the CPU kernel.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::passes::Part;
use super::slopes::{Fit, MARKED, SlopesJob};
use super::windows::{cast, pack};
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, AnyView, AnyViewMut, DType};
use crate::kernel::Context;
use crate::kernel::gradient::{self, GradientOut};
use crate::kernel::simd::Level;

impl Gpu {
    /// As [`gradient::gradient`], within [`facts::tolerance::GRADIENT`], for inputs that [`facts::gradient`] admits. What
    /// does not fit the device, and windows with missing voxels or values at the ends of f32, are computed by the CPU kernel.
    /// After a failure the device is opened anew and the call tried once more.
    ///
    /// Panics where [`gradient::gradient`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn gradient(
        &self,
        src: AnyView,
        fit: &Fit,
        affine: Affine,
        at: [usize; 3],
        mut out: GradientOut,
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        facts::gradient(src.dtype(), false).map_err(|e| GpuError(e.into()))?;
        let Some(dst) = out.magnitude.iter().chain(out.vector.iter().flatten()).map(AnyViewMut::shape).next() else {
            return Ok(Times::default());
        };
        if dst.contains(&0) {
            return Ok(Times::default());
        }
        let job = SlopesJob::new(src.dtype(), src.shape(), dst, at, fit, out.vector.is_some());
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap())?))) else {
            gradient::gradient(src, fit.size, fit.weight, fit.spacing, affine, fit.missing, at, out, cx);
            return Ok(Times::default());
        };
        let half = fit.size / 2;
        let inside = (0..3).all(|a| at[a] >= half && at[a] + dst[a] + half <= src.shape()[a]);
        assert!(inside, "a window sticks out of the source");
        let level = cx.level;
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let recording = job.record(part);
                let mut fill = |to: &mut wgpu::WriteOnly<[u8]>| pack(src, part, job.pitch(part) * job.voxel, to);
                let mut done = |bytes: Option<&[u8]>| {
                    let rows = Rows { job: &job, part, sums: cast(bytes.unwrap_or_default())? };
                    Finish { rows, src, fit, affine, level }.write(&mut out, cx.scratch);
                    Ok(())
                };
                run_part(device, &recording, &mut fill, &mut done, &mut times)?;
            }
            Ok(times)
        })
    }
}

/// From a part's sums to results.
struct Finish<'a> {
    rows: Rows<'a>,
    src: AnyView<'a>,
    fit: &'a Fit,
    affine: Affine,
    level: Level,
}

/// What the device made of a part.
pub(super) struct Rows<'a> {
    pub job: &'a SlopesJob,
    pub part: &'a Part,
    /// Bits of f32: magnitudes, or one plane per component.
    pub sums: &'a [u32],
}

impl Rows<'_> {
    /// Row `[z, y]` of component `c`, or of the magnitudes.
    fn row(&self, c: usize, [z, y]: [usize; 2]) -> &[u32] {
        let [nz, ny, nx] = self.part.dst;
        // Planes come back from multiples of 256 bytes on.
        let plane = (nz * ny * nx).next_multiple_of(64);
        &self.sums[c * plane + (z * ny + y) * nx..][..nx]
    }

    /// Scales and stores; what is marked is rubbish.
    pub fn write(&self, slope: f64, out: &mut GradientOut) {
        let ([nz, ny, nx], lo) = (self.part.dst, self.part.lo);
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let to = [lo[0] + z, lo[1] + y, lo[2]];
            if self.job.vector {
                let rows = [0, 1, 2].map(|c| self.row(c, [z, y]));
                // + 0.0 makes a zero positive whatever the slope, as the CPU does
                let part = |c: usize, i: usize| f32::from_bits(rows[c][i]) as f64 * (self.job.scale[c] * slope) + 0.0;
                for (c, dst) in out.vector.iter_mut().flatten().enumerate() {
                    put(dst, to, nx, |i| part(c, i));
                }
                if let Some(dst) = &mut out.magnitude {
                    put(dst, to, nx, |i| (0..3).map(|c| part(c, i)).map(|g| g * g).sum::<f64>().sqrt());
                }
            } else if let Some(dst) = &mut out.magnitude {
                let (row, scale) = (self.row(0, [z, y]), self.job.scale[0] * slope.abs());
                put(dst, to, nx, |i| f32::from_bits(row[i]) as f64 * scale);
            }
        }
    }
}

impl Finish<'_> {
    fn write(&self, out: &mut GradientOut, scratch: &mut Scratch) {
        self.rows.write(self.affine.slope, out);
        let ([nz, ny, _], lo) = (self.rows.part.dst, self.rows.part.lo);
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let (row, to) = (self.rows.row(0, [z, y]), [lo[0] + z, lo[1] + y, lo[2]]);
            // Marks stand in all components.
            let mut x = 0;
            while let Some(first) = row[x..].iter().position(|&v| v == MARKED).map(|d| x + d) {
                let len = row[first..].iter().take_while(|&&v| v == MARKED).count();
                self.redo(out, [to[0], to[1], to[2] + first], len, scratch);
                x = first + len;
            }
        }
    }

    /// A run of voxels by the CPU kernel, which gives the same wherever a call starts.
    fn redo(&self, out: &mut GradientOut, to: [usize; 3], len: usize, scratch: &mut Scratch) {
        let (shape, at) = ([1, 1, len], std::array::from_fn(|a| self.rows.job.at[a] + to[a]));
        let mut made: [Voxels; 4] = std::array::from_fn(|_| Voxels::zeroed(DType::F32, len));
        let [m, z, y, x] = &mut made;
        let run = GradientOut {
            magnitude: Some(m.view_mut(shape)),
            vector: Some([z.view_mut(shape), y.view_mut(shape), x.view_mut(shape)]),
        };
        let (fit, mut cx) = (self.fit, Context { level: self.level, scratch });
        gradient::gradient(self.src, fit.size, fit.weight, fit.spacing, self.affine, fit.missing, at, run, &mut cx);
        let targets = out.magnitude.iter_mut().map(|m| (0, m));
        let targets = targets.chain(out.vector.iter_mut().flatten().enumerate().map(|(c, v)| (c + 1, v)));
        for (c, dst) in targets {
            put(dst, to, len, |i| made[c].at(i));
        }
    }
}

fn put(dst: &mut AnyViewMut, [z, y, x]: [usize; 3], n: usize, value: impl Fn(usize) -> f64) {
    match dst {
        AnyViewMut::F32(d) => {
            d.row_at(z, y)[x..x + n].iter_mut().enumerate().for_each(|(i, d)| *d = value(i) as f32);
        }
        other => panic!("a gradient of these voxels is not {}", other.dtype()),
    }
}
