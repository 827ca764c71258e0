//! Openness from window counts at quantile levels of the whole volume (local histograms smoothed by a box; see Kass and
//! Solomon 2010), interpolated between levels about as the volume's own distribution rises. Counts are exact integers, levels are the same for every brick.

mod choose;
mod codes;
pub mod reference;
pub(crate) mod sums;
mod vector;

pub use choose::{Levels, PARTS};

use super::Context;
use super::simd::Level;
use super::values::missing_as;
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Shape, View};
use crate::stage::{Ties, WindowParams};
use crate::{multiversion, with_view};
use codes::{Coded, Table, fill_codes, gone};
use sums::{NEVER, Row, Sum, Tile, Work, sweep};

/// Most levels of a volume.
pub const MOST_LEVELS: usize = 64;

/// Planes, rows and columns of a tile. With 32 levels at radius 10: 64 x 64 rows and columns 4.7 ns per voxel, 64 x 256 4.2
/// (2-core Zen 4 VM, AVX-512, 2026-11-26).
const TILE: Shape = [128, 96, 128];

/// Writes the openness of the box that starts at voxel `at` of `src`, with F(v) = share of the window's voxels not above
/// v: exact at levels, and between them rising much as the whole volume's does. `ties = "mid"`: mean of F(v) and of F below v, which for integers is F(v - 1).
/// A window of equal values gives 1 (0.5), a voxel at +inf 1, at -inf 0, a missing one NaN. `dst` has
/// `src.dtype().result()`. Panics if extents or types disagree.
pub fn levels(
    src: AnyView,
    levels: &Levels,
    params: &WindowParams,
    ties: Ties,
    at: [usize; 3],
    mut dst: AnyViewMut,
    cx: &mut Context,
) {
    let (from, to) = (src.shape(), dst.shape());
    assert_eq!(dst.dtype(), src.dtype().result(), "type of the openness of {}", src.dtype());
    assert!((0..3).all(|a| at[a] + to[a] <= from[a]), "the output box sticks out of the source");
    assert!(
        levels.at.len() <= MOST_LEVELS && levels.step.len() == levels.at.len() && levels.rise.len() == levels.at.len()
    );
    if to.contains(&0) {
        return;
    }
    let bytes = cx.scratch.take(scratch_bytes(src.dtype(), from, to, params));
    let radius: [usize; 3] = std::array::from_fn(|a| params.radius[a].min(from[a] - 1));
    with_view!(AnyView, src, v => {
        let (table, missing) = (Table::new(levels, params.flipped()), missing_as(params.missing));
        for (lo, first, tile) in Tile::all(from, to, at, radius, TILE) {
            one_tile(cx.level, v.part(first, tile.src), missing, &table, &tile, ties, bytes, lo, &mut dst);
        }
    });
}

/// Bytes of scratch that [`levels`] takes at most.
pub fn scratch_bytes(_dtype: DType, src: Shape, dst: Shape, params: &WindowParams) -> usize {
    let dst: Shape = std::array::from_fn(|a| TILE[a].min(dst[a]));
    let src: Shape = std::array::from_fn(|a| dst[a].saturating_add(params.radius[a].saturating_mul(2)).min(src[a]));
    let tile = Tile { src, dst, at: [0; 3], radius: params.radius };
    // One lane more counts every voxel, in whole groups.
    let lanes = MOST_LEVELS + 64;
    padded::<u8>(tile.codes()) + padded::<u8>(tile.columns(lanes)) + padded::<u32>(tile.sums(lanes))
}

#[allow(clippy::too_many_arguments)]
fn one_tile<T: Coded>(
    level: Level,
    src: View<T>,
    missing: Option<T>,
    table: &Table<T>,
    tile: &Tile,
    ties: Ties,
    bytes: &mut [u8],
    lo: [usize; 3],
    dst: &mut AnyViewMut,
) {
    let (codes, bytes) = cut::<u8>(bytes, tile.codes());
    let mut gaps = false;
    for (i, codes) in codes.chunks_exact_mut(tile.src[2]).enumerate() {
        let row = src.row_at(i / tile.src[1], i % tile.src[1]);
        gaps |= fill_codes(level, row, missing, table, codes);
    }
    let lanes = (table.levels() + usize::from(gaps)).max(1);
    let job = Job { level, src, missing, table, tile, ties, codes, gaps, lanes };
    match (lanes <= 32, tile.fits::<u16>()) {
        _ if !tile.planes_fit() => job.planes_beyond_bytes(lo, dst),
        (true, true) => job.run::<u16, 32>(bytes, lo, dst),
        (true, false) => job.run::<u32, 32>(bytes, lo, dst),
        (false, true) => job.run::<u16, 64>(bytes, lo, dst),
        (false, false) => job.run::<u32, 64>(bytes, lo, dst),
    }
}

/// One tile.
struct Job<'a, T: Coded> {
    level: Level,
    src: View<'a, T>,
    missing: Option<T>,
    table: &'a Table<T>,
    tile: &'a Tile,
    ties: Ties,
    codes: &'a [u8],
    /// Voxels are missing.
    gaps: bool,
    lanes: usize,
}

/// What is counted for a row of output voxels.
#[derive(Clone, Copy)]
pub(crate) struct Counts {
    /// Voxels of the window.
    n: [u32; TILE[2]],
    /// Those not above the level before the centre, and not above the next one.
    low: [u32; TILE[2]],
    high: [u32; TILE[2]],
}

impl<T: Coded> Job<'_, T> {
    fn run<S: Sum, const L: usize>(&self, bytes: &mut [u8], lo: [usize; 3], dst: &mut AnyViewMut) {
        let tile = self.tile;
        let groups = self.lanes.div_ceil(L);
        let (columns, bytes) = cut::<u8>(bytes, tile.columns(groups * L));
        let (sums, _) = cut::<S>(bytes, tile.sums(groups * L));
        let mut counts = Counts { n: [1; TILE[2]], low: [0; TILE[2]], high: [0; TILE[2]] };
        let all = self.gaps.then_some(self.lanes - 1);
        sweep::<S, L>(self.level, self.codes, tile, groups, Work { columns, sums }, |z, y, row| {
            let rows = (tile.window(0, z).len() * tile.window(1, y).len()) as u32;
            count_row(self.level, self.centres(z, y), row, tile, rows, self.table.levels(), all, &mut counts);
            self.emit(z, y, &counts, lo, dst);
        });
    }

    fn centres(&self, z: usize, y: usize) -> &[u8] {
        let tile = self.tile;
        let place = ((tile.at[0] + z) * tile.src[1] + tile.at[1] + y) * tile.src[2] + tile.at[2];
        &self.codes[place..][..tile.dst[2]]
    }

    /// Openness of a row from its counts.
    fn emit(&self, z: usize, y: usize, counts: &Counts, lo: [usize; 3], dst: &mut AnyViewMut) {
        let tile = self.tile;
        let values = &self.src.row_at(tile.at[0] + z, tile.at[1] + y)[tile.at[2]..][..tile.dst[2]];
        let codes = self.centres(z, y);
        let mut open = [0.0; TILE[2]];
        let open = &mut open[..values.len()];
        interpolate(self.level, values, codes, self.table, self.ties, counts, open);
        let mut before = None;
        for (x, open) in open.iter_mut().enumerate() {
            let (v, code) = (values[x], usize::from(codes[x]));
            if gone(v, self.missing) {
                *open = f64::NAN;
            } else if let Some(fixed) = infinite(v.to_f64(), self.table.flipped) {
                *open = fixed;
            } else if counts.high[x] - counts.low[x] == counts.n[x] && !self.table.steps(code) {
                // Between two levels there may be one value or many.
                let known = before.filter(|(at, w)| at + 1 == x && *w == v).is_some();
                if self.uniform([z, y, x], v, known) {
                    *open = if self.ties == Ties::Le { 1.0 } else { 0.5 };
                    before = Some((x, v));
                }
            }
        }
        match dst {
            AnyViewMut::F32(d) => {
                let row = &mut d.row_at(lo[0] + z, lo[1] + y)[lo[2]..][..open.len()];
                row.iter_mut().zip(open).for_each(|(d, o)| *d = *o as f32);
            }
            AnyViewMut::F64(d) => d.row_at(lo[0] + z, lo[1] + y)[lo[2]..][..open.len()].copy_from_slice(open),
            other => unreachable!("an openness of type {}", other.dtype()),
        }
    }

    /// Whether every voxel of a window is `v` or missing; where that is `known` of the window before, only the columns that
    /// came in are looked at.
    fn uniform(&self, [z, y, x]: [usize; 3], v: T, known: bool) -> bool {
        let (tile, columns) = (self.tile, self.tile.window(2, x));
        let columns = if known { self.tile.window(2, x - 1).end..columns.end } else { columns };
        let same = |w: &T| *w == v || gone(*w, self.missing);
        let mut rows = tile.window(0, z).flat_map(|z| tile.window(1, y).map(move |y| (z, y)));
        rows.all(|(z, y)| self.src.row_at(z, y)[columns.clone()].iter().all(same))
    }

    /// Windows of more planes than a byte counts: a slab of at most 255 voxels of radius is not worth a kernel of its own.
    fn planes_beyond_bytes(&self, lo: [usize; 3], dst: &mut AnyViewMut) {
        let tile = self.tile;
        let mut counts = Counts { n: [1; TILE[2]], low: [0; TILE[2]], high: [0; TILE[2]] };
        for (z, y) in (0..tile.dst[0]).flat_map(|z| (0..tile.dst[1]).map(move |y| (z, y))) {
            let centres = self.centres(z, y);
            for (x, centre) in centres.iter().enumerate() {
                let columns = tile.window(2, x);
                let (mut n, mut low, mut high) = (0, 0, 0);
                for (z, y) in tile.window(0, z).flat_map(|z| tile.window(1, y).map(move |y| (z, y))) {
                    let row = &self.codes[(z * tile.src[1] + y) * tile.src[2]..][..tile.src[2]];
                    for code in &row[columns.clone()] {
                        n += u32::from(!self.gaps || *code != NEVER);
                        low += u32::from(code < centre);
                        high += u32::from(code <= centre && (!self.gaps || *code != NEVER));
                    }
                }
                (counts.n[x], counts.low[x], counts.high[x]) = (n, low, high);
            }
            self.emit(z, y, &counts, lo, dst);
        }
    }
}

/// Openness that the specification fixes for an infinite voxel.
fn infinite(v: f64, flipped: bool) -> Option<f64> {
    v.is_infinite().then(|| f64::from(u8::from((v > 0.0) != flipped)))
}

multiversion! {
    /// Counts of a row; `all` is the lane that counts every voxel, where some are missing.
    fn count_row['a, S: Sum, const L: usize](
        centres: &[u8], row: Row<'a, S, L>, tile: &Tile, rows: u32, levels: usize, all: Option<usize>, counts: &mut Counts,
    ) -> () = count_row_inner;
}

#[inline(always)]
fn count_row_inner<S: Sum, const L: usize>(
    centres: &[u8],
    row: Row<S, L>,
    tile: &Tile,
    rows: u32,
    levels: usize,
    all: Option<usize>,
    counts: &mut Counts,
) {
    for (x, code) in centres.iter().enumerate().take(TILE[2]) {
        let (columns, code) = (tile.window(2, x), usize::from(*code));
        let n = all.map_or(rows * columns.len() as u32, |k| row.count(&columns, k));
        counts.n[x] = n;
        counts.low[x] = if code == 0 { 0 } else { row.count(&columns, (code - 1).min(levels.saturating_sub(1))) };
        counts.high[x] = if code < levels { row.count(&columns, code) } else { n };
    }
}

multiversion! {
    fn interpolate[T: Coded](
        values: &[T], codes: &[u8], table: &Table<T>, ties: Ties, counts: &Counts, open: &mut [f64],
    ) -> () = interpolate_inner;
}

#[inline(always)]
fn interpolate_inner<T: Coded>(
    values: &[T],
    codes: &[u8],
    table: &Table<T>,
    ties: Ties,
    counts: &Counts,
    open: &mut [f64],
) {
    let mut ways = [0.0; TILE[2]];
    let ways = &mut ways[..values.len()];
    for ((way, v), code) in ways.iter_mut().zip(values).zip(codes) {
        *way = table.way(*v, *code);
    }
    for (x, (open, way)) in open.iter_mut().zip(ways.iter()).enumerate() {
        let w = table.weight(*way, codes[x]);
        let (low, n) = (f64::from(counts.low[x]), f64::from(counts.n[x]));
        // The product is rounded once and the sum once: at w = 1 both are exact.
        let at_most = low + (f64::from(counts.high[x]) - low) * w;
        *open = match ties {
            Ties::Le => at_most / n,
            Ties::Mid => {
                let below = table.weight_below(*way, codes[x]);
                (at_most + (low + (f64::from(counts.high[x]) - low) * below)) / (2.0 * n)
            }
        };
    }
}

#[cfg(test)]
mod tests;
