//! Steps, their wires, masks and pre-passes, and whether the shapes of what they read agree.

use super::super::graph::*;
use super::super::{Prepass, PrepassKind};
use super::{Lowering, UNROUNDED_MEAN};
use crate::config::{Op, StageNode, Where, WhereRule};
use crate::grid::{Affine, Border, DType};
use crate::kernel::mask::Band;
use crate::{Error, Result};

impl Lowering<'_> {
    /// The pre-pass of this kind over a wire: an earlier stage's, or a new one.
    pub(super) fn prepass(&mut self, wire: WireId, kind: PrepassKind) -> usize {
        let new = Prepass { wires: vec![wire], kind };
        self.out.prepasses.iter().position(|p| *p == new).unwrap_or_else(|| {
            self.out.prepasses.push(new);
            self.out.prepasses.len() - 1
        })
    }

    pub(super) fn mask(&mut self, node: &StageNode) -> Result<Option<Mask>> {
        let Some(Where { input, rule }) = &node.where_ else { return Ok(None) };
        let wire = self.wire(input, &node.place)?;
        if self.out.graph.wires[wire].components != 1 {
            return Err(Error::config(format!("{}.where", node.place.key), "the mask's input must have one component"));
        }
        let reach = match rule {
            WhereRule::Range { .. } => [0; 3],
            WhereRule::Iso { iso, band } => Band { iso, width: *band, spacing: self.lattice(wire).spacing }.reach(),
        };
        Ok(Some(Mask { wire, rule: rule.clone(), reach }))
    }

    /// Stages that look at one field take one component; pointwise ones take as many on each side, or one.
    pub(super) fn check_components(&self, node: &StageNode, inputs: &[WireId]) -> Result<()> {
        let count = |w: &WireId| self.out.graph.wires[*w].components;
        let most = inputs.iter().map(count).max().unwrap_or(1);
        let single = matches!(
            node.op,
            Op::Gradient { .. } | Op::Saliency { .. } | Op::Transfer { .. } | Op::OcclusionMap { .. }
        );
        let first = if matches!(node.op, Op::Obscurance(_)) { count(&inputs[0]) } else { 1 };
        if (single && most > 1) || first > 1 {
            let name = &self.out.graph.wires[inputs[0]].name;
            let message = format!("\"{name}\" has {most} components; {} takes one (`channel = 0`)", node.op.word());
            return Err(Error::config(format!("{}.input", node.place.key), message));
        }
        let mixed = !matches!(node.op, Op::Obscurance(_)) && inputs.iter().any(|w| count(w) != most && count(w) != 1);
        if mixed {
            let counts: Vec<usize> = inputs.iter().map(count).collect();
            let message = format!("inputs of {counts:?} components; each must have as many as the others, or one");
            return Err(Error::config(node.place.key.clone(), message));
        }
        Ok(())
    }

    pub(super) fn new_step(
        &mut self,
        node: &StageNode,
        kind: StepKind,
        inputs: Vec<WireId>,
        reach: [usize; 3],
        border: Border,
    ) -> Result<StepId> {
        let mask = self.mask(node)?;
        self.check_components(node, &inputs)?;
        let shapes = inputs.iter().chain(mask.as_ref().map(|m| &m.wire));
        let first = self.lattice(inputs[0]).shape;
        for &w in shapes {
            let shape = self.lattice(w).shape;
            if shape != first {
                let (a, b) = (&self.out.graph.wires[inputs[0]].name, &self.out.graph.wires[w].name);
                return Err(Error::config(
                    node.place.key.clone(),
                    format!(
                        "\"{a}\" has the shape {first:?} and \"{b}\" {shape:?}; a stage reads volumes of one shape"
                    ),
                ));
            }
        }
        let step = Step {
            stages: vec![node.name.clone()],
            kind,
            inputs,
            outputs: vec![],
            reach,
            border,
            mask,
            halo: [0; 3],
            streamed: None,
        };
        self.out.graph.steps.push(step);
        Ok(self.out.graph.steps.len() - 1)
    }

    #[allow(clippy::too_many_arguments)]
    pub(super) fn push_step(
        &mut self,
        index: usize,
        node: &StageNode,
        kind: StepKind,
        inputs: Vec<WireId>,
        reach: [usize; 3],
        border: Border,
        channels: &[&'static str],
    ) -> Result<()> {
        let step = self.new_step(node, kind, inputs.clone(), reach, border)?;
        for channel in channels {
            let wire = self.output_wire(index, node, channel, step, &inputs);
            self.out.graph.steps[step].outputs.push(wire);
        }
        Ok(())
    }

    /// Adds the wire of one channel of a stage.
    pub(super) fn output_wire(
        &mut self,
        index: usize,
        node: &StageNode,
        channel: &'static str,
        step: StepId,
        inputs: &[WireId],
    ) -> WireId {
        let src = &self.out.graph.wires[inputs[0]];
        // A sweep's colours and normals have three components; its openness has the density's one.
        let shaping = if matches!(node.op, Op::Obscurance(_)) { &inputs[..1] } else { inputs };
        let most = shaping.iter().map(|&w| self.out.graph.wires[w].components).max().unwrap_or(1);
        let (components, component_names) = match channel {
            "rgb" if !matches!(node.op, Op::AmbientLight { .. }) => {
                (3, ["red", "green", "blue"].map(String::from).to_vec())
            }
            "rgb" => (most, ["red", "green", "blue"].map(String::from).to_vec()),
            "vector" => (3, ["z", "y", "x"].map(String::from).to_vec()),
            // Colour and normal have three components each; the openness that they bear on has one.
            "openness" if matches!(node.op, Op::Obscurance(_)) => (1, src.component_names.clone()),
            _ => (most, src.component_names.clone()),
        };
        let extreme = matches!(channel, "min" | "max") && matches!(node.op, Op::Box { .. }) && src.affine.is_identity();
        let extreme = extreme && !src.beyond(node.border).1;
        let dtype = if extreme {
            src.dtype
        } else if channel == UNROUNDED_MEAN {
            DType::F64
        } else {
            inputs.iter().fold(DType::F32, |d, &w| {
                if self.out.graph.wires[w].dtype.result() == DType::F64 { DType::F64 } else { d }
            })
        };
        let missing = if extreme { src.missing } else { None };
        let wire = Wire {
            name: format!("{}.{channel}", node.name),
            channel: channel.to_string(),
            producer: Producer::Step(step),
            components,
            component_names,
            dtype,
            affine: Affine::IDENTITY,
            missing,
            fill: node.fill.unwrap_or(if ["openness", "lower", "upper"].contains(&channel) { 1.0 } else { 0.0 }),
            lattice: src.lattice,
            sink_halo: [0; 3],
            halo: [0; 3],
        };
        let id = self.push_wire(wire);
        self.out.stage_wires.insert((index, channel), id);
        id
    }
}
