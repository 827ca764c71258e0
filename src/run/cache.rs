//! Decoded chunks of all inputs under one byte limit. Every chunk knows how many bricks will still read it, so it leaves
//! when the last one has; under pressure the least recently used goes first.

use std::collections::HashMap;
use std::sync::{Arc, Condvar, Mutex};

use super::metrics::Metrics;
use crate::Result;
use crate::brick::{Pool, Voxels};
use crate::grid::{Region, Shape};
use crate::store::Source;
use crate::store::source::ChunkRead;

/// Which chunk: input, component, index.
type Key = (usize, usize, [i64; 3]);

/// In place of a number of uses: a mask looks at the chunk, and the brick itself may still read it.
pub const UNCOUNTED: u32 = u32::MAX;

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
    Ready { chunk: Chunk, bytes: u64, last: u64 },
}

#[derive(Debug, Default)]
struct State {
    slots: HashMap<Key, Slot>,
    /// Bricks that will still read a chunk; absent = not counted yet.
    left: HashMap<Key, u32>,
    bytes: u64,
    clock: u64,
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

    /// One chunk for one brick: from the cache, or decoded once even if several ask. `uses` is how many bricks of the
    /// stream read this chunk.
    pub fn get(&self, source: &Source, key: Key, uses: u32, pool: &Pool, metrics: &Metrics) -> Result<Chunk> {
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        loop {
            state.clock += 1;
            let now = state.clock;
            match state.slots.get_mut(&key) {
                Some(Slot::Ready { chunk, last, .. }) => {
                    *last = now;
                    let chunk = chunk.clone();
                    self.used(&mut state, key, uses);
                    return Ok(chunk);
                }
                Some(Slot::Loading) => state = self.loaded.wait(state).unwrap_or_else(|e| e.into_inner()),
                None => break,
            }
        }
        state.slots.insert(key, Slot::Loading);
        drop(state);
        let loaded = load(source, key, pool, metrics);
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        let result = match loaded {
            Ok((chunk, bytes)) => {
                let last = state.clock;
                state.bytes += bytes;
                state.slots.insert(key, Slot::Ready { chunk: chunk.clone(), bytes, last });
                self.used(&mut state, key, uses);
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

    /// Counts one use; after the last the chunk leaves. A look that is no brick's read ([`UNCOUNTED`]) leaves the count alone.
    fn used(&self, state: &mut State, key: Key, uses: u32) {
        if uses == UNCOUNTED {
            return;
        }
        let left = state.left.entry(key).or_insert(uses);
        *left = left.saturating_sub(1);
        if *left == 0 {
            remove(state, key);
        }
    }

    fn evict(&self, state: &mut State) {
        while state.bytes > self.limit {
            let oldest = state
                .slots
                .iter()
                .filter_map(|(k, s)| match s {
                    Slot::Ready { last, bytes, .. } if *bytes > 0 => Some((*last, *k)),
                    _ => None,
                })
                .min();
            match oldest {
                Some((_, key)) => remove(state, key),
                None => break,
            }
        }
    }
}

fn remove(state: &mut State, key: Key) {
    if let Some(Slot::Ready { bytes, .. }) = state.slots.remove(&key) {
        state.bytes -= bytes;
    }
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
            metrics.chunks_decoded(1);
            let bytes = voxels.capacity_bytes() as u64;
            Ok((Chunk::Decoded(Arc::new(voxels)), bytes))
        }
    }
}

/// How many of the stream's bricks read a chunk: bricks are boxes of intervals per axis, so the counts multiply.
#[derive(Debug, Clone)]
pub struct Uses {
    chunk: Shape,
    /// Per axis and chunk index along it: the intervals that touch it.
    per_axis: [Vec<u32>; 3],
}

impl Uses {
    /// `intervals[a]` are the bricks' extents along axis `a`, already grown and clipped.
    pub fn new(intervals: &[Vec<(i64, i64)>; 3], chunk: Shape, volume: Shape) -> Uses {
        let per_axis = std::array::from_fn(|a| {
            let mut counts = vec![0u32; volume[a].div_ceil(chunk[a])];
            for &(lo, hi) in &intervals[a] {
                let (first, last) = (lo as usize / chunk[a], (hi as usize - 1) / chunk[a]);
                counts[first..=last].iter_mut().for_each(|c| *c += 1);
            }
            counts
        });
        Uses { chunk, per_axis }
    }

    pub fn of(&self, chunk: [i64; 3]) -> u32 {
        (0..3)
            .map(|a| self.per_axis[a].get(chunk[a] as usize).copied().unwrap_or(1))
            .fold(1u32, |p, n| p.saturating_mul(n))
    }

    /// Chunks that a box touches.
    pub fn chunks(&self, region: Region) -> Region {
        region.cells([0; 3], self.chunk)
    }
}
