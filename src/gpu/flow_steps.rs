//! The steps of a flow, each recorded over a box: from slabs to slabs.

use super::flow::{FlowStep, Kernel, State};
use super::levels::Slab;
use super::passes::{Job, Part};
use super::points::{Op, Read, look};
use super::record::{Buffer, Shader};
use super::recorder::{Planes, Recorder};
use super::slopes::{Fit, Input, SlopesJob};
use super::stored::Stored;
use super::sweep::{Keys, SweepJob, SweepPart};
use super::taps::{TapsJob, Wanted};
use super::unfit::Unfit;
use crate::grid::{Affine, DType, Region};
use crate::kernel::obscurance::Prepared;
use crate::kernel::window::Needs;
use crate::stage::{WindowChannel, WindowParams};

/// The channels that a step made.
#[derive(Debug, Clone)]
pub(super) struct Made {
    pub slabs: Vec<Slab>,
    pub stored: Stored,
    pub affine: Affine,
}

impl Made {
    pub fn nothing() -> Made {
        Made::floats(vec![])
    }

    fn floats(slabs: Vec<Slab>) -> Made {
        Made { slabs, stored: Stored { voxel: 4, signed: false, real: true }, affine: Affine::IDENTITY }
    }

    /// Channels that are planes of a box, densely packed.
    fn planes(planes: &Planes, count: usize, region: &Region) -> Made {
        let slab = |c: usize| Slab { bind: planes.plane(c), region: *region, pitch: region.shape()[2] };
        Made::floats((0..count).map(slab).collect())
    }

    pub fn read(&self, channel: usize) -> Read {
        Read { slab: self.slabs[channel], stored: self.stored, affine: self.affine }
    }

    /// Gives its buffers back; several channels may share one.
    pub fn release(&mut self, to: &mut Recorder) {
        self.slabs.drain(..).for_each(|s| to.give(s.bind.buffer));
    }
}

/// Where a kernel of windows reads and writes.
struct Window {
    read: Read,
    dtype: DType,
    region: Region,
}

impl Window {
    /// The whole of what is read is a part's source.
    fn part(&self) -> Part {
        Part { lo: [0; 3], dst: self.region.shape(), from: [0; 3], src: self.read.slab.region.shape() }
    }

    fn at(&self) -> [usize; 3] {
        self.read.slab.region.offset_of(&self.region)
    }
}

impl FlowStep {
    /// Makes the step's channels over a box. Where a window may be left to the CPU, `flag` says so.
    ///
    /// # Errors
    /// There is no kernel for what it reads, or not within `cap` bytes.
    pub(super) fn record(
        &self,
        state: &State,
        region: &Region,
        cap: u64,
        flag: &mut Option<Buffer>,
        to: &mut Recorder,
    ) -> Result<Made, Unfit> {
        let reads: Vec<Read> = self.inputs.iter().map(|i| state.read(*i)).collect();
        let read = *reads.first().ok_or(Unfit::Kernel)?;
        let extended = self.extended(&read, region, state.volume(), to);
        let read = extended.unwrap_or(read);
        let window = Window { read, dtype: read.stored.dtype(), region: *region };
        let made = match &self.kernel {
            Kernel::Gaussian { sigma, wanted } => window.gaussian(*sigma, *wanted, to).ok_or(Unfit::Kernel),
            Kernel::Gradient { fit, magnitude, vector } => {
                window.gradient(fit, [*magnitude, *vector], flag, to).ok_or(Unfit::Kernel)
            }
            Kernel::Windows { params, channels } => window.windows(params, channels, flag, to).ok_or(Unfit::Kernel),
            Kernel::Sweep(prepared) => window.sweep(prepared, cap, to),
            Kernel::Points(ops) => {
                let planes = Planes::take(to, region.voxels(), ops.len());
                for (c, (op, of)) in ops.iter().enumerate() {
                    let reads: Vec<Read> = of.iter().map(|&i| reads[i]).collect();
                    op.record(&reads, region, planes.plane(c), to);
                }
                Ok(Made::planes(&planes, ops.len(), region))
            }
        };
        extended.iter().for_each(|r| to.give(r.slab.bind.buffer));
        made
    }

    /// What windows with a border rule read.
    fn extended(&self, read: &Read, region: &Region, volume: &Region, to: &mut Recorder) -> Option<Read> {
        match self.kernel {
            Kernel::Windows { .. } | Kernel::Gaussian { .. } => {
                self.beyond.record(read, &region.grow(self.reach), volume, to)
            }
            _ => None,
        }
    }
}

impl Window {
    fn gaussian(&self, sigma: [f64; 3], wanted: Wanted, to: &mut Recorder) -> Option<Made> {
        let part = self.part();
        let job = TapsJob::new(self.dtype, part.src, part.dst, self.at(), sigma, wanted)?;
        let affine = self.read.affine;
        let squared = Affine { slope: affine.slope * affine.slope, intercept: 0.0 };
        let made = job.results(&part, self.read.slab.bind, to);
        let scaled = |(made, affine): (Option<Buffer>, Affine)| {
            let slab = Slab { bind: made?.into(), region: self.region, pitch: part.dst[2] };
            Some(if affine.is_identity() { slab } else { scale(slab, affine, to) })
        };
        Some(Made::floats(made.into_iter().zip([affine, squared]).filter_map(scaled).collect()))
    }

    fn gradient(
        &self,
        fit: &Fit,
        [magnitude, vector]: [bool; 2],
        flag: &mut Option<Buffer>,
        to: &mut Recorder,
    ) -> Option<Made> {
        let part = self.part();
        let job = SlopesJob::new(self.dtype, part.src, part.dst, self.at(), fit, vector)?;
        let from = Input { bind: self.read.slab.bind, size: part.src, pitch: self.read.slab.pitch, centre: self.at() };
        let raw = job.results(&from, part.dst, to);
        if job.marks() {
            raise(&raw, &part, flag, to);
        }
        // The weights' powers of two and the slope, as the CPU multiplies; + 0 makes a zero positive whatever the slope.
        let slope = self.read.affine.slope;
        let slope = if job.vector { slope } else { slope.abs() };
        let raw_made = Made::planes(&raw, job.planes(), &self.region);
        let reads: Vec<Read> = (0..job.planes())
            .map(|c| Read { affine: Affine { slope: job.scale[c] * slope, intercept: 0.0 }, ..raw_made.read(c) })
            .collect();
        let count = magnitude as usize + 3 * vector as usize;
        let planes = Planes::take(to, self.region.voxels(), count);
        let mut next = 0;
        let mut make = |op: Op, reads: &[Read], to: &mut Recorder| {
            op.record(reads, &self.region, planes.plane(next), to);
            next += 1;
        };
        if magnitude {
            make(if job.vector { Op::Length } else { Op::Scale }, &reads, to);
        }
        if vector {
            reads.iter().for_each(|r| make(Op::Scale, &[*r], to));
        }
        to.give(raw.buffer);
        Some(Made::planes(&planes, count, &self.region))
    }

    fn sweep(&self, prepared: &Prepared, cap: u64, to: &mut Recorder) -> Result<Made, Unfit> {
        let from = self.read.slab;
        let job = SweepJob::new(prepared, self.dtype, from.region, self.region).ok_or(Unfit::Kernel)?;
        let [nz, ny, _] = from.region.shape();
        let words = (nz * ny * from.pitch * self.read.stored.voxel).div_ceil(4);
        let codes = to.take(words as u64 * 4);
        let keys = Keys::new(words, self.read.stored, prepared.params().flipped);
        to.dispatch(Shader::SweepCodes, 0, &keys, &[from.bind, codes.into()], keys.threads);
        let part = SweepPart { dst: self.region, src: from.region };
        let sums = job.sums(&part, codes.into(), cap, to)?;
        to.give(codes);
        // Of the sums, and NaN where the voxel is.
        let planes = Planes::take(to, self.region.voxels(), 1);
        let slab = Slab { bind: sums.into(), region: self.region, pitch: self.region.shape()[2] };
        let stored = Stored { voxel: 4, signed: false, real: false };
        let mut reads = vec![Read { slab, stored, affine: Affine::IDENTITY }];
        reads.extend(self.read.stored.real.then_some(Read { affine: Affine::IDENTITY, ..self.read }));
        Op::Share { of: prepared.total() }.record(&reads, &self.region, planes.plane(0), to);
        to.give(sums);
        Ok(Made::planes(&planes, 1, &self.region))
    }

    fn windows(
        &self,
        params: &WindowParams,
        channels: &[WindowChannel],
        flag: &mut Option<Buffer>,
        to: &mut Recorder,
    ) -> Option<Made> {
        let part = self.part();
        let needs = Needs::of(channels.iter().copied(), self.dtype == DType::F32);
        let job = Job::new(self.dtype, part.src, part.dst, self.at(), params.radius, needs)?;
        let job = job.placed(self.region.lo).finished(params, channels);
        let planes = job.results(&part, self.read.slab.bind, &job.finish?, to);
        if job.real {
            raise(&planes, &part, flag, to);
        }
        Some(Made::planes(&planes, channels.len(), &self.region))
    }
}

/// Raises the flag where a window is left to the CPU: marks stand in all planes.
fn raise(planes: &Planes, part: &Part, flag: &mut Option<Buffer>, to: &mut Recorder) {
    let flag = *flag.get_or_insert_with(|| to.flag());
    look(planes.plane(0), part.dst.iter().product(), flag, to);
}

/// A slab multiplied and moved, which takes its place.
fn scale(slab: Slab, affine: Affine, to: &mut Recorder) -> Slab {
    let planes = Planes::take(to, slab.region.voxels(), 1);
    let read = Read { affine, ..Made::floats(vec![slab]).read(0) };
    Op::Scale.record(&[read], &slab.region, planes.plane(0), to);
    to.give(slab.bind.buffer);
    Slab { bind: planes.plane(0), ..slab }
}
