//! Steps that run on the GPU together on one brick: what comes back of them, voxels that the host needs and levels of outputs.

use super::program::Program;
use super::steps::{Engine, MaskValue};
use super::value::{Comp, Value};
use crate::Result;
use crate::brick::{Pool, Voxels};
use crate::gpu::flow::{Flow, Sink};
use crate::gpu::levels::Pyramid;
use crate::gpu::{Gpu, Needed, SinkOut};
use crate::grid::{DType, Region, View};
use crate::plan::FlowPlan;
use crate::plan::flows::{Site, Target, build};
use crate::plan::graph::{StepId, WireId};

/// The levels of a component of an output over one brick, in its type.
#[derive(Debug)]
pub struct Ready {
    pub output: usize,
    pub component: usize,
    pub levels: Vec<Voxels>,
    /// Numbers of the last level's cells, where the output keeps them.
    pub cells: Vec<f64>,
}

/// What a flow made.
#[derive(Debug, Default)]
pub struct FlowDone {
    /// Its steps, without those that nobody needs on this brick.
    pub steps: Vec<StepId>,
    pub values: Vec<(WireId, Value)>,
    pub ready: Vec<Ready>,
}

/// Room for what comes back of one sink.
enum Room {
    Component(Voxels),
    Levels(Vec<Voxels>, Vec<f64>),
}

impl Engine<'_> {
    /// All steps of a flow that somebody needs on a brick, but for those without a needed voxel and their readers, which are
    /// constants or next to it; `None` where they run one by one. `needed` is by wire.
    ///
    /// # Errors
    /// A GPU that failed twice.
    pub fn flow(
        &self,
        program: &Program,
        flow: &FlowPlan,
        values: &mut [Option<Value>],
        masks: &[(StepId, MaskValue)],
        needed: &[bool],
        brick: Region,
    ) -> Result<Option<FlowDone>> {
        let plan = self.plan;
        let mask = |s: StepId| masks.iter().find(|(m, _)| *m == s).map(|(_, m)| m);
        let masked = |s: StepId| matches!(mask(s), Some(MaskValue::Some(_)));
        let off = |s: StepId| matches!(mask(s), Some(MaskValue::None));
        let live = |s: StepId| !off(s) && plan.graph.steps[s].outputs.iter().any(|&w| needed[w]);
        let steps: Vec<StepId> = program.steps.iter().copied().filter(|&s| live(s)).collect();
        let out: Vec<StepId> = flow.steps.iter().copied().filter(|s| !steps.contains(s)).collect();
        let flow = &flow.without(&plan.graph, &out);
        let Some(gpu) = self.flow_lane(flow) else { return Ok(None) };
        let outputs = &program.outputs[..];
        let site =
            Site { steps: &steps, outputs, volume: program.volume, brick, globals: &self.globals, masked: &masked };
        let Some((recipe, targets)) = build(plan, flow, &site) else { return Ok(None) };
        let value = values[flow.source].as_mut().expect("what a flow reads is made before it");
        if self.skip && value.constants().is_some() {
            return Ok(None);
        }
        value.materialize(self.pool);
        let mut rooms: Vec<Room> = recipe.sinks.iter().zip(&targets).map(|(sink, t)| self.room(sink, t)).collect();
        let mut outs: Vec<SinkOut> = recipe.sinks.iter().zip(&mut rooms).map(|(s, r)| r.out(s)).collect();
        let failed = |e| self.gpu_failed(flow.steps[0], &e);
        let needed = flow.steps.iter().copied().enumerate().filter_map(|(step, s)| {
            let region = program.step_box(plan, s, brick);
            let Some(MaskValue::Some(mask)) = mask(s) else { return None };
            Some(Needed { step, view: View::dense(mask, region.shape()), region })
        });
        let needed: Vec<Needed> = needed.collect();
        let done = gpu.flow(&recipe, value.view(0, value.region), value.region, &needed, &mut outs);
        drop(outs);
        if done.map_err(failed)?.is_none() {
            plan.flow_of(flow.steps[0]).into_iter().for_each(|f| self.metrics.flow_left(f));
            rooms.into_iter().for_each(|r| r.recycle(self.pool));
            return Ok(None);
        }
        let done = collect(rooms, &targets, &recipe, |w| plan.graph.wires[w].dtype);
        Ok(Some(FlowDone { steps: flow.steps.clone(), ..done }))
    }

    /// The GPU, unless all of the steps' bricks may go to either lane and it is busy. The bits are the same.
    fn flow_lane(&self, flow: &FlowPlan) -> Option<&Gpu> {
        let gpu = self.gpu?;
        // Steps that look at one voxel follow the others.
        let shares = flow.steps.iter().all(|&s| self.plan.shares(s));
        if shares && gpu.is_busy() {
            flow.steps.iter().for_each(|&s| self.metrics.shared(s));
            return None;
        }
        Some(gpu)
    }

    fn room(&self, sink: &Sink, target: &Target) -> Room {
        match (target, &sink.pyramid) {
            (Target::Levels { .. }, Some(p)) => {
                let extents = (0..=p.halved.len()).map(|k| p.extent(k, sink.region.shape()));
                let levels = extents.map(|n| self.pool.take(p.dtype, n.iter().product())).collect();
                Room::Levels(levels, Vec::new())
            }
            (Target::Wire(w, _), _) => {
                let dtype = self.plan.graph.wires[*w].dtype;
                Room::Component(self.pool.take(dtype, sink.region.voxels()))
            }
            (Target::Levels { .. }, None) => unreachable!("levels have a pyramid"),
        }
    }
}

impl Room {
    fn out(&mut self, sink: &Sink) -> SinkOut<'_> {
        let shape = sink.region.shape();
        match self {
            Room::Component(v) => SinkOut::Voxels(v.view_mut(shape)),
            Room::Levels(levels, cells) => {
                let plain = Pyramid::plain();
                let p = sink.pyramid.as_ref().unwrap_or(&plain);
                let views = levels.iter_mut().enumerate().map(|(k, v)| v.view_mut(p.extent(k, shape)));
                SinkOut::Levels(views.collect(), cells)
            }
        }
    }

    fn recycle(self, pool: &Pool) {
        match self {
            Room::Component(v) => pool.put(v),
            Room::Levels(levels, _) => levels.into_iter().for_each(|v| pool.put(v)),
        }
    }
}

/// Components to their wires, levels to their outputs.
fn collect(rooms: Vec<Room>, targets: &[Target], recipe: &Flow, dtype: impl Fn(WireId) -> DType) -> FlowDone {
    let mut done = FlowDone::default();
    for ((room, target), sink) in rooms.into_iter().zip(targets).zip(&recipe.sinks) {
        match (room, *target) {
            (Room::Levels(levels, cells), Target::Levels { output, component }) => {
                done.ready.push(Ready { output, component, levels, cells });
            }
            (Room::Component(voxels), Target::Wire(w, _)) => {
                let comp = Comp::Voxels(voxels);
                match done.values.last_mut().filter(|v| v.0 == w) {
                    Some((_, value)) => value.comps.push(comp),
                    None => {
                        let value = Value { dtype: dtype(w), region: sink.region, comps: vec![comp] };
                        done.values.push((w, value));
                    }
                }
            }
            _ => unreachable!("rooms are made for their targets"),
        }
    }
    done
}
