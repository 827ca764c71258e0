//! Steps that run on the GPU together over one wire, so that what they make for each other stays there, and so do channels of
//! which an output takes levels and codes only.

use super::graph::{GradientChannel, Graph, Moment, Producer, Step, StepId, StepKind, TransferChannel, Wire, WireId};
use super::memory::wire_box;
use super::{Group, OutputPlan, Plan};
use crate::brick::Voxels;
use crate::gpu::extend::Beyond;
use crate::gpu::finish::Channels;
use crate::gpu::flow::{Flow, FlowStep, Input, Kernel, Sink};
use crate::gpu::levels::Pyramid;
use crate::gpu::points::{self, Op};
use crate::gpu::slopes::Fit;
use crate::gpu::stored::stored;
use crate::gpu::taps::Wanted;
use crate::grid::{Border, DType, Region, Shape};
use crate::stage::Reduce;

/// Steps over one wire.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowPlan {
    /// The wire whose voxels the host gives.
    pub source: WireId,
    /// In the graph's order.
    pub steps: Vec<StepId>,
}

impl FlowPlan {
    /// The first of its steps that are among these.
    pub fn first(&self, steps: &[StepId]) -> Option<StepId> {
        self.steps.iter().copied().find(|s| steps.contains(s))
    }

    /// Without some of its steps, and without what reads them.
    pub fn without(&self, graph: &Graph, out: &[StepId]) -> FlowPlan {
        let mut flow = self.clone();
        leave(graph, &mut flow, out.to_vec());
        flow
    }
}

/// Why a step that looks at one voxel runs on the CPU.
pub const ALONE: &str = "looks at one voxel, and what it reads or makes is not on the GPU: runs on the CPU";
/// Why it runs on the GPU.
pub const BESIDE: &str = "looks at one voxel of what is there";

/// The flows of a graph. `on_gpu` says which steps with windows were placed there; steps that look at one voxel join them.
pub fn find(graph: &Graph, on_gpu: &[bool]) -> Vec<FlowPlan> {
    let mut flows: Vec<FlowPlan> = Vec::new();
    for (s, step) in graph.steps.iter().enumerate() {
        let point = !ops(graph, step, &[]).is_empty();
        if !mask_is_read(graph, step) || step.streamed.is_some() || !(point || on_gpu[s] && has_kernel(graph, step)) {
            continue;
        }
        let Some(at) = flow_of(graph, &mut flows, step, point) else { continue };
        flows[at].steps.push(s);
    }
    flows.retain(|f| f.steps.iter().any(|&s| on_gpu[s]));
    flows
}

/// Steps leave a flow, and so does what reads them.
fn leave(graph: &Graph, flow: &mut FlowPlan, mut out: Vec<StepId>) {
    for &s in &flow.steps {
        let from = |w: &WireId| matches!(graph.wires[*w].producer, Producer::Step(p) if out.contains(&p));
        if !out.contains(&s) && graph.steps[s].inputs.iter().any(from) {
            out.push(s);
        }
    }
    flow.steps.retain(|s| !out.contains(s));
}

/// The flow that a step belongs to, if all that it reads is one's: the one that makes it, or that is over the same wire.
fn flow_of(graph: &Graph, flows: &mut Vec<FlowPlan>, step: &Step, point: bool) -> Option<usize> {
    let made = |w: WireId| match graph.wires[w].producer {
        Producer::Step(p) => flows.iter().position(|f| f.steps.contains(&p)),
        Producer::Input(_) => None,
    };
    // Sums of floats that were small integers are not the sums of integers.
    let exact =
        |w: WireId| point || graph.wires[w].dtype == DType::F32 && !matches!(step.kind, StepKind::Gaussian { .. });
    let inside = step.inputs.iter().find_map(|&w| made(w).filter(|_| exact(w)));
    let host =
        |at: usize| step.inputs.iter().all(|&w| made(w).filter(|_| exact(w)) == Some(at) || flows[at].source == w);
    if let Some(at) = inside {
        return host(at).then_some(at);
    }
    let &first = step.inputs.first()?;
    let alone = step.inputs.iter().all(|&w| w == first) && is_source(&graph.wires[first]);
    // A sweep sees far: what reads the same wire would be made where nobody needs it.
    let apart = |s: &StepId| is_sweep(&graph.steps[*s]) && graph.steps[*s].inputs[0] == first;
    let near = |f: &FlowPlan| f.source == first && !is_sweep(step) && !f.steps.iter().any(apart);
    let known = flows.iter().position(near);
    alone.then(|| {
        known.unwrap_or_else(|| {
            flows.push(FlowPlan { source: first, steps: Vec::new() });
            flows.len() - 1
        })
    })
}

/// Whether the device reads a wire's voxels as the host has them.
fn is_source(wire: &Wire) -> bool {
    wire.components == 1 && wire.missing.is_none() && stored(wire.dtype).is_some()
}

/// Whether a step's mask, if it has one, is known before anything is made: it hangs on an input.
fn mask_is_read(graph: &Graph, step: &Step) -> bool {
    step.mask.as_ref().is_none_or(|m| matches!(graph.wires[m.wire].producer, Producer::Input(_)))
}

/// What a step's windows see beyond the volume, as the channel that they read has it on the device.
fn beyond(graph: &Graph, step: &Step, made: bool) -> Beyond {
    if step.border == Border::Clip {
        return Beyond { border: Border::Clip, outside: 0 };
    }
    let wire = &graph.wires[step.inputs[0]];
    let (outside, _) = wire.beyond(step.border);
    let mut one = Voxels::zeroed(if made { DType::F32 } else { wire.dtype }, 1);
    one.fill(outside);
    let mut bits = [0; 4];
    bits[..one.as_bytes().len()].copy_from_slice(one.as_bytes());
    Beyond { border: step.border, outside: u32::from_le_bytes(bits) }
}

/// Whether a flow has a kernel for a step with windows; its input's type was looked at when it was placed.
fn has_kernel(graph: &Graph, step: &Step) -> bool {
    let wire = &graph.wires[step.inputs[0]];
    let plain = wire.components == 1 && wire.missing.is_none() && !wire.beyond(step.border).1;
    let outputs = step.outputs.iter().all(|&w| graph.wires[w].missing.is_none() && held(&graph.wires[w]));
    plain
        && outputs
        && match &step.kind {
            StepKind::Window { params, channels } => Channels::of(params, channels, wire.dtype == DType::F32).is_some(),
            // Ranks are looked up by the host.
            StepKind::Obscurance { sweep, .. } => sweep.params().ranks.is_none(),
            StepKind::Gaussian { .. } | StepKind::Gradient { .. } => true,
            _ => false,
        }
}

fn is_sweep(step: &Step) -> bool {
    matches!(step.kind, StepKind::Obscurance { .. })
}

/// Whether f32 holds a wire's values.
fn held(wire: &Wire) -> bool {
    stored(wire.dtype).is_some()
}

/// What a step that looks at one voxel does for each channel that it makes, and of which of its inputs' components; nothing
/// where the device cannot, or for other steps. `globals` are numbers from pre-passes.
fn ops(graph: &Graph, step: &Step, globals: &[Vec<f64>]) -> Vec<(Op, Vec<usize>)> {
    let wires: Vec<&Wire> = step.inputs.iter().map(|&w| &graph.wires[w]).collect();
    let plain = wires.iter().all(|w| w.missing.is_none() && held(w));
    let outputs: Vec<&Wire> = step.outputs.iter().map(|&w| &graph.wires[w]).collect();
    if !plain || wires.len() > points::MOST || outputs.iter().any(|w| w.dtype != DType::F32) {
        return Vec::new();
    }
    // A component of every input: the same one, or the only one.
    let starts: Vec<usize> = (0..wires.len()).map(|i| wires[..i].iter().map(|w| w.components).sum()).collect();
    let parts = |c: usize| wires.iter().zip(&starts).map(|(w, s)| s + c.min(w.components - 1)).collect::<Vec<_>>();
    let each = |op: Op| (0..outputs[0].components).map(|c| (op.clone(), parts(c))).collect();
    match &step.kind {
        StepKind::Transfer { points, channels } => {
            let components = channels.iter().flat_map(|c| match c {
                TransferChannel::Opacity => 1..=1,
                TransferChannel::Rgb => 2..=4,
            });
            components.map(|component| (Op::Transfer { points: points.clone(), component }, parts(0))).collect()
        }
        &StepKind::OpennessWindow { low, high, mode } => each(Op::Window { low, high, mode }),
        &StepKind::ModulateByVariance { sigma_max2 } => each(Op::ByVariance { sigma_max2 }),
        &StepKind::ModulateBySaliency { threshold, gain } => each(Op::BySaliency { threshold, gain }),
        &StepKind::AmbientLight { k } => each(Op::Light { k }),
        &StepKind::Combine { kind } => each(Op::Combine(kind)),
        &StepKind::Divide { by } => {
            let max = Plan::global(globals, by)[1];
            each(Op::Times { by: if max > 0.0 && max.is_finite() { 1.0 / max } else { 1.0 } })
        }
        _ => Vec::new(),
    }
}

/// Where a sink's results belong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// A component of a wire.
    Wire(WireId, usize),
    /// The levels of a component of an output.
    Levels { output: usize, component: usize },
}

/// What a flow is built for.
pub struct Site<'a> {
    /// Steps and outputs of the group.
    pub steps: &'a [StepId],
    pub outputs: &'a [usize],
    pub volume: Shape,
    pub brick: Region,
    /// Numbers from pre-passes.
    pub globals: &'a [Vec<f64>],
    /// Whether a step's mask excludes some voxels.
    pub masked: &'a dyn Fn(StepId) -> bool,
}

/// As if every mask excluded some.
pub const ALL_MASKED: &dyn Fn(StepId) -> bool = &|_| true;

/// A flow over one brick, and where each sink goes. `None` where nothing of it is wanted.
pub fn build(plan: &Plan, flow: &FlowPlan, site: &Site) -> Option<(Flow, Vec<Target>)> {
    let graph = &plan.graph;
    let steps: Vec<StepId> = flow.steps.iter().copied().filter(|s| site.steps.contains(s)).collect();
    let at = |w| maker(graph, &steps, w);
    let input = |w: WireId, component: usize| match at(w) {
        None => Input::Source,
        Some(step) => {
            let before = graph.steps[steps[step]].outputs.iter().take_while(|&&o| o != w);
            Input::Made { step, channel: component + before.map(|&o| graph.wires[o].components).sum::<usize>() }
        }
    };
    let flow_step = |&s: &StepId| {
        let step = &graph.steps[s];
        let inputs = step.inputs.iter().flat_map(|&w| (0..graph.wires[w].components).map(move |c| (w, c)));
        FlowStep {
            kernel: kernel(graph, step, site.globals),
            inputs: inputs.map(|(w, c)| input(w, c)).collect(),
            reach: step.reach,
            beyond: beyond(graph, step, at(step.inputs[0]).is_some()),
            fills: (step.mask.is_some() && (site.masked)(s)).then(|| fills(graph, step)),
        }
    };
    let (mut sinks, mut targets) = (Vec::new(), Vec::new());
    for (&s, &w) in steps.iter().flat_map(|s| graph.steps[*s].outputs.iter().map(move |w| (s, w))) {
        if comes_back(plan, site, &steps, w, &at) {
            for c in 0..graph.wires[w].components {
                let region = wire_box(site.brick, graph.steps[s].halo, site.volume);
                sinks.push(Sink { value: input(w, c), mean: None, region, pyramid: None });
                targets.push(Target::Wire(w, c));
            }
        }
        for (output, component) in levels_of(plan, site.outputs, w, &at) {
            let o = &plan.outputs[output];
            let pooled = o.reduce == Reduce::Moments && o.level_count() > 1;
            let c = o.parts[component].1;
            let mean = o.means[component].filter(|_| pooled).map(|m| input(m, c));
            let pyramid = Some(pyramid(o, component, o.mapped(site.globals)));
            sinks.push(Sink { value: input(w, c), mean, region: site.brick, pyramid });
            targets.push(Target::Levels { output, component });
        }
    }
    let source = &graph.wires[flow.source];
    let (dtype, affine, volume) = (source.dtype, source.affine, Region::whole(site.volume));
    let flow = Flow { dtype, affine, volume, steps: steps.iter().map(flow_step).collect(), sinks };
    (!flow.sinks.is_empty()).then_some((flow, targets))
}

/// By channel, what stands where a masked step's voxels are not needed, as the channel's type holds it.
fn fills(graph: &Graph, step: &Step) -> Vec<f32> {
    let of = |w: &WireId| {
        let wire = &graph.wires[*w];
        vec![Voxels::one(wire.dtype, wire.fill).at(0) as f32; wire.components]
    };
    step.outputs.iter().flat_map(of).collect()
}

/// Which of these steps makes a wire.
fn maker(graph: &Graph, steps: &[StepId], w: WireId) -> Option<usize> {
    match graph.wires[w].producer {
        Producer::Step(p) => steps.iter().position(|&s| s == p),
        Producer::Input(_) => None,
    }
}

/// The components of outputs whose levels the device makes of a wire.
fn levels_of(plan: &Plan, outputs: &[usize], w: WireId, at: &dyn Fn(WireId) -> Option<usize>) -> Vec<(usize, usize)> {
    let parts = outputs.iter().flat_map(|&o| (0..plan.outputs[o].parts.len()).map(move |c| (o, c)));
    parts.filter(|&(o, c)| plan.outputs[o].parts[c].0 == w && makes_levels(&plan.outputs[o], c, at)).collect()
}

/// Whether the device makes the levels of a component of an output.
fn makes_levels(output: &OutputPlan, component: usize, at: &dyn Fn(WireId) -> Option<usize>) -> bool {
    let pooled = output.reduce == Reduce::Moments && output.level_count() > 1;
    let beside = !pooled || output.means[component].is_some_and(|m| at(m).is_some());
    output.map.is_none() && Pyramid::holds(output.spec.dtype) && beside
}

/// Whether the host needs a wire's voxels: for a step that is not in the flow, or an output whose levels it makes.
fn comes_back(plan: &Plan, site: &Site, steps: &[StepId], w: WireId, at: &dyn Fn(WireId) -> Option<usize>) -> bool {
    let reads = |step: &Step| step.inputs.contains(&w) || step.mask.as_ref().is_some_and(|m| m.wire == w);
    let others = site.steps.iter().filter(|s| !steps.contains(s)).any(|&s| reads(&plan.graph.steps[s]));
    let outputs = site.outputs.iter().any(|&o| {
        let output = &plan.outputs[o];
        let mapped = output.map.as_ref().is_some_and(|m| m.source == w);
        let left = |c: usize| !makes_levels(output, c, at);
        let value = |c: usize| output.parts[c].0 == w || output.reduce == Reduce::Moments && output.means[c] == Some(w);
        mapped || (0..output.parts.len()).any(|c| value(c) && left(c))
    });
    others || outputs
}

/// Whether a flow gives the host the voxels of a wire that it makes.
pub fn voxels_come_back(plan: &Plan, flow: &FlowPlan, group: &Group, w: WireId) -> bool {
    let (steps, outputs) = (&group.steps[..], &group.outputs[..]);
    let site =
        Site { steps, outputs, volume: group.shape, brick: Region::whole([0; 3]), globals: &[], masked: ALL_MASKED };
    let at = |w| maker(&plan.graph, &flow.steps, w);
    comes_back(plan, &site, &flow.steps, w, &at)
}

fn pyramid(output: &OutputPlan, component: usize, range: Option<[f64; 2]>) -> Pyramid {
    let levels = 1..=output.brick_level();
    Pyramid {
        dtype: output.spec.dtype,
        mapping: output.mapping(component, range),
        reduce: output.reduce,
        std: output.is_std,
        halved: levels.map(|k| output.level(k).expect("level exists").halved).collect(),
        cells: output.level_count() - 1 > output.brick_level(),
    }
}

fn kernel(graph: &Graph, step: &Step, globals: &[Vec<f64>]) -> Kernel {
    match &step.kind {
        StepKind::Gaussian { sigma, channels } => {
            let [mean, variance] = [Moment::Mean, Moment::Variance].map(|m| channels.contains(&m));
            Kernel::Gaussian { sigma: *sigma, wanted: Wanted { mean, variance } }
        }
        StepKind::Gradient { size, weight, spacing, channels, .. } => {
            let fit = Fit { size: *size, weight: *weight, spacing: *spacing, missing: None };
            let [magnitude, vector] =
                [GradientChannel::Magnitude, GradientChannel::Vector].map(|c| channels.contains(&c));
            Kernel::Gradient { fit, magnitude, vector }
        }
        StepKind::Window { params, channels } => Kernel::Windows { params: *params, channels: channels.clone() },
        StepKind::Obscurance { sweep, .. } => Kernel::Sweep(sweep.clone()),
        _ => Kernel::Points(ops(graph, step, globals)),
    }
}
