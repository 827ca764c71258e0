//! Windows: how a call is cut into parts that fit the device, and the three passes of each quantity. Pure arithmetic,
//! shared by planner and engine.

use super::finish::Channels;
use super::record::{Bind, Buffer, GROUP, Recording, Shader, Sizes};
use super::recorder::{Planes, Recorder};
use super::stored::{Stored, pitch, stored};
use crate::grid::{DType, Shape};
use crate::kernel::window::Needs;
use crate::stage::{WindowChannel, WindowParams};

/// What one dispatch does; the shaders' `struct Pass`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Pass {
    pub n: u32,
    pub m: u32,
    pub first: i32,
    pub window: u32,
    pub in_axis: u32,
    pub in_i: u32,
    pub in_j: u32,
    pub out_axis: u32,
    pub out_i: u32,
    pub out_j: u32,
    pub lines: u32,
    pub blocks: u32,
    pub block: u32,
    pub packing: u32,
    pub flip: u32,
    pub square: u32,
    pub threads: u32,
    pub phase: u32,
    pub zero: u32,
    pub cell: u32,
    pub spare: [u32; 4],
}

/// Outputs along z or y that a thread sums at least. Along z of u8 and of u16 at radius 2: 38 and 42 us of 256^3, with 32: 39 and
/// 48 (H200, 2026-11-27).
const LEAST: u32 = 16;
/// Outputs along x that a workgroup makes of a row by van Herk, or as many whole blocks as they hold.
const SPAN: u32 = 128;
/// Voxels of a row that a workgroup holds to make extremes of; the shader's `HELD`.
const HELD: u32 = 512;

/// A quantity that the device makes for every window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    Extremes,
    /// Sums of codes or of squares, `wide` as pairs of u32.
    Sum {
        square: bool,
        wide: bool,
    },
    /// Least and greatest f32, as codes in their order.
    Order,
    /// Voxels and mean of f32; with `square` M2, too.
    Moments {
        square: bool,
    },
}

impl Quantity {
    /// Whether passes along z and y take four columns at once.
    fn by_fours(self) -> bool {
        matches!(self, Quantity::Extremes | Quantity::Sum { wide: false, .. })
    }

    /// The shader of each axis and its entry, of windows of so many voxels along x.
    fn shaders(self, window: u32) -> [(Shader, usize); 3] {
        let near = window <= HELD / 2;
        match self {
            Quantity::Extremes => [(Shader::ExtremesZ, 0), (Shader::ExtremesY, 0), (Shader::Extremes, near as usize)],
            Quantity::Sum { wide: false, .. } => [(Shader::SumsZ, 0), (Shader::SumsY, 0), (Shader::Sums32, 0)],
            Quantity::Sum { wide: true, .. } => [0, 1, 2].map(|entry| (Shader::Sums64, entry)),
            Quantity::Order => [0, 1, 2 + near as usize].map(|entry| (Shader::Order, entry)),
            Quantity::Moments { .. } => [0, 1, 2].map(|entry| (Shader::Moments, entry)),
        }
    }

    /// Bytes per window.
    pub fn bytes(self) -> u64 {
        match self {
            Quantity::Sum { wide: true, .. } | Quantity::Order => 8,
            Quantity::Moments { square } => 4 * cell(square) as u64,
            Quantity::Sum { wide: false, .. } | Quantity::Extremes => 4,
        }
    }
}

/// One call, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Job {
    pub src: Shape,
    pub dst: Shape,
    pub at: [usize; 3],
    /// At most the extent of `src` less one: a larger radius changes no window.
    pub radius: [usize; 3],
    /// First output voxel in the volume. Floats are merged in blocks that start at multiples of the window there.
    pub place: [i64; 3],
    /// Bytes of a voxel: 1, 2 or 4.
    pub voxel: usize,
    /// Stored as two's complement.
    pub signed: bool,
    /// f32.
    pub real: bool,
    pub needs: Needs,
    /// What the device makes of sums and moments; `None`: they come back as they are.
    pub finish: Option<Channels>,
}

/// Words of a cell of moments.
pub fn cell(square: bool) -> usize {
    if square { 5 } else { 3 }
}

/// A box of the outputs and the voxels that its windows see.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// First output voxel, extent.
    pub lo: [usize; 3],
    pub dst: Shape,
    /// First voxel of `src`, extent.
    pub from: [usize; 3],
    pub src: Shape,
}

impl Job {
    /// `None` if voxels of this type have no kernel here, or the windows could hold 2^31 voxels.
    pub fn new(dtype: DType, src: Shape, dst: Shape, at: [usize; 3], radius: [usize; 3], needs: Needs) -> Option<Job> {
        let Stored { voxel, signed, real } = stored(dtype)?;
        let radius = std::array::from_fn(|a| radius[a].min(src[a].saturating_sub(1)));
        let job = Job { src, dst, at, radius, place: [0; 3], voxel, signed, real, needs, finish: None };
        (job.count() < 1 << 31).then_some(job)
    }

    /// With the first output voxel's place in the volume.
    pub fn placed(self, place: [i64; 3]) -> Job {
        Job { place, ..self }
    }

    /// With what the device makes of windows, where these channels can be made there.
    pub fn finished(self, params: &WindowParams, channels: &[WindowChannel]) -> Job {
        Job { finish: Channels::of(params, channels, self.real), ..self }
    }

    /// Whether a single window fits wherever it lies in a volume of this extent.
    pub fn fits(&self, volume: Shape, cap: u64) -> bool {
        let src = std::array::from_fn(|a| (2 * self.radius[a] + 1).min(volume[a]));
        let at = std::array::from_fn(|a| self.radius[a].min(src[a] - 1));
        let one = Job { src, dst: [1; 3], at, place: [0; 3], ..*self };
        one.record(&one.part([0; 3], [1; 3])).sizes.largest() <= cap
    }

    /// What codes are more than values: the sign bit, which two's complement has the other way around.
    pub(super) fn flip(&self) -> u32 {
        if self.signed { 1 << (8 * self.voxel - 1) } else { 0 }
    }

    /// Most voxels of a window.
    pub(super) fn count(&self) -> u64 {
        (0..3).map(|a| (2 * self.radius[a] + 1).min(self.src[a]) as u64).product()
    }

    /// What the device makes, with the widths that hold it: a sum of n codes up to T fits 32 bits where n T < 2^32.
    pub fn quantities(&self) -> Vec<Quantity> {
        if self.real {
            // Extremes tell which windows are the CPU's, and which are constant.
            let moments = Quantity::Moments { square: self.needs.variance };
            return [Some(Quantity::Order), self.needs.mean.then_some(moments)].into_iter().flatten().collect();
        }
        let top = (1u128 << (8 * self.voxel)) - 1;
        let wide = |most: u128| self.count() as u128 * most >= 1 << 32;
        let mut list = Vec::new();
        if self.needs.extremes {
            list.push(Quantity::Extremes);
        }
        if self.needs.mean {
            list.push(Quantity::Sum { square: false, wide: wide(top) });
        }
        if self.needs.variance {
            // Squares are never narrower than the sums, since n T^2 >= n T.
            list.push(Quantity::Sum { square: true, wide: wide(top * top) });
        }
        list
    }

    pub(super) fn part(&self, lo: [usize; 3], dst: Shape) -> Part {
        Part::around(self.src, self.at, self.radius, lo, dst)
    }

    /// Voxels per packed row, a whole number of words.
    pub fn pitch(&self, part: &Part) -> usize {
        pitch(part.src[2], self.voxel)
    }

    pub fn sizes(&self, part: &Part) -> Sizes {
        self.record(part).sizes
    }

    /// Parts of which every buffer is at most `cap` bytes: halves along z first, since cuts there keep rows whole and cost
    /// least. `None` where even one voxel's windows do not fit.
    pub fn parts(&self, cap: u64) -> Option<Vec<Part>> {
        parts_within(self.dst, cap, |lo, shape| self.part(lo, shape), |p| self.sizes(p))
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        largest(self.parts(cap), |p| self.sizes(p))
    }

    /// The passes of one quantity over a part: z from packed voxels, then y, then x.
    pub fn passes(&self, part: &Part, quantity: Quantity) -> [Pass; 3] {
        let ([_, ny, _], [mz, my, mx]) = (part.src.map(|n| n as u32), part.dst.map(|n| n as u32));
        let unit = if quantity.by_fours() { 4 } else { 1 };
        let row = self.row(part, quantity) as u32 / unit;
        let packed = self.pitch(part) as u32 / unit;
        let axis = |a: usize| {
            let window = 2 * self.radius[a] as u32 + 1;
            let (n, m) = (part.src[a] as u32, part.dst[a] as u32);
            let block = match (quantity, a) {
                (Quantity::Sum { .. }, 0 | 1) => window.max(LEAST),
                (Quantity::Sum { .. }, _) => m.max(1), // a row
                (_, 0 | 1) => window,
                (Quantity::Extremes | Quantity::Order, _) if window <= HELD / 2 => HELD + 1 - window,
                _ => window * (SPAN / window).max(1),
            };
            let start = (self.at[a] + part.lo[a]) as i64 - self.radius[a] as i64 - part.from[a] as i64;
            let phase = match quantity {
                Quantity::Moments { .. } => {
                    let first = self.place[a] + part.lo[a] as i64 - self.radius[a] as i64;
                    first.rem_euclid(window as i64) as u32
                }
                _ => 0,
            };
            let blocks = (m + phase).div_ceil(block);
            Pass { n, m, first: start as i32, window, blocks, block, phase, ..Pass::default() }
        };
        let z = Pass {
            in_axis: ny * packed,
            in_i: 1,
            in_j: packed,
            out_axis: ny * row,
            out_i: 1,
            out_j: row,
            lines: row,
            packing: [2, 1, 0, 0][self.voxel - 1],
            flip: self.flip(),
            ..axis(0)
        };
        let y = Pass {
            in_axis: row,
            in_i: 1,
            in_j: ny * row,
            out_axis: row,
            out_i: 1,
            out_j: my * row,
            lines: row,
            ..axis(1)
        };
        let x = Pass { in_axis: 1, in_i: row * unit, out_axis: 1, out_i: mx, lines: my * mz, ..axis(2) };
        let (square, words) = match quantity {
            Quantity::Moments { square } => (square, cell(square)),
            Quantity::Sum { square, .. } => (square, 0),
            _ => (false, 0),
        };
        let shared = |p: Pass, threads: u32| Pass { threads, square: square as u32, cell: words as u32, ..p };
        let each = |p: Pass, lines: u32| shared(p, p.blocks * p.lines * lines);
        // Van Herk takes 64 rows of a span to a workgroup, prefix sums two, the others one.
        let groups = match quantity.shaders(x.window)[2] {
            (Shader::Sums32 | Shader::Sums64, _) => x.lines.div_ceil(2),
            (Shader::Extremes, 0) | (Shader::Order | Shader::Moments, 2) => x.blocks * x.lines.div_ceil(GROUP),
            _ => x.blocks * x.lines,
        };
        [each(z, ny), each(y, mz), shared(x, groups.saturating_mul(GROUP))]
    }

    /// Elements from row to row of what passes leave along z and y.
    fn row(&self, part: &Part, quantity: Quantity) -> usize {
        if quantity.by_fours() { self.pitch(part) } else { part.src[2] }
    }

    /// Every quantity of a part, then what comes back, one quantity after the other; or what the device makes of all of
    /// them, one channel after the other.
    pub fn record(&self, part: &Part) -> Recording {
        let [nz, ny, _] = part.src;
        let mut recorder = Recorder::new((nz * ny * self.pitch(part) * self.voxel) as u64);
        match self.finish {
            Some(channels) => {
                let planes = self.results(part, Buffer::Source.into(), &channels, &mut recorder);
                let bytes = part.dst.iter().product::<usize>() as u64 * 4;
                for c in 0..channels.count() {
                    recorder.read(planes.plane(c), bytes);
                }
            }
            None => {
                for (quantity, made) in self.made(part, Buffer::Source.into(), &mut recorder) {
                    recorder.read(made.into(), result_bytes(part, quantity));
                    recorder.give(made);
                }
            }
        }
        recorder.finish().expect("windows take few buffers")
    }

    /// What the channels are, left on the device.
    pub(super) fn results(&self, part: &Part, from: Bind, channels: &Channels, to: &mut Recorder) -> Planes {
        let made = self.made(part, from, to);
        let planes = channels.record(self, part, from, &made, to);
        made.iter().for_each(|(_, b)| to.give(*b));
        planes
    }

    /// Every quantity in a buffer of its own, from voxels of which the part's source is all.
    fn made(&self, part: &Part, from: Bind, to: &mut Recorder) -> Vec<(Quantity, Buffer)> {
        let product = |s: Shape| s.iter().map(|&n| n as u64).product::<u64>();
        let ([_, ny, _], [mz, my, _]) = (part.src, part.dst);
        let one = |quantity: Quantity| {
            let row = self.row(part, quantity);
            let last = to.take(result_bytes(part, quantity));
            let [a, b] = [[mz, ny, row], [mz, my, row]].map(|s| to.take(product(s) * quantity.bytes()));
            let [a, b, last] = [a, b, last].map(Bind::from);
            let passes = self.passes(part, quantity);
            let shaders = quantity.shaders(passes[2].window);
            for ((pass, (shader, entry)), bind) in passes.iter().zip(shaders).zip([[from, a], [a, b], [b, last]]) {
                to.dispatch(shader, entry, pass, &bind, pass.threads);
                if shader.has_parts() {
                    to.only(pass.square + 2 * (pass.packing == 1) as u32);
                }
            }
            to.give(a.buffer);
            to.give(b.buffer);
            (quantity, last.buffer)
        };
        self.quantities().into_iter().map(one).collect()
    }
}

impl Part {
    /// The outputs `lo..lo + dst` of a call, and what windows of this radius see of its source.
    pub fn around(src: Shape, at: [usize; 3], radius: [usize; 3], lo: [usize; 3], dst: Shape) -> Part {
        let from: [usize; 3] = std::array::from_fn(|a| (at[a] + lo[a]).saturating_sub(radius[a]));
        let to = |a: usize| (at[a] + lo[a] + dst[a] + radius[a]).min(src[a]);
        Part { lo, dst, from, src: std::array::from_fn(|a| to(a) - from[a]) }
    }
}

/// Parts of a box, each as `part` makes it of its place and shape, of which every buffer is at most `cap` bytes; `None` where even
/// one voxel does not fit.
pub fn parts_within<P>(
    shape: Shape,
    cap: u64,
    part: impl Fn([usize; 3], Shape) -> P,
    sizes: impl Fn(&P) -> Sizes,
) -> Option<Vec<P>> {
    let boxes = cut(shape, |lo, shape| sizes(&part(lo, shape)).largest() <= cap)?;
    Some(boxes.into_iter().map(|(lo, shape)| part(lo, shape)).collect())
}

/// Largest buffers of any part.
pub fn largest<P>(parts: Option<Vec<P>>, sizes: impl Fn(&P) -> Sizes) -> Sizes {
    parts.unwrap_or_default().iter().map(sizes).fold(Sizes::default(), Sizes::max)
}

/// Boxes (first voxel, extent) that tile `shape` and fit: halves along z first. `None` where even one voxel does not fit.
pub fn cut(shape: Shape, fits: impl Fn([usize; 3], Shape) -> bool) -> Option<Vec<([usize; 3], Shape)>> {
    let mut open = vec![([0; 3], shape)];
    let mut boxes = Vec::new();
    while let Some((lo, shape)) = open.pop() {
        if fits(lo, shape) {
            boxes.push((lo, shape));
            continue;
        }
        let axis = (0..3).find(|&a| shape[a] > 1)?;
        let half = shape[axis] / 2;
        let (mut low, mut high, mut middle) = (shape, shape, lo);
        low[axis] = half;
        high[axis] -= half;
        middle[axis] += half;
        open.push((middle, high));
        open.push((lo, low));
    }
    Some(boxes)
}

/// Bytes of a quantity's results.
pub fn result_bytes(part: &Part, quantity: Quantity) -> u64 {
    part.dst.iter().map(|&n| n as u64).product::<u64>() * quantity.bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(dtype: DType, radius: usize) -> Job {
        let needs = Needs { extremes: true, mean: true, variance: true, float: false };
        Job::new(dtype, [40, 30, 50], [20, 30, 40], [10, 0, 5], [radius; 3], needs).unwrap()
    }

    #[test]
    fn parts_tile_the_outputs_and_see_their_windows() {
        let job = job(DType::U16, 4);
        for cap in [1 << 30, 200_000, 20_000, 9_000] {
            let parts = job.parts(cap).unwrap();
            assert_eq!(parts.len() == 1, cap == 1 << 30);
            let voxels: usize = parts.iter().map(|p| p.dst.iter().product::<usize>()).sum();
            assert_eq!(voxels, job.dst.iter().product::<usize>());
            for p in &parts {
                assert!(job.sizes(p).largest() <= cap);
                for a in 0..3 {
                    let c = job.at[a] + p.lo[a];
                    assert_eq!(p.from[a], c.saturating_sub(4));
                    assert_eq!(p.from[a] + p.src[a], (c + p.dst[a] + 4).min(job.src[a]));
                }
            }
        }
        assert!(job.parts(300).is_none());
    }

    #[test]
    fn sums_get_the_bits_that_they_need() {
        let wide = |dtype, radius| {
            let list = job(dtype, radius).quantities();
            list.iter().map(|q| q.bytes()).collect::<Vec<_>>()
        };
        assert_eq!(wide(DType::U8, 10), [4, 4, 4]);
        assert_eq!(wide(DType::U8, 60), [4, 4, 4]); // 60000 voxels of 255^2
        assert_eq!(wide(DType::I16, 2), [4, 4, 8]);
        let needs = Needs { extremes: false, mean: true, variance: true, float: false };
        let far = Job::new(DType::U16, [60; 3], [60; 3], [0; 3], [60; 3], needs).unwrap();
        assert_eq!(far.quantities().iter().map(|q| q.bytes()).collect::<Vec<_>>(), [8, 8]);
        assert!(Job::new(DType::F64, [60; 3], [60; 3], [0; 3], [60; 3], needs).is_none());
        assert!(Job::new(DType::U8, [1300; 3], [9; 3], [0; 3], [2000; 3], needs).is_none());
    }

    #[test]
    fn floats_are_merged_in_blocks_of_the_volume() {
        let job = job(DType::F32, 4).placed([-3, 17, 100]);
        for part in job.parts(40_000).unwrap() {
            let recording = job.record(&part);
            assert_eq!(recording.fault(), None);
            for (a, pass) in job.passes(&part, Quantity::Moments { square: true }).iter().enumerate() {
                let first = job.place[a] + part.lo[a] as i64 - 4 - pass.phase as i64;
                assert!(pass.phase < 9 && first.rem_euclid(9) == 0 && pass.block % 9 == 0);
                let ends = pass.m + pass.phase;
                assert!(pass.blocks * pass.block >= ends && (pass.blocks - 1) * pass.block < ends);
            }
        }
    }

    #[test]
    fn recordings_are_sound() {
        let job = job(DType::I16, 9);
        for cap in [1 << 30, 60_000] {
            for part in job.parts(cap).unwrap() {
                let recording = job.record(&part);
                assert_eq!(recording.fault(), None);
                assert_eq!(recording.dispatches().count(), 9);
                let reads = recording.commands.len() - recording.dispatches().count();
                assert_eq!(reads, job.quantities().len());
            }
        }
    }
}
