//! Graph to plan: what is computed, on which boxes, in which order, within how many bytes. A plan is data: vectors and
//! indices, printable, without threads, buffers or files.

pub mod brick;
pub mod explain;
pub mod graph;
pub mod lengths;
pub mod lower;
pub mod memory;
pub mod outputs;
pub mod tasks;

use graph::{GlobalId, Graph, StepId, WireId};

pub use brick::BrickChoice;
pub use explain::explain;
pub use outputs::{MapPlan, OutputPlan};
pub use tasks::{Group, Task};

use crate::config::Config;
use crate::store::VolumeInfo;
use crate::{Error, Result};

/// A number that needs a pass over the whole volume before the main run.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepass {
    pub wires: Vec<WireId>,
    pub kind: PrepassKind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PrepassKind {
    /// The largest value (`saliency` with `scale = "max"`).
    Max,
    /// Least and largest value (`range = "auto"`).
    MinMax,
}

/// All that a run needs to know.
#[derive(Debug)]
pub struct Plan {
    pub graph: Graph,
    pub prepasses: Vec<Prepass>,
    pub outputs: Vec<OutputPlan>,
    /// Outputs on lattices of one shape share bricks and tasks.
    pub groups: Vec<Group>,
    pub threads: usize,
    /// Ceiling in bytes.
    pub memory: u64,
    pub warnings: Vec<String>,
    /// Why stages run where they run, one line each.
    pub placement: Vec<(String, &'static str, String)>,
}

impl Plan {
    /// Plans a run of `config` on volumes with these facts (the config's inputs, in order). Opens no file.
    pub fn new(config: &Config, infos: &[VolumeInfo]) -> Result<Plan> {
        let mut lowered = lower::lower(config, infos)?;
        let outputs = outputs::plan_outputs(config, infos, &mut lowered)?;
        let threads = match config.run.threads {
            0 => std::thread::available_parallelism().map_or(1, |n| n.get()),
            n => n,
        };
        let graph = lowered.graph;
        let placement = placement(config, &graph)?;
        let warnings = warnings(&graph);
        let mut plan = Plan {
            groups: Vec::new(),
            prepasses: lowered.prepasses,
            outputs,
            graph,
            threads,
            memory: config.run.memory,
            warnings,
            placement,
        };
        plan.groups = tasks::groups(&plan, config)?;
        for g in 0..plan.groups.len() {
            plan.groups[g].brick = brick::choose(&plan, &plan.groups[g], config)?;
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

    /// Tasks of all groups; their numbers are dense.
    pub fn task_count(&self) -> usize {
        self.groups.iter().map(|g| g.task_count()).sum()
    }

    /// Values of pre-pass `id` that are known so far.
    pub fn global(globals: &[[f64; 2]], id: GlobalId) -> [f64; 2] {
        globals.get(id).copied().unwrap_or([0.0, 1.0])
    }
}

/// Device of every stage, with the reason. This build has CPU kernels only.
fn placement(config: &Config, graph: &Graph) -> Result<Vec<(String, &'static str, String)>> {
    use crate::config::Device;
    let reason = match config.run.device {
        Device::Cpu => "device = \"cpu\"",
        Device::Auto => "no GPU kernels in this build",
        Device::Gpu | Device::GpuSoftware => {
            return Err(Error::Failed(
                "run.device: \"gpu\" was asked for, and no GPU was found: this build has no GPU kernels (looked for: a \
                 wgpu back end); use device = \"cpu\" or \"auto\""
                    .into(),
            ));
        }
    };
    Ok(graph.steps.iter().map(|s| (s.stages.join("+"), "cpu", reason.to_string())).collect())
}

/// Windows of equal voxel radius on unequal spacing are long in space: say so.
fn warnings(graph: &Graph) -> Vec<String> {
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
