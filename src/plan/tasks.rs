//! Volumes cut into super-blocks (tasks) and bricks.
//!
//! A task owns whole shards of level 0 and of as many further levels as fit in about one of [`TASK_EDGES`] voxels per axis, and of
//! thin volumes more. It depends on shapes, halos, chunks and shards only, never on bricks, threads or budget, so that a resumed
//! run may change those.

use super::graph::Graph;
use super::graph::{StepId, WireId, add3};
use super::{BrickChoice, OutputPlan, Plan};
use crate::config::OutputFormat;
use crate::gpu::maps::{MapJob, MapLevel};
use crate::grid::{Region, Shape};
use crate::store::LevelLayout;
use crate::{Error, Result};

/// Edges of a task that are aimed at, the first that is small enough: 512^3 u8 voxels take seconds, so that a kill loses little
/// and a marker costs little, but of a volume of that size nothing would be kept.
const TASK_EDGES: [usize; 5] = [512, 256, 128, 64, 32];
/// A task is at most one in so many of the voxels, where files and halos allow it.
const LEAST_TASKS: usize = 8;
/// A task's edge is at least so many halos, where it is below the first of [`TASK_EDGES`]: bricks lie inside tasks.
const HALOS_PER_EDGE: usize = 8;
/// Levels that every brick makes by itself: bricks are multiples of 2^3 on halved axes. Coarser levels are made in the
/// second phase from cells of this level, 1/512 of the voxels.
const BRICK_LEVELS: usize = 3;

/// Most tasks of a run, each of which has a mark in memory and in the journal: 2^50 voxels, a petabyte of bytes.
const MOST_TASKS: usize = 1 << 23;

/// Outputs on one lattice shape, computed brick by brick together.
#[derive(Debug, Clone)]
pub struct Group {
    pub shape: Shape,
    /// The part of the volume that is computed.
    pub region: Region,
    /// Indices into [`Plan::outputs`].
    pub outputs: Vec<usize>,
    /// Wires whose values bricks deliver (outputs, the means beside them, what occlusion maps are made of).
    pub sinks: Vec<WireId>,
    pub steps: Vec<StepId>,
    /// Input wires that the steps and outputs read.
    pub inputs: Vec<WireId>,
    /// Bricks are multiples of this, so that no cell of a brick-made level straddles two.
    pub align: Shape,
    /// Bricks that are multiples of this complete whole chunks.
    pub chunk: Shape,
    /// Voxels of a task, anchored at the region's start; a multiple of `align`.
    pub task: Shape,
    /// Tasks per axis.
    pub tasks: Shape,
    /// Number of the group's first task.
    pub first_task: usize,
    pub brick: BrickChoice,
    /// Bricks of pre-passes, which go over the whole volume; `None` where there is none.
    pub prepass: Option<BrickChoice>,
}

impl Group {
    pub fn task_count(&self) -> usize {
        self.tasks.iter().fold(1, |all, &n| all.saturating_mul(n))
    }

    /// The box of the group's `i`th task (C order over the task grid).
    pub fn task_region(&self, i: usize) -> Region {
        let [_, ny, nx] = self.tasks;
        let cell = [i / (ny * nx), i / nx % ny, i % nx].map(|v| v as i64);
        Region::of_cell(cell, self.region.lo, self.task).clip(&self.region)
    }

    /// Bricks of a task along a Morton curve.
    pub fn bricks(&self, task: Region) -> Vec<Region> {
        let mut cells: Vec<[i64; 3]> = task.cells(task.lo, self.brick.shape).iter().collect();
        cells.sort_by_key(|c| crate::grid::order::morton(*c));
        cells.into_iter().map(|c| Region::of_cell(c, task.lo, self.brick.shape).clip(&task)).collect()
    }

    /// Bricks of the whole group.
    pub fn brick_count(&self) -> usize {
        (0..self.task_count())
            .map(|t| {
                let shape = self.task_region(t).shape();
                (0..3).map(|a| shape[a].div_ceil(self.brick.shape[a])).product::<usize>()
            })
            .sum()
    }
}

impl OutputPlan {
    /// Layout of level `k` of the full-resolution chain (an occlusion map's datasets start later).
    pub fn level(&self, k: usize) -> Option<&LevelLayout> {
        match &self.map {
            Some(map) => map.chain.levels.get(k),
            None => self.spec.pyramid.levels.get(k),
        }
    }

    /// Levels of the chain, level 0 counted.
    pub fn level_count(&self) -> usize {
        self.map.as_ref().map_or(self.spec.pyramid.levels.len(), |m| m.chain.levels.len())
    }

    /// First level of the chain that is stored.
    pub fn first_level(&self) -> usize {
        self.map.as_ref().map_or(0, |m| m.first)
    }

    pub fn is_zarr(&self) -> bool {
        matches!(self.spec.format, OutputFormat::OmeZarr04 | OutputFormat::OmeZarr05)
    }

    /// An occlusion map's chain as the GPU records it, where it has a kernel.
    pub fn map_job(&self, graph: &Graph) -> Option<MapJob> {
        let map = self.map.as_ref()?;
        let levels = map.chain.levels[..=self.brick_level()].iter();
        let levels = levels.map(|l| MapLevel { shape: l.shape, factor: l.factor, halved: l.halved });
        MapJob::new(graph.wires[map.source].dtype, levels.collect())
    }

    /// The values that map to 0 and the largest code, from the config or a pre-pass.
    pub fn mapped(&self, globals: &[Vec<f64>]) -> Option<[f64; 2]> {
        let Some(id) = self.auto_range else { return self.range };
        let [lo, hi] = Plan::global(globals, id);
        let usable = lo.is_finite() && hi.is_finite();
        Some(match usable {
            false => [0.0, 1.0],
            true if hi > lo => [lo, hi],
            true => [lo, lo + 1.0],
        })
    }

    /// The last level that bricks make by themselves.
    pub fn brick_level(&self) -> usize {
        (self.level_count() - 1).min(BRICK_LEVELS)
    }

    /// Edges of the files that are committed whole: shards, or chunks without them.
    pub fn commit_shape(&self) -> Shape {
        match self.spec.format {
            OutputFormat::OmeZarr05 => self.spec.shard.unwrap_or(self.spec.chunk),
            _ => self.spec.chunk,
        }
    }

    /// Whether every file of level `k` belongs to one task of these edges.
    pub fn owned(&self, k: usize, group: &Group) -> bool {
        if !self.is_zarr() {
            return k == self.first_level();
        }
        let (Some(level), file, shape) = (self.level(k), self.commit_shape(), group.region.shape()) else {
            return false;
        };
        k <= self.brick_level()
            && (0..3).all(|a| group.task[a] >= shape[a] || group.task[a].is_multiple_of(file[a] * level.factor[a]))
    }

    /// Whether files of level `k`, which bricks make, belong to several tasks: its voxels wait in scratch for the second phase.
    pub fn shared(&self, k: usize, group: &Group) -> bool {
        self.is_zarr() && k >= self.first_level() && !self.owned(k, group)
    }

    /// The box of level `k` (in its own cells, counted from the output's start) that a box of voxels makes.
    pub fn level_box(&self, k: usize, voxels: Region) -> Region {
        let level = self.level(k).expect("a level of the chain");
        let at = |v: i64, a: usize| (v - self.region.lo[a]).div_euclid(level.factor[a] as i64);
        let up =
            |v: i64, a: usize| (v - self.region.lo[a] + level.factor[a] as i64 - 1).div_euclid(level.factor[a] as i64);
        Region::new(
            std::array::from_fn(|a| at(voxels.lo[a], a)),
            std::array::from_fn(|a| up(voxels.hi[a], a).min(level.shape[a] as i64)),
        )
    }
}

/// Groups outputs by shape and cuts each group into tasks.
pub fn groups(plan: &Plan) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    for (o, output) in plan.outputs.iter().enumerate() {
        let shape = plan.graph.lattices[output.lattice].shape;
        let at = groups.iter().position(|g| g.shape == shape).unwrap_or_else(|| {
            groups.push(Group {
                shape,
                region: output.region,
                outputs: vec![],
                sinks: vec![],
                steps: vec![],
                inputs: vec![],
                align: [1; 3],
                chunk: [1; 3],
                task: [1; 3],
                tasks: [1; 3],
                first_task: 0,
                brick: BrickChoice::default(),
                prepass: None,
            });
            groups.len() - 1
        });
        groups[at].outputs.push(o);
    }
    let mut first_task = 0;
    for group in &mut groups {
        fill_group(plan, group);
        group.first_task = first_task;
        first_task = group.task_count().saturating_add(first_task);
    }
    groups
}

/// The group as it would be over the whole volume, which pre-passes go over whatever the region is; without bricks.
pub fn over_all(plan: &Plan, group: &Group) -> Group {
    let mut all = Group { region: Region::whole(group.shape), ..group.clone() };
    fill_group(plan, &mut all);
    all
}

/// Refuses volumes of more tasks than a run can keep account of.
pub fn countable(plan: &Plan) -> Result<()> {
    let all = plan.groups.iter().map(Group::task_count).fold(0, usize::saturating_add);
    if all <= MOST_TASKS {
        return Ok(());
    }
    let shape = plan.groups[0].region.shape();
    let message = format!(
        "{shape:?} voxels (z, y, x) would be {all} tasks; a run keeps account of up to {MOST_TASKS}: give it a part of the volume"
    );
    Err(Error::config("run.region", message))
}

fn fill_group(plan: &Plan, group: &mut Group) {
    let outputs: Vec<&OutputPlan> = group.outputs.iter().map(|&o| &plan.outputs[o]).collect();
    for output in &outputs {
        let pooled = output.means.iter().flatten().copied().filter(|_| output.reduce == crate::stage::Reduce::Moments);
        let mapped = output.map.iter().map(|m| m.source);
        for w in output.parts.iter().map(|p| p.0).chain(pooled).chain(mapped) {
            if !group.sinks.contains(&w) {
                group.sinks.push(w);
            }
        }
    }
    group.steps = plan.steps_for(&group.sinks);
    group.inputs = inputs_of(plan, &group.steps, &group.sinks);
    group.align = [1; 3];
    group.chunk = [1; 3];
    let mut files = [1; 3];
    for output in &outputs {
        let deepest = output.level(output.brick_level()).expect("level exists").factor;
        group.align = lcm3(group.align, deepest);
        if output.is_zarr() {
            let first = output.level(output.first_level()).expect("level exists").factor;
            let scaled = |edge: Shape| std::array::from_fn(|a| edge[a] * first[a]);
            group.chunk = lcm3(group.chunk, scaled(output.spec.chunk));
            files = lcm3(files, scaled(output.commit_shape()));
        }
    }
    let mut base = lcm3(files, group.align);
    let shape = group.region.shape();
    if outputs.iter().any(|o| !o.is_zarr()) {
        // Planes of a flat file are written in one go; parts of rows take a call each.
        (1..3).for_each(|a| base[a] = shape[a].min(TASK_EDGES[0]).next_multiple_of(base[a]));
    }
    // What sweeps see counts whether they read it as boxes or by columns, which the budget decides.
    let seen = group.steps.iter().map(|&s| &plan.graph.steps[s]).map(|s| add3(s.halo, s.reach));
    let halo = group.inputs.iter().map(|&w| plan.graph.wires[w].halo).chain(seen).flatten().max().unwrap_or(0);
    group.task = choose_task(&outputs, base, shape, halo);
    group.tasks = std::array::from_fn(|a| shape[a].div_ceil(group.task[a]).max(1));
}

/// The first of [`TASK_EDGES`] that cuts the region into [`LEAST_TASKS`]; where files and halos allow none, the least that they
/// allow, unless that leaves more than three quarters in one piece.
fn choose_task(outputs: &[&OutputPlan], base: Shape, region: Shape, halo: usize) -> Shape {
    let allowed = |edge: usize| edge == TASK_EDGES[0] || edge >= HALOS_PER_EDGE * halo;
    let shapes = TASK_EDGES.into_iter().filter(|&e| allowed(e)).map(|edge| task_shape(outputs, base, edge));
    let whole: usize = region.iter().product();
    let most = |task: &Shape| held(*task, region);
    let least = shapes.clone().next_back().filter(|task| most(task) * 4 <= whole * 3);
    let task = shapes
        .clone()
        .find(|task| most(task) * LEAST_TASKS <= whole)
        .or(least)
        .or(shapes.clone().next())
        .unwrap_or(base);
    lengthened(task, region)
}

/// Voxels of a region that a box of this shape holds at most.
pub fn held(shape: Shape, region: Shape) -> usize {
    (0..3).map(|a| shape[a].min(region[a])).product()
}

/// Twice as long along its shortest axis that can grow, as often as it stays one in [`LEAST_TASKS`] of the voxels and no more than
/// a cube of the first of [`TASK_EDGES`]: of volumes that are thin along some axis, a cube holds little.
fn lengthened(mut task: Shape, region: Shape) -> Shape {
    let most = (region.iter().product::<usize>() / LEAST_TASKS).min(TASK_EDGES[0].pow(3));
    loop {
        let Some(axis) = (0..3).rev().filter(|&a| task[a] < region[a]).min_by_key(|&a| task[a]) else { return task };
        let mut next = task;
        next[axis] = next[axis].saturating_mul(2);
        if held(next, region) > most {
            return task;
        }
        task = next;
    }
}

/// Grows a task from the files of level 0 to those of further levels while it stays near `edge`.
fn task_shape(outputs: &[&OutputPlan], base: Shape, edge: usize) -> Shape {
    let mut task = base;
    for k in 1..=BRICK_LEVELS {
        let mut next = task;
        for output in outputs.iter().filter(|o| o.is_zarr() && k <= o.brick_level()) {
            let factor = output.level(k).expect("level exists").factor;
            let file = output.commit_shape();
            next = lcm3(next, std::array::from_fn(|a| file[a] * factor[a]));
        }
        if (0..3).any(|a| next[a] > edge.max(base[a])) {
            break;
        }
        task = next;
    }
    // Flat files and small chunks: as many as come near the edge.
    std::array::from_fn(|a| task[a] * (edge / task[a]).max(1))
}

/// Input wires that steps and sinks read.
pub fn inputs_of(plan: &Plan, steps: &[StepId], sinks: &[WireId]) -> Vec<WireId> {
    let mut inputs = Vec::new();
    let masks = steps.iter().filter_map(|&s| plan.graph.steps[s].mask.as_ref().map(|m| &m.wire));
    let read = steps.iter().flat_map(|&s| &plan.graph.steps[s].inputs).chain(masks).chain(sinks);
    for &w in read {
        if matches!(plan.graph.wires[w].producer, super::graph::Producer::Input(_)) && !inputs.contains(&w) {
            inputs.push(w);
        }
    }
    inputs
}

fn lcm3(a: Shape, b: Shape) -> Shape {
    fn gcd(a: usize, b: usize) -> usize {
        if b == 0 { a } else { gcd(b, a % b) }
    }
    std::array::from_fn(|i| (a[i] / gcd(a[i], b[i])).saturating_mul(b[i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Voxels of the largest task, and how many there are.
    fn sizes(task: Shape, region: Shape) -> (usize, usize) {
        (held(task, region), (0..3).map(|a| region[a].div_ceil(task[a])).product())
    }

    #[test]
    fn tasks_of_thin_volumes_are_long() {
        let long = lengthened([512; 3], [1, 1, 100_000_000]);
        assert_eq!((long, sizes(long, [1, 1, 100_000_000])), ([512, 512, 1 << 23], (1 << 23, 12)));
        let flat = lengthened([512; 3], [1, 10_000, 10_000]);
        assert_eq!((flat, sizes(flat, [1, 10_000, 10_000]).1), ([512, 2048, 4096], 15));
        // Never more than a cube holds, and whole files.
        let sheet = lengthened([384; 3], [64, 100_000, 100_000]);
        assert!(sizes(sheet, [64, 100_000, 100_000]).0 <= 512usize.pow(3) && sheet.iter().all(|n| n % 384 == 0));
        assert!(sizes(sheet, [64, 100_000, 100_000]).0 > 256usize.pow(3));
        // Volumes that are not thin keep their cubes, small ones their task.
        for (task, region) in
            [([512; 3], [4096; 3]), ([64; 3], [128; 3]), ([32; 3], [30, 31, 32]), ([512; 3], [600; 3])]
        {
            assert_eq!(lengthened(task, region), task, "{region:?}");
        }
    }
}
