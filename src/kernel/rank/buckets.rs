//! Voxels of the centre's own bucket, counted one by one, for tiles with more values than thresholds.
//!
//! The voxels of a tile in the order of their keys: a bucket is a run of it, and so are the voxels of a bucket above a
//! value. A window is three comparisons of coordinates, many voxels at a time, and a bucket stays in the L1 cache.

use super::ToKey;
use super::coded::{Index, Source};
use super::gone;
use crate::brick::scratch::{cut, padded};
use crate::kernel::levels::sums::{NEVER, Tile};
use crate::kernel::simd::Level;
use crate::multiversion;
use crate::stage::Ties;

/// Codes of a tile.
const CODES: usize = 256;

/// Bytes that [`Buckets::fill`] takes at most.
pub(super) fn scratch_bytes(tile: &Tile, keys: usize) -> usize {
    let voxels: usize = tile.dst.iter().product();
    2 * padded::<u32>(voxels) + padded::<u32>(keys + 1) + 3 * padded::<u16>(tile.codes())
}

/// A tile's voxels by their keys, and counts on the way.
pub(super) struct Buckets<'a> {
    pub thresholds: usize,
    /// Codes that stand for one value.
    single: [bool; CODES],
    /// First place of each key in the order, and the number of voxels.
    starts: &'a mut [u32],
    /// Coordinates in the order of the keys: planes, rows, columns.
    places: [&'a mut [u16]; 3],
    counted: &'a mut [u32],
    sizes: &'a mut [u32],
}

impl<'a> Buckets<'a> {
    /// Chooses thresholds, writes codes by key to `table` and orders the voxels.
    pub fn fill<T: ToKey<K>, K: Index>(
        source: &Source<T>,
        tile: &Tile,
        table: &mut [u8],
        bytes: &'a mut [u8],
    ) -> (Buckets<'a>, &'a mut [u8]) {
        let voxels: usize = tile.dst.iter().product();
        let (counted, bytes) = cut::<u32>(bytes, voxels);
        let (sizes, bytes) = cut::<u32>(bytes, voxels);
        let (starts, bytes) = cut::<u32>(bytes, K::KEYS + 1);
        let (z, bytes) = cut::<u16>(bytes, tile.codes());
        let (y, bytes) = cut::<u16>(bytes, tile.codes());
        let (x, bytes) = cut::<u16>(bytes, tile.codes());
        starts.fill(0);
        for (_, row) in rows(source, tile) {
            row.iter().filter(|v| !gone(**v, source.missing)).for_each(|v| starts[source.index::<K>(*v)] += 1);
        }
        let (thresholds, single) = choose(starts, table);
        // Counts to first places; filling moves each to its end, which is the next one's first.
        let mut sum = 0;
        for start in starts.iter_mut() {
            (*start, sum) = (sum, sum + *start);
        }
        for ([zz, yy], row) in rows(source, tile) {
            for (xx, v) in row.iter().enumerate().filter(|(_, v)| !gone(**v, source.missing)) {
                let start = &mut starts[source.index::<K>(*v)];
                let at = *start as usize;
                (z[at], y[at], x[at]) = (zz as u16, yy as u16, xx as u16);
                *start += 1;
            }
        }
        starts.copy_within(0..K::KEYS, 1);
        starts[0] = 0;
        (Buckets { thresholds, single, starts, places: [z, y, x], counted, sizes }, bytes)
    }

    /// Counts and window sizes of an output row.
    pub fn row(&self, tile: &Tile, z: usize, y: usize) -> (&[u32], &[u32]) {
        let (from, n) = ((z * tile.dst[1] + y) * tile.dst[2], tile.dst[2]);
        (&self.counted[from..from + n], &self.sizes[from..from + n])
    }

    /// The same to write, and which codes stand for one value.
    pub fn row_mut(&mut self, tile: &Tile, z: usize, y: usize) -> (&mut [u32], &mut [u32], &[bool; CODES]) {
        let (from, n) = ((z * tile.dst[1] + y) * tile.dst[2], tile.dst[2]);
        (&mut self.counted[from..from + n], &mut self.sizes[from..from + n], &self.single)
    }

    /// Takes voxels of the centre's bucket that are above it (with `ties = "mid"`, and those not below it) off the counts.
    pub fn correct(&mut self, level: Level, tile: &Tile, ties: Ties, table: &[u8]) {
        let mut key = 0;
        while key < table.len() {
            let code = table[key];
            let end = table[key..].iter().position(|c| *c != code).map_or(table.len(), |n| key + n);
            if !self.single[usize::from(code)] {
                let bucket_end = self.starts[end] as usize;
                for key in key..end {
                    let (from, to) = (self.starts[key] as usize, self.starts[key + 1] as usize);
                    for i in from..to {
                        self.correct_one(level, tile, ties, i, [from, to, bucket_end]);
                    }
                }
            }
            key = end;
        }
    }

    /// One voxel: `from..to` are those of its key, `to..end` those above it.
    fn correct_one(&mut self, level: Level, tile: &Tile, ties: Ties, i: usize, [from, to, end]: [usize; 3]) {
        let place: [usize; 3] = std::array::from_fn(|a| usize::from(self.places[a][i]));
        let inside = |a: usize| (tile.at[a]..tile.at[a] + tile.dst[a]).contains(&place[a]);
        if !(inside(0) && inside(1) && inside(2)) {
            return;
        }
        let at: [usize; 3] = std::array::from_fn(|a| place[a] - tile.at[a]);
        let window = [0, 1, 2].map(|a| tile.window(a, at[a]));
        let (low, reach) = (window.clone().map(|w| w.start as u16), window.map(|w| (w.len() - 1) as u16));
        let part = |from: usize, to: usize| [0, 1, 2].map(|a| &self.places[a][from..to]);
        let mut less = within(level, part(to, end), low, reach);
        if ties == Ties::Mid {
            less = 2 * less + within(level, part(from, to), low, reach);
        }
        self.counted[(at[0] * tile.dst[1] + at[1]) * tile.dst[2] + at[2]] -= less;
    }
}

/// Rows of the source with their planes and rows.
fn rows<'a, T: crate::grid::Voxel>(source: &Source<'a, T>, tile: &Tile) -> impl Iterator<Item = ([usize; 2], &'a [T])> {
    let (view, [planes, rows, _]) = (source.view, tile.src);
    (0..planes).flat_map(move |z| (0..rows).map(move |y| ([z, y], view.row_at(z, y))))
}

/// Codes by key from the number of voxels of each key: buckets of about equally many voxels, a key with more than that in one
/// of its own. Returns the number of thresholds and which codes stand for one value.
fn choose(counts: &[u32], table: &mut [u8]) -> (usize, [bool; CODES]) {
    let total: u64 = counts.iter().map(|c| u64::from(*c)).sum();
    // With an even share of twice as many codes two neighbours hold more than one share, so there are enough codes.
    for codes in [u64::from(NEVER) - 14, u64::from(NEVER) / 2 - 1] {
        let share = total / codes + 1;
        let (mut code, mut held, mut values, mut single) = (0usize, 0u64, 0, [true; CODES]);
        for (entry, count) in table.iter_mut().zip(counts) {
            let count = u64::from(*count);
            if count > 0 {
                if held > 0 && held + count > share {
                    (code, held, values) = (code + 1, 0, 0);
                }
                (held, values) = (held + count, values + 1);
                single[code.min(CODES - 1)] = values == 1;
            }
            *entry = code.min(CODES - 1) as u8;
        }
        if code + 1 < usize::from(NEVER) {
            return (code + 1, single);
        }
    }
    unreachable!("two neighbouring buckets hold more than a share")
}

multiversion! {
    /// Number of places within `reach` of `low` on every axis.
    fn within['a](places: [&'a [u16]; 3], low: [u16; 3], reach: [u16; 3]) -> u32 = within_inner;
}

#[inline(always)]
fn within_inner([z, y, x]: [&[u16]; 3], low: [u16; 3], reach: [u16; 3]) -> u32 {
    const RUN: usize = 64;
    let inside = |z: u16, y: u16, x: u16| {
        (z.wrapping_sub(low[0]) <= reach[0])
            & (y.wrapping_sub(low[1]) <= reach[1])
            & (x.wrapping_sub(low[2]) <= reach[2])
    };
    let (zs, zt) = z.as_chunks::<RUN>();
    let (ys, yt) = y.as_chunks::<RUN>();
    let (xs, xt) = x.as_chunks::<RUN>();
    let mut found = 0;
    // Counters of 16 bits hold so many runs.
    for start in (0..zs.len()).step_by(usize::from(u16::MAX)) {
        let end = zs.len().min(start + usize::from(u16::MAX));
        let mut counts = [0u16; RUN];
        for ((z, y), x) in zs[start..end].iter().zip(&ys[start..end]).zip(&xs[start..end]) {
            for i in 0..RUN {
                counts[i] += u16::from(inside(z[i], y[i], x[i]));
            }
        }
        found += counts.iter().map(|c| u32::from(*c)).sum::<u32>();
    }
    found + zt.iter().zip(yt).zip(xt).map(|((z, y), x)| u32::from(inside(*z, *y, *x))).sum::<u32>()
}
