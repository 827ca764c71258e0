//! Exact counts for keys of 8 or 16 bits through thresholds: the values of a tile's centres are its thresholds, and
//! [`sums`](crate::kernel::levels) counts every window below all of them at a cost that does not depend on the radius. Where
//! a tile has too many values, thresholds bound buckets of about equally many voxels, and voxels of the centre's own bucket
//! are counted one by one ([`super::buckets`]).

use super::buckets::{self, Buckets};
use super::read::{Counting, Group, MOST, Mask, Places, extent, quotient};
use super::{Key, Plan, ToKey, gone};
use crate::brick::scratch::{cut, padded};
use crate::grid::{DType, Shape, View, ViewMut};
use crate::kernel::levels::search::{as_bytes, bytes};
use crate::kernel::levels::sums::{Asked, NEVER, Sum, Tile, Windows, Work, sweep};
use crate::kernel::simd::{Level, fetch};
use crate::multiversion;
use crate::stage::Ties;

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
    /// At radius 10 with 256 thresholds, 64 x 256 rows and columns take 16.4 ns per voxel, 64 x 128 take 16.7, 48 x 128 take 17.9,
    /// 64 x 96 take 18.2, 32 x 256 take 17.7: edges cost more than columns beyond the L2 cache (2-core Zen 4 VM, AVX-512,
    /// 2026-11-27).
    const TILE: Shape = [128, 64, 256];
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

/// Voxels of a window from which this way is the faster one. 8 bits, 256 thresholds: at radius 3 (343 voxels) comparing takes
/// 8.7 ns per voxel and this 13.4, at radius 4 (729) 12.4 and 13.7, at radius 5 (1331) 18.3 and 14.2, at radius 6 25.2 and 14.3,
/// at radius 8 48.3 and 15.3. 16 bits with many values: at radius 8 (4913) 92 and 222, at radius 11 (12167) 207 and 265, at
/// radius 12 (15625) 265 and 207; at radius 64 this takes 2.3 us, and comparing, which grows with the window, some 38 us by
/// extrapolation. One insertion of all voxels in the order of their keys into sums over blocks took 130 ns at radius 10 in a
/// prototype and 5 us at 64 (2-core Zen 4 VM, AVX-512, 2026-11-27).
const FROM: [usize; 2] = [900, 15_000];

/// Whether windows are counted this way: their planes fit in a byte, and there are enough voxels.
pub(super) fn serves(plan: &Plan, dtype: DType) -> bool {
    plan.reach.is_empty()
        && (2 * plan.radius[0] + 1).min(plan.src[0]) <= usize::from(u8::MAX)
        && pays(plan.radius, dtype)
}

/// Whether windows have enough voxels for this way.
pub(super) fn pays(radius: [usize; 3], dtype: DType) -> bool {
    let window = radius.map(|r| 2 * r.min(1 << 20) + 1);
    window.iter().product::<usize>() > FROM[usize::from(dtype.size() > 1)]
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
    let gaps = fill_codes::<T, K>(level, source, table, codes);
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
fn fill_codes<T: ToKey<K>, K: Index>(level: Level, source: &Source<T>, table: &[u8], codes: &mut [u8]) -> bool {
    let mut any = false;
    let [_, rows, width] = source.view.shape;
    for (i, codes) in codes.chunks_exact_mut(width).enumerate() {
        let row = source.view.row_at(i / rows, i % rows);
        match (as_bytes(row), table.first_chunk()) {
            // Indices are the bits, turned around or not.
            (Some(row), Some(table)) => bytes(level, row, table, source.index::<K>(T::default()) as u8, codes),
            _ => codes.iter_mut().zip(row).for_each(|(c, v)| *c = table[source.index::<K>(*v)]),
        }
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
        let (windows, mut places) = (Windows::of_columns(tile), Places::new());
        for group in self.groups::<L>() {
            let lanes = group.lanes();
            let centres = |z: usize, y: usize| {
                let place = ((tile.at[0] + z) * tile.src[1] + tile.at[1] + y) * tile.src[2] + tile.at[2];
                &self.codes[place..][..tile.dst[2]]
            };
            let asked = |z: usize| {
                let mut all = Mask::default();
                let mut rows = 0;
                for y in 0..tile.dst[1] {
                    let own = group.members(self.level, centres(z, y));
                    if own != Mask::default() {
                        rows = y + 1;
                        all.iter_mut().zip(own).for_each(|(all, own)| *all |= own);
                    }
                }
                Asked { rows, columns: extent(all) }
            };
            sweep::<S, L>(self.level, self.codes, tile, &lanes, &mut work, asked, |z, y, row| {
                let centres = centres(z, y);
                let rows = (tile.window(0, z).len() * tile.window(1, y).len()) as u32;
                let counting = Counting { centres, row, windows: &windows, rows, group: &group };
                match buckets {
                    None => {
                        if y + 1 < tile.dst[1] {
                            fetch(out.row_at(z, y + 1));
                        }
                        counting.openness(self.level, &mut places, out.row_at(z, y));
                    }
                    Some(b) => {
                        let (counted, sizes, single) = b.row_mut(tile, z, y);
                        counting.counts(self.level, single, counted, sizes);
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
