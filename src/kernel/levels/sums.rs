//! Window counts below many thresholds at once, at a cost that does not depend on the radius.
//!
//! A voxel is a code: the number of thresholds below it, so that threshold `k` counts it where `code <= k`. Some thresholds
//! are the lanes of vectors, and nothing but additions of vectors happens: each column of the tile has the counts of the window's
//! planes (one voxel enters and one leaves when the window goes down one plane), and `sums[x]` counts the window's rows and
//! planes over all columns before x, so a window's count is the difference of two elements. All in wrapping integers: exact
//! as long as the largest count fits.

use std::ops::Range;

use crate::brick::scratch::{cut, padded};
use crate::grid::{Region, Shape};
use crate::kernel::simd::Level;
use crate::multiversion;

use super::moves::{Moves, Steps, shift};
use super::vector::{self, Rows};

/// Code of a voxel that no threshold counts; with it, at most 255 thresholds.
pub(crate) const NEVER: u8 = 255;

/// Where the windows of one tile lie.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tile {
    /// Box of codes: everything that a window of the tile sees.
    pub src: Shape,
    pub dst: Shape,
    /// Place of the output in the source.
    pub at: [usize; 3],
    pub radius: [usize; 3],
}

impl Tile {
    /// Tiles of `step` voxels, clipped, of the output box of shape `to` at voxel `at` of a source of shape `from`, each with its
    /// first voxel in the output box and the first that its windows see in the source.
    pub fn all(
        from: Shape,
        to: Shape,
        at: [usize; 3],
        radius: [usize; 3],
        step: Shape,
    ) -> impl Iterator<Item = ([usize; 3], [usize; 3], Tile)> {
        let cells = Region::whole(to).cells([0; 3], step).iter();
        cells.map(move |cell| {
            let lo: [usize; 3] = std::array::from_fn(|a| cell[a] as usize * step[a]);
            let dst: Shape = std::array::from_fn(|a| step[a].min(to[a] - lo[a]));
            let first: [usize; 3] = std::array::from_fn(|a| (at[a] + lo[a]).saturating_sub(radius[a]));
            let last: [usize; 3] = std::array::from_fn(|a| (at[a] + lo[a] + dst[a] + radius[a]).min(from[a]));
            let src = std::array::from_fn(|a| last[a] - first[a]);
            (lo, first, Tile { src, dst, at: std::array::from_fn(|a| at[a] + lo[a] - first[a]), radius })
        })
    }

    /// A tile whose source box is no smaller than that of any of those: for lengths of buffers.
    pub fn largest(from: Shape, to: Shape, radius: [usize; 3], step: Shape) -> Tile {
        let dst: Shape = std::array::from_fn(|a| step[a].min(to[a]));
        let src = std::array::from_fn(|a| dst[a].saturating_add(radius[a].saturating_mul(2)).min(from[a]));
        Tile { src, dst, at: [0; 3], radius }
    }

    /// Planes, rows or columns of the window about output voxel `i`.
    #[inline(always)]
    pub fn window(&self, axis: usize, i: usize) -> Range<usize> {
        let centre = self.at[axis] + i;
        centre.saturating_sub(self.radius[axis])..(centre + self.radius[axis] + 1).min(self.src[axis])
    }

    /// The largest number of voxels along an axis of any window.
    fn most(&self, axis: usize) -> usize {
        (2 * self.radius[axis] + 1).min(self.src[axis])
    }

    /// Whether counts of columns fit in their bytes.
    pub fn planes_fit(&self) -> bool {
        self.most(0) <= usize::from(u8::MAX)
    }

    /// Whether counts of columns fit in their bytes and counts of windows in `S`.
    pub fn fits<S: Sum>(&self) -> bool {
        let window = (0..3).map(|a| self.most(a) as u64).product::<u64>();
        self.planes_fit() && window <= S::MOST
    }

    /// Codes of the source box.
    pub fn codes(&self) -> usize {
        self.src.iter().product()
    }
}

/// Most voxels of a row of a tile whose windows are kept.
pub(crate) const RUN: usize = 256;

/// Columns of the windows of a tile's rows.
pub(crate) struct Windows {
    pub start: [u32; RUN],
    pub end: [u32; RUN],
}

impl Windows {
    pub fn of_columns(tile: &Tile) -> Windows {
        let mut windows = Windows { start: [0; RUN], end: [0; RUN] };
        for x in 0..tile.dst[2] {
            let columns = tile.window(2, x);
            (windows.start[x], windows.end[x]) = (columns.start as u32, columns.end as u32);
        }
        windows
    }

    #[inline(always)]
    pub fn of(&self, x: usize) -> Range<usize> {
        self.start[x] as usize..self.end[x] as usize
    }
}

/// Integer of a window's count.
pub(crate) trait Sum: crate::grid::Voxel + Into<u32> {
    const MOST: u64;
    fn plus(self, by: Self) -> Self;
    fn minus(self, by: Self) -> Self;
    fn by(change: i16) -> Self;
    /// The same, where they are words.
    fn words(sums: &[Self]) -> Option<&[u16]>;
}

macro_rules! sum {
    ($($t:ty, $words:expr;)*) => {$(
        impl Sum for $t {
            const MOST: u64 = <$t>::MAX as u64;
            #[inline(always)]
            fn plus(self, by: Self) -> Self { self.wrapping_add(by) }
            #[inline(always)]
            fn minus(self, by: Self) -> Self { self.wrapping_sub(by) }
            #[inline(always)]
            fn by(change: i16) -> Self { change as $t }
            #[inline(always)]
            fn words(sums: &[Self]) -> Option<&[u16]> { ($words)(sums) }
        }
    )*};
}
sum! {
    u16, Some;
    u32, |_| None;
}

/// Buffers of [`sweep`], cut out of scratch. With 64 lanes the columns of a tile should stay within the L2 cache.
pub(crate) struct Work<'a, S> {
    /// Counts over planes: `[row][column][lane]`, and two rows of zeros.
    columns: &'a mut [u8],
    /// `[column + 1][lane]`, twice.
    sums: &'a mut [S],
    /// Changes of the columns of a plane: steps of the voxels that enter, and of those that leave.
    moves: &'a mut [u16],
    /// [`Steps`].
    steps: &'a mut [u8],
}

impl<'a, S: Sum> Work<'a, S> {
    fn lengths(tile: &Tile, lanes: usize) -> [usize; 4] {
        let [_, rows, width] = tile.src;
        [(rows + 2) * width * lanes, 2 * (width + 1) * lanes, 2 * rows * width, (lanes + 1) * lanes]
    }

    /// Bytes that [`Work::cut`] takes.
    pub fn bytes(tile: &Tile, lanes: usize) -> usize {
        let [columns, sums, moves, steps] = Self::lengths(tile, lanes);
        padded::<u8>(columns) + padded::<S>(sums) + padded::<u16>(moves) + padded::<u8>(steps)
    }

    pub fn cut(bytes: &'a mut [u8], tile: &Tile, lanes: usize) -> Work<'a, S> {
        let lengths = Self::lengths(tile, lanes);
        let (columns, bytes) = cut::<u8>(bytes, lengths[0]);
        let (sums, bytes) = cut::<S>(bytes, lengths[1]);
        let (moves, bytes) = cut::<u16>(bytes, lengths[2]);
        let (steps, _) = cut::<u8>(bytes, lengths[3]);
        Work { columns, sums, moves, steps }
    }
}

/// The sums of one output row.
pub(crate) struct Row<'a, S, const L: usize> {
    pub sums: &'a [[S; L]],
}

impl<S: Sum, const L: usize> Row<'_, S, L> {
    /// Voxels of `columns` that lane `k` counts.
    #[inline(always)]
    pub fn count(&self, columns: &Range<usize>, k: usize) -> u32 {
        self.sums[columns.end][k].minus(self.sums[columns.start][k]).into()
    }

    /// Four neighbouring sums from each place (column times L, plus the lane) on. Panics where there are none. Not compiled for
    /// vectors, which would gather: plain loads are the faster way.
    #[inline(never)]
    pub fn fours<const N: usize>(&self, at: &[u32; N], to: &mut [[S; 4]; N]) {
        let flat = self.sums.as_flattened();
        let last = at.iter().fold(0, |last, at| last.max(*at)) as usize;
        assert!(last + 3 < flat.len(), "sums {last} and the next three of {}", flat.len());
        for (to, at) in to.iter_mut().zip(at) {
            // SAFETY: every place is at most the last, which was checked; an array is aligned as its elements are.
            *to = unsafe { flat.as_ptr().add(*at as usize).cast::<[S; 4]>().read() };
        }
    }
}

/// Output voxels of a plane that are asked for: those of its first rows, in some columns.
pub(crate) struct Asked {
    pub rows: usize,
    pub columns: Range<usize>,
}

impl Asked {
    pub fn all(tile: &Tile) -> Asked {
        Asked { rows: tile.dst[1], columns: 0..tile.dst[2] }
    }
}

/// Calls `emit(z, y, row)` for the rows of each plane that are `asked(z)`, with the counts of L lanes: lane `k` counts codes
/// up to `lanes[k]`, which ascend (see [`Steps`]). More thresholds than lanes: one sweep after the other, whose columns stay
/// in the cache.
pub(crate) fn sweep<S: Sum, const L: usize>(
    level: Level,
    codes: &[u8],
    tile: &Tile,
    lanes: &[u8; L],
    work: &mut Work<S>,
    asked: impl Fn(usize) -> Asked,
    mut emit: impl FnMut(usize, usize, Row<S, L>),
) {
    assert!(tile.fits::<S>() && codes.len() == tile.codes());
    let seen = tile.window(1, 0).start == 0 && tile.window(1, tile.dst[1] - 1).end == tile.src[1];
    assert!(seen, "every row of the source is in a window");
    let [_, rows, width] = tile.src;
    let plane = rows * width;
    let columns = work.columns.as_chunks_mut::<L>().0;
    let (columns, zeros) = columns.split_at_mut(plane);
    let (zeros, none) = zeros.split_at_mut(width);
    let (sums, first) = work.sums.as_chunks_mut::<L>().0.split_at_mut(width + 1);
    columns.fill([0; L]);
    zeros.fill([0; L]);
    none.fill([0; L]);
    let thresholds = &vector::in_columns(lanes);
    let steps = Steps::new(lanes, work.steps.as_chunks_mut::<L>().0);
    let tall = tile.most(0) > i8::MAX as usize;
    let mut planes = 0..0;
    for z in 0..tile.dst[0] {
        let now = tile.window(0, z);
        let (leaving, entering) = (planes.start..now.start.min(planes.end), now.start.max(planes.end)..now.end);
        planes = now;
        let of = |z: usize| &codes[z * plane..][..plane];
        // One plane in, one out: done with the first look at each row of columns.
        let both = leaving.len() == 1 && entering.len() == 1;
        let above = tile.window(1, 0).len() * width;
        let moves = if both {
            let moves = Moves::between(level, &steps, of(entering.start), of(leaving.start), work.moves);
            first_rows(level, &mut columns[..above], moves.cut(0..above), first);
            Some(moves)
        } else if leaving.is_empty() && entering.is_empty() {
            None
        } else {
            leaving.for_each(|z| leave(level, thresholds, of(z), columns));
            if !entering.is_empty() {
                enter(level, thresholds, &codes[entering.start * plane..], plane, entering.len(), columns);
            }
            first.fill([S::default(); L]);
            for into in columns[..above].chunks_exact_mut(width) {
                step_rows(level, Rows { into, out: zeros, moves: None, tall }, first);
            }
            None
        };
        let asked = asked(z);
        // Columns of the windows asked for: sums start anywhere.
        let (seen, reach) = match asked.columns.is_empty() || asked.rows == 0 {
            true => (0, 0..0),
            false => (asked.rows, tile.window(2, asked.columns.start).start..tile.window(2, asked.columns.end - 1).end),
        };
        sums[reach.start..=reach.end].copy_from_slice(&first[reach.start..=reach.end]);
        let row_of = |y: usize| y * width + reach.start..y * width + reach.end;
        let mut band = tile.window(1, 0);
        for y in 0..seen {
            let now = tile.window(1, y);
            let (leaving, entering) = (band.start..now.start.min(band.end), now.start.max(band.end)..now.end);
            band = now;
            for i in 0..leaving.len().max(entering.len()) {
                let into = entering.clone().nth(i);
                let (before, from) = columns.split_at_mut(into.map_or(plane, |y| y * width));
                let out = leaving.clone().nth(i).map_or(&zeros[reach.clone()], |y| &before[row_of(y)]);
                let (into, moves) = match into {
                    Some(y) => (&mut from[reach.clone()], moves.map(|m| m.cut(row_of(y)))),
                    None => (&mut none[reach.clone()], None),
                };
                step_rows(level, Rows { into, out, moves, tall }, &mut sums[reach.start..=reach.end]);
            }
            emit(z, y, Row { sums });
        }
        if let Some(moves) = moves {
            let mut rest = |part: Range<usize>| shift(level, &mut columns[part.clone()], moves.cut(part));
            for y in tile.window(1, 0).end..band.end {
                rest(y * width..row_of(y).start);
                rest(row_of(y).end..(y + 1) * width);
            }
            rest(band.end * width..plane);
        }
    }
}

multiversion! {
    /// Lets voxels of several planes, `stride` codes apart, into their columns.
    fn enter[const L: usize](
        thresholds: &[u8; L], codes: &[u8], stride: usize, planes: usize, columns: &mut [[u8; L]],
    ) -> () = enter_inner;
}

#[inline(always)]
fn enter_inner<const L: usize>(
    thresholds: &[u8; L],
    codes: &[u8],
    stride: usize,
    planes: usize,
    columns: &mut [[u8; L]],
) {
    let thresholds = *thresholds;
    for (x, column) in columns.iter_mut().enumerate() {
        // A copy, so that it stays in registers.
        let mut counts = *column;
        for code in codes[x..].iter().step_by(stride).take(planes) {
            for k in 0..L {
                counts[k] = counts[k].wrapping_add((thresholds[k] >= *code) as u8);
            }
        }
        *column = counts;
    }
}

multiversion! {
    /// Takes voxels of one plane out of their columns.
    fn leave[const L: usize](thresholds: &[u8; L], codes: &[u8], columns: &mut [[u8; L]]) -> () = leave_inner;
}

#[inline(always)]
fn leave_inner<const L: usize>(thresholds: &[u8; L], codes: &[u8], columns: &mut [[u8; L]]) {
    for (column, code) in columns.iter_mut().zip(codes) {
        for (c, threshold) in column.iter_mut().zip(thresholds) {
            *c = c.wrapping_sub(u8::from(threshold >= code));
        }
    }
}

/// Moves the columns of the first window's rows, and its sums with them.
fn first_rows<S: Sum, const L: usize>(level: Level, columns: &mut [[u8; L]], moves: Moves<L>, sums: &mut [[S; L]]) {
    /// Rows whose changes a signed byte holds.
    const ROWS: usize = 32;
    let part = ROWS * (sums.len() - 1);
    for (i, columns) in columns.chunks_mut(part).enumerate() {
        let moves = moves.cut(i * part..i * part + columns.len());
        if !vector::first(level, columns, moves, sums) {
            first(level, columns, moves, sums);
        }
    }
}

multiversion! {
    fn first['a, S: Sum, const L: usize](columns: &mut [[u8; L]], moves: Moves<'a, L>, sums: &mut [[S; L]]) -> () = first_inner;
}

#[inline(always)]
fn first_inner<S: Sum, const L: usize>(columns: &mut [[u8; L]], moves: Moves<L>, sums: &mut [[S; L]]) {
    let width = sums.len() - 1;
    let mut carry = [S::default(); L];
    for (x, sum) in sums[1..].iter_mut().enumerate() {
        let mut change = [0u8; L];
        for at in (x..columns.len()).step_by(width) {
            let by = moves.change(at);
            for k in 0..L {
                columns[at][k] = columns[at][k].wrapping_add(by[k]);
                change[k] = change[k].wrapping_add(by[k]);
            }
        }
        let change = widen(&change, true);
        for k in 0..L {
            carry[k] = carry[k].plus(S::by(change[k]));
            sum[k] = sum[k].plus(carry[k]);
        }
    }
}

/// Bytes of a column, signed or not, as words in the order of the lanes: even bytes are the first half (see
/// [`vector::in_columns`]).
#[inline(always)]
fn widen<const L: usize>(bytes: &[u8; L], signed: bool) -> [i16; L] {
    let mut words = [0; L];
    for (i, pair) in bytes.as_chunks::<2>().0.iter().enumerate() {
        let word = u16::from_le_bytes(*pair);
        let (even, odd) = (word << 8, word);
        words[i] = if signed { even as i16 >> 8 } else { (even >> 8) as i16 };
        words[L / 2 + i] = if signed { odd as i16 >> 8 } else { (odd >> 8) as i16 };
    }
    words
}

multiversion! {
    fn step['a, S: Sum, const L: usize](rows: Rows<'a, L>, sums: &mut [[S; L]]) -> () = step_inner;
}

#[inline(always)]
fn step_inner<S: Sum, const L: usize>(rows: Rows<L>, sums: &mut [[S; L]]) {
    let mut carry = [S::default(); L];
    for (x, ((sum, into), out)) in sums[1..].iter_mut().zip(rows.into).zip(rows.out).enumerate() {
        if let Some(moves) = rows.moves {
            *into = moves.apply(x, *into);
        }
        let (into, out) = (widen(into, false), widen(out, false));
        for k in 0..L {
            carry[k] = carry[k].plus(S::by(into[k] - out[k]));
            sum[k] = sum[k].plus(carry[k]);
        }
    }
}

/// Adds the columns that come in to the sums before each column, and takes off those that leave.
fn step_rows<S: Sum, const L: usize>(level: Level, mut rows: Rows<L>, sums: &mut [[S; L]]) {
    if !vector::step(level, &mut rows, sums) {
        step(level, rows, sums);
    }
}
