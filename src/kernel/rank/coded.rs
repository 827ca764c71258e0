//! Exact counts for keys of 8 or 16 bits through thresholds: the values of a tile's centres are its thresholds, and
//! [`sums`](crate::kernel::levels) counts every window below all of them at a cost that does not depend on the radius. Where
//! a tile has too many values, thresholds bound buckets of about equally many voxels, and voxels of the centre's own bucket
//! are counted one by one ([`super::buckets`]).

use super::buckets::{self, Buckets};
use super::{Key, Plan, ToKey, gone};
use crate::brick::scratch::{cut, padded};
use crate::grid::{DType, Shape, View, ViewMut};
use crate::kernel::levels::sums::{NEVER, Row, Sum, Tile, Windows, Work, sweep};
use crate::kernel::simd::Level;
use crate::multiversion;
use crate::stage::Ties;

/// Most thresholds of a tile.
const MOST: usize = 256;
/// Most of them that one sweep counts.
const LANES: usize = 64;

/// Keys as indices that ascend with them.
pub(super) trait Index: Key {
    const KEYS: usize;
    /// Planes, rows and columns of a tile.
    const TILE: Shape;
    fn index(self) -> usize;
}

impl Index for i8 {
    const KEYS: usize = 1 << 8;
    /// At radius 10 with 256 thresholds, 64 x 128 rows and columns take 21.9 ns per voxel, 64 x 96 take 24.5, 64 x 64 take
    /// 24.8, 96 x 96 in a later build 21.6 beside 19.8: 64 thresholds' columns fill most of the L2 cache, and the rest is
    /// edges (2-core Zen 4 VM, AVX-512, 2026-11-26).
    const TILE: Shape = [128, 64, 128];
    #[inline(always)]
    fn index(self) -> usize {
        usize::from(self as u8 ^ 0x80)
    }
}

impl Index for i16 {
    const KEYS: usize = 1 << 16;
    const TILE: Shape = [64, 64, 64];
    #[inline(always)]
    fn index(self) -> usize {
        usize::from(self as u16 ^ 0x8000)
    }
}

/// What is read from the source.
pub(super) struct Source<'a, T> {
    pub view: View<'a, T>,
    pub missing: Option<T>,
    pub flipped: bool,
}

impl<T: crate::grid::Voxel> Source<'_, T> {
    #[inline(always)]
    pub fn index<K: Index>(&self, v: T) -> usize
    where
        T: ToKey<K>,
    {
        v.key(self.flipped).index()
    }

    /// Index of the missing value.
    fn lost<K: Index>(&self) -> Option<usize>
    where
        T: ToKey<K>,
    {
        self.missing.map(|m| self.index::<K>(m))
    }
}

/// Bytes of scratch that [`count_all`] takes at most.
pub(super) fn scratch_bytes<K: Index>(plan: &Plan) -> usize {
    let tile = Tile::largest(plan.src, plan.dst, plan.radius, K::TILE);
    let buckets = if K::KEYS > MOST { buckets::scratch_bytes(&tile, K::KEYS) } else { 0 };
    padded::<u8>(K::KEYS) + padded::<u8>(tile.codes()) + Work::<u32>::bytes(&tile, LANES) + buckets
}

/// Voxels of a window from which this way is the faster one. 8 bits: at radius 5 (1331 voxels) comparing takes 18.7 ns per
/// voxel and this 24.7, at radius 10 sliding histograms take 73.6 and this 36.5 (19.8 since one group of thresholds is swept
/// after the other). 16 bits with many values: at radius 10 (9261 voxels) comparing takes 166 and this 217; at radius 64 this
/// takes 2.3 us, and comparing, which grows with the window, some 38 us by extrapolation. One insertion of all voxels in the
/// order of their keys into sums over blocks took 130 ns at radius 10 in a prototype and 5 us at 64 (2-core Zen 4 VM, AVX-512,
/// 2026-11-26).
const FROM: [usize; 2] = [1500, 15_000];

/// Whether windows are counted this way: their planes fit in a byte, and there are enough voxels.
pub(super) fn serves(plan: &Plan, dtype: DType) -> bool {
    let window = plan.radius.map(|r| 2 * r + 1);
    let from = FROM[usize::from(dtype.size() > 1)];
    plan.reach.is_empty()
        && window[0].min(plan.src[0]) <= usize::from(u8::MAX)
        && window.iter().product::<usize>() > from
}

/// Writes the openness of every voxel.
pub(super) fn count_all<T: ToKey<K>, K: Index>(
    level: Level,
    source: &Source<T>,
    plan: &Plan,
    bytes: &mut [u8],
    dst: &mut ViewMut<f32>,
) {
    let (table, bytes) = cut::<u8>(bytes, K::KEYS);
    for ([z, y, x], first, tile) in Tile::all(plan.src, plan.dst, plan.at, plan.radius, K::TILE) {
        let part = Source { view: source.view.part(first, tile.src), ..*source };
        let (codes, bytes) = cut::<u8>(bytes, tile.codes());
        let start = dst.data.len().min(z * dst.plane + y * dst.row + x);
        let mut out = ViewMut { data: &mut dst.data[start..], shape: tile.dst, plane: dst.plane, row: dst.row };
        count_tile::<T, K>(level, &part, &tile, plan.ties, table, codes, bytes, &mut out);
    }
}

#[allow(clippy::too_many_arguments)]
fn count_tile<T: ToKey<K>, K: Index>(
    level: Level,
    source: &Source<T>,
    tile: &Tile,
    ties: Ties,
    table: &mut [u8],
    codes: &mut [u8],
    bytes: &mut [u8],
    out: &mut ViewMut<f32>,
) {
    let single = mark_values::<T, K>(source, tile, ties, table);
    let (mut buckets, bytes) = if single.is_none() {
        let (found, rest) = Buckets::fill::<T, K>(source, tile, table, bytes);
        (Some(found), rest)
    } else {
        (None, bytes)
    };
    let thresholds = single.or(buckets.as_ref().map(|b| b.thresholds)).unwrap_or(0);
    let gaps = fill_codes::<T, K>(source, table, codes);
    let job = Job { level, codes, tile, thresholds, gaps, ties };
    match (thresholds < 32, tile.fits::<u16>()) {
        (true, true) => job.run::<u16, 32>(bytes, &mut buckets, out),
        (true, false) => job.run::<u32, 32>(bytes, &mut buckets, out),
        (false, true) => job.run::<u16, 64>(bytes, &mut buckets, out),
        (false, false) => job.run::<u32, 64>(bytes, &mut buckets, out),
    }
    if let Some(buckets) = &mut buckets {
        buckets.correct(level, tile, ties, table);
        for (z, y) in (0..tile.dst[0]).flat_map(|z| (0..tile.dst[1]).map(move |y| (z, y))) {
            let (counted, sizes) = buckets.row(tile, z, y);
            divide(level, counted, sizes, out.row_at(z, y));
        }
    }
    if gaps {
        erase_missing(source, tile, out);
    }
}

/// Codes by key: how many of the values of a tile's centres (and the next smaller ones, where ties need them) lie below.
/// Returns the number of thresholds, or nothing where there are too many.
fn mark_values<T: ToKey<K>, K: Index>(source: &Source<T>, tile: &Tile, ties: Ties, table: &mut [u8]) -> Option<usize> {
    let lost = source.lost::<K>();
    table.fill(0);
    let centres = source.view.part(tile.at, tile.dst);
    for (z, y) in (0..tile.dst[0]).flat_map(|z| (0..tile.dst[1]).map(move |y| (z, y))) {
        centres.row_at(z, y).iter().for_each(|v| table[source.index::<K>(*v)] = 1);
    }
    if ties == Ties::Mid {
        for key in (1..K::KEYS).filter(|k| Some(*k) != lost) {
            // The missing value is no threshold: nothing else is equal to it.
            let before = if Some(key - 1) == lost { key.wrapping_sub(2) } else { key - 1 };
            if table[key] & 1 == 1 && before < K::KEYS {
                table[before] |= 2;
            }
        }
    }
    let mut below = 0;
    for (key, entry) in table.iter_mut().enumerate() {
        let threshold = *entry != 0 && Some(key) != lost;
        *entry = below.min(usize::from(NEVER)) as u8;
        below += usize::from(threshold);
    }
    // Codes of voxels above every threshold, and [`NEVER`] for missing ones, must be codes of their own.
    let most = if K::KEYS <= MOST { K::KEYS } else { usize::from(NEVER) - 1 };
    (below <= most).then_some(below)
}

/// Codes of the source box; returns whether any voxel is missing.
fn fill_codes<T: ToKey<K>, K: Index>(source: &Source<T>, table: &[u8], codes: &mut [u8]) -> bool {
    let mut any = false;
    let [_, rows, width] = source.view.shape;
    for (i, codes) in codes.chunks_exact_mut(width).enumerate() {
        let row = source.view.row_at(i / rows, i % rows);
        codes.iter_mut().zip(row).for_each(|(c, v)| *c = table[source.index::<K>(*v)]);
        if source.missing.is_some() {
            for (c, _) in codes.iter_mut().zip(row).filter(|(_, v)| gone(**v, source.missing)) {
                *c = NEVER;
                any = true;
            }
        }
    }
    any
}

fn erase_missing<T: crate::grid::Voxel>(source: &Source<T>, tile: &Tile, out: &mut ViewMut<f32>) {
    let centres = source.view.part(tile.at, tile.dst);
    for (z, y) in (0..tile.dst[0]).flat_map(|z| (0..tile.dst[1]).map(move |y| (z, y))) {
        let lost = out.row_at(z, y).iter_mut().zip(centres.row_at(z, y)).filter(|(_, v)| gone(**v, source.missing));
        lost.for_each(|(o, _)| *o = f32::NAN);
    }
}

/// One tile.
struct Job<'a> {
    level: Level,
    codes: &'a [u8],
    tile: &'a Tile,
    thresholds: usize,
    /// Voxels are missing.
    gaps: bool,
    ties: Ties,
}

impl Job<'_> {
    /// Counts of every window, a group of thresholds after the other: quotients to `out`, or counts to the buckets, which
    /// correct them first.
    fn run<S: Sum, const L: usize>(&self, bytes: &mut [u8], buckets: &mut Option<Buckets>, out: &mut ViewMut<f32>) {
        let tile = self.tile;
        let mut work = Work::<S>::cut(bytes, tile, L);
        let windows = Windows::of_columns(tile);
        for group in self.groups::<L>() {
            let lanes = group.lanes();
            sweep::<S, L>(self.level, self.codes, tile, &lanes, &mut work, |z, y, row| {
                let place = ((tile.at[0] + z) * tile.src[1] + tile.at[1] + y) * tile.src[2] + tile.at[2];
                let centres = &self.codes[place..][..tile.dst[2]];
                let rows = (tile.window(0, z).len() * tile.window(1, y).len()) as u32;
                let counting = Counting { centres, row, windows: &windows, rows, group: &group };
                match buckets {
                    None => {
                        if y + 1 < tile.dst[1] {
                            fetch(out.row_at(z, y + 1));
                        }
                        quotients(self.level, counting, out.row_at(z, y));
                    }
                    Some(b) => {
                        let (counted, sizes, single) = b.row_mut(tile, z, y);
                        counts(self.level, counting, single, counted, sizes);
                    }
                }
            });
        }
    }

    /// Groups of codes, each with the thresholds that its voxels need.
    fn groups<const L: usize>(&self) -> impl Iterator<Item = Group> {
        let mid = self.ties == Ties::Mid;
        let step = L - usize::from(self.gaps) - usize::from(mid);
        (0..self.thresholds).step_by(step).map(move |code| Group {
            code: code as u8,
            codes: step.min(self.thresholds - code) as u8,
            first: code.saturating_sub(usize::from(mid)) as u8,
            gaps: self.gaps,
            mid,
        })
    }
}

/// Codes whose voxels are counted in one sweep.
struct Group {
    code: u8,
    codes: u8,
    /// Threshold of the first lane; the others follow.
    first: u8,
    /// The last lane counts all voxels but missing ones.
    gaps: bool,
    /// Voxels below the centre are counted as well.
    mid: bool,
}

impl Group {
    fn lanes<const L: usize>(&self) -> [u8; L] {
        std::array::from_fn(|k| match self.gaps && k == L - 1 {
            true => NEVER - 1,
            false => self.first.saturating_add(k as u8),
        })
    }
}

/// Asks for a row that is written soon: of all voxels, a group writes a few here and there.
#[inline(always)]
fn fetch(row: &[f32]) {
    #[cfg(target_arch = "x86_64")]
    for line in row.chunks(16) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint, and every x86-64 has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(line.as_ptr().cast()) };
    }
    let _ = row;
}

/// A row of centres, and what its windows are counted by.
struct Counting<'a, S, const L: usize> {
    centres: &'a [u8],
    row: Row<'a, S, L>,
    windows: &'a Windows,
    /// Rows of each window.
    rows: u32,
    group: &'a Group,
}

impl<S: Sum, const L: usize> Counting<'_, S, L> {
    /// Which of up to 64 centres from `first` on are of the group: bit i for centre i.
    #[inline(always)]
    fn members(&self, first: usize) -> u64 {
        let centres = &self.centres[first..];
        let (code, codes) = (self.group.code, self.group.codes);
        let mut padded = [code.wrapping_sub(1); 64];
        let n = centres.len().min(64);
        padded[..n].copy_from_slice(&centres[..n]);
        let mut mask = 0;
        for (i, c) in padded.iter().enumerate() {
            mask |= u64::from(c.wrapping_sub(code) < codes) << i;
        }
        mask
    }

    /// Voxels not above centre `x`, with `ties = "mid"` plus those below it, and the size of the window (twice); `alone`: the
    /// code stands for one value. Where it does not, all of its voxels count as not above.
    #[inline(always)]
    fn count(&self, x: usize, alone: bool) -> (u32, u32) {
        let (columns, code, group) = (self.windows.of(x), self.centres[x], self.group);
        let lane = usize::from(code.wrapping_sub(group.first)) % L;
        let counted = self.row.count(&columns, lane);
        let size = if group.gaps { self.row.count(&columns, L - 1) } else { self.rows * columns.len() as u32 };
        if !group.mid {
            return (counted, size);
        }
        let below = match code {
            _ if !alone => counted,
            0 => 0,
            _ => self.row.count(&columns, (lane + L - 1) % L),
        };
        (counted + below, 2 * size)
    }
}

multiversion! {
    /// Openness of the centres of a group.
    fn quotients['a, S: Sum, const L: usize](counting: Counting<'a, S, L>, out: &mut [f32]) -> () = quotients_inner;
}

#[inline(always)]
fn quotients_inner<S: Sum, const L: usize>(counting: Counting<S, L>, out: &mut [f32]) {
    for first in (0..counting.centres.len()).step_by(64) {
        let mut mask = counting.members(first);
        while mask != 0 {
            let x = first + mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let (counted, size) = counting.count(x, true);
            // Integers below 2^24 are f32, and their quotient is rounded once.
            let narrow = 2 * S::MOST < 1 << 24;
            out[x] = if narrow { counted as f32 / size as f32 } else { quotient(counted, size) };
        }
    }
}

multiversion! {
    /// Counts of the centres of a group; `single` says whether a code stands for one value.
    fn counts['a, S: Sum, const L: usize](
        counting: Counting<'a, S, L>, single: &[bool; MOST], counted: &mut [u32], sizes: &mut [u32],
    ) -> () = counts_inner;
}

#[inline(always)]
fn counts_inner<S: Sum, const L: usize>(
    counting: Counting<S, L>,
    single: &[bool; MOST],
    counted: &mut [u32],
    sizes: &mut [u32],
) {
    for first in (0..counting.centres.len()).step_by(64) {
        let mut mask = counting.members(first);
        while mask != 0 {
            let x = first + mask.trailing_zeros() as usize;
            mask &= mask - 1;
            (counted[x], sizes[x]) = counting.count(x, single[usize::from(counting.centres[x])]);
        }
    }
}

/// The quotient of two integers below 2^53, rounded to f64 and then to f32 as if at once (see `Counts::openness`).
#[inline(always)]
fn quotient(counted: u32, size: u32) -> f32 {
    (f64::from(counted) / f64::from(size)) as f32
}

multiversion! {
    /// Quotients of a row.
    fn divide[](counted: &[u32], sizes: &[u32], out: &mut [f32]) -> () = divide_inner;
}

#[inline(always)]
fn divide_inner(counted: &[u32], sizes: &[u32], out: &mut [f32]) {
    for ((o, c), n) in out.iter_mut().zip(counted).zip(sizes) {
        *o = quotient(*c, *n);
    }
}
