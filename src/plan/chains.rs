//! Steps on the GPU whose results stay there for the one step that reads them.

use super::Plan;
use super::graph::{GradientChannel, Graph, Moment, Step, StepId, StepKind, WireId};
use crate::gpu::chain::{ChainJob, Extents};
use crate::gpu::finish::Channels;
use crate::gpu::slopes::Fit;
use crate::grid::{Border, DType, Shape};

/// By step: the step that reads its results on the device.
pub fn chains(plan: &Plan) -> Vec<Option<StepId>> {
    let sinks = plan.groups.iter().flat_map(|g| g.sinks.iter().copied());
    let maps = plan.outputs.iter().filter_map(|o| o.map.as_ref()).map(|m| m.source);
    let delivered: Vec<WireId> =
        sinks.chain(maps).chain(plan.prepasses.iter().flat_map(|p| p.wires.iter().copied())).collect();
    let both = |s: StepId, t: StepId| plan.on_gpu(s) && plan.on_gpu(t);
    let graph = &plan.graph;
    (0..graph.steps.len())
        .map(|s| reader(graph, s, &delivered).filter(|&t| both(s, t) && fits(graph, &graph.steps[s], &graph.steps[t])))
        .collect()
}

/// The one step that reads a step's one wire, if nobody else does.
fn reader(graph: &Graph, step: StepId, delivered: &[WireId]) -> Option<StepId> {
    let &[wire] = &graph.steps[step].outputs[..] else { return None };
    let reads = |t: &Step| t.inputs.contains(&wire) || t.mask.as_ref().is_some_and(|m| m.wire == wire);
    let mut readers = (0..graph.steps.len()).filter(|&t| reads(&graph.steps[t]));
    let first = readers.next()?;
    let alone = readers.next().is_none() && !delivered.contains(&wire);
    (alone && graph.steps[first].inputs[..] == [wire]).then_some(first)
}

/// A Gaussian mean whose values on the device are its results, and a gradient or windows; neither with a mask.
fn fits(graph: &Graph, first: &Step, second: &Step) -> bool {
    let input = &graph.wires[first.inputs[0]];
    let mean = matches!(&first.kind, StepKind::Gaussian { channels, .. } if channels[..] == [Moment::Mean]);
    let reads = match &second.kind {
        StepKind::Gradient { .. } => true,
        // Elsewhere than at the edge of the volume a window of means needs means; beyond it, those of the border rule.
        StepKind::Window { params, channels } => {
            second.border == Border::Clip && Channels::of(params, channels).is_some()
        }
        _ => false,
    };
    let plain = input.affine.is_identity() && input.components == 1;
    mean && reads && plain && first.mask.is_none() && second.mask.is_none()
}

/// The recording of two chained steps over boxes of these extents; `None` where they run one by one.
pub fn job(first: &Step, second: &Step, dtype: DType, extents: &Extents) -> Option<ChainJob> {
    let StepKind::Gaussian { sigma, .. } = &first.kind else { return None };
    match &second.kind {
        StepKind::Gradient { size, weight, spacing, channels, .. } => {
            let fit = Fit { size: *size, weight: *weight, spacing: *spacing, missing: None };
            ChainJob::gradient(dtype, extents, *sigma, &fit, channels.contains(&GradientChannel::Vector))
        }
        StepKind::Window { params, channels } => ChainJob::windows(dtype, extents, *sigma, params, channels, [0; 3]),
        _ => None,
    }
}

/// Extents of chained steps for outputs of `dst` in the middle of a volume: the largest that there are.
pub fn extents(first: &Step, second: &Step, dst: Shape, volume: Shape) -> Extents {
    let middle: Shape = std::array::from_fn(|a| (dst[a] + 2 * second.reach[a]).min(volume[a]));
    let src: Shape = std::array::from_fn(|a| middle[a] + 2 * first.reach[a]);
    let inner = std::array::from_fn(|a| second.reach[a].min(middle[a] - dst[a]));
    Extents { src, middle, at: first.reach, dst, inner }
}
