//! Config and volume facts to a pruned graph: names become indices, lengths become voxels, stages that share a pass share
//! a step.

mod openness;

use std::collections::HashMap;

use super::graph::*;
use super::{Prepass, PrepassKind, lengths};
use crate::config::{Config, Input, Modulation, Op, Place, Ref, StageNode, Where, WhereRule, op_channels};
use crate::grid::{Affine, Border, DType};
use crate::kernel::{gaussian, mask, obscurance};
use crate::stage::{GradientWeight, WindowChannel, WindowParams};
use crate::store::VolumeInfo;
use crate::{Error, Result};

/// What lowering makes.
#[derive(Debug, Default)]
pub struct Lowered {
    pub graph: Graph,
    pub prepasses: Vec<Prepass>,
    /// Occlusion maps by stage index: the wire they read and the level of their dataset 0.
    pub maps: HashMap<usize, (WireId, usize)>,
}

struct Lowering<'a> {
    config: &'a Config,
    infos: &'a [VolumeInfo],
    out: Lowered,
    /// Channels that somebody reads, per stage.
    wanted: Vec<Vec<&'static str>>,
    input_wires: HashMap<usize, WireId>,
    stage_wires: HashMap<(usize, &'static str), WireId>,
}

/// What a name of the config means.
enum Target {
    Input(usize),
    Stage(usize, &'static str),
}

/// Lowers everything that the outputs read. `infos` are the facts of the config's inputs, in order.
pub fn lower(config: &Config, infos: &[VolumeInfo]) -> Result<Lowered> {
    let mut lowering = Lowering {
        config,
        infos,
        out: Lowered::default(),
        wanted: vec![Vec::new(); config.stages.len()],
        input_wires: HashMap::new(),
        stage_wires: HashMap::new(),
    };
    for output in &config.outputs {
        for from in &output.from {
            lowering.want(from, &output.place)?;
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
    lowering.out.graph.demand_halos();
    Ok(lowering.out)
}

impl Lowered {
    /// The wire of a reference; `None` for an occlusion map's channels, which are pyramids of their own.
    pub fn wire_of(&self, config: &Config, reference: &Ref) -> Option<WireId> {
        let name = match config.stages.iter().find(|s| s.name == reference.name) {
            Some(stage) => {
                let channel = reference.channel.as_deref().unwrap_or(op_channels(stage.op.word())[0]);
                format!("{}.{channel}", stage.name)
            }
            None => reference.name.clone(),
        };
        self.graph.wires.iter().position(|w| w.name == name)
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
        // Levels of a variance pool the means as well.
        let companion = ["variance", "std"].contains(&channel)
            && op_channels(self.config.stages[stage].op.word()).contains(&"mean");
        if companion && !self.wanted[stage].contains(&"mean") {
            self.wanted[stage].push("mean");
        }
        let node = &self.config.stages[stage];
        for (key, input) in node.reads() {
            // A colour bleeds into the channel rgb alone.
            let unseen = if key == "colour" { first_rgb } else { first };
            if unseen {
                self.want(input, &node.place)?;
            }
        }
        Ok(())
    }

    fn wire(&mut self, reference: &Ref, place: &Place) -> Result<WireId> {
        match self.target(reference, place)? {
            Target::Input(input) => self.input(input),
            Target::Stage(stage, channel) => {
                self.stage(stage)?;
                self.stage_wires.get(&(stage, channel)).copied().ok_or_else(|| {
                    self.error(
                        place,
                        format!("\"{}\" is an occlusion map: it can be written, not read by a stage", reference.name),
                    )
                })
            }
        }
    }

    fn input(&mut self, input: usize) -> Result<WireId> {
        if let Some(wire) = self.input_wires.get(&input) {
            return Ok(*wire);
        }
        let (node, info): (&Input, &VolumeInfo) = (&self.config.inputs[input], &self.infos[input]);
        let lattice =
            Lattice { input, shape: info.shape, spacing: info.spacing, origin: info.origin, unit: info.unit.clone() };
        self.out.graph.lattices.push(lattice);
        let missing = info.nodata.filter(|_| !info.dtype.is_float()).filter(|v| v.fract() == 0.0 && v.abs() < 1e15);
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
            halo: [0; 3],
        };
        let id = self.push_wire(wire);
        self.input_wires.insert(input, id);
        Ok(id)
    }

    fn push_wire(&mut self, wire: Wire) -> WireId {
        self.out.graph.wires.push(wire);
        self.out.graph.wires.len() - 1
    }

    /// Lowers one stage (once), after those that it reads.
    fn stage(&mut self, index: usize) -> Result<()> {
        let wanted = self.wanted[index].clone();
        if self.stage_wires.contains_key(&(index, wanted[0])) || self.out.maps.contains_key(&index) {
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
                    wanted.iter().map(|c| if *c == "mean" { Moment::Mean } else { Moment::Variance }).collect();
                let kind = StepKind::Gaussian { sigma, channels };
                self.push_step(index, node, kind, vec![src], gaussian::reach(sigma), node.border, wanted)
            }
            Op::OcclusionMap { input, start_level } => {
                let src = self.wire(input, place)?;
                if node.where_.is_some() {
                    return Err(Error::config(
                        key("where"),
                        "an occlusion_map takes no `where`: its levels pool every voxel",
                    ));
                }
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

    /// Window kernels count voxels in 32 bits.
    fn check_window(&self, src: WireId, radius: [usize; 3], border: Border, key: &str) -> Result<()> {
        let shape = self.lattice(src).shape;
        let cut = |side: f64, a: usize| if border == Border::Clip { side.min(shape[a] as f64) } else { side };
        let voxels: f64 = (0..3).map(|a| cut(2.0 * radius[a] as f64 + 1.0, a)).product();
        if voxels >= (1u64 << 31) as f64 {
            let message = format!("{radius:?} voxels (z, y, x) make a window of {voxels:.0} voxels; at most 2^31 - 1");
            return Err(Error::config(key, message));
        }
        Ok(())
    }

    /// The pre-pass of this kind over a wire: an earlier stage's, or a new one.
    fn prepass(&mut self, wire: WireId, kind: PrepassKind) -> usize {
        let new = Prepass { wires: vec![wire], kind };
        self.out.prepasses.iter().position(|p| *p == new).unwrap_or_else(|| {
            self.out.prepasses.push(new);
            self.out.prepasses.len() - 1
        })
    }

    fn window_params(&self, src: WireId, radius: [usize; 3], solid_low: bool) -> WindowParams {
        let wire = &self.out.graph.wires[src];
        WindowParams { radius, affine: wire.affine, missing: wire.missing, solid_low }
    }

    /// A window stage joins the pass of an earlier one with the same input, window, border and mask.
    fn window(
        &mut self,
        index: usize,
        node: &StageNode,
        src: WireId,
        radius: [usize; 3],
        solid_low: bool,
        channels: Vec<(&'static str, WindowChannel)>,
    ) -> Result<()> {
        let params = self.window_params(src, radius, solid_low);
        let mask = self.mask(node)?;
        // Box statistics do not ask which side is solid.
        let side_matters = channels.iter().any(|(_, c)| matches!(c, WindowChannel::Openness(..)));
        let found = self.out.graph.steps.iter().position(|s| match &s.kind {
            StepKind::Window { params: p, channels: theirs } => {
                let same_side = p.solid_low == solid_low
                    || !side_matters
                    || !theirs.iter().any(|c| matches!(c, WindowChannel::Openness(..)));
                let same = p.radius == radius && s.inputs == [src] && s.border == node.border && s.mask == mask;
                same && same_side
            }
            _ => false,
        });
        let names: Vec<&'static str> = channels.iter().map(|(n, _)| *n).collect();
        let kinds: Vec<WindowChannel> = channels.iter().map(|(_, c)| *c).collect();
        let Some(step) = found else {
            let kind = StepKind::Window { params, channels: kinds };
            return self.push_step(index, node, kind, vec![src], radius, node.border, &names);
        };
        for (name, kind) in channels {
            let wire = self.output_wire(index, node, name, step, &[src]);
            let StepKind::Window { params, channels } = &mut self.out.graph.steps[step].kind else { unreachable!() };
            channels.push(kind);
            params.solid_low |= side_matters && solid_low;
            self.out.graph.steps[step].outputs.push(wire);
        }
        self.out.graph.steps[step].stages.push(node.name.clone());
        Ok(())
    }

    fn gradient_kind(
        &self,
        src: WireId,
        size: usize,
        weight: GradientWeight,
        channels: Vec<GradientChannel>,
    ) -> StepKind {
        StepKind::Gradient { size, weight, spacing: self.lattice(src).spacing, channels, stored: false }
    }

    fn saliency(
        &mut self,
        index: usize,
        node: &StageNode,
        input: &Ref,
        size: usize,
        weight: GradientWeight,
        scale_max: bool,
    ) -> Result<()> {
        let src = self.wire(input, &node.place)?;
        let kind = self.gradient_kind(src, size, weight, vec![GradientChannel::Magnitude]);
        if !scale_max {
            return self.push_step(index, node, kind, vec![src], [size / 2; 3], Border::Nearest, &["saliency"]);
        }
        // The raw magnitude on a wire of its own, its maximum by a pre-pass, then the quotient.
        let step = self.new_step(node, kind, vec![src], [size / 2; 3], Border::Nearest)?;
        let raw = self.output_wire(index, node, "saliency", step, &[src]);
        self.out.graph.wires[raw].name = format!("{}.saliency (raw)", node.name);
        self.out.graph.steps[step].outputs.push(raw);
        self.out.prepasses.push(Prepass { wires: vec![raw], kind: PrepassKind::Max });
        let by = self.out.prepasses.len() - 1;
        self.push_step(index, node, StepKind::Divide { by }, vec![raw], [0; 3], Border::Clip, &["saliency"])
    }

    fn obscurance(
        &mut self,
        index: usize,
        node: &StageNode,
        op: &crate::config::ObscuranceOp,
        wanted: &[&'static str],
    ) -> Result<()> {
        let src = self.wire(&op.input, &node.place)?;
        let max_distance =
            lengths::distance(&op.max_distance, self.lattice(src), &format!("{}.max_distance", node.place.key))?;
        let bleeds = wanted.contains(&"rgb");
        let colour = op.colour.as_ref().filter(|_| bleeds).map(|c| self.wire(c, &node.place)).transpose()?;
        if bleeds && colour.is_none() {
            return Err(Error::config(
                format!("{}.colour", node.place.key),
                "the channel rgb needs `colour = STAGE`, a transfer stage whose rgb bleeds",
            ));
        }
        if let Some(c) = colour
            && self.out.graph.wires[c].components != 3
        {
            let name = &self.out.graph.wires[c].name;
            return Err(Error::config(
                format!("{}.colour", node.place.key),
                format!("\"{name}\" has {} component(s); an rgb channel has 3", self.out.graph.wires[c].components),
            ));
        }
        let normal = if op.weight_by_normal { Some(self.normal(index, node, src)?) } else { None };
        let wire = &self.out.graph.wires[src];
        let params = obscurance::ObscuranceParams {
            directions: op.directions,
            set: op.set,
            weights: op.weights,
            rho: op.rho,
            max_distance,
            spacing: self.lattice(src).spacing,
            flipped: op.solid_low != (wire.affine.slope < 0.0),
            missing: wire.missing,
            ambient: op.ambient,
        };
        let reach = obscurance::Prepared::new(&params).reach();
        let channels = wanted
            .iter()
            .map(|c| if *c == "openness" { ObscuranceChannel::Openness } else { ObscuranceChannel::Rgb })
            .collect();
        let inputs = [Some(src), colour, normal].into_iter().flatten().collect();
        let kind = StepKind::Obscurance { params, channels, colour, normal };
        self.push_step(index, node, kind, inputs, reach, Border::Clip, wanted)
    }

    /// The 3^3 gradient (weight inverse) of the density, for `weight_by_normal`.
    fn normal(&mut self, index: usize, node: &StageNode, src: WireId) -> Result<WireId> {
        let spacing = self.lattice(src).spacing;
        let channels = vec![GradientChannel::Vector];
        let kind = StepKind::Gradient { size: 3, weight: GradientWeight::Inverse, spacing, channels, stored: true };
        let step = self.new_step(node, kind, vec![src], [1; 3], Border::Nearest)?;
        let wire = self.output_wire(index, node, "vector", step, &[src]);
        self.out.graph.wires[wire].name = format!("{} (normal)", node.name);
        self.out.graph.steps[step].outputs.push(wire);
        Ok(wire)
    }

    fn mask(&mut self, node: &StageNode) -> Result<Option<Mask>> {
        let Some(Where { input, rule }) = &node.where_ else { return Ok(None) };
        let wire = self.wire(input, &node.place)?;
        if self.out.graph.wires[wire].components != 1 {
            return Err(Error::config(format!("{}.where", node.place.key), "the mask's input must have one component"));
        }
        let reach = match rule {
            WhereRule::Range { .. } => [0; 3],
            WhereRule::Iso { band, .. } => mask::iso_reach(*band, self.lattice(wire).spacing),
        };
        Ok(Some(Mask { wire, rule: rule.clone(), reach }))
    }

    /// Stages that look at one field take one component; pointwise ones take as many on each side, or one.
    fn check_components(&self, node: &StageNode, inputs: &[WireId]) -> Result<()> {
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

    fn new_step(
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
        let step =
            Step { stages: vec![node.name.clone()], kind, inputs, outputs: vec![], reach, border, mask, halo: [0; 3] };
        self.out.graph.steps.push(step);
        Ok(self.out.graph.steps.len() - 1)
    }

    #[allow(clippy::too_many_arguments)]
    fn push_step(
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
    fn output_wire(
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
            halo: [0; 3],
        };
        let id = self.push_wire(wire);
        self.stage_wires.insert((index, channel), id);
        id
    }
}

fn box_channel(name: &str) -> WindowChannel {
    match name {
        "mean" => WindowChannel::Mean,
        "min" => WindowChannel::Min,
        "max" => WindowChannel::Max,
        "variance" => WindowChannel::Variance,
        "std" => WindowChannel::Std,
        _ => WindowChannel::Moment2,
    }
}
