//! Config and volume facts to a pruned graph: names become indices, lengths become voxels, stages that share a pass share
//! a step.

mod openness;
mod ops;
mod steps;

use std::collections::HashMap;

use super::graph::*;
use super::{Prepass, lengths};
use crate::config::{Config, Input, Modulation, ObscuranceOp, Op, Place, Ref, StageNode, op_channels};
use crate::grid::Border;
use crate::kernel::gaussian;
use crate::stage::{Reduce, WindowChannel, WindowShape};
use crate::store::VolumeInfo;
use crate::{Error, Result};
use ops::box_channel;

/// A mean that levels are pooled with, in f64: rounded to f32 it would hide small spreads of large means. No name of a config.
pub const UNROUNDED_MEAN: &str = "unrounded mean";

/// What lowering makes.
#[derive(Debug, Default)]
pub struct Lowered {
    pub graph: Graph,
    pub prepasses: Vec<Prepass>,
    /// Occlusion maps by stage index: the wire they read and the level of their dataset 0.
    pub maps: HashMap<usize, (WireId, usize)>,
    input_wires: HashMap<usize, WireId>,
    /// By stage and channel.
    stage_wires: HashMap<(usize, &'static str), WireId>,
}

struct Lowering<'a> {
    config: &'a Config,
    infos: &'a [VolumeInfo],
    out: Lowered,
    /// Channels that somebody reads, per stage.
    wanted: Vec<Vec<&'static str>>,
}

/// What a name of the config means.
enum Target {
    Input(usize),
    Stage(usize, &'static str),
}

/// Lowers everything that the outputs read; halos come with the outputs. `infos` are the facts of the config's inputs, in order.
pub fn lower(config: &Config, infos: &[VolumeInfo]) -> Result<Lowered> {
    let mut lowering =
        Lowering { config, infos, out: Lowered::default(), wanted: vec![Vec::new(); config.stages.len()] };
    for output in &config.outputs {
        for from in &output.from {
            lowering.want(from, &output.place)?;
            if output.reduce == Some(Reduce::Moments) {
                lowering.want_means(from, &output.place)?;
            }
        }
    }
    let stages: Vec<usize> = (0..config.stages.len()).filter(|&s| !lowering.wanted[s].is_empty()).collect();
    for stage in stages {
        lowering.stage(stage)?;
    }
    // Inputs that outputs read directly.
    for output in &config.outputs {
        for from in &output.from {
            if let Target::Input(input) = lowering.target(from, &output.place)? {
                lowering.input(input)?;
            }
        }
    }
    forget_mirrors(&mut lowering.out.graph);
    Ok(lowering.out)
}

/// Voxels that `nearest` and `reflect` repeat lie in the window themselves. Extremes need no copies of them; along an axis of one
/// voxel a box or a Gaussian of nothing but copies has the distribution of what it copies, so a plane stays a plane.
fn forget_mirrors(graph: &mut Graph) {
    for step in &mut graph.steps {
        if !matches!(step.border, Border::Nearest | Border::Reflect) {
            continue;
        }
        let shape = graph.lattices[graph.wires[step.inputs[0]].lattice].shape;
        let radius = match &mut step.kind {
            StepKind::Window { channels, params } => {
                if channels.iter().all(|c| matches!(c, WindowChannel::Min | WindowChannel::Max)) {
                    step.border = Border::Clip;
                }
                Some(&mut params.radius)
            }
            StepKind::Rank { params, shape: WindowShape::Box, .. }
            | StepKind::Levels { params, .. }
            | StepKind::Moments4 { params, .. } => Some(&mut params.radius),
            // Its kernel renormalises to the voxels that it is given.
            StepKind::Gaussian { .. } => None,
            _ => continue,
        };
        for reach in radius.into_iter().chain([&mut step.reach]) {
            for a in (0..3).filter(|&a| shape[a] == 1) {
                reach[a] = 0;
            }
        }
    }
}

impl Lowered {
    /// The wire of a reference; `None` for an occlusion map's channels, which are pyramids of their own.
    pub fn wire_of(&self, config: &Config, reference: &Ref) -> Option<WireId> {
        if let Some(input) = config.inputs.iter().position(|i| i.name == reference.name) {
            return self.input_wires.get(&input).copied();
        }
        let stage = config.stages.iter().position(|s| s.name == reference.name)?;
        let channels = op_channels(config.stages[stage].op.word());
        let wanted = reference.channel.as_deref().unwrap_or(channels[0]);
        let channel = *channels.iter().find(|c| **c == wanted)?;
        self.stage_wires.get(&(stage, channel)).copied()
    }

    /// Another channel of the stage that makes a wire, if somebody reads it.
    pub fn beside(&self, wire: WireId, channel: &'static str) -> Option<WireId> {
        let ((stage, _), _) = self.stage_wires.iter().find(|(_, w)| **w == wire)?;
        self.stage_wires.get(&(*stage, channel)).copied()
    }
}

impl Lowering<'_> {
    fn error(&self, place: &Place, message: impl std::fmt::Display) -> Error {
        Error::config(place.key.clone(), message).located(&self.config.file, place.line)
    }

    fn target(&self, reference: &Ref, place: &Place) -> Result<Target> {
        if let Some(input) = self.config.inputs.iter().position(|i| i.name == reference.name) {
            return Ok(Target::Input(input));
        }
        let Some(stage) = self.config.stages.iter().position(|s| s.name == reference.name) else {
            return Err(self.error(place, format!("there is no input or stage named \"{}\"", reference.name)));
        };
        let channels = op_channels(self.config.stages[stage].op.word());
        let wanted = reference.channel.as_deref().unwrap_or(channels[0]);
        match channels.iter().find(|c| **c == wanted) {
            Some(channel) => Ok(Target::Stage(stage, channel)),
            None => Err(self.error(
                place,
                format!("stage \"{}\" has no channel \"{wanted}\"; it has {}", reference.name, channels.join(", ")),
            )),
        }
    }

    /// Marks a channel as read, and what its stage reads in turn.
    fn want(&mut self, reference: &Ref, place: &Place) -> Result<()> {
        let Target::Stage(stage, channel) = self.target(reference, place)? else { return Ok(()) };
        let first = self.wanted[stage].is_empty();
        let first_rgb = channel == "rgb" && !self.wanted[stage].contains(&channel);
        if !self.wanted[stage].contains(&channel) {
            self.wanted[stage].push(channel);
        }
        let node = &self.config.stages[stage];
        for (key, input) in node.reads() {
            // A colour bleeds into the channel rgb alone.
            let unseen = if key == "colour" { first_rgb } else { first };
            let by_ranks = |op: &ObscuranceOp| -> Result<bool> {
                Ok(key == "input" && !op.weight_by_normal && self.ranked(input, &node.place)?.is_some())
            };
            let instead = matches!(&node.op, Op::Obscurance(op) if by_ranks(op)?);
            if unseen && !instead {
                self.want(input, &node.place)?;
            }
        }
        Ok(())
    }

    /// Levels of a variance pool the means as well.
    fn want_means(&mut self, reference: &Ref, place: &Place) -> Result<()> {
        let Target::Stage(stage, _) = self.target(reference, place)? else { return Ok(()) };
        let (Op::Box { input, .. } | Op::Gaussian { input, .. }) = &self.config.stages[stage].op else { return Ok(()) };
        // f32 holds the mean of a few bytes well enough beside any variance that they can have, and so does the GPU.
        let bytes = matches!(self.target(input, place)?, Target::Input(i) if self.infos[i].dtype.size() == 1);
        let channel = if bytes { "mean" } else { UNROUNDED_MEAN };
        if !self.wanted[stage].contains(&channel) {
            self.wanted[stage].push(channel);
        }
        Ok(())
    }

    fn wire(&mut self, reference: &Ref, place: &Place) -> Result<WireId> {
        match self.target(reference, place)? {
            Target::Input(input) => self.input(input),
            Target::Stage(stage, channel) => {
                self.stage(stage)?;
                self.out.stage_wires.get(&(stage, channel)).copied().ok_or_else(|| {
                    self.error(
                        place,
                        format!("\"{}\" is an occlusion map: it can be written, not read by a stage", reference.name),
                    )
                })
            }
        }
    }

    fn input(&mut self, input: usize) -> Result<WireId> {
        if let Some(wire) = self.out.input_wires.get(&input) {
            return Ok(*wire);
        }
        let (node, info): (&Input, &VolumeInfo) = (&self.config.inputs[input], &self.infos[input]);
        let lattice =
            Lattice { input, shape: info.shape, spacing: info.spacing, origin: info.origin, unit: info.unit.clone() };
        self.out.graph.lattices.push(lattice);
        // What the type cannot hold is no voxel's value.
        let (least, most) = info.dtype.range();
        let missing = info.nodata.filter(|v| !info.dtype.is_float() && v.fract() == 0.0 && (least..=most).contains(v));
        let wire = Wire {
            name: node.name.clone(),
            channel: "value".into(),
            producer: Producer::Input(input),
            components: info.components,
            component_names: info.component_names.clone(),
            dtype: info.dtype,
            affine: info.affine,
            missing: missing.map(|v| v as i64),
            fill: missing.unwrap_or(0.0),
            lattice: self.out.graph.lattices.len() - 1,
            sink_halo: [0; 3],
            halo: [0; 3],
        };
        let id = self.push_wire(wire);
        self.out.input_wires.insert(input, id);
        Ok(id)
    }

    fn push_wire(&mut self, wire: Wire) -> WireId {
        self.out.graph.wires.push(wire);
        self.out.graph.wires.len() - 1
    }

    /// Lowers one stage (once), after those that it reads.
    fn stage(&mut self, index: usize) -> Result<()> {
        let wanted = self.wanted[index].clone();
        if self.out.stage_wires.contains_key(&(index, wanted[0])) || self.out.maps.contains_key(&index) {
            return Ok(());
        }
        let node = self.config.stages[index].clone();
        self.lower_op(index, &node, &wanted)
            .map_err(|e| self.config.locate(e).located(&self.config.file, node.place.line))
    }

    fn lower_op(&mut self, index: usize, node: &StageNode, wanted: &[&'static str]) -> Result<()> {
        let place = &node.place;
        let key = |k: &str| format!("{}.{k}", place.key);
        match &node.op {
            Op::Box { input, radius } => {
                let src = self.wire(input, place)?;
                let radius = lengths::radius(radius, self.lattice(src), &key("radius"))?;
                self.check_window(src, radius, node.border, &key("radius"))?;
                let channels = wanted.iter().map(|c| (*c, box_channel(c))).collect();
                self.window(index, node, src, radius, false, channels)
            }
            Op::AmbientOcclusion { .. } => self.openness(index, node, wanted),
            Op::Gaussian { input, sigma } => {
                let src = self.wire(input, place)?;
                let sigma = lengths::sigma(sigma, self.lattice(src), &key("sigma"))?;
                let channels =
                    wanted.iter().map(|c| if *c == "variance" { Moment::Variance } else { Moment::Mean }).collect();
                let kind = StepKind::Gaussian { sigma, channels };
                self.push_step(index, node, kind, vec![src], gaussian::reach(sigma), node.border, wanted)
            }
            Op::OcclusionMap { input, start_level } => {
                let src = self.wire(input, place)?;
                self.out.maps.insert(index, (src, *start_level));
                Ok(())
            }
            Op::Gradient { input, size, weight } => {
                let src = self.wire(input, place)?;
                let channels = wanted
                    .iter()
                    .map(|c| if *c == "magnitude" { GradientChannel::Magnitude } else { GradientChannel::Vector })
                    .collect();
                let kind = self.gradient_kind(src, *size, *weight, channels);
                self.push_step(index, node, kind, vec![src], [size / 2; 3], Border::Nearest, wanted)
            }
            Op::Saliency { input, size, weight, scale_max } => {
                self.saliency(index, node, input, *size, *weight, *scale_max)
            }
            Op::Obscurance(op) => self.obscurance(index, node, op, wanted),
            Op::Transfer { input, points } => {
                let src = self.wire(input, place)?;
                let channels = wanted
                    .iter()
                    .map(|c| if *c == "opacity" { TransferChannel::Opacity } else { TransferChannel::Rgb })
                    .collect();
                let kind = StepKind::Transfer { points: points.clone(), channels };
                self.push_step(index, node, kind, vec![src], [0; 3], Border::Clip, wanted)
            }
            Op::Window { input, low, high, mode } => {
                let src = self.wire(input, place)?;
                let kind = StepKind::OpennessWindow { low: *low, high: *high, mode: *mode };
                self.push_step(index, node, kind, vec![src], [0; 3], Border::Clip, wanted)
            }
            Op::OpacityModulation { input, by, rule } => {
                let inputs = vec![self.wire(input, place)?, self.wire(by, place)?];
                let kind = match *rule {
                    Modulation::Variance { sigma_max2 } => StepKind::ModulateByVariance { sigma_max2 },
                    Modulation::Saliency { threshold, gain } => StepKind::ModulateBySaliency { threshold, gain },
                };
                self.push_step(index, node, kind, inputs, [0; 3], Border::Clip, wanted)
            }
            Op::AmbientLight { input, rgb, k } => {
                let inputs = vec![self.wire(input, place)?, self.wire(rgb, place)?];
                self.push_step(index, node, StepKind::AmbientLight { k: *k }, inputs, [0; 3], Border::Clip, wanted)
            }
            Op::Combine { inputs, kind } => {
                let wires = inputs.iter().map(|r| self.wire(r, place)).collect::<Result<Vec<_>>>()?;
                self.push_step(index, node, StepKind::Combine { kind: *kind }, wires, [0; 3], Border::Clip, wanted)
            }
        }
    }

    fn lattice(&self, wire: WireId) -> &Lattice {
        &self.out.graph.lattices[self.out.graph.wires[wire].lattice]
    }
}
