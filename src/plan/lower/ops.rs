//! Stages that make more than one step, or share one.

use std::sync::Arc;

use super::super::graph::*;
use super::super::{Prepass, PrepassKind, lengths};
use super::{Lowering, Target, UNROUNDED_MEAN};
use crate::brick::Voxels;
use crate::config::{ObscuranceOp, Op, Place, Ref, StageNode};
use crate::grid::{AnyViewMut, Border, ViewMut};
use crate::kernel::values::store_any;
use crate::kernel::{obscurance, pointwise};
use crate::stage::{GradientWeight, WindowChannel, WindowParams};
use crate::{Error, Result};

impl Lowering<'_> {
    /// Window kernels count voxels in 32 bits.
    pub(super) fn check_window(&self, src: WireId, radius: [usize; 3], border: Border, key: &str) -> Result<()> {
        let shape = self.lattice(src).shape;
        // Along an axis of one voxel a mirror adds nothing (`forget_mirrors`).
        let flat = |a: usize| shape[a] == 1 && !matches!(border, Border::Constant(_));
        let cut = |side: f64, a: usize| {
            if border == Border::Clip || flat(a) { side.min(shape[a] as f64) } else { side }
        };
        let voxels: f64 = (0..3).map(|a| cut(2.0 * radius[a] as f64 + 1.0, a)).product();
        if voxels >= (1u64 << 31) as f64 {
            let message = format!("{radius:?} voxels (z, y, x) make a window of {voxels:.0} voxels; at most 2^31 - 1");
            return Err(Error::config(key, message));
        }
        Ok(())
    }

    pub(super) fn window_params(&self, src: WireId, radius: [usize; 3], solid_low: bool) -> WindowParams {
        let wire = &self.out.graph.wires[src];
        WindowParams { radius, affine: wire.affine, missing: wire.missing, solid_low }
    }

    /// A window stage joins the pass of an earlier one with the same input, window, border and mask.
    pub(super) fn window(
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

    pub(super) fn gradient_kind(
        &self,
        src: WireId,
        size: usize,
        weight: GradientWeight,
        channels: Vec<GradientChannel>,
    ) -> StepKind {
        StepKind::Gradient { size, weight, spacing: self.lattice(src).spacing, channels, stored: false }
    }

    pub(super) fn saliency(
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
        // What masked voxels are filled with is no saliency: it must not be the largest.
        self.out.graph.wires[raw].fill = 0.0;
        self.out.graph.steps[step].outputs.push(raw);
        self.out.prepasses.push(Prepass { wires: vec![raw], kind: PrepassKind::Max });
        let by = self.out.prepasses.len() - 1;
        self.push_step(index, node, StepKind::Divide { by }, vec![raw], [0; 3], Border::Clip, &["saliency"])
    }

    pub(super) fn obscurance(
        &mut self,
        index: usize,
        node: &StageNode,
        op: &ObscuranceOp,
        wanted: &[&'static str],
    ) -> Result<()> {
        let (src, ranks) = match self.ranked(&op.input, &node.place)? {
            Some((input, ranks)) => (self.input(input)?, Some(ranks)),
            None => (self.wire(&op.input, &node.place)?, None),
        };
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
        let normal = if op.weight_by_normal {
            let density = self.wire(&op.input, &node.place)?;
            Some(self.normal(index, node, density)?)
        } else {
            None
        };
        let wire = &self.out.graph.wires[src];
        // Opacities are what they are, whichever way the stored values go.
        let falling = ranks.is_none() && wire.affine.slope < 0.0;
        let params = obscurance::ObscuranceParams {
            directions: op.directions,
            set: op.set,
            weights: op.weights,
            rho: op.rho,
            max_distance,
            spacing: self.lattice(src).spacing,
            flipped: op.solid_low != falling,
            missing: wire.missing,
            ambient: op.ambient,
            ranks,
        };
        let sweep = Arc::new(obscurance::Prepared::within(&params, self.lattice(src).shape));
        let reach = sweep.reach();
        let channels = wanted
            .iter()
            .map(|c| if *c == "openness" { ObscuranceChannel::Openness } else { ObscuranceChannel::Rgb })
            .collect();
        let inputs = [Some(src), colour, normal].into_iter().flatten().collect();
        let kind = StepKind::Obscurance { sweep, channels, colour, normal };
        self.push_step(index, node, kind, inputs, reach, Border::Clip, wanted)
    }

    /// A sweep of the opacity that a `transfer` makes of an 8- or 16-bit input reads that input, and compares voxels by the
    /// ranks of their opacities: the input and the ranks. `None` for other densities, and for a table under a mask, whose
    /// opacity is not a function of the voxel.
    pub(super) fn ranked(&self, density: &Ref, place: &Place) -> Result<Option<(usize, obscurance::Ranks)>> {
        let Target::Stage(stage, "opacity") = self.target(density, place)? else { return Ok(None) };
        let node = &self.config.stages[stage];
        let (Op::Transfer { input, points }, None) = (&node.op, &node.where_) else { return Ok(None) };
        let Target::Input(input) = self.target(input, &node.place)? else { return Ok(None) };
        let info = &self.infos[input];
        if info.dtype.is_float() || info.dtype.size() > 2 || info.components > 1 {
            return Ok(None);
        }
        let n = 1 << (8 * info.dtype.size());
        let shape = [1, 1, n];
        let all: Vec<f64> = (0..n).map(|i| info.dtype.range().0 + i as f64).collect();
        let mut stored = Voxels::zeroed(info.dtype, n);
        store_any(&mut stored.view_mut(shape), [0; 3], &all);
        let mut opacity = vec![0.0; n];
        let out = AnyViewMut::F32(ViewMut::dense(&mut opacity, shape));
        pointwise::transfer((stored.view(shape), info.affine, None), points, Some(out), None);
        Ok(obscurance::Ranks::new(&opacity).map(|ranks| (input, ranks)))
    }

    /// The 3^3 gradient (weight inverse) of the density, for `weight_by_normal`.
    pub(super) fn normal(&mut self, index: usize, node: &StageNode, src: WireId) -> Result<WireId> {
        let spacing = self.lattice(src).spacing;
        let channels = vec![GradientChannel::Vector];
        let kind = StepKind::Gradient { size: 3, weight: GradientWeight::Inverse, spacing, channels, stored: true };
        let step = self.new_step(node, kind, vec![src], [1; 3], Border::Nearest)?;
        let wire = self.output_wire(index, node, "vector", step, &[src]);
        self.out.graph.wires[wire].name = format!("{} (normal)", node.name);
        self.out.graph.steps[step].outputs.push(wire);
        Ok(wire)
    }
}

/// The window channel of a box statistic.
pub(super) fn box_channel(name: &str) -> WindowChannel {
    match name {
        "mean" | UNROUNDED_MEAN => WindowChannel::Mean,
        "min" => WindowChannel::Min,
        "max" => WindowChannel::Max,
        "variance" => WindowChannel::Variance,
        "std" => WindowChannel::Std,
        _ => WindowChannel::Moment2,
    }
}
