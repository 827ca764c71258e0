//! How often a run would decode the chunks of its inputs: the cache is played through over the order of bricks. An input
//! of which the cache cannot hold enough is better unpacked once, to plain planes in scratch.

use std::collections::{BTreeSet, HashMap};

use super::graph::{Producer, WireId};
use super::{Group, Plan};
use crate::grid::order::morton;
use crate::grid::{Region, Shape};

/// Decodings, in all chunks of the array, above which an input is unpacked. That costs one decoding of each, and writing.
/// 2-core Zen 4 VM, AVX-512, 2026-11-27, mean of radius 6 over 224^3 u16 of noise in chunks of 112^3, zstd, seconds beside
/// those with unpacking: decoded 2.6 times 0.52 beside 0.55, 4.9 times 0.42 beside 0.50, 9.4 times 0.58 beside 0.29, 15.6
/// times 0.80 beside 0.50; a sweep over 160^3 f32 in one chunk, decoded 279 times: 21.1 beside 1.0.
const MOST_DECODES: f64 = 3.0;
/// Visits of chunks that are played through, some tens of milliseconds and 20 MiB: what comes later goes as what came before.
const MOST_VISITS: usize = 1 << 18;

/// Tasks along an axis that are looked at, a power of two.
const MOST_ALONG: usize = 64;

/// Times that a sweep which reads while it runs is taken to go through all that it sees: one for some of its directions.
const SWEEP_PASSES: usize = 8;

/// The input whose chunks a run would decode most often, if that is often enough to unpack it first.
pub fn worth_unpacking(plan: &Plan) -> Option<usize> {
    let times = plan.groups.iter().flat_map(|g| decodes(plan, g));
    let most = times.filter(|(_, times)| *times > MOST_DECODES).max_by(|a, b| a.1.total_cmp(&b.1));
    most.map(|(input, _)| input)
}

/// A chunked input of a group.
struct Chunked {
    input: usize,
    chunk: Shape,
    /// Decoded, all components.
    bytes: u64,
    halo: [usize; 3],
    /// The part of the array's chunks that the group reads.
    share: f64,
    /// Times that a brick goes through its box: sweeps fetch it slab by slab, for one direction after another.
    passes: usize,
}

/// Inputs of a group with chunks, and how many times the whole array's chunks would be decoded.
fn decodes(plan: &Plan, group: &Group) -> Vec<(usize, f64)> {
    let inputs: Vec<Chunked> = group.inputs.iter().filter_map(|&w| chunked(plan, group, w)).collect();
    if inputs.is_empty() {
        return Vec::new();
    }
    let (visits, chunks) = visits(group, &inputs);
    let counts = play(&visits, &chunks.iter().map(|i| inputs[*i].bytes).collect::<Vec<_>>(), group.brick.cache);
    let of = |i: usize| {
        let own = || chunks.iter().zip(&counts).filter(move |(c, _)| **c == i);
        let times = own().map(|(_, n)| *n as f64).sum::<f64>() / own().count().max(1) as f64;
        (inputs[i].input, times * inputs[i].share)
    };
    (0..inputs.len()).map(of).collect()
}

fn chunked(plan: &Plan, group: &Group, w: WireId) -> Option<Chunked> {
    let wire = &plan.graph.wires[w];
    let Producer::Input(input) = wire.producer else { return None };
    let chunk = plan.input_chunks[input]?;
    // Nobody knows how much of it a mask leaves: as if everything were needed.
    let bytes = (chunk.iter().product::<usize>() * wire.components * wire.dtype.size()) as u64;
    let mut halo = plan.graph.wires[w].halo;
    let swept = group.steps.iter().map(|&s| &plan.graph.steps[s]).filter(|s| s.streamed == Some(w));
    let mut passes = 1;
    for step in swept {
        halo = std::array::from_fn(|a| halo[a].max(step.halo[a] + step.reach[a]));
        passes = SWEEP_PASSES;
    }
    let whole = Region::whole(group.shape);
    let count = |r: Region| r.cells([0; 3], chunk).voxels() as f64;
    let share = count(group.region.grow(halo).clip(&whole)) / count(whole);
    Some(Chunked { input, chunk, bytes, halo, share, passes })
}

/// Chunks in the order in which bricks visit them, by number, and the input of each number.
fn visits(group: &Group, inputs: &[Chunked]) -> (Vec<u32>, Vec<usize>) {
    let whole = Region::whole(group.shape);
    let (mut numbers, mut of, mut visits) = (HashMap::new(), Vec::new(), Vec::new());
    let [_, ny, nx] = group.tasks;
    // The first along the curve, whatever the volume's size.
    let first = Region::whole(group.tasks.map(|n| n.min(MOST_ALONG)));
    let mut tasks: Vec<[i64; 3]> = first.iter().collect();
    tasks.sort_by_key(|t| morton(*t));
    let number = |[z, y, x]: [i64; 3]| (z as usize * ny + y as usize) * nx + x as usize;
    for brick in tasks.into_iter().map(number).flat_map(|t| group.bricks(group.task_region(t))) {
        for (i, input) in inputs.iter().enumerate() {
            let cells = brick.grow(input.halo).clip(&whole).cells([0; 3], input.chunk);
            for _ in 0..input.passes {
                for cell in cells.iter() {
                    visits.push(*numbers.entry((i, cell)).or_insert_with(|| {
                        of.push(i);
                        of.len() as u32 - 1
                    }));
                }
            }
        }
        if visits.len() > MOST_VISITS {
            break;
        }
    }
    (visits, of)
}

/// How often each chunk is decoded by a cache of `limit` bytes that lets go of what is needed last, as the run's does.
fn play(visits: &[u32], bytes: &[u64], limit: u64) -> Vec<u32> {
    const NEVER: usize = usize::MAX;
    let mut seen = vec![NEVER; bytes.len()];
    let mut next = vec![NEVER; visits.len()];
    for (i, &chunk) in visits.iter().enumerate().rev() {
        next[i] = std::mem::replace(&mut seen[chunk as usize], i);
    }
    let (mut counts, mut held, mut used) = (vec![0; bytes.len()], BTreeSet::new(), 0);
    for (i, &chunk) in visits.iter().enumerate() {
        let size = bytes[chunk as usize];
        if !held.remove(&(i, chunk)) {
            counts[chunk as usize] += 1;
            used += size;
        }
        if next[i] == NEVER {
            used -= size;
        } else {
            held.insert((next[i], chunk));
        }
        while used > limit {
            let Some((_, gone)) = held.pop_last() else { break };
            used -= bytes[gone as usize];
        }
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_lets_go_of_what_is_needed_last() {
        let visits = [0, 1, 2, 0, 1, 2];
        assert_eq!(play(&visits, &[10; 3], 30), [1, 1, 1]);
        assert_eq!(play(&visits, &[10; 3], 20), [1, 1, 2], "2 goes, and comes back when 0 is done");
        assert_eq!(play(&visits, &[10; 3], 0), [2, 2, 2]);
        assert_eq!(play(&[0, 0, 0], &[10], 9), [3], "a chunk beyond the cache");
        assert_eq!(play(&[0, 1, 2], &[10; 3], 0), [1, 1, 1], "nothing is needed twice");
    }
}
