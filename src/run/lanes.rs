//! Which device runs a step on a box, and the sweep, whose operands are narrowed first, on either.

use super::steps::{Engine, Fetch, MaskValue, Piece, three, view_mut, views_mut};
use super::value::{Value, common_value};
use crate::brick::Scratch;
use crate::gpu::{Gpu, GpuError};
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Region, View, Voxel};
use crate::kernel::gradient::GradientOut;
use crate::kernel::mask::Part;
use crate::kernel::obscurance::ObscuranceIo;
use crate::kernel::{Context, pointwise};
use crate::plan::graph::{GradientChannel, ObscuranceChannel, Producer, Step, StepId, StepKind};
use crate::{Error, Result};

impl<'a> Engine<'a> {
    /// A sweep over its whole source.
    pub(super) fn sweep(&self, piece: Piece, inputs: &[&Value], outputs: &mut [Value], cx: &mut Context) -> Result<()> {
        let Piece { id, step, mask, region, volume } = piece;
        let StepKind::Obscurance { sweep, channels, colour, normal } = &step.kind else {
            unreachable!("only sweeps come here")
        };
        let (has_colour, has_normal) = (colour.is_some(), normal.is_some());
        let src_box = region.grow(sweep.reach()).clip(&volume);
        // Colours and normals of f64 data are narrowed: colours are weighted by f32 tables, of normals only the direction counts.
        let colour = has_colour.then(|| interleave([0, 1, 2].map(|c| inputs[1].view(c, src_box))));
        let colour = colour.as_ref().map(|c| View::dense(&c[..], src_box.shape()));
        let normal = has_normal.then(|| three_of(inputs[1 + usize::from(has_colour)], region));
        let normal = normal.as_ref().map(|n| std::array::from_fn(|c| View::dense(&n[c], region.shape())));
        // Sweeps sum in fixed point and round to f32; results of f64 data are widened.
        let wide = outputs[0].dtype == DType::F64;
        let mut narrow_outputs: Vec<Value> = Vec::new();
        if wide {
            narrow_outputs = outputs.iter().map(|v| self.buffers(DType::F32, region, v.comps.len())).collect();
        }
        let targets = if wide { &mut narrow_outputs[..] } else { &mut *outputs };
        let mut io = ObscuranceIo { colour, normal, needed: self.needed(mask, region), openness: None, rgb: None };
        for (channel, value) in channels.iter().zip(targets) {
            let mut views = views_mut(value);
            match channel {
                ObscuranceChannel::Openness => io.openness = views.pop(),
                ObscuranceChannel::Rgb => io.rgb = Some(three(views)),
            }
        }
        let src = inputs[0].view(0, src_box);
        match (self.lane(id, region), &mut io.openness) {
            (Some(gpu), Some(AnyViewMut::F32(openness))) => {
                let done = gpu.obscurance(sweep, src, src_box, region, openness, cx);
                done.map_err(|e| self.gpu_failed(id, &e))?;
            }
            _ => self.metrics.lines(id, sweep.sweep(src, src_box, region, io, cx)),
        }
        for (from, to) in narrow_outputs.into_iter().zip(outputs) {
            for c in 0..from.comps.len() {
                pointwise::scale(from.view(c, region), Affine::IDENTITY, None, view_mut(to, c));
            }
            from.recycle(self.pool);
        }
        Ok(())
    }

    /// The voxels that a mask leaves, for kernels that skip the others.
    fn needed<'m>(&self, mask: &'m MaskValue, region: Region) -> Option<View<'m, u8>> {
        match mask {
            MaskValue::Some(needed) if self.skip => Some(View::dense(needed, region.shape())),
            _ => None,
        }
    }

    /// A sweep that reads the columns of its lines while it runs. A brick in which nothing can be occluded is a constant.
    pub(super) fn sweep_streamed(
        &self,
        piece: Piece,
        inputs: &[&Value],
        fetch: &Fetch,
        scratch: &mut Scratch,
    ) -> Result<Vec<Value>> {
        let Piece { id, step, mask, region, volume } = piece;
        let StepKind::Obscurance { sweep, .. } = &step.kind else { unreachable!("only sweeps are streamed") };
        let wire = &self.plan.graph.wires[step.outputs[0]];
        let mut openness = self.buffers(DType::F32, region, 1);
        let mut read = |part: Region, dst: AnyViewMut| self.fetched(step, part, dst, fetch);
        let src = inputs[0].view(0, region);
        let mut cx = Context { level: self.level, scratch };
        let normal = inputs.get(1).map(|value| three_of(value, region));
        let io = ObscuranceIo {
            colour: None,
            normal: normal.as_ref().map(|n| std::array::from_fn(|c| View::dense(&n[c], region.shape()))),
            needed: self.needed(mask, region),
            openness: Some(view_mut(&mut openness, 0)),
            rgb: None,
        };
        let done = sweep.sweep_streamed(src, region, volume, io, &mut read, &mut cx)?;
        self.metrics.lines(id, done.lines);
        if done.flat
            && self.skip
            && matches!(mask, MaskValue::All)
            && let Some(value) = common_value(openness.view(0, region))
        {
            openness.recycle(self.pool);
            return Ok(vec![Value::constant(wire.dtype, region, 1, value)]);
        }
        if wire.dtype == DType::F32 {
            return Ok(vec![openness]);
        }
        let mut wide = self.buffers(wire.dtype, region, 1);
        pointwise::scale(openness.view(0, region), Affine::IDENTITY, None, view_mut(&mut wide, 0));
        openness.recycle(self.pool);
        Ok(vec![wide])
    }

    /// A box of a streamed step's first input: read, or read and put through the transfer that makes it.
    fn fetched(&self, step: &Step, part: Region, dst: AnyViewMut, fetch: &Fetch) -> Result<()> {
        let graph = &self.plan.graph;
        let Some(input) = step.streamed.filter(|w| *w != step.inputs[0]) else {
            return fetch(step.inputs[0], part, dst);
        };
        let Producer::Step(made) = graph.wires[step.inputs[0]].producer else { unreachable!("inputs are read") };
        let StepKind::Transfer { points, .. } = &graph.steps[made].kind else { unreachable!("streams of transfers") };
        let wire = &graph.wires[input];
        let mut stored = self.pool.take(wire.dtype, part.voxels());
        let read = fetch(input, part, stored.view_mut(part.shape()));
        if read.is_ok() {
            pointwise::transfer((stored.view(part.shape()), wire.affine, wire.missing), points, Some(dst), None);
        }
        self.pool.put(stored);
        read
    }

    /// The GPU, where it is to run a step on this box: not a single voxel, which stands for a constant brick, and not while
    /// all slots are taken if the step's bricks may go to either lane. The bits are the same.
    pub(super) fn lane(&self, id: StepId, region: Region) -> Option<&'a Gpu> {
        let gpu = self.gpu.filter(|_| self.plan.on_gpu(id) && region.shape() != [1, 1, 1])?;
        if self.plan.shares(id) && gpu.is_busy() {
            self.metrics.shared(id);
            return None;
        }
        Some(gpu)
    }

    pub(super) fn gpu_failed(&self, id: StepId, error: &GpuError) -> Error {
        let step = &self.plan.graph.steps[id];
        Error::Failed(format!("{} on the GPU: {error}; --resume continues", step.stages.join("+")))
    }
}

/// Where the channels of a gradient of a part go.
pub(super) fn gradient_out<'v>(channels: &[GradientChannel], outputs: &'v mut [Value], part: &Part) -> GradientOut<'v> {
    let mut out = GradientOut::default();
    for (channel, value) in channels.iter().zip(outputs) {
        let mut views: Vec<AnyViewMut> = views_mut(value).into_iter().map(|v| v.part(part.lo, part.shape)).collect();
        match channel {
            GradientChannel::Magnitude => out.magnitude = views.pop(),
            GradientChannel::Vector => out.vector = Some(three(views)),
        }
    }
    out
}

/// Three components side by side.
fn interleave(views: [AnyView; 3]) -> Vec<[f32; 4]> {
    fn run<T: Voxel>(v: View<T>, c: usize, out: &mut [[f32; 4]]) {
        let rows = (0..v.shape[0]).flat_map(|z| (0..v.shape[1]).map(move |y| v.row_at(z, y)));
        out.iter_mut().zip(rows.flatten()).for_each(|(out, x)| out[c] = x.to_f64() as f32);
    }
    let mut out = vec![[0.0; 4]; views[0].shape().iter().product()];
    for (c, view) in views.into_iter().enumerate() {
        crate::with_view!(AnyView, view, v => run(v, c, &mut out));
    }
    out
}

/// The three components of a value, narrowed.
fn three_of(value: &Value, region: Region) -> [Vec<f32>; 3] {
    std::array::from_fn(|c| narrow(value.view(c, region)))
}

fn narrow(view: AnyView) -> Vec<f32> {
    fn run<T: Voxel>(v: View<T>) -> Vec<f32> {
        let mut out = Vec::with_capacity(v.shape.iter().product());
        for z in 0..v.shape[0] {
            for y in 0..v.shape[1] {
                out.extend(v.row_at(z, y).iter().map(|x| x.to_f64() as f32));
            }
        }
        out
    }
    crate::with_view!(AnyView, view, v => run(v))
}
