//! Gaussian means and variances: how a brick is cut into parts that fit the device, the table of weights, and one pass per
//! axis of each. Pure arithmetic, shared by planner and engine.

use super::passes::{Part, largest, parts_within};
use super::record::{Bind, Buffer, GROUP, Recording, Shader, Sizes};
use super::recorder::Recorder;
use super::stored::{packed, pitch};
use crate::grid::{DType, Shape};
use crate::kernel::gaussian;

/// What one dispatch does; `struct Taps` of `shaders/gaussian.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Taps {
    pub n: u32,
    pub at: u32,
    pub from: u32,
    pub m: u32,
    pub radius: u32,
    pub input: [u32; 3],
    pub output: [u32; 3],
    pub inner: u32,
    pub middle: u32,
    pub axis: u32,
    pub weights: u32,
    pub packing: u32,
    pub sign: u32,
    pub zero: u32,
    pub threads: u32,
    pub centres: u32,
    pub last: u32,
    pub strip: u32,
    pub spare: [u32; 2],
}

/// One call, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TapsJob {
    pub src: Shape,
    pub dst: Shape,
    pub at: [usize; 3],
    pub sigma: [f64; 3],
    radius: [usize; 3],
    /// Bytes of a voxel: 1 or 2.
    pub voxel: usize,
    signed: bool,
    pub moments: Wanted,
}

/// What is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    pub mean: bool,
    pub variance: bool,
}

/// A moment and the shader that makes it.
const MEAN: Shader = Shader::Gaussian;
/// Outputs of a thread of the mean; the shader's vectors. 80 us along y of 256^3 at sigma 2, with four 107 (H200, 2026-11-27).
const STRIP: usize = 8;
/// Steps along x up to which workgroups hold rows, and outputs that they hold them for; the shader's.
const MOST_STEPS: usize = 128;
const PART: usize = 256;
const VARIANCE: Shader = Shader::GaussianVariance;

impl TapsJob {
    /// `None` if voxels of this type have no kernel here.
    pub fn new(
        dtype: DType,
        src: Shape,
        dst: Shape,
        at: [usize; 3],
        sigma: [f64; 3],
        moments: Wanted,
    ) -> Option<TapsJob> {
        let (voxel, signed) = packed(dtype)?;
        Some(TapsJob { src, dst, at, sigma, radius: gaussian::shared::radius(sigma, src), voxel, signed, moments })
    }

    /// One voxel of a volume of this extent, with all that its window sees wherever it lies.
    pub fn one(dtype: DType, volume: Shape, sigma: [f64; 3], moments: Wanted) -> Option<TapsJob> {
        let radius = gaussian::shared::radius(sigma, volume);
        let src = std::array::from_fn(|a| (2 * radius[a] + 1).min(volume[a]));
        let at = std::array::from_fn(|a| radius[a].min(src[a] - 1));
        TapsJob::new(dtype, src, [1; 3], at, sigma, moments)
    }

    /// Whether it is recorded in buffers of at most `cap` bytes.
    pub fn fits(&self, cap: u64) -> bool {
        self.sizes(&self.part([0; 3], self.dst)).largest() <= cap
    }

    pub(super) fn part(&self, lo: [usize; 3], dst: Shape) -> Part {
        Part::around(self.src, self.at, self.radius, lo, dst)
    }

    /// Voxels per packed row, a whole number of words.
    pub fn pitch(&self, part: &Part) -> usize {
        pitch(part.src[2], self.voxel)
    }

    fn sizes(&self, part: &Part) -> Sizes {
        self.record(part).sizes
    }

    /// Parts of which every buffer is at most `cap` bytes; `None` where even one voxel does not fit.
    pub fn parts(&self, cap: u64) -> Option<Vec<Part>> {
        parts_within(self.dst, cap, |lo, shape| self.part(lo, shape), |p| self.sizes(p))
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        largest(self.parts(cap), |p| self.sizes(p))
    }

    /// Where the results of a moment stand among those that come back.
    pub fn place(&self, part: &Part, variance: bool) -> std::ops::Range<usize> {
        let bytes = part.dst.iter().product::<usize>() * 4;
        let from = if variance && self.moments.mean { bytes.next_multiple_of(256) } else { 0 };
        from..from + bytes
    }

    /// The mean, then the variance, and that they come back.
    pub fn record(&self, part: &Part) -> Recording {
        let mut recorder = Recorder::new((part.src[0] * part.src[1] * self.pitch(part) * self.voxel) as u64);
        for made in self.results(part, Buffer::Source.into(), &mut recorder).into_iter().flatten() {
            recorder.read(made.into(), self.place(part, false).len() as u64);
        }
        recorder.finish().expect("a Gaussian takes few buffers")
    }

    /// Mean and variance, where they are wanted, left on the device.
    pub(super) fn results(&self, part: &Part, from: Bind, to: &mut Recorder) -> [Option<Buffer>; 2] {
        let mut tables = Vec::new();
        let mut starts = self.tables(part, &mut tables);
        let first = to.table(tables);
        starts.iter_mut().flatten().for_each(|s| *s += first);
        [(MEAN, self.moments.mean, 4), (VARIANCE, self.moments.variance, 12)]
            .map(|(shader, wanted, cell)| wanted.then(|| self.passes(part, shader, starts, cell, from, to)))
    }

    /// Weights of every axis and of its centres, for each output along it, and where they start.
    fn tables(&self, part: &Part, tables: &mut Vec<u32>) -> [[u32; 2]; 3] {
        std::array::from_fn(|axis| {
            let (sigma, radius, n) = (self.sigma[axis], self.radius[axis], self.src[axis]);
            let centres = (0..part.dst[axis]).map(|k| self.at[axis] + part.lo[axis] + k);
            let weights = tables.len() as u32;
            let of_outputs: Vec<Vec<u32>> = centres
                .clone()
                .map(|p| gaussian::shared::weights(sigma, radius, p, n).map(f32::to_bits).collect())
                .collect();
            tables.extend((0..radius).flat_map(|d| of_outputs.iter().map(move |w| w[d])));
            let start = tables.len() as u32;
            tables.extend(centres.map(|p| gaussian::shared::centre_weight(sigma, radius, p, n).to_bits()));
            [weights, start]
        })
    }

    /// x from packed voxels, then y, then z, as the CPU does it, over cells of so many bytes.
    fn passes(
        &self,
        part: &Part,
        shader: Shader,
        starts: [[u32; 2]; 3],
        cell: u64,
        from: Bind,
        to: &mut Recorder,
    ) -> Buffer {
        let bytes = |s: Shape| s.iter().map(|&n| n as u64).product::<u64>() * cell;
        let ([nz, ny, _], [_, my, mx]) = (part.src, part.dst);
        let last = to.take(part.dst.iter().map(|&n| n as u64).product::<u64>() * 4);
        let [a, b] = [[nz, ny, mx], [nz, my, mx]].map(|s| to.take(bytes(s)));
        let pitch = self.pitch(part);
        let mut strides = [part.src[1] * pitch, pitch, 1];
        let mut extent = part.src;
        for (entry, axis) in [(0, 2), (1, 1), (1, 0)] {
            extent[axis] = part.dst[axis];
            // Held rows are the first pass.
            let held = axis == 2 && shader == MEAN && self.radius[axis] <= MOST_STEPS;
            let strip = if shader == MEAN && !held { STRIP } else { 1 };
            let mut threads = extent;
            threads[axis] = extent[axis].div_ceil(strip);
            let next = [extent[1] * extent[2], extent[2], 1];
            let others = [[1, 2], [0, 2], [0, 1]][axis];
            let order = |s: [usize; 3]| [s[axis] as u32, s[others[0]] as u32, s[others[1]] as u32];
            let taps = Taps {
                n: self.src[axis] as u32,
                at: (self.at[axis] + part.lo[axis]) as u32,
                from: part.from[axis] as u32,
                m: part.dst[axis] as u32,
                radius: self.radius[axis] as u32,
                input: order(strides),
                output: order(next),
                inner: threads[2] as u32,
                middle: threads[1] as u32,
                axis: axis as u32,
                weights: starts[axis][0],
                packing: if self.voxel == 1 { 2 } else { 1 },
                sign: if self.signed { 1 << (8 * self.voxel - 1) } else { 0 },
                threads: threads.iter().product::<usize>() as u32,
                centres: starts[axis][1],
                last: (axis == 0) as u32,
                strip: strip as u32,
                ..Taps::default()
            };
            let input = [Bind::from(b), a.into(), from][axis];
            let bind = [input, [last, b, a][axis].into(), Buffer::Tables.into()];
            if held {
                let rows = (extent[0] * extent[1]) as u32;
                let threads = rows.saturating_mul(extent[2].div_ceil(PART) as u32).saturating_mul(GROUP);
                to.dispatch(Shader::GaussianRows, 0, &Taps { inner: rows, threads, ..taps }, &bind, threads);
            } else {
                to.dispatch(shader, entry, &taps, &bind, taps.threads);
            }
            strides = next;
        }
        to.give(a);
        to.give(b);
        last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_are_sound_and_parts_tile_the_outputs() {
        // The widest kernel sees the whole source from every voxel.
        for (sigma, least) in [([0.4; 3], 30_000), ([2.0, 0.7, 3.3], 90_000), ([40.0; 3], 150_000)] {
            for (mean, variance) in [(true, false), (false, true), (true, true)] {
                let moments = Wanted { mean, variance };
                let job = TapsJob::new(DType::I16, [40, 30, 50], [20, 30, 40], [10, 0, 5], sigma, moments).unwrap();
                for cap in [1 << 30, 3 * least] {
                    let parts = job.parts(cap).unwrap();
                    assert_eq!(parts.iter().map(|p| p.dst.iter().product::<usize>()).sum::<usize>(), 20 * 30 * 40);
                    for part in &parts {
                        let recording = job.record(part);
                        assert_eq!(recording.fault(), None);
                        assert!(recording.sizes.largest() <= cap);
                        assert_eq!(recording.dispatches().count(), 3 * (mean as usize + variance as usize));
                    }
                }
                assert!(job.parts(300).is_none());
            }
        }
        let moments = Wanted { mean: true, variance: true };
        assert!(TapsJob::new(DType::F32, [4; 3], [4; 3], [0; 3], [1.0; 3], moments).is_none());
    }
}
