//! Openness from window counts at quantile levels of the whole volume (local histograms smoothed by a box; see Kass and
//! Solomon 2010), interpolated between levels about as the volume's own
//! distribution rises, leaning to the side where the window has more voxels. Counts are exact integers, levels are the same for every brick.

mod choose;
mod codes;
mod counts;
mod moves;
pub mod reference;
pub(crate) mod search;
mod slopes;
pub(crate) mod sums;
mod vector;

pub use choose::{Levels, PARTS};
pub(crate) use codes::Coded;

use std::ops::Range;

use super::Context;
use super::simd::Level;
use super::values::missing_as;
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Shape, View, Voxel};
use crate::stage::{Ties, WindowParams};
use crate::{with_dtype, with_view};
use codes::{Seen, Stored, fill_codes, gone};
use counts::{All, Counts, Lanes, count_row};
use slopes::{Line, Slopes, interpolate};
use sums::{Asked, NEVER, Sum, Tile, Windows, Work, sweep};

/// Most levels of a volume.
pub const MOST_LEVELS: usize = 64;

/// Planes, rows and columns of a tile. With 32 levels at radius 10, an earlier sweep took 4.7 ns per voxel with 64 x 64 rows and
/// columns, 4.2 with 64 x 256 (2-core Zen 4 VM, AVX-512, 2026-11-26); 128 columns keep a row's sums in L1.
const TILE: Shape = [128, 96, 128];

/// Writes the openness of the box that starts at voxel `at` of `src`, with F(v) = share of the window's voxels not above
/// v: exact at levels, and between them rising much as the whole volume's does, more steeply to the side of the neighbouring
/// interval that has more of the window's voxels. `ties = "mid"`: mean of F(v) and of F below v,
/// which for integers is F(v - 1). Within 4e-7 of that where the result is f32. A window of equal values gives 1 (0.5), a voxel at +inf 1, at -inf 0, a missing one NaN. `dst` has
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
        let rule = Rule::new(levels, params, ties);
        let (table, bytes) = cut::<u8>(bytes, table_len(src.dtype()));
        rule.stored.fill_table(table);
        for (lo, first, tile) in Tile::all(from, to, at, radius, TILE) {
            one_tile(cx.level, v.part(first, tile.src), &rule, table, &tile, bytes, lo, &mut dst);
        }
    });
}

/// Bytes of scratch that [`levels`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams) -> usize {
    let tile = Tile::largest(src, dst, params.radius, TILE);
    padded::<u8>(table_len(dtype)) + padded::<u8>(tile.codes()) + Work::<u32>::bytes(&tile, MOST_LEVELS)
}

/// Entries of the table of codes.
fn table_len(dtype: DType) -> usize {
    with_dtype!(dtype, T => <T as Coded>::VALUES)
}

/// What a voxel's openness is computed from, beside its window's counts.
struct Rule<T> {
    stored: Stored<T>,
    slopes: Either,
    missing: Option<T>,
    ties: Ties,
}

/// Slopes in the float that openness is computed in: f32 where it holds twice the largest count and every span, which
/// depends on no brick.
#[allow(clippy::large_enum_variant)] // one per brick
enum Either {
    F32(Slopes<f32>),
    F64(Slopes<f64>),
}

impl<T: Coded> Rule<T> {
    fn new(levels: &Levels, params: &WindowParams, ties: Ties) -> Rule<T> {
        let stored = Stored::new(levels, params.flipped());
        let window = params.radius.iter().map(|r| 2.0 * *r as f64 + 1.0).product::<f64>();
        let single = Slopes::<f32>::new(levels, &stored);
        let slopes = if T::DTYPE.result() == DType::F32 && 2.0 * window < f64::from(1 << 24) && single.all_finite() {
            Either::F32(single)
        } else {
            Either::F64(Slopes::new(levels, &stored))
        };
        Rule { stored, slopes, missing: missing_as(params.missing), ties }
    }
}

#[allow(clippy::too_many_arguments)]
fn one_tile<T: Coded>(
    level: Level,
    src: View<T>,
    rule: &Rule<T>,
    table: &[u8],
    tile: &Tile,
    bytes: &mut [u8],
    lo: [usize; 3],
    dst: &mut AnyViewMut,
) {
    let (codes, bytes) = cut::<u8>(bytes, tile.codes());
    let mut seen = Seen::default();
    for (i, codes) in codes.chunks_exact_mut(tile.src[2]).enumerate() {
        let row = src.row_at(i / tile.src[1], i % tile.src[1]);
        fill_codes(level, row, rule.missing, &rule.stored, table, codes, &mut seen);
    }
    // Where no voxel lies above the top level, its lane counts all that exist.
    let levels = rule.stored.levels().len();
    let all = match seen.gaps {
        false => All::Inside,
        true if seen.above || levels == 0 => All::Last,
        true => All::Top,
    };
    let job = Job { level, src, rule, tile, codes, all };
    match (levels + usize::from(all == All::Last) <= 32, tile.fits::<u16>()) {
        _ if !tile.planes_fit() => job.planes_beyond_bytes(lo, dst),
        (true, true) => job.run::<u16, 32>(bytes, lo, dst),
        (true, false) => job.run::<u32, 32>(bytes, lo, dst),
        (false, true) => job.run::<u16, 64>(bytes, lo, dst),
        (false, false) => job.run::<u32, 64>(bytes, lo, dst),
    }
}

/// Rows in either float.
type Lines = (Line<f32>, Line<f64>);

/// One tile.
struct Job<'a, T: Coded> {
    level: Level,
    src: View<'a, T>,
    rule: &'a Rule<T>,
    tile: &'a Tile,
    codes: &'a [u8],
    all: All,
}

impl<T: Coded> Job<'_, T> {
    fn run<S: Sum, const L: usize>(&self, bytes: &mut [u8], lo: [usize; 3], dst: &mut AnyViewMut) {
        let tile = self.tile;
        let mut work = Work::<S>::cut(bytes, tile, L);
        let (mut counts, mut rows, windows) = (Counts::new(), (Line::new(), Line::new()), Windows::of_columns(tile));
        for lanes in Lanes::sweeps(self.rule.stored.levels().len(), self.all, L) {
            sweep::<S, L>(
                self.level,
                self.codes,
                tile,
                &lanes.thresholds(),
                &mut work,
                |_| Asked::all(tile),
                |z, y, row| {
                    let height = (tile.window(0, z).len() * tile.window(1, y).len()) as u32;
                    count_row(self.level, self.centres(z, y), row, &windows, height, &lanes, &mut counts);
                    self.emit(z, y, &counts, &mut rows, lanes.part.clone(), lo, dst);
                },
            );
        }
    }

    fn centres(&self, z: usize, y: usize) -> &[u8] {
        let tile = self.tile;
        let place = ((tile.at[0] + z) * tile.src[1] + tile.at[1] + y) * tile.src[2] + tile.at[2];
        &self.codes[place..][..tile.dst[2]]
    }

    fn values(&self, z: usize, y: usize) -> &[T] {
        let tile = self.tile;
        &self.src.row_at(tile.at[0] + z, tile.at[1] + y)[tile.at[2]..][..tile.dst[2]]
    }

    /// Openness of a row from its counts, where its codes are of the part given.
    #[allow(clippy::too_many_arguments)]
    fn emit(
        &self,
        z: usize,
        y: usize,
        counts: &Counts,
        lines: &mut Lines,
        part: Option<Range<usize>>,
        lo: [usize; 3],
        dst: &mut AnyViewMut,
    ) {
        let (values, codes, ties) = (self.values(z, y), self.centres(z, y), self.rule.ties);
        let place = [lo[0] + z, lo[1] + y, lo[2]];
        match &self.rule.slopes {
            Either::F32(slopes) => {
                interpolate(self.level, values, codes, slopes, ties, counts, &mut lines.0);
                self.special([z, y], counts, &mut lines.0.open[..values.len()]);
                write(&lines.0.open, codes, part, place, dst);
            }
            Either::F64(slopes) => {
                interpolate(self.level, values, codes, slopes, ties, counts, &mut lines.1);
                self.special([z, y], counts, &mut lines.1.open[..values.len()]);
                write(&lines.1.open, codes, part, place, dst);
            }
        }
    }

    /// Voxels whose openness is not interpolated: missing ones, infinities, and those in windows of one value.
    fn special<R: Voxel>(&self, [z, y]: [usize; 2], counts: &Counts, open: &mut [R]) {
        let (values, codes, rule) = (self.values(z, y), self.centres(z, y), self.rule);
        if self.all != All::Inside || T::DTYPE.is_float() {
            for (open, v) in open.iter_mut().zip(values) {
                if gone(*v, rule.missing) {
                    *open = R::from_f64(f64::NAN);
                } else if let Some(fixed) = infinite(v.to_f64(), rule.stored.flipped) {
                    *open = R::from_f64(fixed);
                }
            }
        }
        if !counts.narrow {
            return;
        }
        let mut before = None;
        for (x, open) in open.iter_mut().enumerate() {
            // Between two levels there may be one value or many; where none lies between, the count is exact.
            let between = counts.high[x].wrapping_sub(counts.low[x]) == counts.n[x];
            if !between || rule.stored.steps(usize::from(codes[x])) {
                continue;
            }
            let v = values[x];
            if gone(v, rule.missing) || infinite(v.to_f64(), rule.stored.flipped).is_some() {
                continue;
            }
            let known = before.filter(|(at, w)| at + 1 == x && *w == v).is_some();
            if self.uniform([z, y, x], v, known) {
                *open = R::from_f64(if rule.ties == Ties::Le { 1.0 } else { 0.5 });
                before = Some((x, v));
            }
        }
    }

    /// Whether every voxel of a window is `v` or missing; where that is `known` of the window before, only the columns that
    /// came in are looked at.
    fn uniform(&self, [z, y, x]: [usize; 3], v: T, known: bool) -> bool {
        let (tile, columns) = (self.tile, self.tile.window(2, x));
        let columns = if known { self.tile.window(2, x - 1).end..columns.end } else { columns };
        let same = |w: &T| *w == v || gone(*w, self.rule.missing);
        let mut rows = tile.window(0, z).flat_map(|z| tile.window(1, y).map(move |y| (z, y)));
        rows.all(|(z, y)| self.src.row_at(z, y)[columns.clone()].iter().all(same))
    }

    /// Windows of more planes than a byte counts: a slab of at most 255 voxels of radius is not worth a kernel of its own.
    fn planes_beyond_bytes(&self, lo: [usize; 3], dst: &mut AnyViewMut) {
        let tile = self.tile;
        let (mut counts, gaps) = (Counts { narrow: true, ..Counts::new() }, self.all != All::Inside);
        let mut rows = (Line::new(), Line::new());
        for (z, y) in (0..tile.dst[0]).flat_map(|z| (0..tile.dst[1]).map(move |y| (z, y))) {
            let centres = self.centres(z, y);
            for (x, centre) in centres.iter().enumerate() {
                let columns = tile.window(2, x);
                let (mut n, mut low, mut high, mut before, mut after) = (0, 0, 0, 0, 0);
                for (z, y) in tile.window(0, z).flat_map(|z| tile.window(1, y).map(move |y| (z, y))) {
                    let row = &self.codes[(z * tile.src[1] + y) * tile.src[2]..][..tile.src[2]];
                    for code in &row[columns.clone()] {
                        n += u32::from(!gaps || *code != NEVER);
                        low += u32::from(code < centre);
                        high += u32::from(code <= centre && (!gaps || *code != NEVER));
                        before += u32::from(u32::from(*code) + 1 == u32::from(*centre));
                        after += u32::from(u32::from(*code) == u32::from(*centre) + 1);
                    }
                }
                (counts.n[x], counts.low[x], counts.high[x]) = (n, low, high);
                (counts.before[x], counts.after[x]) = (before, after);
            }
            self.emit(z, y, &counts, &mut rows, None, lo, dst);
        }
    }
}

/// Writes a row, or those of its voxels whose codes are of `part`.
fn write<R: Voxel>(open: &[R], codes: &[u8], part: Option<Range<usize>>, [z, y, x]: [usize; 3], dst: &mut AnyViewMut) {
    macro_rules! put {
        ($d:expr, $t:ty) => {{
            let row = $d.row_at(z, y)[x..][..codes.len()].iter_mut().zip(open);
            match part {
                None => row.for_each(|(d, o)| *d = o.to_f64() as $t),
                Some(part) => row
                    .zip(codes)
                    .filter(|(_, code)| part.contains(&usize::from(**code)))
                    .for_each(|((d, o), _)| *d = o.to_f64() as $t),
            }
        }};
    }
    match dst {
        AnyViewMut::F32(d) => put!(d, f32),
        AnyViewMut::F64(d) => put!(d, f64),
        other => unreachable!("an openness of type {}", other.dtype()),
    }
}

/// Openness that the specification fixes for an infinite voxel.
fn infinite(v: f64, flipped: bool) -> Option<f64> {
    v.is_infinite().then(|| f64::from(u8::from((v > 0.0) != flipped)))
}

#[cfg(test)]
mod tests;
