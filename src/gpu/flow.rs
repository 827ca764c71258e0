//! Several steps of the graph on one brick, recorded together: what one makes for another stays on the device, and so do
//! channels of which only levels and codes are asked for. A flow is data; [`Flow::part`] turns a box of it into a recording.
//!
//! All boxes are in voxels of the volume. A part's boxes go from the sinks backward: each step makes what its readers see.

use std::sync::Arc;

use super::extend::Beyond;
use super::flow_steps::Made;
use super::levels::{Placed, Pyramid, Slab};
use super::masks::Mask;
use super::points::{LOOKED, Op};
use super::record::{Bind, Buffer, Recording, Sizes, rounded};
use super::recorder::Recorder;
use super::slopes::Fit;
use super::stored::{pitch, stored};
use super::sweep::repeated;
use super::taps::Wanted;
use super::unfit::{Unfit, cut_to};
use crate::grid::{Affine, DType, Region};
use crate::kernel::obscurance::Prepared;
use crate::stage::{WindowChannel, WindowParams};

/// What a step computes.
#[derive(Debug, Clone, PartialEq)]
pub enum Kernel {
    Gaussian {
        sigma: [f64; 3],
        wanted: Wanted,
    },
    Gradient {
        fit: Fit,
        magnitude: bool,
        vector: bool,
    },
    /// Openness by obscurance.
    Sweep(Arc<Prepared>),
    Windows {
        params: WindowParams,
        channels: Vec<WindowChannel>,
    },
    /// One operation per channel that it makes, and which of the step's inputs it reads.
    Points(Vec<(Op, Vec<usize>)>),
}

/// A channel that a step reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// The voxels that the host gives.
    Source,
    /// A channel of an earlier step.
    Made { step: usize, channel: usize },
}

/// One step.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowStep {
    pub kernel: Kernel,
    /// Those with windows have one.
    pub inputs: Vec<Input>,
    /// Voxels that a window sees on each side.
    pub reach: [usize; 3],
    /// What windows see beyond the volume. Gradients see the nearest voxels, whatever stands here.
    pub beyond: Beyond,
    /// Of a masked step, by channel: what stands where nothing is needed.
    pub fills: Option<Vec<f32>>,
}

/// What becomes of a channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Sink {
    pub value: Input,
    /// The channel beside it that a pyramid of moments pools.
    pub mean: Option<Input>,
    /// All that is wanted of it.
    pub region: Region,
    /// `None`: the channel itself comes back.
    pub pyramid: Option<Pyramid>,
}

/// Steps over one source.
#[derive(Debug, Clone, PartialEq)]
pub struct Flow {
    pub dtype: DType,
    /// Of the source; channels that steps make have none.
    pub affine: Affine,
    pub volume: Region,
    /// Each reads the source or earlier ones.
    pub steps: Vec<FlowStep>,
    pub sinks: Vec<Sink>,
}

/// A box of a flow, recorded.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowPart {
    /// What the host packs, in rows of `pitch` voxels.
    pub source: Region,
    pub pitch: usize,
    /// The masks behind it.
    pub masks: Vec<Mask>,
    pub recording: Recording,
    /// By sink: the box that this part makes, and where it stands among what comes back.
    pub placed: Vec<Option<(Region, Placed)>>,
    /// Where the flag stands that says whether a window is left to the CPU.
    pub flag: Option<u64>,
}

impl Flow {
    /// The source's box that all sinks together need.
    pub fn source(&self) -> Option<Region> {
        self.boxes(|sink| Some(sink.region)).map(|(source, _)| source)
    }

    /// Boxes of the source and of the steps for what is wanted of each sink; `None` where nothing is.
    fn boxes(&self, wanted: impl Fn(&Sink) -> Option<Region>) -> Option<(Region, Vec<Option<Region>>)> {
        fn need(have: &mut Option<Region>, region: Region) {
            *have = Some(have.map_or(region, |h| h.union(&region)));
        }
        let (mut source, mut boxes) = (None, vec![None; self.steps.len()]);
        let mut of = |boxes: &mut Vec<Option<Region>>, input: Input, region: Region| match input {
            Input::Source => need(&mut source, region),
            Input::Made { step, .. } => need(&mut boxes[step], region),
        };
        for sink in &self.sinks {
            let Some(region) = wanted(sink) else { continue };
            [Some(sink.value), sink.mean].into_iter().flatten().for_each(|i| of(&mut boxes, i, region));
        }
        for (s, step) in self.steps.iter().enumerate().rev() {
            let Some(region) = boxes[s] else { continue };
            let seen = region.grow(step.reach).clip(&self.volume);
            step.inputs.iter().for_each(|&i| of(&mut boxes, i, seen));
        }
        source.map(|s| (s, boxes))
    }

    /// A box that holds all sinks, and the edges of the cells in whose multiples it may be cut, from a place on.
    fn hull(&self) -> Option<(Region, [usize; 3], [i64; 3])> {
        let hull = self.sinks.iter().map(|s| s.region).reduce(|a, b| a.union(&b))?;
        let pyramids = || self.sinks.iter().filter_map(|s| s.pyramid.as_ref().map(|p| (s, p)));
        let unit = pyramids().fold([1; 3], |u, (_, p)| std::array::from_fn(|a| u[a].max(p.factor()[a])));
        Some((hull, unit, pyramids().next().map_or(hull.lo, |(s, _)| s.region.lo)))
    }

    /// Parts of which every buffer is at most `cap` bytes.
    ///
    /// # Errors
    /// There are none, or too many buffers are needed.
    pub fn parts(&self, cap: u64) -> Result<Vec<FlowPart>, Unfit> {
        let (hull, unit, origin) = self.hull().ok_or(Unfit::Kernel)?;
        let cells = hull.cells(origin, unit);
        let region = |lo: [usize; 3], shape: [usize; 3]| {
            let at = |a: usize, i: usize| origin[a] + (cells.lo[a] + i as i64) * unit[a] as i64;
            let lo_hi =
                Region::new(std::array::from_fn(|a| at(a, lo[a])), std::array::from_fn(|a| at(a, lo[a] + shape[a])));
            lo_hi.clip(&hull)
        };
        // Each box is recorded once more when it is known to fit: recording takes microseconds.
        let boxes = cut_to(cells.shape(), cap, |lo, shape| {
            Ok(self.part(&region(lo, shape), cap)?.map_or(Sizes::default(), |p| p.recording.sizes))
        })?;
        let made = boxes.into_iter().map(|(lo, shape)| self.part(&region(lo, shape), cap));
        let parts: Vec<FlowPart> = made.filter_map(Result::transpose).collect::<Result<_, _>>()?;
        // A sweep's halo is large.
        if self.steps.iter().any(|s| matches!(s.kernel, Kernel::Sweep(_))) {
            repeated(parts.iter().map(|p| p.source.voxels()), self.source().map_or(0, |s| s.voxels()))?;
        }
        Ok(parts)
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        let parts = self.parts(cap).unwrap_or_default();
        parts.iter().map(|p| p.recording.sizes).fold(Sizes::default(), Sizes::max)
    }

    /// Records what of the flow lies in a box; `None` where nothing does.
    fn part(&self, region: &Region, cap: u64) -> Result<Option<FlowPart>, Unfit> {
        let own = |sink: &Sink| Some(sink.region.clip(region)).filter(|r| !r.is_empty());
        let Some((source, boxes)) = self.boxes(own) else { return Ok(None) };
        let kind = stored(self.dtype).ok_or(Unfit::Kernel)?;
        let pitch = pitch(source.shape()[2], kind.voxel);
        let mut bytes = rounded((source.shape()[0] * source.shape()[1] * pitch * kind.voxel) as u64);
        let mut masks = Vec::new();
        for (step, region) in boxes.iter().enumerate().filter(|(s, _)| self.steps[*s].fills.is_some()) {
            let Some(region) = *region else { continue };
            masks.push(Mask { step, region, from: bytes });
            bytes += masks[masks.len() - 1].bytes();
        }
        let mut to = Recorder::new(bytes);
        let slab = Slab { bind: Buffer::Source.into(), region: source, pitch };
        let mut state = State {
            flow: self,
            masks: &masks,
            source: Made { slabs: vec![slab], stored: kind, affine: self.affine },
            made: vec![],
        };
        let mut placed = vec![None; self.sinks.len()];
        let mut flag = None;
        for (s, step) in self.steps.iter().enumerate() {
            let made = match &boxes[s] {
                Some(region) => step.record(&state, region, cap, &mut flag, &mut to)?,
                None => Made::nothing(),
            };
            if let (Some(mask), Some(fills)) = (state.mask(s), &step.fills) {
                made.slabs.iter().zip(fills).for_each(|(slab, fill)| mask.fill(slab.bind, *fill, &mut to));
            }
            state.made.push(made);
            for (sink, placed) in self.sinks.iter().zip(&mut placed).filter(|(sink, _)| sink.ready() == Some(s)) {
                *placed = own(sink).map(|region| (region, state.deliver(sink, &region, &mut to)));
            }
            state.release(s, &mut to);
        }
        let flag = flag.map(|f: Buffer| to.read(Bind::from(f), LOOKED));
        Ok(Some(FlowPart { source, pitch, masks, recording: to.finish()?, placed, flag }))
    }
}

impl Sink {
    /// The step after which it can be made.
    fn ready(&self) -> Option<usize> {
        [Some(self.value), self.mean].into_iter().flatten().filter_map(Input::step).max()
    }
}

impl Input {
    fn step(self) -> Option<usize> {
        match self {
            Input::Source => None,
            Input::Made { step, .. } => Some(step),
        }
    }
}

/// What is on the device while a part is recorded.
pub(super) struct State<'a> {
    flow: &'a Flow,
    masks: &'a [Mask],
    source: Made,
    made: Vec<Made>,
}

impl State<'_> {
    /// A channel and how it is stored.
    pub fn read(&self, input: Input) -> super::points::Read {
        match input {
            Input::Source => self.source.read(0),
            Input::Made { step, channel } => self.made[step].read(channel),
        }
    }

    pub fn volume(&self) -> &Region {
        &self.flow.volume
    }

    /// The mask of a step.
    fn mask(&self, step: usize) -> Option<&Mask> {
        self.masks.iter().find(|m| m.step == step)
    }

    fn deliver(&self, sink: &Sink, region: &Region, to: &mut Recorder) -> Placed {
        let value = self.read(sink.value).slab;
        let mean = sink.mean.map(|m| self.read(m).slab);
        match &sink.pyramid {
            Some(pyramid) => {
                let mask = sink.value.step().and_then(|s| self.mask(s));
                pyramid.record(&value, mean.as_ref(), mask, region, to)
            }
            None => Pyramid::plain().record(&value, None, None, region, to),
        }
    }

    /// Gives back what no step or sink after step `s` reads.
    fn release(&mut self, s: usize, to: &mut Recorder) {
        let after = |input: &Input, step: usize| input.step() == Some(step);
        for made in 0..=s {
            let steps = self.flow.steps[s + 1..].iter().any(|t| t.inputs.iter().any(|i| after(i, made)));
            let sinks = self.flow.sinks.iter().filter(|k| k.ready() > Some(s));
            let wanted = sinks.flat_map(|k| [Some(k.value), k.mean]).flatten().any(|i| after(&i, made));
            if !steps && !wanted {
                self.made[made].release(to);
            }
        }
    }
}
