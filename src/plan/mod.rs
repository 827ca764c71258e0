//! Graph to plan: what is computed, on which boxes, in which order, within how many bytes. A plan is data: vectors and
//! indices, printable, without threads, buffers or files.

pub mod brick;
pub mod decodes;
pub mod explain;
mod fills;
mod fits;
pub mod flows;
pub mod graph;
pub mod lengths;
pub mod lower;
pub mod memory;
pub mod outputs;
pub mod parked;
pub mod skips;
pub mod streams;
pub mod tasks;

use graph::{GlobalId, Graph, StepId, WireId};

pub use brick::BrickChoice;
pub use explain::explain;
pub use flows::FlowPlan;
pub use outputs::{MAP_BLOCK, MapPlan, OutputPlan};
pub use tasks::Group;

use crate::config::{Config, Device, Lanes};
use crate::gpu::passes::Job;
use crate::gpu::taps::{TapsJob, Wanted};
use crate::gpu::{GpuFacts, facts};
use crate::grid::{Border, DType};
use crate::kernel::window::Needs;
use crate::stage::WindowChannel;
use crate::store::VolumeInfo;
use crate::{Error, Result};

/// A number that needs a pass over the whole volume before the main run.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepass {
    pub wires: Vec<WireId>,
    pub kind: PrepassKind,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PrepassKind {
    /// The largest value (`saliency` with `scale = "max"`).
    Max,
    /// Least and largest value (`range = "auto"`).
    MinMax,
    /// Quantile levels (`method = "levels"`, and the codes of `"moments4"`); `flipped` where smaller stored values are denser,
    /// `beyond` the stored value that a constant border adds to windows.
    Levels { count: usize, flipped: bool, beyond: Option<f64> },
}

/// Finds a GPU, or says what was looked for.
pub type FindGpu<'a> = &'a mut dyn FnMut() -> Result<GpuFacts, String>;

/// All that a run needs to know.
#[derive(Debug)]
pub struct Plan {
    pub graph: Graph,
    pub prepasses: Vec<Prepass>,
    pub outputs: Vec<OutputPlan>,
    /// Outputs on lattices of one shape share bricks and tasks.
    pub groups: Vec<Group>,
    pub threads: usize,
    /// Threads that compute bricks: `threads`, or as many as keep the GPU's slots busy, where most of them wait.
    pub workers: usize,
    /// Chunks of the config's inputs; `None` where any box can be read.
    pub input_chunks: Vec<Option<crate::grid::Shape>>,
    /// Which stages may give bricks to both lanes.
    pub lanes: Lanes,
    /// Ceiling in bytes.
    pub memory: u64,
    pub warnings: Vec<String>,
    /// Why stages run where they run, one line each.
    pub placement: Placement,
    /// Stages and devices before flows and bricks were looked at, which change no voxel and may be others in a resumed run.
    pub held: Vec<(String, &'static str)>,
    /// The adapter that the steps placed on "gpu" run on.
    pub gpu: Option<GpuFacts>,
    /// Steps that run on the GPU together.
    pub flows: Vec<FlowPlan>,
}

/// Voxels read per voxel made from which a plan warns: bricks of half their halo read so many.
const DEAR: f64 = 100.0;

impl Plan {
    /// Plans a run of `config` on volumes with these facts (the config's inputs, in order). Opens no file.
    /// `find_gpu` is called at most once, when a GPU could be used.
    pub fn new(config: &Config, infos: &[VolumeInfo], find_gpu: FindGpu) -> Result<Plan> {
        let mut lowered = lower::lower(config, infos)?;
        let outputs = outputs::plan_outputs(config, infos, &mut lowered)?;
        let threads = match config.run.threads {
            0 => std::thread::available_parallelism().map_or(1, |n| n.get()),
            n => n,
        };
        let graph = lowered.graph;
        let (mut placement, gpu) = placement(config, &graph, &outputs, find_gpu)?;
        let held = placement.iter().map(|(name, device, _)| (name.clone(), *device)).collect();
        let flows = join_flows(&graph, &mut placement);
        let inputs = config.inputs.iter().zip(infos);
        let mut warnings: Vec<String> =
            inputs.flat_map(|(i, info)| info.warnings.iter().map(|w| format!("input {}: {w}", i.name))).collect();
        warnings.extend(long_windows(&graph));
        warnings.extend(fills::warnings(config, &graph));
        let mut plan = Plan {
            groups: Vec::new(),
            prepasses: lowered.prepasses,
            outputs,
            graph,
            threads,
            workers: if gpu.is_some() { threads.max(facts::SLOTS as usize) } else { threads },
            input_chunks: infos.iter().map(|i| i.chunk).collect(),
            lanes: config.run.lanes,
            memory: config.run.memory,
            warnings,
            placement,
            held,
            gpu,
            flows,
        };
        if plan.waives_byte_identity() {
            plan.warnings.push("lanes = \"mixed\": byte identity is waived for float stages on the GPU".into());
        }
        brick::chunks_fit(&plan, config)?;
        streams::choose(&mut plan, config)?;
        let dear = plan.groups.iter().map(|g| g.brick.amplification).filter(|a| *a > DEAR).fold(0.0, f64::max);
        if dear > 0.0 {
            plan.warnings.push(format!(
                "{dear:.0} voxels are read for each one that is made: bricks are small beside their halos in this budget; more \
                 run.memory makes them larger"
            ));
        }
        fits::settle(&mut plan);
        if !plan.prepasses.is_empty() {
            let bricks: Vec<_> = plan.groups.iter().map(|g| brick::over_all(&plan, g, config)).collect();
            plan.groups.iter_mut().zip(bricks).for_each(|(group, brick)| group.prepass = Some(brick));
        }
        Ok(plan)
    }

    /// Steps that the wires need, in order.
    pub fn steps_for(&self, wires: &[WireId]) -> Vec<StepId> {
        let mut needed = vec![false; self.graph.wires.len()];
        wires.iter().for_each(|&w| needed[w] = true);
        let mut steps = Vec::new();
        for (id, step) in self.graph.steps.iter().enumerate().rev() {
            if step.outputs.iter().any(|&w| needed[w]) {
                steps.push(id);
                step.inputs.iter().chain(step.mask.as_ref().map(|m| &m.wire)).for_each(|&w| needed[w] = true);
            }
        }
        steps.reverse();
        steps
    }

    /// Voxels of all level-0 output boxes, each group once.
    pub fn voxels(&self) -> u64 {
        self.groups.iter().map(|g| g.region.voxels() as u64).sum()
    }

    /// What `auto` has to say when it wanted a GPU and found none.
    pub fn gpu_note(&self, config: &Config) -> Option<String> {
        let (_, _, why) = self.placement.iter().find(|p| p.2.starts_with(NO_GPU))?;
        (config.run.device == Device::Auto).then(|| format!("device = \"auto\": running on the CPU, {why}"))
    }

    /// Device and reason of the occlusion map of output `o`; they follow those of the steps.
    pub fn map_placement(&self, o: usize) -> Option<&(String, &'static str, String)> {
        self.outputs[o].map.as_ref()?;
        let before = self.outputs[..o].iter().filter(|p| p.map.is_some()).count();
        self.placement.get(self.graph.steps.len() + before)
    }

    /// Whether the occlusion map of output `o` is made on the GPU.
    pub fn map_on_gpu(&self, o: usize) -> bool {
        self.map_placement(o).is_some_and(|p| p.1 == "gpu")
    }

    /// Whether a step was placed on the GPU.
    pub fn on_gpu(&self, step: StepId) -> bool {
        self.placement[step].1 == "gpu"
    }

    /// Bricks that the GPU lane holds at once: as many as every group has room for.
    pub fn slots(&self) -> u64 {
        self.groups.iter().map(|g| g.brick.slots).filter(|s| *s > 0).min().unwrap_or(facts::SLOTS)
    }

    /// Whether a step on the GPU gives bricks to CPU workers while all slots are taken: where results are integers or fixed
    /// point, and with `lanes = "mixed"` everywhere.
    pub fn shares(&self, step: StepId) -> bool {
        self.on_gpu(step) && (self.lanes == Lanes::Mixed || !floats(&self.graph, &self.graph.steps[step]))
    }

    /// `lanes = "mixed"` with a step whose floats both lanes make.
    pub fn waives_byte_identity(&self) -> bool {
        let steps = &self.graph.steps;
        self.lanes == Lanes::Mixed && (0..steps.len()).any(|s| self.on_gpu(s) && floats(&self.graph, &steps[s]))
    }

    /// The flow that a step belongs to.
    pub fn flow_of(&self, step: StepId) -> Option<usize> {
        self.flows.iter().position(|f| f.steps.contains(&step))
    }

    /// Tasks of all groups; their numbers are dense.
    pub fn task_count(&self) -> usize {
        self.groups.iter().map(|g| g.task_count()).sum()
    }

    /// Values of pre-pass `id` that are known so far.
    pub fn global(globals: &[Vec<f64>], id: GlobalId) -> [f64; 2] {
        globals.get(id).and_then(|g| Some([*g.first()?, *g.get(1)?])).unwrap_or([0.0, 1.0])
    }
}

/// How the reason begins where a GPU would have been used.
const NO_GPU: &str = "no GPU: ";

/// Stage, device and reason of every step, then of every output that is an occlusion map.
pub type Placement = Vec<(String, &'static str, String)>;

/// Whether a step that reads `input` has a GPU kernel, or why not.
fn gpu_kernel(step: &graph::Step, input: &graph::Wire) -> Result<(), &'static str> {
    let windows = match &step.kind {
        graph::StepKind::Window { channels, .. } => Some(channels),
        graph::StepKind::Gaussian { .. } => None,
        graph::StepKind::Gradient { stored, .. } => return facts::gradient(input.dtype, *stored),
        graph::StepKind::Rank { .. } => return Err(facts::EXACT),
        graph::StepKind::Obscurance { channels, normal, .. } => {
            let plain = normal.is_none() && channels[..] == [graph::ObscuranceChannel::Openness];
            return facts::obscurance(input.dtype, plain);
        }
        graph::StepKind::Levels { .. } => return Err(facts::LEVELS),
        graph::StepKind::Moments4 { .. } => return Err(facts::MOMENTS4),
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
        (None, graph::StepKind::Gaussian { .. }) => facts::gaussian(input.dtype, missing),
        (None, _) => unreachable!("other kinds of steps have returned"),
    }
}

/// The flows of a graph; steps that look at one voxel go where they are part of one.
fn join_flows(graph: &Graph, placement: &mut Placement) -> Vec<FlowPlan> {
    let on_gpu: Vec<bool> = placement[..graph.steps.len()].iter().map(|p| p.1 == "gpu").collect();
    let flows = flows::find(graph, &on_gpu);
    for &s in flows.iter().flat_map(|f| &f.steps) {
        if placement[s].1 != "gpu" {
            (placement[s].1, placement[s].2) = ("gpu", flows::BESIDE.to_string());
        }
    }
    flows
}

/// Whether a step on the GPU makes floats there that are not the CPU's bit for bit.
fn floats(graph: &Graph, step: &graph::Step) -> bool {
    exact(graph, step) || Work::Step(step).close()
}

fn is_open(channel: &WindowChannel) -> bool {
    matches!(channel, WindowChannel::Openness(..))
}

/// Whether a step needs [`GpuFacts::exact_floats`].
fn exact(graph: &Graph, step: &graph::Step) -> bool {
    match step.kind {
        graph::StepKind::Gaussian { .. } => true,
        graph::StepKind::Window { .. } => graph.wires[step.inputs[0]].dtype.is_float(),
        _ => false,
    }
}

/// Device of every step. An adapter is looked for where one is demanded, or where `auto` has a step for it.
fn placement(
    config: &Config,
    graph: &Graph,
    outputs: &[OutputPlan],
    find: FindGpu,
) -> Result<(Placement, Option<GpuFacts>)> {
    // Name, whether there is a kernel, whether it asks for exact floats, and what it is.
    let steps = graph.steps.iter().map(|s| {
        let input = &graph.wires[s.inputs[0]];
        let unrounded = |w: &graph::WireId| graph.wires[*w].dtype == DType::F64 && input.dtype.result() == DType::F32;
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
        (None, _) if config.run.device == Device::Cpu => ("cpu", "device = \"cpu\"".to_string()),
        (_, Err(why)) => ("cpu", why.to_string()),
        (Some(Ok(gpu)), Ok(())) if exact && !gpu.exact_floats => ("cpu", facts::INEXACT.to_string()),
        (Some(Ok(gpu)), Ok(())) if of.close() && !gpu.close_floats => ("cpu", facts::ROUGH.to_string()),
        // Floats are the bits of the device that makes them: which one that is must not hang on the budget.
        (Some(Ok(gpu)), Ok(())) => match of.too_large(graph, gpu.buffer_cap(of.budget(graph, config.run.memory))) {
            Some(why) => ("cpu", why.to_string()),
            None => ("gpu", gpu.name.clone()),
        },
        (Some(Err(why)), Ok(())) => ("cpu", format!("{NO_GPU}{why}")),
        (None, Ok(())) => unreachable!("a GPU is looked for where a step could use it"),
    };
    let mut places = Placement::new();
    for (name, kernel, exact, of) in work {
        let (device, reason) = place(kernel, exact, of);
        if let (Some(Ok(gpu)), "gpu") = (&found, device) {
            enough_for(gpu, config, graph, &name, of)?;
        }
        places.push((name, device, reason));
    }
    let used = places.iter().any(|p| p.1 == "gpu");
    Ok((places, found.and_then(|f| f.ok()).filter(|_| used)))
}

/// What is placed.
#[derive(Clone, Copy)]
enum Work<'a> {
    Step(&'a graph::Step),
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
            graph::StepKind::Gradient { .. } => true,
            graph::StepKind::Window { channels, .. } => channels.iter().any(is_open),
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
                    graph::StepKind::Window { params, channels } => {
                        let needs = Needs::of(channels.iter().copied(), wire.dtype.is_float());
                        let job = Job::new(wire.dtype, volume, volume, [0; 3], params.radius, needs);
                        job.is_some_and(|job| job.finished(params, channels).fits(volume, cap))
                    }
                    graph::StepKind::Gaussian { sigma, channels } => {
                        let [mean, variance] =
                            [graph::Moment::Mean, graph::Moment::Variance].map(|m| channels.contains(&m));
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

/// Windows of equal voxel radius on unequal spacing are long in space: say so.
fn long_windows(graph: &Graph) -> Vec<String> {
    let mut warnings = Vec::new();
    for step in &graph.steps {
        let graph::StepKind::Window { params, .. } = &step.kind else { continue };
        let lattice = &graph.lattices[graph.wires[step.inputs[0]].lattice];
        let long: Vec<f64> = (0..3)
            .filter(|&a| lattice.shape[a] > 1)
            .map(|a| (2 * params.radius[a] + 1) as f64 * lattice.spacing[a])
            .collect();
        let (least, most) = long.iter().fold((f64::INFINITY, 0.0f64), |(l, m), v| (l.min(*v), m.max(*v)));
        if most > 3.0 * least {
            warnings.push(format!(
                "{}: the window of radius {:?} voxels is {:.1} times longer on one axis (spacing {:?}, z y x); a physical \
                 radius such as \"2.5 mm\" makes it even",
                step.stages.join("+"),
                params.radius,
                most / least,
                lattice.spacing
            ));
        }
    }
    warnings
}
