//! Bytes of what waits between bricks: chunks that several bricks fill, indices of shards, cells for the second phase.

use super::memory::{FIXED, PER_THREAD, in_flight};
use super::tasks::Group;
use super::{OutputPlan, Plan};
use crate::grid::{Region, Shape, order::morton};
use crate::kernel::reduce;

/// Open chunks of the levels between their first and last brick, for one task, all outputs, and those that are being encoded.
pub fn parked_bytes(plan: &Plan, group: &Group) -> u64 {
    let (mut total, mut encoding) = (0, 0);
    for &o in &group.outputs {
        let output = &plan.outputs[o];
        if !output.is_zarr() {
            continue;
        }
        let parts = output.spec.components.unwrap_or(1) as u64;
        let bricks = in_flight(plan.workers);
        // Chunks are whole in memory where the volume ends inside them.
        let chunk = output.spec.chunk.iter().map(|&n| n as u64).product::<u64>() * output.spec.dtype.size() as u64;
        let task = task(group);
        for k in (output.first_level()..=output.brick_level()).filter(|&k| output.owned(k, group)) {
            let span = span(output, k);
            total += open_chunks(task, group.brick.shape, span, bricks, group.task_count() > 1) * chunk * parts;
            // Each worker encodes one at a time: padded, as its filters leave it, and as it is compressed.
            let all = (0..3).map(|a| task[a].div_ceil(span[a]) as u64).product::<u64>();
            encoding = encoding.max((all * parts).min(plan.workers as u64) * (3 * chunk).saturating_sub(PER_THREAD));
        }
        total += index_bytes(output, task);
        // Cells kept for the second phase, where there is one.
        if output.level_count() > output.brick_level() + 1 {
            let deepest = output.level(output.brick_level()).expect("level exists").factor;
            let cells =
                task.iter().map(|&n| n as u64).product::<u64>() / deepest.iter().map(|&f| f as u64).product::<u64>();
            total += cells * parts * reduce::bytes_per_cell(output.reduce) as u64;
        }
    }
    total + encoding
}

/// A task's extents, no more than there is.
fn task(group: &Group) -> Shape {
    std::array::from_fn(|a| group.task[a].min(group.region.shape()[a]))
}

/// Voxels of level 0 that a chunk of level `k` covers.
fn span(output: &OutputPlan, k: usize) -> Shape {
    let factor = output.level(k).expect("level exists").factor;
    std::array::from_fn(|a| output.spec.chunk[a].saturating_mul(factor[a]))
}

/// Chunks of `span` voxels along each axis that a brick touches, at most.
fn touched(brick: Shape, span: Shape) -> Shape {
    std::array::from_fn(|a| match brick[a].is_multiple_of(span[a]) {
        true => brick[a] / span[a],
        false => brick[a].div_ceil(span[a]) + usize::from(!span[a].is_multiple_of(brick[a])),
    })
}

/// Chunks that the second phase makes at a time: each is held as voxels (of a map, all its components), padded, as its filters
/// leave it and as it is compressed. One always goes, as it does in the first phase.
pub fn chunks_at_once(plan: &Plan, output: &OutputPlan) -> usize {
    let held = if output.map.is_some() { output.spec.components.unwrap_or(1) } else { 1 };
    let chunk = output.spec.chunk.iter().product::<usize>() * output.spec.dtype.size();
    let room = plan.memory.saturating_sub(FIXED + PER_THREAD * plan.threads as u64);
    (room / ((held + 3) * chunk) as u64).clamp(1, plan.threads as u64) as usize
}

/// Chunks of `span` voxels that wait at once for parts, or encoded for a writer, while bricks go through a task along the Morton
/// curve, and through a like one after it where there are `several`. So many bricks are in flight, and may overtake one
/// another. A chunk inside one brick never waits.
fn open_chunks(task: Shape, brick: Shape, span: Shape, bricks: usize, several: bool) -> u64 {
    let touched = touched(brick, span);
    if (0..3).all(|a| brick[a].is_multiple_of(span[a]) || brick[a] >= task[a]) {
        return 0;
    }
    // The curve is alike in all cubes of bricks that hold a chunk's longest row of them: a few such cubes say it all.
    let row = (0..3).map(|a| span[a].min(task[a]).div_ceil(brick[a])).max().unwrap_or(1).next_power_of_two();
    let looked: Shape = std::array::from_fn(|a| task[a].div_ceil(span[a]).min(4 * row.max(touched[a])));
    let (mut begins, mut ends) = (Vec::new(), Vec::new());
    for c in Region::whole(looked).iter() {
        let c = c.map(|v| v as usize);
        let first = std::array::from_fn(|a| (c[a] * span[a] / brick[a]) as i64);
        let last = std::array::from_fn(|a| ((((c[a] + 1) * span[a]).min(task[a]) - 1) / brick[a]) as i64);
        // Codes grow along every axis: no brick of the box comes before its first or after its last corner.
        if first != last {
            begins.push(morton(first));
            ends.push(morton(last));
        }
    }
    begins.sort_unstable();
    ends.sort_unstable();
    // Chunks begun by each brick that begins any, and all before it.
    let begun: Vec<(u64, usize)> = (begins.chunk_by(|a, b| a == b))
        .scan(0, |all, same| {
            *all += same.len();
            Some((same[0], *all))
        })
        .collect();
    let (mut gone, mut open) = (0, 0);
    for (i, (begin, _)) in begun.iter().enumerate() {
        while ends[gone] < *begin {
            gone += 1;
        }
        // What bricks ahead begin is there while this one is still to come, or to be written.
        open = open.max(begun[(i + bricks - 1).min(begun.len() - 1)].1 - gone);
    }
    if several && !begun.is_empty() {
        // The next task's first bricks while this one's last are still there.
        let last: usize = ends.chunk_by(|a, b| a == b).rev().take(bricks).map(<[u64]>::len).sum();
        let next = bricks.checked_sub(2).map_or(0, |i| begun[i.min(begun.len() - 1)].1);
        open = open.max(last + next);
    }
    open as u64
}

/// Indices of the shards of all levels of a task, and one of them once more while it is written.
fn index_bytes(output: &OutputPlan, task: Shape) -> u64 {
    if !output.spec.is_sharded() {
        return 0;
    }
    let (file, chunk) = (output.spec.file_shape(), output.spec.chunk);
    let entries = (0..3).map(|a| (file[a] / chunk[a]) as u64).product::<u64>();
    let shards = (0..output.level_count())
        .filter_map(|k| output.level(k))
        .map(|level| (0..3).map(|a| task[a].div_ceil(level.factor[a]).div_ceil(file[a]) as u64).product::<u64>());
    let open = shards.sum::<u64>() * output.spec.components.unwrap_or(1) as u64;
    (open + 1).saturating_mul(16 * entries)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    /// By going through the bricks.
    fn played(task: Shape, brick: Shape, span: Shape) -> u64 {
        let all = Region::whole(task);
        let mut cells: Vec<[i64; 3]> = all.cells([0; 3], brick).iter().collect();
        cells.sort_by_key(|c| morton(*c));
        let (mut open, mut most): (HashMap<[i64; 3], usize>, usize) = (HashMap::new(), 0);
        for cell in cells {
            let brick = Region::of_cell(cell, [0; 3], brick).clip(&all);
            for c in brick.cells([0; 3], span).iter() {
                let chunk = Region::of_cell(c, [0; 3], span).clip(&all);
                let part = chunk.clip(&brick).voxels();
                if part < chunk.voxels() {
                    *open.entry(c).or_insert(chunk.voxels()) -= part;
                }
            }
            most = most.max(open.len());
            open.retain(|_, left| *left > 0);
        }
        most as u64
    }

    #[test]
    fn open_chunks_are_those_of_the_visit() {
        for (task, brick, span) in [
            ([64, 512, 512], [8, 512, 64], [64, 64, 64]),
            ([64, 512, 1024], [8, 512, 64], [64, 64, 64]),
            ([128, 128, 128], [32, 32, 32], [64, 64, 64]),
            ([128, 128, 128], [64, 64, 64], [64, 64, 64]),
            ([100, 90, 130], [16, 24, 40], [64, 32, 64]),
            ([96, 96, 96], [48, 48, 48], [32, 32, 32]),
            ([256, 256, 256], [64, 64, 64], [512, 512, 512]),
            ([8, 2048, 2048], [8, 64, 2048], [1, 2048, 2048]),
            ([40, 40, 40], [8, 8, 8], [16, 40, 8]),
            // Tasks of more chunks than are looked at.
            ([320, 256, 512], [8, 32, 16], [16, 16, 32]),
            ([256, 64, 700], [8, 24, 40], [16, 16, 16]),
            ([512, 64, 512], [64, 8, 8], [32, 32, 8]),
        ] {
            let open = open_chunks(task, brick, span, 1, false);
            assert_eq!(open, played(task, brick, span), "{task:?} in {brick:?} of {span:?}");
        }
        assert_eq!(open_chunks([64, 512, 4096], [8, 512, 64], [64; 3], 1, true), 64);
        // The next task's first bricks begin theirs while the last of this one are written.
        assert_eq!(open_chunks([64, 512, 512], [8, 512, 64], [64; 3], 4, false), 64);
        assert_eq!(open_chunks([64, 512, 512], [8, 512, 64], [64; 3], 4, true), 64);
        assert_eq!(open_chunks([64, 64, 512], [8, 64, 512], [64; 3], 4, true), 16);
        assert_eq!(open_chunks([128; 3], [64; 3], [32; 3], 4, true), 0);
        // Each of four bricks that run side by side may be in a chunk of its own, or in one that the slowest still keeps open.
        assert_eq!(open_chunks([256; 3], [32; 3], [64; 3], 4, false), 4);
    }
}
