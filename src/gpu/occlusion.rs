//! Occlusion maps on the device: pooled moments there, scaled here.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts;
use super::flow_call;
use super::maps::{CELL, MapCodes, MapJob};
use super::passes::Part;
use super::windows::{cast, pack};
use crate::brick::Voxels;
use crate::grid::{Affine, AnyView, Region};
use crate::kernel::occlusion_map::Moments;

/// The levels of a map that a brick owns, as an output stores them.
#[derive(Debug)]
pub struct MapLevels {
    /// By level from 1 on and component; none of levels that are not stored.
    pub codes: Vec<Vec<Voxels>>,
    /// The last level, where its cells are kept.
    pub last: Option<Moments>,
}

impl Gpu {
    /// The levels from 1 on of an occlusion map over a brick, each over the cells that the brick owns, in an output's type: what
    /// [`crate::kernel::convert::convert`] makes, bit for bit, of levels that are those of
    /// [`crate::kernel::occlusion_map::coarsen`] within [`facts::tolerance`]. `src` covers `src_box`, which holds what
    /// [`MapJob::boxes`] of the brick reads; all boxes are counted from the start of the map. After a failure the device is
    /// opened anew and the call tried once more.
    ///
    /// # Errors
    /// An input without a kernel, a cell that does not fit the device, or a second failure of the device.
    pub fn occlusion_codes(
        &self,
        src: AnyView,
        src_box: Region,
        job: &MapJob,
        brick: Region,
        codes: &MapCodes,
    ) -> Result<MapLevels, GpuError> {
        facts::occlusion_map(src.dtype(), false).map_err(|e| GpuError(e.into()))?;
        let parts = job.parts(brick, self.cap()).ok_or_else(|| GpuError("a cell does not fit its buffers".into()))?;
        let end = job.levels() - 1;
        self.attempt(|device| {
            let of = |k: usize| {
                let count = if k >= codes.first { codes.moments.len() } else { 0 };
                (0..count).map(|_| Voxels::zeroed(codes.dtype, job.own(k, brick).voxels())).collect()
            };
            let mut made = MapLevels {
                codes: (1..=end).map(of).collect(),
                last: codes.cells.then(|| room(job.own(end, brick).voxels())),
            };
            for &part in &parts {
                let boxes = job.boxes(part);
                let (seen, pitch) = read(job, boxes[0], src_box);
                let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, &seen, pitch, out);
                let (recording, places, last) = job.recorded(part, codes);
                let mut done = |bytes: Option<&[u8]>| {
                    let bytes = bytes.unwrap_or_default();
                    for (k, (places, levels)) in (1..).zip(places.iter().zip(&mut made.codes)) {
                        let (own, all) = (job.own(k, part), job.own(k, brick));
                        for (place, to) in places.iter().zip(levels) {
                            let mut view = to.view_mut(all.shape());
                            flow_call::paste(&bytes[*place as usize..], own.shape(), all.offset_of(&own), &mut view);
                        }
                    }
                    if let Some(to) = &mut made.last {
                        let cells = cast(&bytes[last as usize..][..boxes[end].voxels() * 4 * CELL])?;
                        paste(cells, boxes[end], job.own(end, part), job.own(end, brick), codes.affine, to);
                    }
                    Ok(())
                };
                run_part(device, &recording, &mut fill, &mut done, &mut Times::default())?;
            }
            Ok(made)
        })
    }
}

/// What a part reads of `src_box`, and the bytes of its rows as they are packed.
fn read(job: &MapJob, wanted: Region, src_box: Region) -> (Part, usize) {
    assert!(src_box.contains(&wanted), "voxels {wanted:?} are needed, {src_box:?} are given");
    let shape = wanted.shape();
    let seen = Part { lo: [0; 3], dst: shape, from: src_box.offset_of(&wanted), src: shape };
    (seen, job.pitch(wanted) * job.voxel)
}

fn room(cells: usize) -> Moments {
    Moments { mean: vec![0.0; cells], variance: vec![0.0; cells] }
}

/// Copies the cells of `own`, which lie in those of `have`, to their places in `brick`.
fn paste(cells: &[u32], have: Region, own: Region, brick: Region, affine: Affine, to: &mut Moments) {
    let place = |r: Region, z: i64, y: i64, x: i64| {
        let ([_, ny, nx], v) = (r.shape(), [z - r.lo[0], y - r.lo[1], x - r.lo[2]].map(|v| v as usize));
        (v[0] * ny + v[1]) * nx + v[2]
    };
    let number = |w: u32| f32::from_bits(w) as f64;
    let n = own.shape()[2];
    for (z, y) in (own.lo[0]..own.hi[0]).flat_map(|z| (own.lo[1]..own.hi[1]).map(move |y| (z, y))) {
        let from = &cells[CELL * place(have, z, y, own.lo[2])..][..CELL * n];
        let start = place(brick, z, y, own.lo[2]);
        for (x, cell) in from.chunks_exact(CELL).enumerate() {
            to.mean[start + x] = affine.slope * (number(cell[0]) + number(cell[1])) + affine.intercept;
            to.variance[start + x] = affine.slope * affine.slope * number(cell[2]);
        }
    }
}
