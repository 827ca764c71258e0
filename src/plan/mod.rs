//! Graph to plan: what is computed, on which boxes, in which order, within how many bytes. A plan is data: vectors and
//! indices, printable, without threads or buffers; only what is printed of one (`explain`, `skips`) looks at files.

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
pub mod place;
pub mod skips;
pub mod streams;
pub mod tasks;

use graph::{GlobalId, Graph, StepId, WireId};

pub use brick::BrickChoice;
pub use explain::explain;
pub use flows::FlowPlan;
pub use outputs::{MAP_BLOCK, MapPlan, OutputPlan};
pub use place::{Lane, Placed};
pub use tasks::Group;

use crate::Result;
use crate::config::{Config, Device, Lanes};
use crate::gpu::{GpuFacts, facts};
use crate::store::VolumeInfo;

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
    pub placement: Vec<Placed>,
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
        let (mut placement, gpu) = place::placement(config, &graph, &outputs, find_gpu)?;
        let held = placement.iter().map(|p| (p.name.clone(), p.lane.name())).collect();
        let flows = place::join_flows(&graph, &mut placement);
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
        let placed = self.placement.iter().find(|p| p.cause == place::Cause::NoGpu)?;
        (config.run.device == Device::Auto).then(|| format!("device = \"auto\": running on the CPU, {}", placed.why))
    }

    /// Device and reason of the occlusion map of output `o`; they follow those of the steps.
    pub fn map_placement(&self, o: usize) -> Option<&Placed> {
        self.outputs[o].map.as_ref()?;
        let before = self.outputs[..o].iter().filter(|p| p.map.is_some()).count();
        self.placement.get(self.graph.steps.len() + before)
    }

    /// Whether the occlusion map of output `o` is made on the GPU.
    pub fn map_on_gpu(&self, o: usize) -> bool {
        self.map_placement(o).is_some_and(|p| p.lane == Lane::Gpu)
    }

    /// Whether a step was placed on the GPU.
    pub fn on_gpu(&self, step: StepId) -> bool {
        self.placement[step].lane == Lane::Gpu
    }

    /// Bricks that the GPU lane holds at once: as many as every group has room for.
    pub fn slots(&self) -> u64 {
        self.groups.iter().map(|g| g.brick.slots).filter(|s| *s > 0).min().unwrap_or(facts::SLOTS)
    }

    /// Whether a step on the GPU gives bricks to CPU workers while all slots are taken: where results are integers or fixed
    /// point, and with `lanes = "mixed"` everywhere.
    pub fn shares(&self, step: StepId) -> bool {
        self.on_gpu(step) && (self.lanes == Lanes::Mixed || !place::floats(&self.graph, &self.graph.steps[step]))
    }

    /// `lanes = "mixed"` with a step whose floats both lanes make.
    pub fn waives_byte_identity(&self) -> bool {
        let steps = &self.graph.steps;
        self.lanes == Lanes::Mixed && (0..steps.len()).any(|s| self.on_gpu(s) && place::floats(&self.graph, &steps[s]))
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
