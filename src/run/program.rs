//! What is evaluated for each brick: steps in order, wires to deliver, and when a buffer is free again.

use super::steps::MaskValue;
use crate::grid::{Region, Shape};
use crate::plan::graph::{Producer, StepId, WireId};
use crate::plan::memory::wire_box;
use crate::plan::tasks::{Group, inputs_of};
use crate::plan::{FlowPlan, Plan, Prepass};

/// A pruned sub-graph for one stream of bricks.
#[derive(Debug)]
pub struct Program {
    pub steps: Vec<StepId>,
    /// Wires whose values are delivered.
    pub sinks: Vec<WireId>,
    /// Input wires with the halo to read.
    pub inputs: Vec<(WireId, [usize; 3])>,
    pub volume: Shape,
    /// Outputs whose levels may be made with the steps.
    pub outputs: Vec<usize>,
    /// Steps that run on the GPU together.
    pub flows: Vec<FlowPlan>,
}

impl Program {
    /// The main stream of a group.
    pub fn of_group(plan: &Plan, group: &Group) -> Program {
        let inputs = group.inputs.iter().map(|&w| (w, plan.graph.wires[w].halo)).collect();
        Program {
            steps: group.steps.clone(),
            sinks: group.sinks.clone(),
            inputs,
            volume: group.shape,
            outputs: group.outputs.clone(),
            flows: plan.flows.clone(),
        }
    }

    /// The stream of a pre-pass over the whole volume.
    pub fn of_prepass(plan: &Plan, prepass: &Prepass, volume: Shape) -> Program {
        let steps = plan.steps_for(&prepass.wires);
        let inputs = inputs_of(plan, &steps, &prepass.wires);
        // An input by itself is read without what windows see beyond.
        let halo = |w: WireId| if steps.is_empty() { [0; 3] } else { plan.graph.wires[w].halo };
        let inputs = inputs.into_iter().map(|w| (w, halo(w))).collect();
        let sinks = prepass.wires.clone();
        Program { steps, sinks, inputs, volume, outputs: Vec::new(), flows: Vec::new() }
    }

    /// Whether a wire is still wanted after the step at position `at`.
    pub fn wanted_after(&self, plan: &Plan, at: usize, wire: WireId) -> bool {
        self.sinks.contains(&wire)
            || self.steps[at + 1..].iter().any(|&s| {
                let step = &plan.graph.steps[s];
                step.inputs.contains(&wire) || step.mask.as_ref().is_some_and(|m| m.wire == wire)
            })
    }

    /// The flow that starts with a step.
    pub fn flow_at(&self, step: StepId) -> Option<&FlowPlan> {
        self.flows.iter().find(|f| f.first(&self.steps) == Some(step))
    }

    /// The box of a step's outputs for a brick.
    pub fn step_box(&self, plan: &Plan, step: StepId, brick: Region) -> Region {
        wire_box(brick, plan.graph.steps[step].halo, self.volume)
    }

    /// The mask of a step over its box for a brick, where one of these steps has the same.
    pub fn same_mask(
        &self,
        plan: &Plan,
        step: StepId,
        brick: Region,
        known: &[(StepId, MaskValue)],
    ) -> Option<MaskValue> {
        let of = |s: StepId| (&plan.graph.steps[s].mask, self.step_box(plan, s, brick));
        known.iter().find(|(s, _)| of(*s) == of(step)).map(|(_, mask)| mask.clone())
    }

    /// Wires that must be made or read, given the steps that a mask switched off. Inputs that only masks look at are not
    /// among them: the reader looks at those by itself.
    pub fn needed(&self, plan: &Plan, switched_off: &[StepId]) -> Vec<bool> {
        let mut needed = vec![false; plan.graph.wires.len()];
        self.sinks.iter().for_each(|&w| needed[w] = true);
        for &s in self.steps.iter().rev() {
            let step = &plan.graph.steps[s];
            if !switched_off.contains(&s) && step.outputs.iter().any(|&w| needed[w]) {
                let mask = step.mask.as_ref().map(|m| m.wire);
                let made = mask.filter(|&w| matches!(plan.graph.wires[w].producer, Producer::Step(_)));
                step.inputs.iter().copied().chain(made).for_each(|w| needed[w] = true);
            }
        }
        needed
    }
}
