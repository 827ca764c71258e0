//! Gradients: how a brick is cut into parts that fit the device, the table of weights, and the one dispatch. Pure
//! arithmetic, shared by planner and engine.

use super::passes::{Part, largest, parts_within};
use super::record::{Bind, Buffer, Recording, Shader, Sizes};
use super::recorder::{Planes, Recorder};
use super::stored::{pitch, stored};
use crate::grid::{DType, Shape};
use crate::kernel::gradient::shared::{self, Along};
use crate::stage::GradientWeight;

/// What the dispatch does; `struct Slopes` of `shaders/gradient.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Slopes {
    pub out: [u32; 3],
    pub plane: u32,
    pub row: u32,
    pub at: [u32; 3],
    pub size: [u32; 3],
    pub half: u32,
    pub packing: u32,
    pub sign: u32,
    pub real: u32,
    pub gaps: u32,
    pub missing: u32,
    pub vector: u32,
    pub threads: u32,
    pub table: u32,
    pub stride: u32,
    pub spare: [u32; 3],
}

/// Bits of a result that the device leaves to the CPU: a NaN that arithmetic does not make.
pub const MARKED: u32 = u32::MAX;

/// Where a dispatch reads: a dense box whose rows are `pitch` voxels apart.
#[derive(Debug, Clone, Copy)]
pub(super) struct Input {
    pub bind: Bind,
    pub size: Shape,
    pub pitch: usize,
    /// Centre of output 0.
    pub centre: [usize; 3],
}

/// Beyond this ratio of the components' weights, magnitudes are not made from what f32 keeps of the smallest.
const MOST_UNEQUAL: f64 = (1u64 << 30) as f64;

/// One call, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SlopesJob {
    pub src: Shape,
    pub dst: Shape,
    pub at: [usize; 3],
    pub half: usize,
    /// Bytes of a voxel.
    pub voxel: usize,
    signed: bool,
    real: bool,
    /// Bits of missing voxels of an integer type.
    missing: Option<u32>,
    along: [Along; 3],
    /// Power of two by which the results of each component must be multiplied; magnitudes by the first, which then is all
    /// components'.
    pub scale: [f64; 3],
    /// Components come back, not magnitudes.
    pub vector: bool,
}

/// What a gradient is of: the regression, and how voxels may be missing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    pub size: usize,
    pub weight: GradientWeight,
    pub spacing: [f64; 3],
    pub missing: Option<i64>,
}

impl SlopesJob {
    /// `vector`: components are asked for. `None` if voxels of this type have no kernel here, or the weights of this spacing
    /// no finite numbers.
    pub fn new(dtype: DType, src: Shape, dst: Shape, at: [usize; 3], fit: &Fit, vector: bool) -> Option<SlopesJob> {
        let stored = stored(dtype)?;
        let along = shared::along(fit.size, fit.weight, fit.spacing);
        let most = |a: &Along| a.iter().flatten().flatten().fold(0.0f64, |m, w| m.max(w.abs()));
        let mut scale = [0, 1, 2].map(|a| power_below(most(&along[a])));
        if !along.iter().flatten().flatten().flatten().chain(&scale).all(|v| v.is_finite()) {
            return None;
        }
        let (least, greatest) = scale.iter().fold((f64::INFINITY, 0.0f64), |(l, g), s| (l.min(*s), g.max(*s)));
        let vector = vector || greatest > least * MOST_UNEQUAL;
        if !vector {
            scale = [greatest; 3];
        }
        let (low, high) = dtype.range();
        let missing = fit.missing.filter(|m| !stored.real && (low..=high).contains(&(*m as f64)));
        let missing = missing.map(|m| m as u32 & (u32::MAX >> (32 - 8 * stored.voxel)));
        let (voxel, signed, real, half) = (stored.voxel, stored.signed, stored.real, fit.size / 2);
        Some(SlopesJob { src, dst, at, half, voxel, signed, real, missing, along, scale, vector })
    }

    pub(super) fn part(&self, lo: [usize; 3], dst: Shape) -> Part {
        Part::around(self.src, self.at, [self.half; 3], lo, dst)
    }

    /// Voxels per packed row, a whole number of words.
    pub fn pitch(&self, part: &Part) -> usize {
        pitch(part.src[2], self.voxel)
    }

    /// Whether a window may be left to the CPU.
    pub fn marks(&self) -> bool {
        self.real || self.missing.is_some()
    }

    /// Planes that are made: components, or magnitudes.
    pub fn planes(&self) -> usize {
        if self.vector { 3 } else { 1 }
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

    /// The results of a part, and that they come back.
    pub fn record(&self, part: &Part) -> Recording {
        let centre = std::array::from_fn(|a| self.at[a] + part.lo[a] - part.from[a]);
        let pitch = self.pitch(part);
        let mut recorder = Recorder::new((part.src[0] * part.src[1] * pitch * self.voxel) as u64);
        let from = Input { bind: Buffer::Source.into(), size: part.src, pitch, centre };
        let planes = self.results(&from, part.dst, &mut recorder);
        let bytes = part.dst.iter().product::<usize>() as u64 * 4;
        for c in 0..self.planes() {
            recorder.read(planes.plane(c), bytes);
        }
        recorder.finish().expect("a gradient takes few buffers")
    }

    /// One plane per component, or magnitudes, left on the device, to be multiplied by [`Self::scale`].
    pub(super) fn results(&self, from: &Input, dst: Shape, to: &mut Recorder) -> Planes {
        let threads = dst.iter().product::<usize>() as u32;
        let planes = Planes::take(to, threads as usize, self.planes());
        let slopes = Slopes {
            out: dst.map(|n| n as u32),
            plane: (from.size[1] * from.pitch) as u32,
            row: from.pitch as u32,
            at: from.centre.map(|n| n as u32),
            size: from.size.map(|n| n as u32),
            half: self.half as u32,
            packing: [2, 1, 0, 0][self.voxel - 1],
            sign: if self.signed { 1 << (8 * self.voxel - 1) } else { 0 },
            real: self.real as u32,
            gaps: self.missing.is_some() as u32,
            missing: self.missing.unwrap_or(0),
            vector: self.vector as u32,
            threads,
            table: to.table(self.table()),
            stride: planes.stride,
            spare: [0; 3],
        };
        let bind = [from.bind, planes.buffer.into(), Buffer::Tables.into()];
        to.dispatch(Shader::Gradient, 0, &slopes, &bind, threads);
        planes
    }

    /// Weights as the shader adds them up: mirrored voxels are added for every axis, also where both sides are one voxel.
    fn table(&self) -> Vec<u32> {
        let mut words = Vec::with_capacity(81);
        for (a, along) in self.along.iter().enumerate() {
            for (z, y, x) in (0..3).flat_map(|z| (0..3).flat_map(move |y| (0..3).map(move |x| (z, y, x)))) {
                let twice = [z, y, x].iter().enumerate().filter(|(b, d)| *b != a && **d == 0).count();
                let w = along[z][y][x] / self.scale[a] / (1 << twice) as f64;
                words.push((w as f32).to_bits());
            }
        }
        words
    }
}

/// The greatest power of two that is no greater; of a subnormal or less than that, NaN.
fn power_below(v: f64) -> f64 {
    let exponent = v.to_bits() & (0x7ff << 52);
    if v > 0.0 && exponent > 0 { f64::from_bits(exponent) } else { f64::NAN }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(size: usize, spacing: [f64; 3]) -> Fit {
        Fit { size, weight: GradientWeight::Distance, spacing, missing: Some(-3) }
    }

    #[test]
    fn recordings_are_sound_and_parts_tile_the_outputs() {
        for (dtype, vector) in [(DType::U8, false), (DType::I16, true), (DType::F32, false)] {
            for size in [3, 5] {
                let fit = fit(size, [1.0, 2.0, 0.5]);
                let job = SlopesJob::new(dtype, [24, 34, 54], [20, 30, 40], [2; 3], &fit, vector).unwrap();
                for cap in [1 << 30, 20_000, 2_000] {
                    let parts = job.parts(cap).unwrap();
                    assert_eq!(parts.iter().map(|p| p.dst.iter().product::<usize>()).sum::<usize>(), 20 * 30 * 40);
                    for part in &parts {
                        let recording = job.record(part);
                        assert_eq!(recording.fault(), None);
                        assert!(recording.sizes.largest() <= cap);
                        assert!((0..3).all(|a| part.src[a] == part.dst[a] + 2 * job.half));
                    }
                }
                assert!(job.parts(300).is_none());
            }
        }
    }

    #[test]
    fn spacings_that_f32_cannot_hold_are_refused_or_come_back_by_component() {
        let job = |spacing| SlopesJob::new(DType::U8, [9; 3], [5; 3], [2; 3], &fit(5, spacing), false);
        assert!(!job([1.0, 1.0, 1.0]).unwrap().vector);
        assert!(!job([1e-30, 1e-30, 2e-30]).unwrap().vector, "a power of two is taken out");
        assert!(job([1e15, 1.0, 1.0]).unwrap().vector);
        assert!(job([1e-200, 1.0, 1e200]).is_none());
        let mixed = job([1.0, 4.0, 1.0]).unwrap();
        assert_eq!(mixed.scale, [mixed.scale[0]; 3]);
        assert!(mixed.table().iter().all(|w| f32::from_bits(*w) < 2.0));
        assert!(SlopesJob::new(DType::F64, [9; 3], [5; 3], [2; 3], &fit(5, [1.0; 3]), true).is_none());
    }

    #[test]
    fn a_marker_beyond_the_type_marks_nothing() {
        let missing = |dtype, value| {
            let fit = Fit { missing: Some(value), ..fit(3, [1.0; 3]) };
            SlopesJob::new(dtype, [9; 3], [5; 3], [2; 3], &fit, false).unwrap().missing
        };
        assert_eq!(missing(DType::U8, 200), Some(200));
        assert_eq!(missing(DType::U8, 256), None);
        assert_eq!(missing(DType::I8, -3), Some(0xfd));
        assert_eq!(missing(DType::I16, -3), Some(0xfffd));
        assert_eq!(missing(DType::F32, 0), None);
    }
}
