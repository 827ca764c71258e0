//! A Gaussian mean and the step that reads it, a gradient or windows, in one go: the mean stays on the device. Pure
//! arithmetic, shared by planner and engine.

use super::passes::{Job, Part, largest, parts_within};
use super::record::{Buffer, Command, PARAMS_STRIDE, Readback, Recording, Sizes, rounded};
use super::slopes::{Fit, Input, SlopesJob, WEIGHTS};
use super::taps::{TapsJob, Wanted};
use crate::grid::{DType, Shape};
use crate::kernel::window::Needs;
use crate::stage::{WindowChannel, WindowParams};

/// The two steps; the boxes of the second lie in the results of the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainJob {
    pub taps: TapsJob,
    /// Of f32 means; its source box is `middle`.
    pub reader: Reader,
}

/// The second step.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(clippy::large_enum_variant)] // one per call, and none is kept
pub enum Reader {
    Slopes(SlopesJob),
    /// Whose results the device makes itself.
    Windows(Job),
}

/// A box of the results: what it reads of the means, and what they read of the voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainPart {
    /// Its source is part of the means.
    pub reader: Part,
    /// Its outputs are the source of `reader`.
    pub taps: Part,
}

/// What a chain reads and makes, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extents {
    /// The Gaussian's source; its outputs, and where the first of them lies in the source.
    pub src: Shape,
    pub middle: Shape,
    pub at: [usize; 3],
    /// The second step's outputs, and where the first of them lies among the means, whose edge is the volume's where a
    /// window sees it.
    pub dst: Shape,
    pub inner: [usize; 3],
}

impl Reader {
    fn dst(&self) -> Shape {
        match self {
            Reader::Slopes(job) => job.dst,
            Reader::Windows(job) => job.dst,
        }
    }

    fn part(&self, lo: [usize; 3], dst: Shape) -> Part {
        match self {
            // Means beyond the edge of the volume are those at it.
            Reader::Slopes(job) => Part::around(job.src, job.at, [job.half; 3], lo, dst),
            Reader::Windows(job) => job.part(lo, dst),
        }
    }

    /// Buffers besides the means.
    fn sizes(&self, part: &Part) -> Sizes {
        match self {
            Reader::Slopes(job) => {
                let results = rounded(job.result_bytes(part.dst));
                Sizes { params: PARAMS_STRIDE, tables: 4 * WEIGHTS, a: results, read: results, ..Sizes::default() }
            }
            Reader::Windows(job) => Sizes { source: 0, ..job.sizes(part) },
        }
    }

    /// Adds what reads the means in `D`.
    fn append(&self, part: &Part, recording: &mut Recording) {
        match self {
            Reader::Slopes(job) => {
                let table = recording.tables.len() as u32;
                recording.tables.extend(job.table());
                let Part { lo, from, src, dst } = *part;
                let centre = std::array::from_fn(|a| job.at[a] + lo[a] - from[a]);
                let from = Input { buffer: Buffer::D, size: src, pitch: src[2], centre, table };
                recording.commands.push(Command::Dispatch(job.dispatch(&from, dst, Buffer::A)));
                let bytes = job.result_bytes(dst);
                recording.commands.push(Command::Readback(Readback { from: Buffer::A, bytes, to: 0 }));
            }
            Reader::Windows(job) => {
                recording.commands.extend(job.record(part).commands.into_iter().map(|mut command| {
                    if let Command::Dispatch(d) = &mut command {
                        d.bind.iter_mut().filter(|b| **b == Buffer::Source).for_each(|b| *b = Buffer::D);
                    }
                    command
                }))
            }
        }
    }
}

impl ChainJob {
    fn new(dtype: DType, extents: &Extents, sigma: [f64; 3], reader: Reader) -> Option<ChainJob> {
        let Extents { src, middle, at, .. } = *extents;
        let taps = TapsJob::new(dtype, src, middle, at, sigma, Wanted { mean: true, variance: false })?;
        Some(ChainJob { taps, reader })
    }

    /// With a gradient. `None` where one of the two has no kernel, or the gradient's weights do not suit f32.
    pub fn gradient(dtype: DType, e: &Extents, sigma: [f64; 3], fit: &Fit, vector: bool) -> Option<ChainJob> {
        let slopes = SlopesJob::new(DType::F32, e.middle, e.dst, e.inner, fit, vector)?;
        ChainJob::new(dtype, e, sigma, Reader::Slopes(slopes))
    }

    /// With windows, the first of which lies at `place` of the volume. `None` where one of the two has no kernel, or the
    /// device does not make the results of the channels.
    pub fn windows(
        dtype: DType,
        e: &Extents,
        sigma: [f64; 3],
        params: &WindowParams,
        channels: &[WindowChannel],
        place: [i64; 3],
    ) -> Option<ChainJob> {
        let needs = Needs::of(channels.iter().copied(), true);
        let job = Job::new(DType::F32, e.middle, e.dst, e.inner, params.radius, needs)?;
        let job = job.placed(place).finished(params, channels);
        job.finish?;
        ChainJob::new(dtype, e, sigma, Reader::Windows(job))
    }

    fn part(&self, lo: [usize; 3], dst: Shape) -> ChainPart {
        let reader = self.reader.part(lo, dst);
        ChainPart { reader, taps: self.taps.part(reader.from, reader.src) }
    }

    fn sizes(&self, part: &ChainPart) -> Sizes {
        let (first, second) = (self.taps.sizes(&part.taps), self.reader.sizes(&part.reader));
        let means = part.taps.dst.iter().map(|&n| n as u64).product::<u64>() * 4;
        Sizes {
            params: first.params + second.params,
            tables: rounded(first.tables + second.tables),
            d: rounded(means),
            read: second.read,
            ..first.max(second)
        }
    }

    /// Parts of which every buffer is at most `cap` bytes; `None` where even one voxel does not fit.
    pub fn parts(&self, cap: u64) -> Option<Vec<ChainPart>> {
        parts_within(self.reader.dst(), cap, |lo, shape| self.part(lo, shape), |p| self.sizes(p))
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        largest(self.parts(cap), |p| self.sizes(p))
    }

    /// The Gaussian's passes, whose results are left on the device, then the second step's.
    pub fn record(&self, part: &ChainPart) -> Recording {
        let mut recording = self.taps.record_into(&part.taps, Buffer::D);
        recording.sizes = self.sizes(part);
        self.reader.append(&part.reader, &mut recording);
        recording
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Affine;
    use crate::stage::GradientWeight;

    const EXTENTS: Extents =
        Extents { src: [30, 34, 54], middle: [24, 26, 40], at: [3, 0, 7], dst: [20, 24, 38], inner: [2, 0, 2] };

    fn jobs() -> Vec<(ChainJob, usize)> {
        let fit = Fit { size: 5, weight: GradientWeight::Distance, spacing: [1.0; 3], missing: None };
        let sigma = [0.9, 1.0, 1.4];
        let params = WindowParams { radius: [2, 3, 2], affine: Affine::IDENTITY, missing: None, solid_low: false };
        let channels = [WindowChannel::Mean, WindowChannel::Std];
        let windows = ChainJob::windows(DType::I16, &EXTENTS, sigma, &params, &channels, [5; 3]);
        let mut jobs = vec![(windows.unwrap(), 3 + 6 + 1)];
        jobs.extend([false, true].map(|v| (ChainJob::gradient(DType::U8, &EXTENTS, sigma, &fit, v).unwrap(), 4)));
        assert!(ChainJob::gradient(DType::F32, &EXTENTS, sigma, &fit, false).is_none());
        let scaled = WindowParams { affine: Affine { slope: 2.0, intercept: 0.0 }, ..params };
        assert!(ChainJob::windows(DType::I16, &EXTENTS, sigma, &scaled, &channels, [5; 3]).is_none());
        jobs
    }

    #[test]
    fn recordings_are_sound_boxes_nest_and_means_do_not_come_back() {
        for (job, dispatches) in jobs() {
            for cap in [1 << 30, 120_000, 40_000] {
                let parts = job.parts(cap).unwrap();
                assert_eq!(parts.len() == 1, cap == 1 << 30);
                assert_eq!(parts.iter().map(|p| p.reader.dst.iter().product::<usize>()).sum::<usize>(), 20 * 24 * 38);
                for part in &parts {
                    let recording = job.record(part);
                    assert_eq!(recording.fault(), None);
                    assert!(recording.sizes.largest() <= cap);
                    assert_eq!(recording.dispatches().count(), dispatches);
                    assert_eq!((part.taps.lo, part.taps.dst), (part.reader.from, part.reader.src));
                    let backs = recording.commands.iter().filter(|c| matches!(c, Command::Readback(_))).count();
                    assert_eq!(backs, 1);
                    assert_eq!(recording.dispatches().filter(|d| d.bind.contains(&Buffer::Source)).count(), 1);
                }
            }
            assert!(job.parts(1000).is_none());
        }
    }
}
