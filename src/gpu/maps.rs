//! Occlusion maps: the chain of levels of a brick recorded, cut into parts that fit. Pure arithmetic, shared by planner and
//! engine. Boxes are counted from the start of the map's region.

use super::levels::{Codes, MAP_KINDS, Slab};
use super::passes::{largest, parts_within};
use super::record::{Bind, Buffer, Recording, Shader, Sizes};
use super::recorder::Recorder;
use super::stored::{packed, pitch};
use crate::grid::{Affine, DType, Region, Shape};
use crate::kernel::convert::Mapping;
use crate::kernel::occlusion_map::{full_weights, needed};

/// What one dispatch does; `struct Pool` of `shaders/map_pool.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Pool {
    pub out: [u32; 3],
    pub plane: u32,
    pub row: u32,
    pub axis: u32,
    pub shift: [u32; 3],
    pub first: i32,
    pub least: i32,
    pub most: i32,
    pub weights: u32,
    pub packing: u32,
    pub sign: u32,
    pub zero: u32,
    pub threads: u32,
    pub spare: [u32; 3],
}

/// A level of the chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapLevel {
    pub shape: Shape,
    /// Level-0 voxels per cell.
    pub factor: [usize; 3],
    /// Which axes the step from the level before halved.
    pub halved: [bool; 3],
}

/// A chain of levels, level 0 = the data.
#[derive(Debug, Clone, PartialEq)]
pub struct MapJob {
    levels: Vec<MapLevel>,
    /// Bytes of a voxel: 1 or 2.
    pub voxel: usize,
    signed: bool,
}

/// Words of a cell.
pub const CELL: usize = 3;

/// What an output takes of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapCodes {
    /// The first level that is stored.
    pub first: usize,
    /// By component: 0 for the mean, 1 for the variance.
    pub moments: Vec<usize>,
    pub dtype: DType,
    pub mapping: Mapping,
    pub affine: Affine,
    /// The cells of the last level are kept.
    pub cells: bool,
}

impl MapCodes {
    fn of(&self, moment: usize) -> Codes {
        let squared = Affine { slope: self.affine.slope * self.affine.slope, intercept: 0.0 };
        let affine = [self.affine, squared][moment];
        Codes { dtype: self.dtype, mapping: self.mapping, kind: MAP_KINDS[moment], affine }
    }
}

impl MapJob {
    /// `levels` up to the last that bricks make. `None` if voxels of this type have no kernel here, or no level is made.
    pub fn new(dtype: DType, levels: Vec<MapLevel>) -> Option<MapJob> {
        let (voxel, signed) = packed(dtype)?;
        (levels.len() > 1).then_some(MapJob { levels, voxel, signed })
    }

    /// How many levels there are, level 0 counted.
    pub fn levels(&self) -> usize {
        self.levels.len()
    }

    /// Cells of level `k` that lie over a box of voxels.
    pub fn own(&self, k: usize, voxels: Region) -> Region {
        let MapLevel { factor, shape, .. } = self.levels[k];
        let f = factor.map(|f| f as i64);
        let hi = |a: usize| ((voxels.hi[a] + f[a] - 1).div_euclid(f[a])).min(shape[a] as i64);
        Region::new(std::array::from_fn(|a| voxels.lo[a].div_euclid(f[a])), std::array::from_fn(hi))
    }

    /// The box of each level that is made for a box of voxels; of level 0, that is read.
    pub fn boxes(&self, voxels: Region) -> Vec<Region> {
        let last = self.levels.len() - 1;
        let mut boxes = vec![self.own(last, voxels); last + 1];
        for k in (0..last).rev() {
            let need = needed(boxes[k + 1], self.levels[k + 1].halved, self.levels[k].shape);
            boxes[k] = if k > 0 { need.union(&self.own(k, voxels)) } else { need };
        }
        boxes
    }

    /// Parts of a brick, whole cells of the last level, of which every buffer is at most `cap` bytes; `None` where even one
    /// cell does not fit.
    pub fn parts(&self, brick: Region, cap: u64) -> Option<Vec<Region>> {
        let factor = self.levels[self.levels.len() - 1].factor;
        let cells = std::array::from_fn(|a| brick.shape()[a].div_ceil(factor[a]));
        let part = |lo: [usize; 3], shape: Shape| {
            let at = |a: usize, cells: usize| brick.lo[a] + (cells * factor[a]) as i64;
            let hi = |a: usize| at(a, lo[a] + shape[a]).min(brick.hi[a]);
            Region::new(std::array::from_fn(|a| at(a, lo[a])), std::array::from_fn(hi))
        };
        parts_within(cells, cap, part, |p| self.sizes(*p))
    }

    /// Whether a cell of the last level can be made wherever it lies.
    pub fn fits(&self, cap: u64) -> bool {
        let last = self.levels[self.levels.len() - 1];
        let lo: [i64; 3] = std::array::from_fn(|a| (last.shape[a] / 2 * last.factor[a]) as i64);
        let cell = Region::new(lo, std::array::from_fn(|a| lo[a] + last.factor[a] as i64));
        self.sizes(cell.clip(&Region::whole(self.levels[0].shape))).largest() <= cap
    }

    /// Voxels per packed row of a part, a whole number of words.
    pub fn pitch(&self, read: Region) -> usize {
        pitch(read.shape()[2], self.voxel)
    }

    fn sizes(&self, part: Region) -> Sizes {
        // With the most that an output takes.
        let (dtype, mapping, affine) = (DType::F32, Mapping::KEEP, Affine::IDENTITY);
        let codes = MapCodes { first: 0, moments: vec![0, 1], dtype, mapping, affine, cells: true };
        self.recorded(part, &codes).0.sizes
    }

    /// Largest buffers of any part.
    pub fn slot(&self, brick: Region, cap: u64) -> Sizes {
        largest(self.parts(brick, cap), |p| self.sizes(*p))
    }

    /// Every level of a part, axis by axis, each read back when it is made: the cells that the part owns in an output's type, one
    /// component after the other, and the cells of the last one as they are; with where the codes of every level from 1 on and
    /// those cells stand.
    pub fn recorded(&self, part: Region, codes: &MapCodes) -> (Recording, Vec<Vec<u64>>, u64) {
        let boxes = self.boxes(part);
        let pitch = self.pitch(boxes[0]);
        let source = boxes[0].shape()[0] * boxes[0].shape()[1] * pitch * self.voxel;
        let mut recorder = Recorder::new(source as u64);
        let (mut places, mut last) = (Vec::new(), 0);
        let mut from = Grid { region: boxes[0], buffer: Buffer::Source, pitch };
        for k in 1..boxes.len() {
            let (fine, halved) = (self.levels[k - 1].shape, self.levels[k].halved);
            let want = needed(boxes[k], halved, fine);
            for axis in (0..3).filter(|&a| halved[a]) {
                let next = self.pass(&mut recorder, &from, want, boxes[k], axis, fine[axis]);
                recorder.give(from.buffer);
                from = next;
            }
            let own = self.own(k, part);
            let stored: Vec<Codes> = codes.moments.iter().filter(|_| k >= codes.first).map(|m| codes.of(*m)).collect();
            let slab = Slab { bind: from.buffer.into(), region: boxes[k], pitch: boxes[k].shape()[2] };
            let one = |c: Codes| c.write(slab.bind, slab.start(&own), own.shape(), true, &mut recorder);
            places.push(stored.into_iter().map(one).collect());
            if codes.cells && k + 1 == boxes.len() {
                last = recorder.read(from.buffer.into(), (boxes[k].voxels() * 4 * CELL) as u64);
            }
        }
        (recorder.finish().expect("a map takes few buffers"), places, last)
    }

    /// Halves one axis of the `n` cells of a level; of the axes that are not done yet, only what is wanted goes on.
    fn pass(&self, to: &mut Recorder, from: &Grid, want: Region, coarse: Region, axis: usize, n: usize) -> Grid {
        // Axes up to this one are in coarse cells, or are not halved, and then both boxes say the same of them.
        let lo: [i64; 3] = std::array::from_fn(|a| if a <= axis { coarse.lo[a] } else { want.lo[a] });
        let hi = std::array::from_fn(|a| if a <= axis { coarse.hi[a] } else { want.hi[a] });
        let region = Region::new(lo, hi);
        let start = from.region.lo[axis];
        let cells = coarse.lo[axis]..coarse.hi[axis];
        let weights = to.table(cells.flat_map(|i| full_weights(i, n as i64)).map(|w| (w as f32).to_bits()));
        let shift = |a: usize| if a == axis { 0 } else { (lo[a] - from.region.lo[a]) as u32 };
        let pool = Pool {
            out: region.shape().map(|n| n as u32),
            plane: (from.region.shape()[1] * from.pitch) as u32,
            row: from.pitch as u32,
            axis: axis as u32,
            shift: std::array::from_fn(shift),
            first: (2 * coarse.lo[axis] - 2 - start) as i32,
            least: -start as i32,
            most: (n as i64 - 1 - start) as i32,
            weights,
            packing: if self.voxel == 1 { 2 } else { 1 },
            sign: if self.signed { 1 << (8 * self.voxel - 1) } else { 0 },
            threads: region.voxels() as u32,
            ..Pool::default()
        };
        let buffer = to.take((region.voxels() * 4 * CELL) as u64);
        let bind = [from.buffer, buffer, Buffer::Tables].map(Bind::from);
        to.dispatch(Shader::MapPool, (from.buffer != Buffer::Source) as usize, &pool, &bind, pool.threads);
        Grid { region, buffer, pitch: region.shape()[2] }
    }
}

/// Cells on the device: the box, in coarse cells along the axes that are done, and its rows' pitch.
struct Grid {
    region: Region,
    buffer: Buffer,
    pitch: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn levels(shape: Shape) -> Vec<MapLevel> {
        let mut list = vec![MapLevel { shape, factor: [1; 3], halved: [false; 3] }];
        for halved in [[true; 3], [false, true, true], [true; 3]] {
            let fine = list[list.len() - 1];
            list.push(MapLevel {
                shape: std::array::from_fn(|a| if halved[a] { fine.shape[a].div_ceil(2) } else { fine.shape[a] }),
                factor: std::array::from_fn(|a| fine.factor[a] << halved[a] as usize),
                halved,
            });
        }
        list
    }

    #[test]
    fn recordings_are_sound_and_parts_tile_every_level() {
        let shape = [37, 60, 71];
        let (dtype, mapping, affine) = (DType::U8, Mapping { range: Some([0.0, 9.0]), fill: 0.0 }, Affine::IDENTITY);
        let codes = MapCodes { first: 0, moments: vec![0, 1], dtype, mapping, affine, cells: true };
        for dtype in [DType::U8, DType::I16] {
            let job = MapJob::new(dtype, levels(shape)).unwrap();
            for brick in [Region::whole(shape), Region::new([16, 0, 32], [37, 32, 71])] {
                for cap in [1 << 30, 400_000] {
                    let parts = job.parts(brick, cap).unwrap();
                    assert_eq!(parts.len() > 1, cap < 1 << 30 && brick == Region::whole(shape));
                    for k in 1..4 {
                        let cells: usize = parts.iter().map(|p| job.own(k, *p).voxels()).sum();
                        assert_eq!(cells, job.own(k, brick).voxels());
                    }
                    for part in &parts {
                        let (recording, places, _) = job.recorded(*part, &codes);
                        assert!(places.len() == 3 && places.iter().all(|p| p.len() == 2));
                        assert_eq!(recording.fault(), None);
                        assert!(recording.sizes.largest() <= cap);
                        let boxes = job.boxes(*part);
                        assert!((1..4).all(|k| boxes[k].contains(&job.own(k, *part))));
                        // An axis at a time, then both moments of every level as codes.
                        assert_eq!(recording.dispatches().count(), 3 + 2 + 3 + 3 * 2);
                    }
                }
            }
            assert!(job.fits(1 << 20) && !job.fits(2000) && job.parts(Region::whole(shape), 2000).is_none());
        }
        assert!(MapJob::new(DType::F32, levels(shape)).is_none());
        assert!(MapJob::new(DType::U8, levels(shape)[..1].to_vec()).is_none());
    }
}
