//! The brick's shape from the budget.

use super::Plan;
use super::graph::Producer;
use super::memory::{self, brick_bytes, slot_bytes};
use super::parked::parked_bytes;
use super::tasks::Group;
use super::{streams, tasks};
use crate::config::Config;
use crate::gpu::facts;
use crate::grid::Shape;
use crate::{Error, Result};

/// The brick and what it costs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BrickChoice {
    pub shape: Shape,
    /// Bytes that one brick keeps alive.
    pub bytes: u64,
    /// Bytes of scratch of each worker that computes one.
    pub scratch: u64,
    /// Bricks alive at once.
    pub in_flight: usize,
    /// Bytes for decoded chunks.
    pub cache: u64,
    /// Bytes for buffers that wait for the next brick, beside what bricks hold; none where there are chunks to hold instead.
    pub waiting: u64,
    /// Bytes of open chunks of the levels, and of the GPU lane's slots.
    pub parked: u64,
    /// Bricks that the GPU lane holds at once; 0 where no step of the group runs there.
    pub slots: u64,
    /// Input voxels read per output voxel.
    pub amplification: f64,
    pub why: String,
}

impl BrickChoice {
    /// Worst case by formula.
    pub fn peak(&self, workers: usize) -> u64 {
        memory::FIXED
            + memory::PER_THREAD * workers as u64
            + self.parked
            + self.alive(workers)
            + self.cache
            + self.waiting
    }

    /// Bytes of all bricks in flight and of the workers' scratch.
    pub fn alive(&self, workers: usize) -> u64 {
        self.bytes * self.in_flight as u64 + self.scratch * self.in_flight.min(workers) as u64
    }
}

/// Chooses the brick of a group and says its relative time per voxel, or refuses with the least budget that would do.
pub fn choose(plan: &Plan, group: &Group, config: &Config) -> Result<(BrickChoice, f64)> {
    if let Some(asked) = config.run.brick {
        // No more than there is: memory is for voxels that exist.
        let region = group.region.shape();
        let shape = round_up(std::array::from_fn(|a| asked[a].clamp(1, region[a])), group.align, group.task);
        let why = if shape == asked {
            "as asked".to_string()
        } else {
            format!(
                "asked for {asked:?}; bricks are multiples of {:?}, at most a task of {:?} and no larger than the volume needs",
                group.align, group.task
            )
        };
        let choice = fit(plan, group, shape, why).ok_or_else(|| refuse(plan, group, shape, "run.brick", config))?;
        let cost = cost(plan, group, shape, &choice);
        return Ok((choice, cost));
    }
    let mut best: Option<(f64, f64, BrickChoice)> = None;
    for shape in candidates(group) {
        let Some(choice) = fit(plan, group, shape, String::new()) else { continue };
        let cost = cost(plan, group, shape, &choice);
        let with_decoding = cost * decoded_again(plan, group, &choice);
        if best.as_ref().is_none_or(|(c, ..)| with_decoding < *c) {
            best = Some((with_decoding, cost, choice));
        }
    }
    match best {
        Some((_, cost, mut choice)) => {
            choice.why = format!(
                "least work per voxel of the shapes whose {} bricks in flight fit: reads {:.2} input voxels per output voxel",
                choice.in_flight, choice.amplification
            );
            Ok((choice, cost))
        }
        None => Err(refuse(plan, group, least(plan, group), "the smallest", config)),
    }
}

/// Bricks of a pre-pass: those of a run of the whole volume, since a small region has small ones, which are mostly halo.
pub fn over_all(plan: &Plan, group: &Group, config: &Config) -> BrickChoice {
    choose(plan, &tasks::over_all(plan, group), config).map_or_else(|_| group.brick.clone(), |(choice, _)| choice)
}

/// The brick of those that are looked at which takes least memory.
fn least(plan: &Plan, group: &Group) -> Shape {
    let all = candidates(group).into_iter();
    all.min_by_key(|&shape| one_brick(plan, group, shape)[1]).expect("there is a shape")
}

fn round_up(asked: Shape, align: Shape, task: Shape) -> Shape {
    std::array::from_fn(|a| (asked[a].div_ceil(align[a]) * align[a]).min(task[a]))
}

/// Multiples of whole chunks (powers of two of them), and of the alignment below a chunk.
fn candidates(group: &Group) -> Vec<Shape> {
    let shape = group.region.shape();
    let axis = |a: usize| {
        let unit = if group.chunk[a].is_multiple_of(group.align[a]) && group.chunk[a] > 1 {
            group.chunk[a]
        } else {
            group.align[a]
        };
        let unit = if unit < 16 { unit * 16usize.div_ceil(unit) } else { unit };
        let mut edges: Vec<usize> = Vec::new();
        let mut edge = unit;
        let end = group.task[a].min(shape[a].div_ceil(group.align[a]) * group.align[a]);
        while edge < end {
            edges.push(edge);
            edge *= 2;
        }
        edges.push(end);
        // Below a chunk: for budgets that one chunk's brick does not fit.
        let mut small = unit / 2;
        while small >= group.align[a].max(8) && unit > group.align[a] {
            edges.push(small.div_ceil(group.align[a]) * group.align[a]);
            small /= 2;
        }
        edges.sort_unstable();
        edges.dedup();
        edges
    };
    let (zs, ys, xs) = (axis(0), axis(1), axis(2));
    let mut all = Vec::new();
    for &z in &zs {
        for &y in &ys {
            all.extend(xs.iter().map(|&x| [z, y, x]));
        }
    }
    all
}

/// Bytes of a shape, or `None` where not even one brick fits.
fn fit(plan: &Plan, group: &Group, shape: Shape, why: String) -> Option<BrickChoice> {
    let bytes = brick_bytes(plan, group, shape);
    let mut probe = group.clone();
    probe.brick.shape = shape;
    let slot = slot_bytes(plan, &probe);
    let parked = parked_bytes(plan, &probe) + facts::SLOTS * slot;
    let fixed = memory::FIXED + memory::PER_THREAD * plan.workers as u64;
    let room = plan.memory.checked_sub(fixed + parked)?;
    let mut choice = BrickChoice { shape, bytes, parked, why, ..BrickChoice::default() };
    choice.scratch = memory::scratch_bytes(plan, group, shape);
    let fits = |n: &usize| BrickChoice { in_flight: *n, ..choice.clone() }.alive(plan.workers) <= room;
    choice.in_flight = (1..=memory::in_flight(plan.workers)).rev().find(fits)?;
    let left = |c: &BrickChoice| memory::left_bytes(plan, c.alive(plan.workers), c.parked);
    let decoded = memory::decoded_bytes(plan, group);
    choice.cache = left(&choice).min(decoded);
    // One brick beyond the workers keeps them busy; more only smooth the flow, and a cache that loses the chunks between two
    // layers of bricks has them decoded again. 2-core Zen 4 VM, 2026-11-26, mean of radius 5, 1024^3 u8 in chunks of 64^3
    // under 256 MiB: 695 MiB of 367 read with 4 bricks in flight, 435 with 3.
    let enough = plan.workers + 1;
    if choice.in_flight > enough && choice.cache < layer_bytes(plan, group) {
        choice.in_flight = enough;
        choice.cache = left(&choice).min(decoded);
    }
    // More slots of the GPU lane of half of what nothing else takes.
    if let Some(more) = ((left(&choice) - choice.cache) / 2).checked_div(slot) {
        choice.slots = (facts::SLOTS + more).min(facts::MOST_SLOTS).min(plan.workers as u64);
        choice.parked += (choice.slots - facts::SLOTS) * slot;
    }
    if decoded == 0 {
        choice.waiting = left(&choice).min(choice.bytes * choice.in_flight as u64);
    }
    choice.amplification = amplification(plan, group, shape);
    Some(choice)
}

/// Bytes of the chunks of all inputs that two layers of a task's bricks share.
fn layer_bytes(plan: &Plan, group: &Group) -> u64 {
    let region = group.region.shape();
    let one = |&w: &usize| {
        let wire = &plan.graph.wires[w];
        let Producer::Input(input) = wire.producer else { return 0 };
        let Some(chunk) = plan.input_chunks[input] else { return 0 };
        let halo = plan.graph.wires[w].halo;
        let across = |a: usize| {
            let edge = (group.task[a].min(region[a]) + 2 * halo[a]).min(group.shape[a]);
            edge.div_ceil(chunk[a]) + 1
        };
        let layers = (2 * halo[0]).div_ceil(chunk[0]) + 1;
        let voxels = layers * across(1) * across(2) * chunk.iter().product::<usize>();
        (voxels * wire.dtype.size() * wire.components) as u64
    };
    group.inputs.iter().map(one).sum::<u64>().min(memory::decoded_bytes(plan, group))
}

/// Relative time of decoding again what bricks leave no room for between two layers of them. Columns of lines are read by
/// a rule of their own. 2-core Zen 4 VM, 2026-11-26, a chain of four stages over 15 million u16 in chunks of whole planes
/// under 160 MiB: bricks of [200, 64, 128] leave 2 MiB, decode 280 MiB for 25 stored and take 1.3 s; of [64, 128, 128]
/// leave 31 MiB, decode all once and take 1.0 s.
fn decoded_again(plan: &Plan, group: &Group, choice: &BrickChoice) -> f64 {
    let layer = layer_bytes(plan, group);
    if layer == 0 || streams::any(plan, group) {
        return 1.0;
    }
    1.0 + 0.5 * (1.0 - choice.cache as f64 / layer as f64).max(0.0)
}

/// Input voxels read per output voxel, the mean over the group's inputs, halos clipped to the volume.
fn amplification(plan: &Plan, group: &Group, shape: Shape) -> f64 {
    let inputs = &group.inputs;
    let one = |w: usize| {
        let halo = plan.graph.wires[w].halo;
        (0..3).map(|a| seen_along(group, shape[a], halo[a], a)).product::<f64>()
    };
    let mean = inputs.iter().map(|&w| one(w)).sum::<f64>() / inputs.len().max(1) as f64;
    let streamed = group.steps.iter().filter(|&&s| plan.graph.steps[s].streamed.is_some());
    let fetched: usize = streamed.map(|&s| streams::fetched(plan, s, shape, group.shape)).sum();
    mean + fetched as f64 / shape.iter().product::<usize>() as f64
}

/// Voxels that bricks of this edge see along an axis, halos included, per voxel that they make.
fn seen_along(group: &Group, edge: usize, halo: usize, axis: usize) -> f64 {
    let (lo, hi, n) = (group.region.lo[axis] as usize, group.region.hi[axis] as usize, group.shape[axis]);
    let (mut at, mut seen) = (lo, 0);
    while at < hi {
        // Bricks end where tasks do.
        let task_end = lo + ((at - lo) / group.task[axis] + 1) * group.task[axis];
        let end = (at + edge).min(task_end).min(hi);
        seen += (end + halo).min(n) - at.saturating_sub(halo);
        at = end;
    }
    seen as f64 / (hi - lo).max(1) as f64
}

/// Relative time per voxel: work on halos, short rows, idle cores at the end, too few bricks in flight.
fn cost(plan: &Plan, group: &Group, shape: Shape, choice: &BrickChoice) -> f64 {
    let region = group.region.shape();
    let bricks = (0..3).map(|a| region[a].div_ceil(shape[a])).product::<usize>() as f64;
    let threads = plan.threads as f64;
    // One brick is one task on one thread: the last round leaves cores idle, and nothing overlaps the first brick's reading
    // and the last one's writing. 2-core Zen 4 VM, 2026-11-26, 415 x 256 x 256 u16, cdf_power r=10, one thread, .npy to .npy:
    // 225 ms in 4 bricks, 190 in 7, 165 in 13, 150 in 26; half a round, as before, chose 4.
    let rounds = ((bricks / threads).ceil() * threads + 2.0 * threads) / bricks;
    let short_rows = 1.0 + 24.0 / shape[2].min(region[2]) as f64;
    let starved = match choice.in_flight {
        // Workers read for themselves.
        n if streams::any(plan, group) => threads / (n as f64).min(threads),
        n if n > plan.workers => 1.0,
        n => 1.5 + threads / n as f64,
    };
    // Cells, chunks and cached pages stay warm in bricks of a few million voxels (the same runs: 77 ms of kernel in bricks of
    // 2 million, 85 of 4, 95 of 8); beyond, the pipeline only gets coarser.
    let voxels = tasks::held(shape, region) as f64;
    let large = 1.0 + voxels / 40e6 + (voxels / 16e6).powi(2) * 0.1;
    let partial_chunks =
        if (0..3).any(|a| !shape[a].is_multiple_of(group.chunk[a]) && shape[a] < region[a]) { 1.15 } else { 1.0 };
    let overhead = 1.0 + 20_000.0 / voxels;
    streams::work(plan, group, choice.amplification) * rounds * short_rows * starved * large * partial_chunks * overhead
}

/// Bytes of one brick with its scratch, and of a run of such bricks one by one.
fn one_brick(plan: &Plan, group: &Group, shape: Shape) -> [u64; 2] {
    let bytes = brick_bytes(plan, group, shape) + memory::scratch_bytes(plan, group, shape);
    let mut probe = group.clone();
    probe.brick.shape = shape;
    let parked = parked_bytes(plan, &probe) + facts::SLOTS * slot_bytes(plan, &probe);
    [bytes, bytes + parked + memory::FIXED + memory::PER_THREAD * plan.workers as u64]
}

/// The least budget that would do for a group.
pub fn least_bytes(plan: &Plan, group: &Group) -> u64 {
    one_brick(plan, group, least(plan, group))[1]
}

fn refuse(plan: &Plan, group: &Group, shape: Shape, which: &str, config: &Config) -> Error {
    let [bytes, need] = one_brick(plan, group, shape);
    config.locate(Error::config(
        "run.memory",
        format!(
            "{} is too little for one brick: {which}, {shape:?} voxels (z, y, x), with its halo, results and scratch \
             takes {}, beside {} that every run holds; give at least memory = \"{}MiB\"",
            mib(plan.memory),
            mib(bytes),
            mib(need - bytes),
            need.div_ceil(1 << 20)
        ),
    ))
}

/// Bytes beside the budget that a chunk on its way may take: three quarters of what a run may have beyond `memory`.
const BESIDE: u64 = 96 << 20;

/// Refuses budgets that a chunk of an input breaks by itself: it is decoded whole, from as much again at worst.
pub fn chunks_fit(plan: &Plan, config: &Config) -> Result<()> {
    for wire in plan.graph.wires.iter() {
        let Producer::Input(input) = wire.producer else { continue };
        let Some(chunk) = plan.input_chunks[input] else { continue };
        let voxels = chunk.iter().fold(1u64, |all, &n| all.saturating_mul(n as u64));
        let bytes = voxels.saturating_mul(wire.dtype.size() as u64);
        let need = bytes.saturating_mul(2).saturating_sub(BESIDE);
        if need > plan.memory {
            let (memory, took) = (mib(plan.memory), mib(bytes));
            return Err(config.locate(Error::config(
                "run.memory",
                format!(
                    "{memory} is too little for the chunks of input {}: one of {chunk:?} voxels (z, y, x) takes {took} decoded, and \
                     up to as much encoded; give at least memory = \"{}MiB\"",
                    config.inputs[input].name,
                    need.div_ceil(1 << 20)
                ),
            )));
        }
    }
    Ok(())
}

/// A size for people.
pub fn mib(bytes: u64) -> String {
    if bytes >= 10 << 30 {
        format!("{:.1} GiB", bytes as f64 / (1u64 << 30) as f64)
    } else if bytes >= 1 << 20 || bytes == 0 {
        format!("{:.1} MiB", bytes as f64 / (1 << 20) as f64)
    } else if bytes < 1 << 10 {
        format!("{bytes} bytes")
    } else {
        format!("{:.1} KiB", bytes as f64 / 1024.0)
    }
}
