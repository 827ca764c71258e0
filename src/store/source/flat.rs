//! Zarr arrays in flat or very large chunks (a file per plane, say): decoded once into plain planes in scratch.
//!
//! A brick of some 100^3 voxels touches as many chunks of single planes as it has planes, and of each takes a small part.
//! Where the cache cannot hold that stack of chunks until the neighbours have had their parts, every brick would decode it
//! again: measured on 512 planes of 1024^2 u16 (zstd, budget 256 MiB, window radius 10), some 40 times.

use std::fs::File;
use std::ops::Range;
use std::path::Path;

use super::bytes::{Files, MappedFile};
use super::lattice::{Lattice, Planes};
use super::planar::Planar;
use super::spool::{Progress, nameless};
use super::zarr::ZarrArray;
use super::{ChunkRead, VolumeInfo};
use crate::brick::{Voxels, gather};
use crate::grid::{Region, Shape};
use crate::store::os::FileExt;
use crate::{Error, Result};

/// Planes of a brick and its halo, for weighing a stack of chunks against the budget.
const STACK: usize = 128;
/// Share of the budget that decoded chunks may be counted on to get beside bricks and open shards.
const CACHE_SHARE: u64 = 8;

/// Bytes written at a time: recent kernels keep what one call wrote in one large page, and map all of it into this process
/// where a byte of it is read.
const PIECE: usize = 1 << 16;

/// Bytes of chunks side by side that are written together, at most.
const BAND: usize = 8 << 20;

/// Bytes of the voxels of these planes, all components.
pub fn bytes(info: &VolumeInfo, planes: &Range<usize>) -> u64 {
    let voxels = (planes.len() as u64).saturating_mul((info.shape[1] * info.shape[2]) as u64);
    voxels.saturating_mul((info.components * info.dtype.size()) as u64)
}

/// Whether the stack of chunks under a brick is too much for the cache, while a chunk is not too much for the budget.
pub fn is_flat(info: &VolumeInfo, memory: u64) -> bool {
    let Some(chunk) = info.chunk else { return false };
    let one = chunk.iter().product::<usize>() as u64 * info.dtype.size() as u64;
    let stack = STACK.min(info.shape[0]).div_ceil(chunk[0]) as u64;
    let several = (0..3).any(|a| chunk[a] < info.shape[a]);
    several && one.saturating_mul(4) <= memory && one.saturating_mul(stack) > memory / CACHE_SHARE
}

/// An array in planes in scratch.
#[derive(Debug)]
pub struct Unpacked {
    pub planes: Planar,
    /// Bytes that were read from the array.
    pub read: u64,
    chunk: Shape,
    /// Chunks per axis.
    grid: Shape,
    /// By component and chunk: nothing is stored, all voxels are `fill`.
    absent: Vec<bool>,
    fill: f64,
}

impl Unpacked {
    /// The stored value of a box inside the volume in which no chunk was stored.
    pub fn absent_box(&self, component: usize, region: Region) -> Option<f64> {
        let absent = |chunk| self.absent[place(self.grid, component, chunk)];
        region.cells([0; 3], self.chunk).iter().all(absent).then_some(self.fill)
    }
}

/// Number of a chunk among those of all components.
fn place([nz, ny, nx]: Shape, component: usize, [z, y, x]: [i64; 3]) -> usize {
    ((component * nz + z as usize) * ny + y as usize) * nx + x as usize
}

/// Decodes every chunk that holds some of these planes once into a nameless file in `scratch`.
pub fn run(
    array: &ZarrArray,
    info: &VolumeInfo,
    planes: &Range<usize>,
    scratch: &Path,
    progress: Progress,
) -> Result<Unpacked> {
    let total = bytes(info, &(0..info.shape[0]));
    let file = nameless(scratch, bytes(info, planes))?;
    let failed = |e: std::io::Error| Error::file(scratch, format!("scratch: {e}"));
    // What is not written reads as 0.
    file.set_len(total).map_err(failed)?;
    let big = cfg!(target_endian = "big");
    let mut lattice = Lattice::dense(info.shape, info.dtype, big, 0)
        .ok_or_else(|| Error::Failed("the volume is larger than any file".into()))?;
    let Planes::Even { bases, plane } = &mut lattice.planes else { unreachable!("dense planes are even") };
    let component = *plane * info.shape[0] as u64;
    *bases = (0..info.components as u64).map(|c| c * component).collect();
    let (chunk, whole) = (array.chunk(), Region::whole(info.shape));
    let grid: Shape = std::array::from_fn(|a| info.shape[a].div_ceil(chunk[a]));
    let mut voxels = Voxels::zeroed(info.dtype, chunk.iter().product());
    // Chunks side by side are written together: rows of one chunk alone are short, and each would be a call.
    let beside = (BAND / voxels.as_bytes().len().max(1)).clamp(1, grid[2]);
    let wide = [chunk[0], chunk[1], chunk[2] * beside];
    let shape = [chunk[0], chunk[1], wide[2].min(info.shape[2])];
    let mut band = Voxels::zeroed(info.dtype, if beside > 1 { shape.iter().product() } else { 0 });
    let (mut done, mut read, mut fill) = (0, 0, 0.0);
    let mut absent = vec![false; info.components * grid.iter().product::<usize>()];
    for c in 0..info.components {
        for outer in whole.cells([0; 3], wide).iter() {
            let cell = Region::of_cell(outer, [0; 3], wide).clip(&whole);
            if cell.hi[0] <= planes.start as i64 || cell.lo[0] >= planes.end as i64 {
                continue;
            }
            let mut stored = false;
            for index in cell.cells([0; 3], chunk).iter() {
                match array.read_chunk(c, index, &mut voxels)? {
                    ChunkRead::Missing(value) => {
                        fill = value;
                        voxels.fill(value);
                        absent[place(grid, c, index)] = true;
                        stored |= value.to_bits() != 0;
                    }
                    ChunkRead::Data { stored_bytes } => {
                        read += stored_bytes;
                        stored = true;
                    }
                }
                if beside > 1 {
                    let from = Region::of_cell(index, [0; 3], chunk);
                    let held = Region::new(cell.lo, std::array::from_fn(|a| cell.lo[a] + shape[a] as i64));
                    gather::copy_common(voxels.view(chunk), from, band.view_mut(shape), held);
                }
            }
            if stored {
                let (held, shape) = if beside > 1 { (&band, shape) } else { (&voxels, chunk) };
                put(&file, c as u64 * component, info, shape, cell, held.as_bytes()).map_err(failed)?;
            }
            done += (cell.voxels() * info.dtype.size()) as u64;
            if !progress(done) {
                return Err(Error::Interrupted);
            }
        }
    }
    let planes = Planar::held(lattice, Files::Held(vec![MappedFile::of(scratch, file)?]));
    Ok(Unpacked { planes, read, chunk, grid, absent, fill })
}

/// Writes the part of a chunk that lies in the volume, in runs as long as both layouts allow.
fn put(file: &File, base: u64, info: &VolumeInfo, chunk: Shape, cell: Region, bytes: &[u8]) -> std::io::Result<()> {
    let size = info.dtype.size();
    let [nz, ny, nx] = cell.shape();
    let [_, height, width] = info.shape;
    // Whole rows of the volume follow each other in both.
    let (runs, rows) = if nx == width && chunk[2] == width { (1, ny) } else { (ny, 1) };
    for z in 0..nz {
        for y in 0..runs {
            let from = (z * chunk[1] + y) * chunk[2] * size;
            let at = ((cell.lo[0] as usize + z) * height + cell.lo[1] as usize + y) * width + cell.lo[2] as usize;
            for (i, piece) in bytes[from..from + rows * nx * size].chunks(PIECE).enumerate() {
                file.write_all_at(piece, base + (at * size + i * PIECE) as u64)?;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::DType;

    #[test]
    fn planes_are_flat_for_a_small_budget_and_blocks_are_not() {
        let info = |chunk| {
            let mut info = VolumeInfo::plain([512, 1024, 1024], DType::U16, "Zarr");
            info.chunk = Some(chunk);
            info
        };
        let mib = 1u64 << 20;
        assert!(is_flat(&info([1, 1024, 1024]), 256 * mib));
        assert!(!is_flat(&info([1, 1024, 1024]), 4096 * mib), "the cache holds 128 planes");
        assert!(!is_flat(&info([64, 64, 64]), 64 * mib));
        assert!(!is_flat(&info([512, 1024, 1024]), 256 * mib), "one chunk: nothing is decoded twice");
        assert!(!is_flat(&info([256, 1024, 1024]), 256 * mib), "too large to decode within the budget at all");
    }
}
