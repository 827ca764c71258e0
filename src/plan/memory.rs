//! Bytes by formula: what one brick of a given shape keeps alive at its worst moment, and what the run keeps besides.

use std::ops::Range;

use super::graph::{GradientChannel, Mask, Moment, Producer, Step, StepId, StepKind, WireId};
use super::tasks::Group;
use super::{OutputPlan, Plan, flows};
use crate::config::WhereRule;
use crate::gpu::flow::Flow;
use crate::gpu::{passes, record, slopes, sweep, taps};
use crate::grid::{Border, DType, Region, Shape};
use crate::kernel::{gaussian, gradient, levels, mask, moments4, rank, reduce, window};

/// What the program itself, thread stacks and the allocator's slack take of the ceiling.
pub const FIXED: u64 = 16 << 20;
/// Codec contexts and the chunk being encoded or decoded, per thread.
pub const PER_THREAD: u64 = 4 << 20;

/// The box of a wire that a brick needs: grown by the halo, clipped to the volume.
pub fn wire_box(brick: Region, halo: [usize; 3], volume: Shape) -> Region {
    brick.grow(halo).clip(&Region::whole(volume))
}

/// Bytes that one brick of `shape` voxels keeps alive at most, from its first read to its last write, apart from the
/// scratch of the worker that computes it.
pub fn brick_bytes(plan: &Plan, group: &Group, shape: Shape) -> u64 {
    let size = |halo: [usize; 3]| grown(shape, halo, group.shape);
    let voxels = |s: Shape| s.iter().map(|&n| n as u64).product::<u64>();
    let wire_bytes = |w: WireId, halo: [usize; 3]| {
        let wire = &plan.graph.wires[w];
        voxels(size(halo)) * (wire.components * wire.dtype.size()) as u64
    };
    let mut live: Vec<(WireId, u64)> =
        group.inputs.iter().map(|&w| (w, wire_bytes(w, plan.graph.wires[w].halo))).collect();
    let mut peak = sum(&live);
    for (at, &s) in group.steps.iter().enumerate() {
        let of = |s: StepId| {
            let step = &plan.graph.steps[s];
            step.outputs.iter().map(|&w| (w, wire_bytes(w, step.halo))).collect::<Vec<(WireId, u64)>>()
        };
        let outputs = of(s);
        peak = peak.max(sum(&live) + sum(&outputs));
        if let Some(flow) = plan.flows.iter().find(|f| f.first(&group.steps) == Some(s)) {
            // All that comes back is made at once, unless the steps must run one by one.
            let back = flow.steps.iter().flat_map(|&t| of(t));
            let back = back.filter(|(w, _)| flows::voxels_come_back(plan, flow, group, *w));
            peak = peak.max(sum(&live) + back.map(|b| b.1).sum::<u64>() + level_bytes(plan, group, flow, shape));
        }
        live.extend(outputs);
        let last_use = |w: WireId| {
            group.sinks.contains(&w) || group.steps[at + 1..].iter().any(|&t| reads(&plan.graph.steps[t], w))
        };
        live.retain(|(w, _)| last_use(*w));
    }
    let masks = mask_bytes(plan, group, shape);
    let sinks: u64 = group.outputs.iter().map(|&o| output_bytes(plan, group, &plan.outputs[o], shape)).sum();
    masks + peak.max(sum(&live) + sinks)
}

/// Masks that a brick keeps until it is written: steps that have the same share it.
fn mask_bytes(plan: &Plan, group: &Group, shape: Shape) -> u64 {
    let mut distinct: Vec<(&Mask, [usize; 3])> = Vec::new();
    for step in group.steps.iter().map(|&s| &plan.graph.steps[s]) {
        if let Some(mask) = &step.mask
            && !distinct.contains(&(mask, step.halo))
        {
            distinct.push((mask, step.halo));
        }
    }
    distinct.iter().map(|(_, halo)| grown(shape, *halo, group.shape).iter().map(|&n| n as u64).product::<u64>()).sum()
}

/// Bytes that a worker needs besides to compute bricks of `shape`: bricks that wait to be computed or written take none.
pub fn scratch_bytes(plan: &Plan, group: &Group, shape: Shape) -> u64 {
    let steps = group.steps.iter().map(|&s| {
        let step = &plan.graph.steps[s];
        step_scratch(plan, step, shape, group.shape)
            + if plan.on_gpu(s) { redone(plan, step, shape, group.shape) } else { 0 }
    });
    // Readers look at masks of inputs while workers compute.
    let looks = group.steps.iter().map(|&s| mask_scratch(plan, &plan.graph.steps[s], shape, group.shape));
    steps.max().unwrap_or(0) + looks.max().unwrap_or(0)
}

/// Scratch of the mask of a step.
fn mask_scratch(plan: &Plan, step: &Step, brick: Shape, volume: Shape) -> u64 {
    let Some(Mask { wire, rule: WhereRule::Iso { iso, band }, reach }) = &step.mask else { return 0 };
    let spacing = plan.graph.lattices[plan.graph.wires[*wire].lattice].spacing;
    let dst = grown(brick, step.halo, volume);
    mask::scratch_bytes(grown(dst, *reach, volume), dst, &mask::Band { iso, width: *band, spacing }) as u64
}

fn sum(list: &[(WireId, u64)]) -> u64 {
    list.iter().map(|e| e.1).sum()
}

fn reads(step: &Step, wire: WireId) -> bool {
    step.inputs.contains(&wire) || step.mask.as_ref().is_some_and(|m| m.wire == wire)
}

/// A brick grown by a halo, at most the volume.
fn grown(shape: Shape, halo: [usize; 3], volume: Shape) -> Shape {
    std::array::from_fn(|a| (shape[a] + 2 * halo[a]).min(volume[a]))
}

/// Voxels of a brick with its border copy at most, or so: a million million.
const MOST_PADDED: f64 = 1e12;

/// Kernel scratch, border copies and masks of one step.
fn step_scratch(plan: &Plan, step: &Step, brick: Shape, volume: Shape) -> u64 {
    let dst = grown(brick, step.halo, volume);
    let wire = &plan.graph.wires[step.inputs[0]];
    let padded: Shape = std::array::from_fn(|a| dst[a] + 2 * step.reach[a]);
    let (src, copy) = match step.border {
        Border::Clip => (std::array::from_fn(|a| padded[a].min(volume[a])), 0),
        _ => {
            let copy = padded.iter().fold(window_dtype(wire.dtype, step.border).size(), |n, &p| n.saturating_mul(p));
            (padded, copy)
        }
    };
    // Beyond any memory, and too much for the products below.
    if padded.iter().map(|&n| n as f64).product::<f64>() > MOST_PADDED && step.border != Border::Clip {
        return 1 << 52;
    }
    let dtype = window_dtype(wire.dtype, step.border);
    let kernel = match &step.kind {
        StepKind::Window { params, channels } => window::scratch_bytes(dtype, src, dst, params, channels),
        StepKind::Rank { params, shape, .. } => rank::scratch_bytes(dtype, src, dst, params, *shape),
        StepKind::Levels { params, .. } => levels::scratch_bytes(dtype, src, dst, params),
        StepKind::Moments4 { params, .. } => moments4::scratch_bytes(dtype, src, dst, params),
        StepKind::Gaussian { sigma, channels } => gaussian::scratch_bytes(dtype, src, dst, *sigma, channels.len() > 1),
        StepKind::Gradient { size, .. } => gradient::scratch_bytes(dtype, src, dst, *size),
        StepKind::Obscurance { sweep, colour, normal, .. } => {
            let wide = dtype.result() == DType::F64;
            if let Some(read) = step.streamed {
                let kernel = sweep.streamed_bytes(dtype, volume, dst, normal.is_some());
                let made = if read == step.inputs[0] { 0 } else { plan.graph.wires[read].dtype.size() };
                let kernel = kernel + made * sweep.slab_voxels(volume, dst, normal.is_some());
                return (kernel + narrowed(dst, normal.is_some()) + narrowed(dst, wide) + masked(step, dst)) as u64;
            }
            sweep.scratch_bytes(dtype, src, dst, colour.is_some(), normal.is_some())
                + narrowed(src, colour.is_some()) / 3 * 4
                + narrowed(dst, normal.is_some())
                + narrowed(dst, wide)
        }
        _ => 0,
    };
    (kernel + copy + masked(step, dst)) as u64
}

/// The part of a mask that levels see, and what a kernel that skips keeps of it.
fn masked(step: &Step, dst: Shape) -> usize {
    let kernel = match &step.kind {
        StepKind::Obscurance { sweep, .. } => sweep.masked_bytes(dst),
        _ => 0,
    };
    if step.mask.is_some() { dst.iter().product::<usize>() + kernel } else { 0 }
}

/// Windows of f32 that the GPU leaves to the CPU are made in a box of their own, and rows are finished there.
fn redone(plan: &Plan, step: &Step, brick: Shape, volume: Shape) -> u64 {
    match &step.kind {
        StepKind::Window { channels, .. } if plan.graph.wires[step.inputs[0]].dtype.is_float() => {
            let dst = grown(brick, step.halo, volume);
            let rows = window::finish_floats::scratch_bytes(dst[2]);
            (dst.iter().product::<usize>() * channels.len() * DType::F32.size() + rows) as u64
        }
        _ => 0,
    }
}

/// f32 copies of three components that a sweep reads or writes.
fn narrowed(shape: Shape, used: bool) -> usize {
    if used { shape.iter().product::<usize>() * 12 } else { 0 }
}

/// Staging of a slot of the GPU lane for bricks of this shape, and its device buffers where they are this process's memory. Slots
/// stay alive between bricks.
pub fn slot_bytes(plan: &Plan, group: &Group) -> u64 {
    let Some(gpu) = &plan.gpu else { return 0 };
    let cap = gpu.buffer_cap(plan.memory);
    let steps = group.steps.iter().filter(|&&s| plan.on_gpu(s));
    let sizes = steps.map(|&s| slot_sizes(plan, group, &plan.graph.steps[s], cap));
    let flows = plan.flows.iter().filter_map(|f| Some(inner_flow(plan, f, group)?.slot(cap)));
    let maps = group.outputs.iter().filter(|&&o| plan.map_on_gpu(o)).filter_map(|&o| {
        // A brick in the middle of the map, where it sees most.
        let job = plan.outputs[o].map_job(&plan.graph)?;
        let shape = plan.outputs[o].region.shape();
        let lo: [i64; 3] =
            std::array::from_fn(|a| (shape[a].saturating_sub(group.brick.shape[a]) / 2 / 16 * 16) as i64);
        let brick = Region::new(lo, std::array::from_fn(|a| lo[a] + group.brick.shape[a] as i64));
        Some(job.slot(brick.clip(&Region::whole(shape)), cap))
    });
    let largest = sizes.chain(maps).chain(flows).reduce(record::Sizes::max);
    largest.map_or(0, |sizes| sizes.host_bytes(gpu.software))
}

/// A flow over a brick in the middle of its group, where it sees most; `None` where the group has none of it.
pub fn inner_flow(plan: &Plan, flow: &flows::FlowPlan, group: &Group) -> Option<Flow> {
    let brick = inner(group.region, group.brick.shape, group.align);
    let (steps, outputs) = (&group.steps[..], &group.outputs[..]);
    let site = flows::Site { steps, outputs, volume: group.shape, brick, globals: &[], masked: flows::ALL_MASKED };
    Some(flows::build(plan, flow, &site)?.0)
}

/// A brick in the middle of a region, where it sees most.
fn inner(region: Region, brick: Shape, align: Shape) -> Region {
    let n = region.shape();
    let lo: [i64; 3] = std::array::from_fn(|a| {
        let before = n[a].saturating_sub(brick[a]) / 2;
        region.lo[a] + (before / align[a] * align[a]) as i64
    });
    Region::new(lo, std::array::from_fn(|a| lo[a] + brick[a] as i64)).clip(&region)
}

/// Levels and cells of the outputs that a flow makes, all components at once.
fn level_bytes(plan: &Plan, group: &Group, flow: &flows::FlowPlan, brick: Shape) -> u64 {
    let voxels = brick.iter().map(|&n| n as u64).product::<u64>();
    let made = |w: WireId| flow.steps.iter().any(|&s| plan.graph.steps[s].outputs.contains(&w));
    let of = |o: &OutputPlan| {
        let parts = o.parts.iter().filter(|p| made(p.0)).count() as u64;
        // Every level halves at least one axis.
        let levels = if o.level_count() > 1 { 2 } else { 1 };
        parts * voxels * (levels * o.spec.dtype.size() as u64 + reduce::bytes_per_cell(o.reduce) as u64 / 8)
    };
    group.outputs.iter().map(|&o| of(&plan.outputs[o])).sum()
}

/// Largest buffers that a step needs on the GPU.
fn slot_sizes(plan: &Plan, group: &Group, step: &Step, cap: u64) -> record::Sizes {
    let (src, dst, at) = sees(group, step);
    let dtype = plan.graph.wires[step.inputs[0]].dtype;
    match &step.kind {
        StepKind::Window { params, channels } => {
            let needs = window::Needs::of(channels.iter().copied(), dtype.is_float());
            let job = passes::Job::new(dtype, src, dst, at, params.radius, needs);
            job.map_or(record::Sizes::default(), |j| j.finished(params, channels).slot(cap))
        }
        StepKind::Obscurance { .. } => {
            with_sweep(plan, group, step, |job| job.map_or(record::Sizes::default(), |j| j.slot(cap)))
        }
        StepKind::Gaussian { sigma, channels } => {
            let [mean, variance] = [Moment::Mean, Moment::Variance].map(|m| channels.contains(&m));
            let job = taps::TapsJob::new(dtype, src, dst, at, *sigma, taps::Wanted { mean, variance });
            job.map_or(record::Sizes::default(), |j| j.slot(cap))
        }
        StepKind::Gradient { size, weight, spacing, channels, .. } => {
            let fit = slopes::Fit { size: *size, weight: *weight, spacing: *spacing, missing: None };
            let job = slopes::SlopesJob::new(dtype, src, dst, at, &fit, channels.contains(&GradientChannel::Vector));
            job.map_or(record::Sizes::default(), |j| j.slot(cap))
        }
        _ => record::Sizes::default(),
    }
}

/// A sweep's job on a brick in the middle of its group; `None` where there is no kernel.
pub fn with_sweep<R>(plan: &Plan, group: &Group, step: &Step, f: impl FnOnce(Option<sweep::SweepJob>) -> R) -> R {
    let StepKind::Obscurance { sweep: prepared, .. } = &step.kind else { return f(None) };
    let (src, dst, at) = sees(group, step);
    let from = at.map(|n| n as i64);
    let inner = Region::new(from, std::array::from_fn(|a| from[a] + dst[a] as i64));
    f(sweep::SweepJob::new(prepared, plan.graph.wires[step.inputs[0]].dtype, Region::whole(src), inner))
}

/// Extents of what a step reads and makes of a brick in the middle, and where the one lies in the other.
fn sees(group: &Group, step: &Step) -> (Shape, Shape, [usize; 3]) {
    let dst = grown(group.brick.shape, step.halo, group.shape);
    let src: Shape = std::array::from_fn(|a| {
        let padded = dst[a] + 2 * step.reach[a];
        if step.border == Border::Clip { padded.min(group.shape[a]) } else { padded }
    });
    (src, dst, std::array::from_fn(|a| step.reach[a].min(src[a] - dst[a])))
}

/// Element type that a window kernel sees: a constant border may need a float where the input's type cannot hold it.
pub(super) fn window_dtype(dtype: DType, border: Border) -> DType {
    match border {
        Border::Constant(_) => dtype.result(),
        _ => dtype,
    }
}

/// Converted voxels, cells of the levels and encoded chunks of one output.
fn output_bytes(plan: &Plan, group: &Group, output: &OutputPlan, brick: Shape) -> u64 {
    let voxels = brick.iter().map(|&n| n as u64).product::<u64>();
    let parts = output.spec.components.unwrap_or(1) as u64;
    let written = voxels * output.spec.dtype.size() as u64;
    // Encoded bytes may exceed the voxels a little; converted voxels are one component at a time.
    let encoded = parts * (written + written / 8);
    let level_1 = if output.level_count() > 1 { voxels / 8 } else { 0 };
    let cells = 2 * level_1 * reduce::bytes_per_cell(output.reduce) as u64;
    let map = match &output.map {
        // Mean and variance of the grown brick or of blocks of it and the level below, and the passes between.
        Some(m) => {
            let [nz, ny, nx] = grown(brick, plan.graph.wires[m.source].halo, group.shape).map(|n| n as u64);
            if m.by_blocks(output.brick_level()) {
                let [z, y] = super::MAP_BLOCK.map(|n| 2 * n as u64 + 4);
                let factor = m.chain.levels[1].factor.iter().map(|&f| f as u64).product::<u64>();
                (nz.min(z) * ny.min(y) * nx + (nz * ny * nx).div_ceil(factor)) * 24
            } else {
                nz * ny * nx * 16 * 3
            }
        }
        None => 0,
    };
    written + encoded + cells + map
}

/// Bricks that are alive at once: one per worker, one being read, one being written.
pub fn in_flight(threads: usize) -> usize {
    threads + 2
}

/// Bytes that bricks and scratch of `bricks` bytes leave of the budget.
pub fn left_bytes(plan: &Plan, bricks: u64, parked: u64) -> u64 {
    let fixed = FIXED + PER_THREAD * plan.workers as u64;
    plan.memory.saturating_sub(fixed + parked + bricks)
}

/// The part of an input's wire that a group reads at most.
fn seen(plan: &Plan, group: &Group, w: WireId) -> Region {
    let whole = Region::whole(group.shape);
    let streamed = group.steps.iter().any(|&s| plan.graph.steps[s].streamed == Some(w));
    // Pre-passes and columns of lines see more than the bricks' halos.
    let all = streamed || !plan.prepasses.is_empty();
    if all { whole } else { group.region.grow(plan.graph.wires[w].halo).clip(&whole) }
}

/// Planes of an input that a run reads at most; empty where it reads none.
pub fn planes_read(plan: &Plan, input: usize) -> Range<usize> {
    let wires = plan.groups.iter().flat_map(|g| g.inputs.iter().map(move |&w| (g, w)));
    let of_input = wires.filter(|&(_, w)| plan.graph.wires[w].producer == Producer::Input(input));
    let planes = of_input.map(|(g, w)| seen(plan, g, w)).map(|r| r.lo[0] as usize..r.hi[0] as usize);
    planes.reduce(|a, b| a.start.min(b.start)..a.end.max(b.end)).unwrap_or(0..0)
}

/// Bytes of all chunks that a group reads, decoded: a cache never holds more. 0 where its inputs have no chunks.
pub fn decoded_bytes(plan: &Plan, group: &Group) -> u64 {
    let one = |&w: &WireId| {
        let wire = &plan.graph.wires[w];
        let Producer::Input(input) = wire.producer else { return 0 };
        let Some(chunk) = plan.input_chunks[input] else { return 0 };
        let chunks = seen(plan, group, w).cells([0; 3], chunk).voxels() as u64;
        chunks.saturating_mul((chunk.iter().product::<usize>() * wire.components * wire.dtype.size()) as u64)
    };
    group.inputs.iter().map(one).fold(0, u64::saturating_add)
}
