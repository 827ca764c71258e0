//! Runs a flow on the device: packs the source, takes what comes back apart.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::flow::{Flow, FlowPart, Sink};
use super::levels::{EXCLUDED, Placed, Pyramid};
use super::passes::Part;
use super::stored::stored;
use super::windows::{cast, pack};
use crate::grid::{AnyView, AnyViewMut, Region, Shape, View, ViewMut, Voxel};

/// Where a sink's results go.
pub enum SinkOut<'a> {
    /// The channel, over the sink's box.
    Voxels(AnyViewMut<'a>),
    /// Every level over the brick in the output's type, and where they are asked for the numbers of the last one's cells, as
    /// [`crate::kernel::reduce::Cells::store`] has them.
    Levels(Vec<AnyViewMut<'a>>, &'a mut Vec<f64>),
}

/// Which voxels of a masked step's outputs are needed: 1 where one is.
#[derive(Clone, Copy)]
pub struct Needed<'a> {
    /// Which of the flow's steps.
    pub step: usize,
    pub view: View<'a, u8>,
    /// What the view covers: at least all that the step makes.
    pub region: Region,
}

impl Gpu {
    /// Makes all sinks of a flow: what the steps would make one by one ([`Gpu::window`] and its kind, the kernels of the CPU
    /// for levels and voxel by voxel), bit for bit. `src` covers `src_box`, which holds [`Flow::source`]; `needed` has a mask for
    /// every step with fills. `None` where they
    /// must be called one by one, because a window is left to the CPU or the device cannot hold all; the outputs may then
    /// hold anything. After a failure the device is opened anew and the call tried once more.
    ///
    /// # Errors
    /// A second failure of the device.
    pub fn flow(
        &self,
        flow: &Flow,
        src: AnyView,
        src_box: Region,
        needed: &[Needed],
        outs: &mut [SinkOut],
    ) -> Result<Option<Times>, GpuError> {
        assert_eq!(outs.len(), flow.sinks.len(), "an output for each sink");
        let Ok(parts) = flow.parts(self.cap()) else { return Ok(None) };
        let voxel = stored(flow.dtype).map_or(0, |s| s.voxel);
        room(flow, outs);
        self.attempt(|device| {
            let mut times = Times::default();
            for part in &parts {
                let shape = part.source.shape();
                let seen = Part { lo: [0; 3], dst: shape, from: src_box.offset_of(&part.source), src: shape };
                let mut fill = |to: &mut wgpu::WriteOnly<[u8]>| {
                    pack_masks(part, needed, to);
                    pack(src, &seen, part.pitch * voxel, to)
                };
                let mut left = false;
                let mut done = |bytes: Option<&[u8]>| {
                    let bytes = bytes.unwrap_or_default();
                    left = part.flag.is_some_and(|f| bytes[f as usize] != 0);
                    if left { Ok(()) } else { take(flow, part, bytes, outs) }
                };
                run_part(device, &part.recording, &mut fill, &mut done, &mut times)?;
                if left {
                    return Ok(None);
                }
            }
            Ok(Some(times))
        })
    }
}

/// The masks of a part to their places.
fn pack_masks(part: &FlowPart, needed: &[Needed], to: &mut wgpu::WriteOnly<[u8]>) {
    for mask in &part.masks {
        let given = needed.iter().find(|n| n.step == mask.step).expect("a mask for every step with fills");
        let shape = mask.region.shape();
        let seen = Part { lo: [0; 3], dst: shape, from: given.region.offset_of(&mask.region), src: shape };
        let from = mask.from as usize;
        pack(AnyView::U8(given.view), &seen, mask.pitch(), &mut to.slice(from..from + mask.bytes() as usize));
    }
}

/// Room for the numbers of cells, whose planes lie one after the other.
fn room(flow: &Flow, outs: &mut [SinkOut]) {
    for (sink, out) in flow.sinks.iter().zip(outs) {
        if let (SinkOut::Levels(_, cells), Some(p)) = (out, &sink.pyramid) {
            let count: usize = p.extent(p.halved.len(), sink.region.shape()).iter().product();
            cells.clear();
            cells.resize(if p.cells { count * planes(p) } else { 0 }, 0.0);
        }
    }
}

/// Planes of numbers of a cell: the value, the count, and of moments both spreads.
fn planes(pyramid: &Pyramid) -> usize {
    crate::kernel::reduce::planes(pyramid.reduce)
}

fn take(flow: &Flow, part: &FlowPart, bytes: &[u8], outs: &mut [SinkOut]) -> Result<(), GpuError> {
    let made = flow.sinks.iter().zip(&part.placed).zip(outs);
    for ((sink, placed), out) in made.filter_map(|((s, p), o)| Some(((s, p.as_ref()?), o))) {
        let (region, placed) = placed;
        let at = sink.region.offset_of(region);
        match (out, &sink.pyramid) {
            (SinkOut::Voxels(dst), _) => {
                let (from, shape) = placed.levels[0];
                let floats: &[f32] = cast(&bytes[from as usize..][..4 * shape.iter().product::<usize>()])?;
                paste_floats(floats, shape, at, dst);
            }
            (SinkOut::Levels(levels, cells), Some(pyramid)) => {
                let mut factor = [1; 3];
                for (k, ((from, shape), dst)) in placed.levels.iter().zip(levels).enumerate() {
                    if k > 0 {
                        let halved = pyramid.halved[k - 1];
                        factor = std::array::from_fn(|a| factor[a] << halved[a] as usize);
                    }
                    paste(&bytes[*from as usize..], *shape, std::array::from_fn(|a| at[a] / factor[a]), dst);
                }
                numbers(sink, pyramid, placed, bytes, std::array::from_fn(|a| at[a] / factor[a]), cells)?;
            }
            (SinkOut::Levels(..), None) => unreachable!("a sink without levels has voxels"),
        }
    }
    Ok(())
}

/// Rows of a box, densely packed, to their places.
pub(super) fn paste(bytes: &[u8], [nz, ny, nx]: Shape, at: [usize; 3], dst: &mut AnyViewMut) {
    let size = dst.dtype().size();
    crate::with_view!(AnyViewMut, dst, d => {
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let row = &mut d.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
            let to: &mut [u8] = bytemuck::cast_slice_mut(row);
            to.copy_from_slice(&bytes[(z * ny + y) * nx * size..][..nx * size]);
        }
    })
}

/// As [`paste`], cast to the type of the channel, whose values it holds.
pub(super) fn paste_floats(floats: &[f32], shape: Shape, at: [usize; 3], dst: &mut AnyViewMut) {
    fn rows<T: Voxel>(
        floats: &[f32],
        [nz, ny, nx]: Shape,
        at: [usize; 3],
        d: &mut ViewMut<T>,
        cast: impl Fn(f32) -> T,
    ) {
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let to = d.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx].iter_mut();
            to.zip(&floats[(z * ny + y) * nx..]).for_each(|(t, f)| *t = cast(*f));
        }
    }
    match dst {
        AnyViewMut::F32(_) => paste(bytemuck::cast_slice(floats), shape, at, dst),
        // Extremes of small integers, which f32 holds.
        AnyViewMut::U8(d) => rows(floats, shape, at, d, |f| f as u8),
        AnyViewMut::I8(d) => rows(floats, shape, at, d, |f| f as i8),
        AnyViewMut::U16(d) => rows(floats, shape, at, d, |f| f as u16),
        AnyViewMut::I16(d) => rows(floats, shape, at, d, |f| f as i16),
        other => crate::with_view!(AnyViewMut, other, d => rows(floats, shape, at, d, |f| Voxel::from_f64(f as f64))),
    }
}

/// Cells as plain numbers, plane by plane over the brick.
fn numbers(
    sink: &Sink,
    pyramid: &Pyramid,
    placed: &Placed,
    bytes: &[u8],
    at: [usize; 3],
    out: &mut [f64],
) -> Result<(), GpuError> {
    let Some((from, [nz, ny, nx])) = placed.cells else { return Ok(()) };
    let brick = pyramid.extent(pyramid.halved.len(), sink.region.shape());
    let (cell, count) = (pyramid.cell(), brick.iter().product::<usize>());
    let words: &[u32] = cast(&bytes[from as usize..][..4 * cell * nz * ny * nx])?;
    let pair = |c: &[u32], i: usize| f64::from_bits(c[i] as u64 | (c[i + 1] as u64) << 32);
    for (i, c) in words.chunks_exact(cell).enumerate() {
        let [z, y, x] = [i / (ny * nx) + at[0], i / nx % ny + at[1], i % nx + at[2]];
        let to = (z * brick[1] + y) * brick[2] + x;
        out[to] = pair(c, 0);
        // The sign says that the cell covers excluded voxels only.
        let covered = (c[2] & !EXCLUDED) as f64;
        out[count + to] = if c[2] & EXCLUDED != 0 { -covered } else { covered };
        if cell > 3 {
            out[2 * count + to] = pair(c, 3);
            out[3 * count + to] = pair(c, 5);
        }
    }
    Ok(())
}
