//! Decoded chunks of all inputs under one byte limit. The order of bricks is known, so every chunk knows how many bricks
//! will still read it, and which next: it leaves when the last one has, and under pressure the one that is needed last goes
//! first (Belady, IBM Systems Journal 5, 1966).

use std::cmp::Reverse;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Condvar, Mutex};

use super::metrics::Metrics;
use crate::Result;
use crate::brick::{Pool, Voxels};
use crate::grid::{Region, Shape};
use crate::store::Source;
use crate::store::source::ChunkRead;

/// Which chunk: input, component, index.
type Key = (usize, usize, [i64; 3]);

/// What is known of a chunk's future when a brick reads it.
#[derive(Debug, Clone, Copy)]
pub struct Future {
    /// Bricks of the stream that read it, or `None` if this is no brick's read: a mask looks at it, and the brick itself may
    /// still read it.
    pub uses: Option<u32>,
    /// Place in the order of bricks of the next that reads it, after this one; of this one where `uses` is `None`.
    pub next: u32,
    /// Place of the brick that reads it now.
    pub now: u32,
}

impl Future {
    /// Nobody knows: kept before all else, and of these the least recently used goes first.
    pub const UNKNOWN: Future = Future { uses: None, next: 0, now: 0 };
}

/// A decoded chunk.
#[derive(Debug, Clone)]
pub enum Chunk {
    /// Not stored: every voxel has this value.
    Missing(f64),
    Decoded(Arc<Voxels>),
}

#[derive(Debug)]
enum Slot {
    Loading,
    Ready { chunk: Chunk, bytes: u64, next: u32, last: u64 },
}

#[derive(Debug, Default)]
struct State {
    slots: HashMap<Key, Slot>,
    /// Bricks that will still read a chunk; absent = not counted yet.
    left: HashMap<Key, u32>,
    bytes: u64,
    /// Bytes of chunks that are being decoded, packed and unpacked.
    decoding: u64,
    clock: u64,
    /// Furthest place that was read for.
    front: u32,
}

/// Bricks that may be read out of order: a chunk kept for a place further behind than this is not waited for any more.
const BEHIND: u32 = 64;

impl State {
    /// What a chunk is evicted by, greatest first.
    fn rank(&self, next: u32) -> u32 {
        let given_up = next > 0 && next.saturating_add(BEHIND) < self.front;
        if given_up { u32::MAX } else { next }
    }
}

/// Shared by the readers of one stream.
#[derive(Debug)]
pub struct ChunkCache {
    limit: u64,
    state: Mutex<State>,
    loaded: Condvar,
}

impl ChunkCache {
    pub fn new(limit: u64) -> ChunkCache {
        ChunkCache { limit, state: Mutex::default(), loaded: Condvar::new() }
    }

    /// One chunk for one brick: from the cache, or decoded once even if several ask.
    pub fn get(&self, source: &Source, key: Key, future: Future, pool: &Pool, metrics: &Metrics) -> Result<Chunk> {
        let takes = 2 * chunk_bytes(source);
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        state.front = state.front.max(future.now);
        loop {
            state.clock += 1;
            let now = state.clock;
            let busy = state.decoding > 0 && state.decoding + takes > AT_ONCE;
            match state.slots.get_mut(&key) {
                Some(Slot::Ready { chunk, last, next, .. }) => {
                    (*last, *next) = (now, future.next);
                    let chunk = chunk.clone();
                    used(&mut state, key, future);
                    return Ok(chunk);
                }
                Some(Slot::Loading) => state = self.loaded.wait(state).unwrap_or_else(|e| e.into_inner()),
                None if busy => state = self.loaded.wait(state).unwrap_or_else(|e| e.into_inner()),
                None => break,
            }
        }
        state.slots.insert(key, Slot::Loading);
        state.decoding += takes;
        drop(state);
        // Readers that wait for the chunk must hear of a panic, too.
        let loaded = catch_unwind(AssertUnwindSafe(|| load(source, key, pool, metrics)));
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        state.decoding -= takes;
        let loaded = loaded.unwrap_or_else(|cause| {
            state.slots.remove(&key);
            self.loaded.notify_all();
            resume_unwind(cause)
        });
        let result = match loaded {
            Ok((chunk, bytes)) => {
                let last = state.clock;
                state.bytes += bytes;
                state.slots.insert(key, Slot::Ready { chunk: chunk.clone(), bytes, next: future.next, last });
                used(&mut state, key, future);
                self.evict(&mut state);
                Ok(chunk)
            }
            Err(e) => {
                state.slots.remove(&key);
                Err(e)
            }
        };
        self.loaded.notify_all();
        result
    }

    fn evict(&self, state: &mut State) {
        while state.bytes > self.limit {
            let latest = state
                .slots
                .iter()
                .filter_map(|(k, s)| match s {
                    Slot::Ready { next, last, bytes, .. } if *bytes > 0 => {
                        Some((state.rank(*next), Reverse(*last), *k))
                    }
                    _ => None,
                })
                .max();
            match latest {
                Some((_, _, key)) => remove(state, key),
                None => break,
            }
        }
    }
}

/// Counts one use; after the last the chunk leaves.
fn used(state: &mut State, key: Key, future: Future) {
    let Some(uses) = future.uses else { return };
    let left = state.left.entry(key).or_insert(uses);
    *left = left.saturating_sub(1);
    if *left == 0 {
        state.left.remove(&key);
        remove(state, key);
    }
}

fn remove(state: &mut State, key: Key) {
    if let Some(Slot::Ready { bytes, .. }) = state.slots.remove(&key) {
        state.bytes -= bytes;
    }
}

/// Bytes that chunks may take together while several are decoded, from as much again at worst: less than what one chunk may take
/// beside the budget.
const AT_ONCE: u64 = 64 << 20;

fn chunk_bytes(source: &Source) -> u64 {
    let info = source.info();
    info.chunk.map_or(0, |c| c.iter().product::<usize>() * info.dtype.size()) as u64
}

fn load(source: &Source, key: Key, pool: &Pool, metrics: &Metrics) -> Result<(Chunk, u64)> {
    let info = source.info();
    let shape = info.chunk.expect("a chunked source has a chunk shape");
    let mut voxels = pool.take(info.dtype, shape.iter().product());
    match source.read_chunk(key.1, key.2, &mut voxels)? {
        ChunkRead::Missing(value) => {
            pool.put(voxels);
            Ok((Chunk::Missing(value), 0))
        }
        ChunkRead::Data { stored_bytes } => {
            metrics.bytes_read(stored_bytes);
            let bytes = voxels.capacity_bytes() as u64;
            pool.part_with(&voxels);
            Ok((Chunk::Decoded(Arc::new(voxels)), bytes))
        }
    }
}

/// Which of the stream's bricks read a chunk. Bricks are boxes of intervals per axis.
#[derive(Debug, Clone)]
pub struct Uses {
    chunk: Shape,
    /// Chunk index along each axis of the first one that a brick may touch.
    first: [i64; 3],
    /// Per axis and chunk index along it, from there to the last: the intervals that touch it, half-open.
    touching: [Vec<(u32, u32)>; 3],
    /// Intervals per axis.
    counts: Shape,
    /// Place in the order by the brick's intervals; `ABSENT` where there is none.
    order: Vec<u32>,
}

const ABSENT: u32 = u32::MAX;

impl Uses {
    /// `bricks` are the stream's bricks in order, grown by their halo and clipped.
    pub fn new(bricks: &[Region], chunk: Shape) -> Uses {
        let intervals: [Vec<(i64, i64)>; 3] = std::array::from_fn(|a| {
            let mut list: Vec<(i64, i64)> = bricks.iter().map(|b| (b.lo[a], b.hi[a])).collect();
            list.sort_unstable();
            list.dedup();
            list
        });
        let all = bricks.iter().fold(Region::whole([0; 3]), |all, b| all.union(b)).cells([0; 3], chunk);
        let touching = std::array::from_fn(|a| {
            let cells = all.lo[a]..all.hi[a];
            let (edge, list) = (chunk[a] as i64, &intervals[a]);
            let of = |c: i64| {
                let first = list.partition_point(|i| i.1 <= c * edge);
                (first as u32, (first + list[first..].partition_point(|i| i.0 < (c + 1) * edge)) as u32)
            };
            cells.map(of).collect()
        });
        let counts = intervals.each_ref().map(Vec::len);
        let mut order = vec![ABSENT; counts.iter().product()];
        for (place, b) in bricks.iter().enumerate() {
            let at: [usize; 3] = std::array::from_fn(|a| intervals[a].partition_point(|i| *i < (b.lo[a], b.hi[a])));
            order[(at[0] * counts[1] + at[1]) * counts[2] + at[2]] = place as u32;
        }
        Uses { chunk, first: all.lo, touching, counts, order }
    }

    /// The future of a chunk that the brick at place `now` reads.
    pub fn of(&self, chunk: [i64; 3], now: u32) -> Future {
        let (mut uses, mut next) = (0u32, ABSENT);
        let of = |a: usize| self.touching[a].get(usize::try_from(chunk[a] - self.first[a]).ok()?).copied();
        let [z, y, x] = [0, 1, 2].map(|a| of(a).unwrap_or((0, 0)));
        for z in z.0..z.1 {
            for y in y.0..y.1 {
                let row = (z as usize * self.counts[1] + y as usize) * self.counts[2];
                for &place in &self.order[row + x.0 as usize..row + x.1 as usize] {
                    uses += (place != ABSENT) as u32;
                    if place > now {
                        next = next.min(place);
                    }
                }
            }
        }
        Future { uses: Some(uses.max(1)), next, now }
    }

    /// Chunks that a box touches.
    pub fn chunks(&self, region: Region) -> Region {
        region.cells([0; 3], self.chunk)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn futures_are_those_of_the_order() {
        let (volume, chunk) = (Region::whole([90, 50, 70]), [16, 32, 10]);
        let mut bricks: Vec<Region> = volume
            .cells([0; 3], [32, 16, 40])
            .iter()
            .map(|c| Region::of_cell(c, [0; 3], [32, 16, 40]).grow([5, 7, 3]).clip(&volume))
            .collect();
        bricks.reverse();
        bricks.remove(4); // not every product of intervals is a brick
        let uses = Uses::new(&bricks, chunk);
        for c in volume.cells([0; 3], chunk).iter() {
            let cell = Region::of_cell(c, [0; 3], chunk).clip(&volume);
            let readers: Vec<u32> =
                (0..bricks.len()).filter(|&b| !bricks[b].clip(&cell).is_empty()).map(|b| b as u32).collect();
            for now in 0..bricks.len() as u32 {
                let next = readers.iter().copied().find(|&b| b > now).unwrap_or(ABSENT);
                let future = uses.of(c, now);
                assert_eq!((future.uses, future.next), (Some(readers.len().max(1) as u32), next), "{c:?} {now}");
            }
        }
    }
}
