//! Which lane every step and every occlusion map runs on, and why.

use super::flows::{self, FlowPlan};
use super::graph::{Graph, Moment, ObscuranceChannel, Step, StepKind, Wire, WireId};
use super::{FindGpu, OutputPlan};
use crate::config::{Config, Device};
use crate::gpu::passes::Job;
use crate::gpu::taps::{TapsJob, Wanted};
use crate::gpu::{GpuFacts, facts};
use crate::grid::{Border, DType};
use crate::kernel::window::Needs;
use crate::stage::WindowChannel;
use crate::{Error, Result};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    Cpu,
    Gpu,
}

impl Lane {
    /// As configs and reports have it.
    pub fn name(self) -> &'static str {
        match self {
            Lane::Cpu => "cpu",
            Lane::Gpu => "gpu",
        }
    }
}

/// What decided where something runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// Config, kernel, adapter and sizes.
    Facts,
    /// A GPU would have been used.
    NoGpu,
    /// It looks at one voxel at a time of what a flow has on the GPU.
    Beside,
}

/// Where a step or an occlusion map runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// Its stages.
    pub name: String,
    pub lane: Lane,
    pub cause: Cause,
    /// In words.
    pub why: String,
}

impl Placed {
    /// Moves it, and says why.
    pub fn go(&mut self, lane: Lane, cause: Cause, why: String) {
        (self.lane, self.cause, self.why) = (lane, cause, why);
    }
}

/// Lane of every step, then of every output that is an occlusion map. An adapter is looked for where one is demanded, or where `auto` has a step for it.
pub fn placement(
    config: &Config,
    graph: &Graph,
    outputs: &[OutputPlan],
    find: FindGpu,
) -> Result<(Vec<Placed>, Option<GpuFacts>)> {
    // Name, whether there is a kernel, whether it asks for exact floats, and what it is.
    let steps = graph.steps.iter().map(|s| {
        let input = &graph.wires[s.inputs[0]];
        let unrounded = |w: &WireId| graph.wires[*w].dtype == DType::F64 && input.dtype.result() == DType::F32;
        let kernel = if s.outputs.iter().any(unrounded) { Err(facts::UNROUNDED) } else { gpu_kernel(s, input) };
        (s.stages.join("+"), kernel, exact(graph, s), Work::Step(s))
    });
    let maps = outputs.iter().filter_map(|o| o.map.as_ref().map(|m| (o, m))).map(|(o, m)| {
        let wire = &graph.wires[m.source];
        let kernel = facts::occlusion_map(wire.dtype, wire.missing.is_some());
        (config.outputs[o.index].from[0].name.clone(), kernel, true, Work::Map(o))
    });
    let work: Vec<_> = steps.chain(maps).collect();
    let any = work.iter().any(|w| w.1.is_ok());
    let found = match config.run.device {
        Device::Cpu => None,
        Device::Auto => any.then(find),
        Device::Gpu | Device::GpuSoftware => Some(Ok(find().map_err(|why| no_such_gpu(config, &why))?)),
    };
    let place = |kernel: Result<(), &'static str>, exact: bool, of: Work| match (&found, kernel) {
        (None, _) if config.run.device == Device::Cpu => (Lane::Cpu, Cause::Facts, "device = \"cpu\"".to_string()),
        (_, Err(why)) => (Lane::Cpu, Cause::Facts, why.to_string()),
        (Some(Ok(gpu)), Ok(())) if exact && !gpu.exact_floats => (Lane::Cpu, Cause::Facts, facts::INEXACT.to_string()),
        (Some(Ok(gpu)), Ok(())) if of.close() && !gpu.close_floats => {
            (Lane::Cpu, Cause::Facts, facts::ROUGH.to_string())
        }
        // Floats are the bits of the device that makes them: which one that is must not hang on the budget.
        (Some(Ok(gpu)), Ok(())) => match of.too_large(graph, gpu.buffer_cap(of.budget(graph, config.run.memory))) {
            Some(why) => (Lane::Cpu, Cause::Facts, why.to_string()),
            None => (Lane::Gpu, Cause::Facts, gpu.name.clone()),
        },
        (Some(Err(why)), Ok(())) => (Lane::Cpu, Cause::NoGpu, format!("no GPU: {why}")),
        (None, Ok(())) => unreachable!("a GPU is looked for where a step could use it"),
    };
    let mut places = Vec::new();
    for (name, kernel, exact, of) in work {
        let (lane, cause, why) = place(kernel, exact, of);
        if let (Some(Ok(gpu)), Lane::Gpu) = (&found, lane) {
            enough_for(gpu, config, graph, &name, of)?;
        }
        places.push(Placed { name, lane, cause, why });
    }
    let used = places.iter().any(|p| p.lane == Lane::Gpu);
    Ok((places, found.and_then(|f| f.ok()).filter(|_| used)))
}

/// Whether a step that reads `input` has a GPU kernel, or why not.
fn gpu_kernel(step: &Step, input: &Wire) -> Result<(), &'static str> {
    let windows = match &step.kind {
        StepKind::Window { channels, .. } => Some(channels),
        StepKind::Gaussian { .. } => None,
        StepKind::Gradient { stored, .. } => return facts::gradient(input.dtype, *stored),
        StepKind::Rank { .. } => return Err(facts::EXACT),
        StepKind::Obscurance { channels, normal, .. } => {
            let plain = normal.is_none() && channels[..] == [ObscuranceChannel::Openness];
            return facts::obscurance(input.dtype, plain);
        }
        StepKind::Levels { .. } => return Err(facts::LEVELS),
        StepKind::Moments4 { .. } => return Err(facts::MOMENTS4),
        _ => return Err(flows::ALONE),
    };
    if matches!(step.border, Border::Constant(_)) && input.beyond(step.border).1 {
        return Err(
            "the border's constant makes floats of the voxels, for which there is no GPU kernel: runs on the CPU",
        );
    }
    let missing = input.missing.is_some();
    match (windows, &step.kind) {
        (Some(channels), _) => facts::window(input.dtype, missing, channels),
        (None, StepKind::Gaussian { .. }) => facts::gaussian(input.dtype, missing),
        (None, _) => unreachable!("other kinds of steps have returned"),
    }
}

/// The flows of a graph; steps that look at one voxel go where they are part of one.
pub fn join_flows(graph: &Graph, placement: &mut [Placed]) -> Vec<FlowPlan> {
    let on_gpu: Vec<bool> = placement[..graph.steps.len()].iter().map(|p| p.lane == Lane::Gpu).collect();
    let flows = flows::find(graph, &on_gpu);
    for &s in flows.iter().flat_map(|f| &f.steps) {
        if placement[s].lane != Lane::Gpu {
            placement[s].go(Lane::Gpu, Cause::Beside, flows::BESIDE.to_string());
        }
    }
    flows
}

/// Whether a step on the GPU makes floats there that are not the CPU's bit for bit.
pub fn floats(graph: &Graph, step: &Step) -> bool {
    exact(graph, step) || Work::Step(step).close()
}

fn is_open(channel: &WindowChannel) -> bool {
    matches!(channel, WindowChannel::Openness(..))
}

/// Whether a step needs [`GpuFacts::exact_floats`].
fn exact(graph: &Graph, step: &Step) -> bool {
    match step.kind {
        StepKind::Gaussian { .. } => true,
        StepKind::Window { .. } => graph.wires[step.inputs[0]].dtype.is_float(),
        _ => false,
    }
}

/// What is placed.
#[derive(Clone, Copy)]
enum Work<'a> {
    Step(&'a Step),
    Map(&'a OutputPlan),
}

/// Refuses a budget that leaves no buffers for a step of floats, which the device itself could hold.
fn enough_for(gpu: &GpuFacts, config: &Config, graph: &Graph, name: &str, of: Work) -> Result<()> {
    let memory = config.run.memory;
    let fits = |memory: u64| of.too_large(graph, gpu.buffer_cap(memory)).is_none();
    if fits(memory) {
        return Ok(());
    }
    let mut enough = memory;
    while !fits(enough) {
        enough += enough / 16 + 1;
    }
    let message = format!(
        "too little for {name} on the GPU, whose buffers a share of the budget bounds; give at least memory = \"{}MiB\", or \
         device = \"cpu\" (whose floats have other last digits)",
        enough.div_ceil(1 << 20)
    );
    Err(config.locate(Error::config("run.memory", message)))
}

impl Work<'_> {
    /// The budget whose share of buffers decides the placement: the run's, or any where results are floats, which are one
    /// device's.
    fn budget(self, graph: &Graph, memory: u64) -> u64 {
        match self {
            Work::Step(step) if !floats(graph, step) => memory,
            _ => u64::MAX,
        }
    }

    /// Whether it needs [`GpuFacts::close_floats`].
    fn close(self) -> bool {
        let Work::Step(step) = self else { return false };
        match &step.kind {
            StepKind::Gradient { .. } => true,
            StepKind::Window { channels, .. } => channels.iter().any(is_open),
            _ => false,
        }
    }

    /// Why it stays on the CPU, where not even one voxel of it fits the device's buffers: floats must be one lane's.
    fn too_large(self, graph: &Graph, cap: u64) -> Option<&'static str> {
        match self {
            Work::Map(output) => {
                let fits = output.map_job(graph).is_some_and(|job| job.fits(cap));
                (!fits).then_some(facts::MAP_TOO_LARGE)
            }
            Work::Step(step) => {
                let wire = &graph.wires[step.inputs[0]];
                let volume = graph.lattices[wire.lattice].shape;
                let fits = match &step.kind {
                    StepKind::Window { params, channels } => {
                        let needs = Needs::of(channels.iter().copied(), wire.dtype.is_float());
                        let job = Job::new(wire.dtype, volume, volume, [0; 3], params.radius, needs);
                        job.is_some_and(|job| job.finished(params, channels).fits(volume, cap))
                    }
                    StepKind::Gaussian { sigma, channels } => {
                        let [mean, variance] = [Moment::Mean, Moment::Variance].map(|m| channels.contains(&m));
                        TapsJob::one(wire.dtype, volume, *sigma, Wanted { mean, variance }).is_some_and(|j| j.fits(cap))
                    }
                    _ => true,
                };
                (!fits).then_some(facts::WINDOW_TOO_LARGE)
            }
        }
    }
}

/// A GPU that was demanded and is not there: the file and line that ask for it, what was found, what would be accepted. The
/// config is right where there is such a GPU, so that it is the run that fails.
fn no_such_gpu(config: &Config, why: &str) -> Error {
    let (name, other) = match config.run.device {
        Device::GpuSoftware => ("gpu:software", "gpu"),
        _ => ("gpu", "gpu:software"),
    };
    let message = format!(
        "\"{name}\" was asked for, and no such GPU can be used: {why}; accepted here: \"cpu\", \"auto\" (the CPU where \
         there is no GPU) or \"{other}\" with such a driver"
    );
    Error::NoDevice(config.locate(Error::config("run.device", message)).to_string())
}
