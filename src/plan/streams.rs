//! Which sweeps read their halos box by box while they run. A halo on all sides of a brick is mostly voxels that no line
//! of one direction crosses; where the budget leaves only small bricks beside it, a sweep reads each family's column for
//! itself, which takes more reading and a fraction of the memory. The bits are the same, so that a resumed run may change it.

use super::graph::{ObscuranceChannel, Producer, StepId, StepKind, WireId};
use super::{Group, Plan, brick, tasks};
use crate::Result;
use crate::config::Config;
use crate::grid::{Region, Shape};

/// Cuts the groups and chooses their bricks, with sweeps streamed where that is less work.
pub fn choose(plan: &mut Plan, config: &Config) -> Result<()> {
    let whole = bricks(plan, config);
    let steps = candidates(plan);
    if steps.is_empty() {
        return whole.map(|_| ());
    }
    let groups = std::mem::take(&mut plan.groups);
    stream(plan, &steps, true);
    let columns = bricks(plan, config);
    let better = match (&whole, &columns) {
        (Ok(whole), Ok(columns)) => columns < whole,
        (Err(_), Ok(_)) => true,
        (Ok(_), Err(_)) => false,
        // Both are refused: with the least that would do.
        (Err(_), Err(_)) => {
            least(plan) < {
                let columns = std::mem::replace(&mut plan.groups, groups.clone());
                stream(plan, &steps, false);
                let least = least(plan);
                plan.groups = columns;
                stream(plan, &steps, true);
                least
            }
        }
    };
    if better {
        return columns.map(|_| ());
    }
    stream(plan, &steps, false);
    plan.groups = groups;
    whole.map(|_| ())
}

/// Groups and bricks of the graph as it is, and the relative time of the whole run.
fn bricks(plan: &mut Plan, config: &Config) -> Result<f64> {
    plan.groups = tasks::groups(plan);
    tasks::countable(plan).map_err(|e| config.locate(e))?;
    let mut time = 0.0;
    for g in 0..plan.groups.len() {
        let (choice, cost) = brick::choose(plan, &plan.groups[g], config)?;
        time += cost * plan.groups[g].region.voxels() as f64;
        plan.groups[g].brick = choice;
    }
    Ok(time)
}

/// The least budget that would do.
fn least(plan: &Plan) -> u64 {
    plan.groups.iter().map(|g| brick::least_bytes(plan, g)).max().unwrap_or(0)
}

fn stream(plan: &mut Plan, steps: &[(StepId, WireId)], streamed: bool) {
    steps.iter().for_each(|&(s, wire)| plan.graph.steps[s].streamed = streamed.then_some(wire));
    plan.graph.demand_halos();
}

/// Sweeps on the CPU without colours, and what they would read: an input that is their density, or of which a transfer makes
/// their density voxel by voxel.
fn candidates(plan: &Plan) -> Vec<(StepId, WireId)> {
    let graph = &plan.graph;
    let is_input = |w: &WireId| matches!(graph.wires[*w].producer, Producer::Input(_));
    let read = |s: StepId| {
        let StepKind::Obscurance { channels, .. } = &graph.steps[s].kind else { return None };
        let density = graph.steps[s].inputs[0];
        let wire = match graph.wires[density].producer {
            Producer::Input(_) => density,
            Producer::Step(t) => match (&graph.steps[t].kind, &graph.steps[t].mask) {
                (StepKind::Transfer { .. }, None) => graph.steps[t].inputs[0],
                _ => return None,
            },
        };
        let fits = channels[..] == [ObscuranceChannel::Openness] && !plan.on_gpu(s);
        (fits && is_input(&wire)).then_some((s, wire))
    };
    (0..graph.steps.len()).filter_map(read).collect()
}

/// Whether a step of the group is streamed.
pub fn any(plan: &Plan, group: &Group) -> bool {
    group.steps.iter().any(|&s| plan.graph.steps[s].streamed.is_some())
}

/// Relative work per voxel of bricks that read so many input voxels for each of theirs. A sweep's columns are read without
/// a copy of all that the brick needs, and its search costs more than its reading: 2-core Zen 4 VM, AVX-512, 2026-11-26,
/// u8, 42 directions, distance 256, ns per voxel and thread: boxes that read 27 times 117 to 158, 225 times 440; columns
/// that read 63 times 144 to 170, 82 times 156, 111 times 168, 167 times 227, 226 times 286.
pub fn work(plan: &Plan, group: &Group, amplification: f64) -> f64 {
    let directions = |s: &StepId| match &plan.graph.steps[*s].kind {
        StepKind::Obscurance { sweep, .. } => sweep.params().directions as f64,
        _ => 0.0,
    };
    let swept = group.steps.iter().map(directions).fold(0.0, f64::max);
    // A transfer table costs more than a read: 0.6 of these units, a guess of 6 ns per voxel that was not measured.
    let made = |&s: &StepId| plan.graph.steps[s].streamed.is_some_and(|w| w != plan.graph.steps[s].inputs[0]);
    let reading = if group.steps.iter().any(made) { 0.68 } else { 0.08 };
    match any(plan, group) {
        true => 0.24 * swept + reading * amplification,
        false if swept > 0.0 => amplification.powf(0.8) * (0.3 + 0.7 * swept / 42.0),
        false => amplification.powf(0.8),
    }
}

/// Voxels that a streamed step fetches for a brick in the middle of the volume.
pub fn fetched(plan: &Plan, step: StepId, brick: Shape, volume: Shape) -> usize {
    let step = &plan.graph.steps[step];
    let StepKind::Obscurance { sweep, normal, .. } = &step.kind else { return 0 };
    let lo: [i64; 3] = std::array::from_fn(|a| (volume[a].saturating_sub(brick[a]) / 2) as i64);
    let whole = Region::whole(volume);
    let brick = Region::new(lo, std::array::from_fn(|a| lo[a] + brick[a] as i64)).grow(step.halo).clip(&whole);
    sweep.streamed_voxels(brick, whole, normal.is_some())
}
