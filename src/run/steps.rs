//! Runs one step of the graph on one brick: cuts what the kernel may see, applies the border rule and the mask.

use std::sync::Arc;

use super::lanes::gradient_out;
use super::masked::views_of;
use super::metrics::Metrics;
use super::repair;
use super::value::{Comp, Value};
use super::windowed::Windowed;
use crate::Result;
use crate::brick::{Pool, Scratch, Voxels};
use crate::config::WhereRule;
use crate::gpu::Gpu;
use crate::gpu::slopes::Fit;
use crate::grid::{Affine, AnyViewMut, Border, DType, Region, ViewMut, Voxel};
use crate::kernel::moments4::{BoundOut, Codes};
use crate::kernel::simd::Level;
use crate::kernel::window::{Place, WindowOut};
use crate::kernel::{Context, gaussian, gradient, levels, mask, moments4, pointwise, rank, window};
use crate::plan::Plan;
use crate::plan::graph::{Mask, Moment, Step, StepId, StepKind, TransferChannel, Wire, WireId};
use crate::stage::WindowParams;

/// What all bricks of a run share.
pub struct Engine<'a> {
    pub plan: &'a Plan,
    pub level: Level,
    /// Results of the pre-passes so far.
    pub globals: Vec<Vec<f64>>,
    /// Constants are propagated instead of computed.
    pub skip: bool,
    pub pool: &'a Pool,
    /// Runs the steps that the plan placed on it.
    pub gpu: Option<&'a Gpu>,
    pub(super) metrics: &'a Metrics,
}

/// Reads a box of an input's wire while a step runs.
pub type Fetch<'a> = dyn Fn(WireId, Region, AnyViewMut) -> Result<()> + 'a;

/// A mask over a step's output box: 1 = needed.
#[derive(Debug, Clone)]
pub enum MaskValue {
    All,
    None,
    /// Shared by the steps that have the same.
    Some(Arc<Vec<u8>>),
}

/// A step and the box of its output that is to be made.
#[derive(Clone, Copy)]
pub struct Piece<'p> {
    pub id: StepId,
    pub step: &'p Step,
    pub mask: &'p MaskValue,
    pub region: Region,
    /// All of the lattice: windows end there, or are continued by the border rule.
    pub volume: Region,
}

impl<'a> Engine<'a> {
    pub fn new(plan: &'a Plan, pool: &'a Pool, gpu: Option<&'a Gpu>, metrics: &'a Metrics, skip: bool) -> Engine<'a> {
        Engine { plan, level: Level::detect(), globals: Vec::new(), skip, pool, gpu, metrics }
    }

    /// The mask of a step over `region`, from its wire's value.
    pub fn mask(
        &self,
        mask: &Mask,
        value: &mut Value,
        region: Region,
        volume: Region,
        scratch: &mut Scratch,
    ) -> MaskValue {
        if self.skip
            && let Some(&[constant]) = value.constants().as_deref()
        {
            return self.mask_of_constant(mask, constant);
        }
        value.materialize(self.pool);
        let wire = &self.plan.graph.wires[mask.wire];
        let mut needed = vec![0u8; region.voxels()];
        let dst = ViewMut::dense(&mut needed, region.shape());
        match &mask.rule {
            WhereRule::Range { min, max } => {
                mask::range(value.view(0, region), wire.affine, wire.missing, *min, *max, dst);
            }
            WhereRule::Iso { iso, band } => {
                let src_box = region.grow(mask.reach).clip(&volume);
                let spacing = self.plan.graph.lattices[wire.lattice].spacing;
                let band = mask::Band { iso, width: *band, spacing };
                let cx = &mut Context { level: self.level, scratch };
                mask::iso_band(value.view(0, src_box), src_box, wire.affine, wire.missing, &band, dst, region, cx);
            }
        }
        let count = needed.iter().map(|&n| n as usize).sum::<usize>();
        match count {
            0 if self.skip => MaskValue::None,
            n if n == needed.len() => MaskValue::All,
            _ => MaskValue::Some(Arc::new(needed)),
        }
    }

    /// The mask over a box of one value: all of it or nothing, and no surface.
    fn mask_of_constant(&self, mask: &Mask, value: f64) -> MaskValue {
        let WhereRule::Range { min, max } = mask.rule else { return MaskValue::None };
        let wire = &self.plan.graph.wires[mask.wire];
        let (voxel, mut needed) = (Voxels::one(wire.dtype, value), [0]);
        mask::range(voxel.view([1; 3]), wire.affine, wire.missing, min, max, ViewMut::dense(&mut needed, [1; 3]));
        if needed == [1] { MaskValue::All } else { MaskValue::None }
    }

    /// Outputs of a step that no voxel needs.
    pub fn filled(&self, step: &Step, region: Region) -> Vec<Value> {
        let wires = step.outputs.iter().map(|&w| &self.plan.graph.wires[w]);
        wires.map(|w| Value::constant(w.dtype, region, w.components, w.fill)).collect()
    }

    /// Computes a piece; `values` holds the step's inputs, each covering what it needs but for what `fetch` reads.
    ///
    /// # Errors
    /// A GPU that failed twice, or an input that could not be read.
    pub fn run(
        &self,
        piece: Piece,
        values: &mut [Option<Value>],
        fetch: &Fetch,
        scratch: &mut Scratch,
    ) -> Result<Vec<Value>> {
        let Piece { step, mask, region, .. } = piece;
        if let MaskValue::None = mask {
            return Ok(self.filled(step, region));
        }
        if self.skip
            && matches!(mask, MaskValue::All)
            && step.streamed.is_none()
            && let Some(values) = self.constant(piece, &inputs_of(step, values), scratch)?
        {
            return Ok(values);
        }
        for &w in &step.inputs {
            if let Some(value) = &mut values[w] {
                value.materialize(self.pool);
            }
        }
        let mut outputs = if step.streamed.is_some() {
            self.sweep_streamed(piece, &inputs_of(step, values), fetch, scratch)?
        } else {
            self.compute(piece, step.border, &inputs_of(step, values), scratch)?
        };
        if let MaskValue::Some(needed) = mask {
            for (value, &w) in outputs.iter_mut().zip(&step.outputs) {
                let fill = self.plan.graph.wires[w].fill;
                value.comps.iter_mut().for_each(|c| fill_where(c, needed, fill));
            }
        }
        Ok(outputs)
    }

    /// A step of constants is the same step on one voxel: the kernel itself says what comes out.
    fn constant(&self, piece: Piece, inputs: &[&Value], scratch: &mut Scratch) -> Result<Option<Vec<Value>>> {
        let Piece { step, region, volume, .. } = piece;
        let Some(constants) = inputs.iter().map(|v| v.constants()).collect::<Option<Vec<_>>>() else { return Ok(None) };
        if matches!(step.border, Border::Constant(_)) && !volume.contains(&region.grow(step.reach)) {
            return Ok(None);
        }
        let one = Region::whole([1, 1, 1]);
        let small: Vec<Value> = inputs
            .iter()
            .zip(constants)
            .map(|(v, constants)| {
                let comps = constants.into_iter().map(|c| Comp::Voxels(Voxels::one(v.dtype, c)));
                Value { dtype: v.dtype, region: one, comps: comps.collect() }
            })
            .collect();
        // Its windows end inside the volume: around the one voxel lies its own value, not the border's.
        let border = if matches!(step.border, Border::Constant(_)) { Border::Nearest } else { step.border };
        let small: Vec<&Value> = small.iter().collect();
        let voxel = Piece { mask: &MaskValue::All, region: one, volume: one, ..piece };
        let outputs = self.compute(voxel, border, &small, scratch)?;
        let spread = |value: Value| {
            let comps = value.comps.iter().map(|c| match c {
                Comp::Const(v) => Comp::Const(*v),
                Comp::Voxels(v) => Comp::Const(v.at(0)),
            });
            Value { dtype: value.dtype, region, comps: comps.collect() }
        };
        Ok(Some(outputs.into_iter().map(spread).collect()))
    }

    /// `border` is the step's, or what stands for it around a constant.
    fn compute(&self, piece: Piece, border: Border, inputs: &[&Value], scratch: &mut Scratch) -> Result<Vec<Value>> {
        let Piece { id, step, region, .. } = piece;
        let wires: Vec<&Wire> = step.outputs.iter().map(|&w| &self.plan.graph.wires[w]).collect();
        let mut outputs: Vec<Value> = wires.iter().map(|w| self.buffers(w.dtype, region, w.components)).collect();
        let mut cx = Context { level: self.level, scratch };
        let input_wire = &self.plan.graph.wires[step.inputs[0]];
        match &step.kind {
            StepKind::Obscurance { .. } => self.sweep(piece, inputs, &mut outputs, &mut cx)?,
            StepKind::Gradient { size, weight, spacing, channels, stored } => {
                let whole = self.windowed(piece, border, inputs[0], 0);
                let affine = if *stored { Affine::IDENTITY } else { whole.affine };
                let fit = Fit { size: *size, weight: *weight, spacing: *spacing, missing: whole.missing };
                for part in self.parts(piece, &whole) {
                    let src = whole.part(&part, step.reach);
                    let out = gradient_out(channels, &mut outputs, &part);
                    match self.lane(id, region) {
                        Some(gpu) => {
                            let done = gpu.gradient(src.view(), &fit, affine, src.at, out, &mut cx);
                            done.map_err(|e| self.gpu_failed(id, &e))?;
                        }
                        None => {
                            let Fit { missing, .. } = fit;
                            gradient::gradient(
                                src.view(),
                                *size,
                                *weight,
                                *spacing,
                                affine,
                                missing,
                                src.at,
                                out,
                                &mut cx,
                            );
                        }
                    }
                }
                whole.recycle(self.pool);
            }
            StepKind::Window { .. }
            | StepKind::Rank { .. }
            | StepKind::Levels { .. }
            | StepKind::Moments4 { .. }
            | StepKind::Gaussian { .. } => {
                for c in 0..input_wire.components {
                    let src = self.windowed(piece, border, inputs[0], c);
                    for part in self.parts(piece, &src) {
                        let outs = views_of(&mut outputs, c, &part);
                        self.windows(id, &src.part(&part, step.reach), outs, region, &mut cx)?;
                    }
                    repair::missing(&wires, inputs[0], c, input_wire, &mut outputs, region);
                    repair::undefined(&wires, inputs[0], c, input_wire, &mut outputs, region);
                    src.recycle(self.pool);
                }
            }
            _ => self.pointwise(step, inputs, &mut outputs, region),
        }
        Ok(outputs)
    }

    /// A kernel of windows on one component of a part of `region`; `outs` go with the step's outputs.
    fn windows(
        &self,
        id: StepId,
        src: &Windowed,
        mut outs: Vec<AnyViewMut>,
        region: Region,
        cx: &mut Context,
    ) -> Result<()> {
        let step = &self.plan.graph.steps[id];
        match &step.kind {
            StepKind::Window { params, channels } => {
                let params = WindowParams { missing: src.missing, ..*params };
                let mut outs: Vec<WindowOut> =
                    channels.iter().zip(outs).map(|(&channel, dst)| WindowOut { channel, dst }).collect();
                match self.lane(id, region) {
                    Some(gpu) => {
                        let done = gpu.window(src.view(), &params, src.at, src.voxel, &mut outs, cx);
                        done.map_err(|e| self.gpu_failed(id, &e))?;
                    }
                    None => window::window(src.view(), &params, Place::new(src.at, src.voxel), &mut outs, cx),
                }
            }
            StepKind::Rank { params, shape, ties } => {
                let params = WindowParams { missing: src.missing, ..*params };
                rank::rank(src.view(), &params, *shape, *ties, src.at, outs.swap_remove(0), cx);
            }
            StepKind::Levels { params, levels, ties } => {
                let params = WindowParams { missing: src.missing, ..*params };
                let found = levels::Levels::from_numbers(&self.globals[*levels]);
                levels::levels(src.view(), &found, &params, *ties, src.at, outs.swap_remove(0), cx);
            }
            StepKind::Moments4 { params, codes, ties, channels } => {
                let params = WindowParams { missing: src.missing, ..*params };
                let codes = codes.map(|g| Codes::new(&levels::Levels::from_numbers(&self.globals[g])));
                let mut outs: Vec<BoundOut> =
                    channels.iter().zip(outs).map(|(&channel, dst)| BoundOut { channel, dst }).collect();
                moments4::moments4(src.view(), codes.as_ref(), &params, *ties, src.at, &mut outs, cx);
            }
            StepKind::Gaussian { sigma, channels } => {
                let (mut mean, mut unrounded, mut variance) = (None, None, None);
                for (channel, out) in channels.iter().zip(outs) {
                    match (channel, out.dtype()) {
                        (Moment::Mean, dtype) if dtype != src.view().dtype().result() || mean.is_some() => {
                            unrounded = Some(out)
                        }
                        (Moment::Mean, _) => mean = Some(out),
                        (Moment::Variance, _) => variance = Some(out),
                    }
                }
                let Windowed { affine, missing, at, .. } = *src;
                if let (Some(_), Some(_)) = (&mean, &unrounded) {
                    gaussian::gaussian(src.view(), *sigma, affine, missing, at, mean.take(), None, cx);
                }
                let mean = mean.or(unrounded);
                match self.lane(id, region) {
                    Some(gpu) => {
                        let done = gpu.gaussian(src.view(), *sigma, affine, at, mean, variance, cx);
                        done.map_err(|e| self.gpu_failed(id, &e))?;
                    }
                    None => gaussian::gaussian(src.view(), *sigma, affine, missing, at, mean, variance, cx),
                }
            }
            _ => unreachable!("only window kernels come here"),
        }
        Ok(())
    }

    /// Uninitialised voxels for a value.
    pub(super) fn buffers(&self, dtype: DType, region: Region, comps: usize) -> Value {
        let buffer = || Comp::Voxels(self.pool.take(dtype, region.voxels()));
        Value { dtype, region, comps: (0..comps).map(|_| buffer()).collect() }
    }

    fn pointwise(&self, step: &Step, inputs: &[&Value], outputs: &mut [Value], region: Region) {
        // A component of an input: the same one, or the only one.
        let part = |i: usize, c: usize| -> pointwise::Operand {
            let wire = &self.plan.graph.wires[step.inputs[i]];
            (inputs[i].view(c.min(inputs[i].comps.len() - 1), region), wire.affine, wire.missing)
        };
        match &step.kind {
            StepKind::Transfer { points, channels } => {
                let (mut opacity, mut rgb) = (None, None);
                for (channel, value) in channels.iter().zip(outputs.iter_mut()) {
                    let mut views = views_mut(value);
                    match channel {
                        TransferChannel::Opacity => opacity = Some(views.swap_remove(0)),
                        TransferChannel::Rgb => rgb = Some(three(views)),
                    }
                }
                pointwise::transfer(part(0, 0), points, opacity, rgb);
            }
            kind => {
                for c in 0..outputs[0].comps.len() {
                    let dst = view_mut(&mut outputs[0], c);
                    match kind {
                        StepKind::OpennessWindow { low, high, mode } => {
                            pointwise::openness_window(part(0, c), *low, *high, *mode, dst);
                        }
                        StepKind::ModulateByVariance { sigma_max2 } => {
                            pointwise::modulate_by_variance(part(0, c), part(1, c), *sigma_max2, dst);
                        }
                        StepKind::ModulateBySaliency { threshold, gain } => {
                            pointwise::modulate_by_saliency(part(0, c), part(1, c), *threshold, *gain, dst);
                        }
                        StepKind::AmbientLight { k } => pointwise::ambient_light(part(0, c), part(1, c), *k, dst),
                        StepKind::Combine { kind } => {
                            let parts: Vec<_> = (0..inputs.len()).map(|i| part(i, c)).collect();
                            pointwise::combine(&parts, *kind, dst);
                        }
                        StepKind::Divide { by } => {
                            let max = Plan::global(&self.globals, *by)[1];
                            let slope = if max > 0.0 && max.is_finite() { 1.0 / max } else { 1.0 };
                            let (view, ..) = part(0, c);
                            pointwise::scale(view, Affine { slope, intercept: 0.0 }, None, dst);
                        }
                        _ => unreachable!("window kernels do not come here"),
                    }
                }
            }
        }
    }
}

/// A step's inputs, in its order. Panics if one has not been read or made.
fn inputs_of<'v>(step: &Step, values: &'v [Option<Value>]) -> Vec<&'v Value> {
    step.inputs.iter().map(|&w| values[w].as_ref().expect("inputs are made before their readers")).collect()
}

fn fill_where(comp: &mut Comp, needed: &[u8], fill: f64) {
    fn set<T: Voxel>(v: &mut [T], needed: &[u8], fill: f64) {
        let fill = T::from_f64(fill);
        for (v, n) in v.iter_mut().zip(needed) {
            if *n == 0 {
                *v = fill;
            }
        }
    }
    if let Comp::Voxels(voxels) = comp {
        crate::with_voxels!(voxels, v => set(v, needed, fill));
    }
}

pub(super) fn view_mut(value: &mut Value, comp: usize) -> AnyViewMut<'_> {
    let shape = value.region.shape();
    match &mut value.comps[comp] {
        Comp::Voxels(v) => v.view_mut(shape),
        Comp::Const(_) => unreachable!("outputs are allocated as voxels"),
    }
}

pub(super) fn views_mut(value: &mut Value) -> Vec<AnyViewMut<'_>> {
    let shape = value.region.shape();
    value
        .comps
        .iter_mut()
        .map(|c| match c {
            Comp::Voxels(v) => v.view_mut(shape),
            Comp::Const(_) => unreachable!("outputs are allocated as voxels"),
        })
        .collect()
}

pub(super) fn three(views: Vec<AnyViewMut<'_>>) -> [AnyViewMut<'_>; 3] {
    match <[AnyViewMut<'_>; 3]>::try_from(views) {
        Ok(three) => three,
        Err(views) => panic!("{} components where 3 belong", views.len()),
    }
}
