//! Pyramids of a channel on the device: level 0 and every level that a brick makes, in the output's type, and the cells of the
//! last one. Everything is in the CPU's bits, so it does not matter where a brick's levels are made.

use super::masks::Mask;
use super::record::{Bind, Buffer, Shader};
use super::recorder::Recorder;
use crate::grid::{Affine, DType, Region, Shape};
use crate::kernel::convert::{Linear, Mapping};
use crate::stage::Reduce;

/// Bits of f32 of a box on the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slab {
    pub bind: Bind,
    pub region: Region,
    /// Voxels from row to row.
    pub pitch: usize,
}

impl Slab {
    /// Where a part of the box starts, and the strides of planes and rows.
    pub fn start(&self, part: &Region) -> [u32; 3] {
        let (at, rows) = (self.region.offset_of(part), self.region.shape()[1]);
        let from = (at[0] * rows + at[1]) * self.pitch + at[2];
        [from, rows * self.pitch, self.pitch].map(|v| v as u32)
    }
}

/// What one step of a pyramid does; `struct Join` of `shaders/level_pool.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Join {
    pub out: [u32; 3],
    pub fine: [u32; 3],
    pub step: [u32; 3],
    pub value: [u32; 3],
    pub mean: [u32; 3],
    pub kind: u32,
    pub threads: u32,
    pub mask: [u32; 3],
}

/// How voxels or cells become codes; `struct Write` of `shaders/level_write.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Write {
    pub extent: [u32; 2],
    pub count: u32,
    pub start: [u32; 3],
    pub kind: u32,
    pub packing: u32,
    pub linear: u32,
    pub fill: u32,
    pub threads: u32,
    pub real: u32,
    /// half, lo, width, top, low, high, slope, intercept.
    pub numbers: [[u32; 2]; 8],
}

/// Set in a cell's count where it covers only voxels that a mask excludes; in `shaders/level_cells.wgsl`, too.
pub(super) const EXCLUDED: u32 = 1 << 31;

/// The words of an f64, the low one first.
pub fn words(v: f64) -> [u32; 2] {
    [v.to_bits() as u32, (v.to_bits() >> 32) as u32]
}

/// The levels of one channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Pyramid {
    /// f32, or 8 or 16 bits.
    pub dtype: DType,
    pub mapping: Mapping,
    pub reduce: Reduce,
    /// Moments: the channel is a standard deviation.
    pub std: bool,
    /// The axes that each level from 1 on halves.
    pub halved: Vec<[bool; 3]>,
    /// The cells of the last level come back, too.
    pub cells: bool,
}

/// Where the results of a part stand among those that come back.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Placed {
    /// First byte and extent of every level.
    pub levels: Vec<(u64, Shape)>,
    /// Of the last level's cells.
    pub cells: Option<(u64, Shape)>,
}

impl Pyramid {
    /// Whether the device writes this type.
    pub fn holds(dtype: DType) -> bool {
        matches!(dtype, DType::F32 | DType::U8 | DType::I8 | DType::U16 | DType::I16)
    }

    /// The channel itself, f32, without levels.
    pub fn plain() -> Pyramid {
        let (dtype, mapping, reduce) = (DType::F32, Mapping::KEEP, Reduce::Mean);
        Pyramid { dtype, mapping, reduce, std: false, halved: vec![], cells: false }
    }

    /// Level-0 voxels per cell of the last level.
    pub fn factor(&self) -> [usize; 3] {
        std::array::from_fn(|a| self.halved.iter().fold(1, |f, h| f << h[a] as usize))
    }

    /// Extent of level `k` over a box that starts at a cell and ends at one, or where the volume does.
    pub fn extent(&self, k: usize, voxels: Shape) -> Shape {
        self.halved[..k].iter().fold(voxels, |n, h| std::array::from_fn(|a| n[a].div_ceil(1 + h[a] as usize)))
    }

    fn kind(&self) -> u32 {
        match self.reduce {
            Reduce::Mean => 0,
            Reduce::Min => 1,
            Reduce::Max => 2,
            Reduce::Stride => 3,
            Reduce::Moments => 4 + self.std as u32,
        }
    }

    /// Words of a cell.
    pub fn cell(&self) -> usize {
        if self.reduce == Reduce::Moments { 7 } else { 3 }
    }

    /// Makes every level over a box of the channel. `mean` is the channel beside it, for moments; `mask` says which voxels enter.
    pub(super) fn record(
        &self,
        value: &Slab,
        mean: Option<&Slab>,
        mask: Option<&Mask>,
        region: &Region,
        to: &mut Recorder,
    ) -> Placed {
        let mut placed = Placed::default();
        let shape = region.shape();
        let whole = value.region == *region && value.pitch == shape[2] && self.dtype == DType::F32;
        let place = match whole {
            true => to.read(value.bind, shape.iter().product::<usize>() as u64 * 4),
            false => self.codes().write(value.bind, value.start(region), shape, false, to),
        };
        placed.levels.push((place, shape));
        let (mut fine, mut extent) = (None, shape);
        for (k, halved) in self.halved.iter().enumerate() {
            let next = self.extent(k + 1, shape);
            let count = next.iter().product::<usize>();
            let cells = to.take((count * self.cell() * 4) as u64);
            let join = Join {
                out: next.map(|n| n as u32),
                fine: extent.map(|n| n as u32),
                step: halved.map(|h| 1 + h as u32),
                value: value.start(region),
                mean: mean.map_or([0; 3], |m| m.start(region)),
                kind: self.kind(),
                threads: count as u32,
                mask: mask.filter(|_| fine.is_none()).map_or([0; 3], |m| m.start(region)),
            };
            let input = fine.map_or(value.bind, Bind::from);
            let bind = [input, cells.into(), mean.map_or(input, |m| m.bind), mask.map_or(input, |m| m.bind())];
            to.dispatch(Shader::LevelPool, fine.is_some() as usize, &join, &bind, join.threads);
            fine.into_iter().for_each(|f: Buffer| to.give(f));
            placed.levels.push((self.codes().write(cells.into(), dense(next), next, true, to), next));
            (fine, extent) = (Some(cells), next);
        }
        if let Some(cells) = fine {
            let bytes = (extent.iter().product::<usize>() * self.cell() * 4) as u64;
            placed.cells = self.cells.then(|| (to.read(cells.into(), bytes), extent));
            to.give(cells);
        }
        placed
    }

    fn codes(&self) -> Codes {
        Codes { dtype: self.dtype, mapping: self.mapping, kind: self.kind(), affine: Affine::IDENTITY }
    }
}

/// Where cells of a box that are dense stand: the first, and the strides of planes and rows.
fn dense([_, ny, nx]: Shape) -> [u32; 3] {
    [0, ny * nx, nx].map(|n| n as u32)
}

/// How voxels or cells become an output's type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Codes {
    pub dtype: DType,
    pub mapping: Mapping,
    /// What cells hold.
    pub kind: u32,
    /// Of an occlusion map's values.
    pub affine: Affine,
}

/// Kinds of an occlusion map's cells: of which the mean is written, or the variance.
pub(super) const MAP_KINDS: [u32; 2] = [6, 7];

impl Codes {
    /// Rounds a box and brings it back; says where.
    pub fn write(&self, from: Bind, start: [u32; 3], extent: Shape, cells: bool, to: &mut Recorder) -> u64 {
        let (size, count) = (self.dtype.size(), extent.iter().product::<usize>());
        let Linear { half, lo, width, top, low, high, fill } = Linear::new(self.mapping, self.dtype);
        let Affine { slope, intercept } = self.affine;
        let threads = (count * size).div_ceil(4) as u32;
        let write = Write {
            extent: [extent[1] as u32, extent[2] as u32],
            count: count as u32,
            start,
            kind: self.kind,
            packing: [0, 2, 1, 0, 0][size],
            linear: self.mapping.range.is_some() as u32 + (self.mapping.is_unit() && !cells) as u32,
            fill: fill.round_ties_even() as i64 as u32,
            threads,
            real: (self.dtype == DType::F32) as u32,
            numbers: [half, lo, width, top, low, high, slope, intercept].map(words),
        };
        let codes = to.take(threads as u64 * 4);
        to.dispatch(Shader::LevelWrite, cells as usize, &write, &[from, codes.into()], threads);
        let place = to.read(codes.into(), threads as u64 * 4);
        to.give(codes);
        place
    }
}
