//! A Gaussian mean and the gradient of it in one go: the mean stays on the device. Pure arithmetic, shared by planner and
//! engine.

use super::passes::{Part, cut};
use super::record::{Buffer, Command, PARAMS_STRIDE, Readback, Recording, Sizes, rounded};
use super::slopes::{Fit, Input, SlopesJob, WEIGHTS};
use super::taps::{TapsJob, Wanted};
use crate::grid::{DType, Shape};

/// The two calls, and how the boxes of the second lie in the results of the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainJob {
    pub taps: TapsJob,
    /// Of f32 means; its source box is `middle`.
    pub slopes: SlopesJob,
}

/// A box of the gradients: what it reads of the means, and what they read of the voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainPart {
    /// Its source is part of the means.
    pub slopes: Part,
    /// Its outputs are the source of `slopes`.
    pub taps: Part,
}

/// What a chain reads and makes, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extents {
    /// The Gaussian's source; its outputs, and where the first of them lies in the source.
    pub src: Shape,
    pub middle: Shape,
    pub at: [usize; 3],
    /// The gradient's outputs, and where the first of them lies among the means. Means beyond the box are those at its edge,
    /// which is the volume's.
    pub dst: Shape,
    pub inner: [usize; 3],
}

impl ChainJob {
    /// `None` where one of the two has no kernel, or the gradient's weights do not suit f32.
    pub fn new(dtype: DType, extents: &Extents, sigma: [f64; 3], fit: &Fit, vector: bool) -> Option<ChainJob> {
        let Extents { src, middle, at, dst, inner } = *extents;
        let taps = TapsJob::new(dtype, src, middle, at, sigma, Wanted { mean: true, variance: false })?;
        let slopes = SlopesJob::new(DType::F32, middle, dst, inner, fit, vector)?;
        Some(ChainJob { taps, slopes })
    }

    fn part(&self, lo: [usize; 3], dst: Shape) -> ChainPart {
        let slopes = Part::around(self.slopes.src, self.slopes.at, [self.slopes.half; 3], lo, dst);
        ChainPart { slopes, taps: self.taps.part(slopes.from, slopes.src) }
    }

    fn sizes(&self, part: &ChainPart) -> Sizes {
        let first = self.taps.sizes(&part.taps);
        let results = rounded(self.slopes.result_bytes(part.slopes.dst));
        Sizes {
            params: first.params + PARAMS_STRIDE,
            tables: rounded(first.tables + 4 * WEIGHTS),
            b: first.b.max(results),
            read: results,
            ..first
        }
    }

    /// Parts of which every buffer is at most `cap` bytes; `None` where even one voxel does not fit.
    pub fn parts(&self, cap: u64) -> Option<Vec<ChainPart>> {
        let boxes = cut(self.slopes.dst, |lo, shape| self.sizes(&self.part(lo, shape)).largest() <= cap)?;
        Some(boxes.into_iter().map(|(lo, shape)| self.part(lo, shape)).collect())
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        let parts = self.parts(cap).unwrap_or_default();
        parts.iter().map(|p| self.sizes(p)).fold(Sizes::default(), Sizes::max)
    }

    /// The Gaussian's passes, whose results are left where they are, then the gradient's.
    pub fn record(&self, part: &ChainPart) -> Recording {
        let mut recording = self.taps.record(&part.taps);
        recording.commands.retain(|c| matches!(c, Command::Dispatch(_)));
        let table = recording.tables.len() as u32;
        recording.tables.extend(self.slopes.table());
        let Part { lo, from, src, dst } = part.slopes;
        let centre = std::array::from_fn(|a| self.slopes.at[a] + lo[a] - from[a]);
        let from = Input { buffer: Buffer::A, size: src, pitch: src[2], centre, table };
        recording.commands.push(Command::Dispatch(self.slopes.dispatch(&from, dst, Buffer::B)));
        let bytes = self.slopes.result_bytes(dst);
        recording.commands.push(Command::Readback(Readback { from: Buffer::B, bytes, to: 0 }));
        Recording { sizes: self.sizes(part), ..recording }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stage::GradientWeight;

    #[test]
    fn recordings_are_sound_and_boxes_nest() {
        let extents =
            Extents { src: [30, 34, 54], middle: [24, 26, 40], at: [3, 0, 7], dst: [20, 24, 38], inner: [2, 0, 2] };
        let fit = Fit { size: 5, weight: GradientWeight::Distance, spacing: [1.0; 3], missing: None };
        for vector in [false, true] {
            let job = ChainJob::new(DType::U8, &extents, [0.9, 1.0, 1.4], &fit, vector).unwrap();
            for cap in [1 << 30, 60_000, 20_000] {
                let parts = job.parts(cap).unwrap();
                assert_eq!(parts.len() == 1, cap == 1 << 30);
                assert_eq!(parts.iter().map(|p| p.slopes.dst.iter().product::<usize>()).sum::<usize>(), 20 * 24 * 38);
                for part in &parts {
                    let recording = job.record(part);
                    assert_eq!(recording.fault(), None);
                    assert!(recording.sizes.largest() <= cap);
                    assert_eq!(recording.dispatches().count(), 4);
                    assert_eq!((part.taps.lo, part.taps.dst), (part.slopes.from, part.slopes.src));
                    let backs = recording.commands.iter().filter(|c| matches!(c, Command::Readback(_))).count();
                    assert_eq!(backs, 1, "means do not come back");
                }
            }
            assert!(job.parts(1000).is_none());
        }
        assert!(ChainJob::new(DType::F32, &extents, [1.0; 3], &fit, false).is_none());
    }
}
