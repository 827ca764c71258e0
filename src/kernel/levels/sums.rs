//! Window counts below many thresholds at once, at a cost that does not depend on the radius.
//!
//! A voxel is a code: the number of thresholds below it, so that threshold `k` counts it where `code <= k`. Thresholds are
//! the lanes of vectors, and nothing but additions of vectors happens: each column of the tile has the counts of the window's
//! planes (one voxel enters and one leaves when the window goes down one plane), and `sums[x]` counts the window's rows and
//! planes over all columns before x, so a window's count is the difference of two elements. All in wrapping integers: exact
//! as long as the largest count fits.

use std::ops::Range;

use crate::grid::{Region, Shape};
use crate::kernel::simd::Level;
use crate::multiversion;

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

    /// Bytes of [`Work::columns`] for so many lanes.
    pub fn columns(&self, lanes: usize) -> usize {
        (self.src[1] + 2) * self.src[2] * lanes
    }

    /// Elements of [`Work::sums`].
    pub fn sums(&self, lanes: usize) -> usize {
        (self.src[2] + 1) * lanes
    }
}

/// Integer of a window's count.
pub(crate) trait Sum: crate::grid::Voxel + Into<u32> {
    const MOST: u64;
    fn plus(self, by: Self) -> Self;
    fn minus(self, by: Self) -> Self;
    /// The difference of two bytes.
    fn step(into: u8, out: u8) -> Self;
}

macro_rules! sum {
    ($($t:ty),*) => {$(
        impl Sum for $t {
            const MOST: u64 = <$t>::MAX as u64;
            #[inline(always)]
            fn plus(self, by: Self) -> Self { self.wrapping_add(by) }
            #[inline(always)]
            fn minus(self, by: Self) -> Self { self.wrapping_sub(by) }
            #[inline(always)]
            fn step(into: u8, out: u8) -> Self { (into as $t).wrapping_sub(out as $t) }
        }
    )*};
}
sum!(u16, u32);

/// Buffers of [`sweep`], cut out of scratch.
pub(crate) struct Work<'a, S> {
    /// Counts over planes: `[row][group][column][lane]`, and two rows of zeros.
    pub columns: &'a mut [u8],
    /// `[group][column + 1][lane]`.
    pub sums: &'a mut [S],
}

/// The sums of one output row.
pub(crate) struct Row<'a, S, const L: usize> {
    sums: &'a [[S; L]],
    /// Columns of the tile, and one.
    pitch: usize,
}

impl<S: Sum, const L: usize> Row<'_, S, L> {
    /// Voxels of `columns` that threshold `k` counts.
    #[inline(always)]
    pub fn count(&self, columns: &Range<usize>, k: usize) -> u32 {
        let at = |x: usize| self.sums[k / L * self.pitch + x][k % L];
        at(columns.end).minus(at(columns.start)).into()
    }
}

/// Calls `emit(z, y, row)` for every output row, with the counts of `groups` times `L` thresholds.
pub(crate) fn sweep<S: Sum, const L: usize>(
    level: Level,
    codes: &[u8],
    tile: &Tile,
    groups: usize,
    work: Work<S>,
    mut emit: impl FnMut(usize, usize, Row<S, L>),
) {
    assert!(tile.fits::<S>() && codes.len() == tile.codes());
    let seen = tile.window(1, 0).start == 0 && tile.window(1, tile.dst[1] - 1).end == tile.src[1];
    assert!(seen, "every row of the source is in a window");
    let [_, rows, width] = tile.src;
    let (plane, pitch) = (rows * width, width * groups);
    let columns = work.columns[..tile.columns(groups * L)].as_chunks_mut::<L>().0;
    let (columns, zeros) = columns.split_at_mut(rows * pitch);
    let (zeros, none) = zeros.split_at_mut(pitch);
    let sums = work.sums[..tile.sums(groups * L)].as_chunks_mut::<L>().0;
    columns.fill([0; L]);
    zeros.fill([0; L]);
    none.fill([0; L]);
    let order = vector::order::<L>(level);
    let codes_of = |z: usize, y: usize| &codes[z * plane + y * width..][..width];
    let mut planes = 0..0;
    for z in 0..tile.dst[0] {
        let now = tile.window(0, z);
        let (leaving, entering) = (planes.start..now.start.min(planes.end), now.start.max(planes.end)..now.end);
        // One plane in, one out: done with the first look at each row of columns.
        let both = leaving.len() == 1 && entering.len() == 1;
        if !both {
            for (y, columns) in columns.chunks_exact_mut(pitch).enumerate() {
                leaving.clone().for_each(|z| leave(level, &order, codes_of(z, y), columns));
                if !entering.is_empty() {
                    let first = &codes[entering.start * plane + y * width..];
                    enter(level, &order, first, plane, entering.len(), width, columns);
                }
            }
        }
        planes = now;
        sums.fill([S::default(); L]);
        let mut band = 0..0;
        for y in 0..tile.dst[1] {
            let now = tile.window(1, y);
            let (leaving, entering) = (band.start..now.start.min(band.end), now.start.max(band.end)..now.end);
            band = now;
            for i in 0..leaving.len().max(entering.len()) {
                let into = entering.clone().nth(i);
                let (before, from) = columns.split_at_mut(into.map_or(columns.len(), |y| y * pitch));
                let out = leaving.clone().nth(i).map_or(&*zeros, |y| &before[y * pitch..][..pitch]);
                let moved = |y| [codes_of(planes.end - 1, y), codes_of(planes.start - 1, y)];
                let (into, moved) = match into {
                    Some(y) => (&mut from[..pitch], both.then(|| moved(y))),
                    None => (&mut *none, None),
                };
                step_rows(level, Rows { groups, into, out, moved }, sums);
            }
            emit(z, y, Row { sums, pitch: width + 1 });
        }
    }
}

/// Whether the lanes of group `g` count a code: all thresholds from the code on.
#[inline(always)]
fn counts<const L: usize>(order: &[u8; L], group: usize, code: u8) -> [u8; L] {
    let first = (group * L) as u8;
    let mut all = [0; L];
    for (to, lane) in all.iter_mut().zip(order) {
        *to = (lane + first >= code) as u8;
    }
    all
}

multiversion! {
    /// Lets a row's voxels of several planes, `stride` codes apart, into its columns.
    fn enter[const L: usize](
        order: &[u8; L], codes: &[u8], stride: usize, planes: usize, width: usize, columns: &mut [[u8; L]],
    ) -> () = enter_inner;
}

#[inline(always)]
fn enter_inner<const L: usize>(
    order: &[u8; L],
    codes: &[u8],
    stride: usize,
    planes: usize,
    width: usize,
    columns: &mut [[u8; L]],
) {
    for (g, columns) in columns.chunks_exact_mut(width).enumerate() {
        let thresholds = order.map(|lane| lane + (g * L) as u8);
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
}

multiversion! {
    /// Takes a row's voxels of one plane out of its columns.
    fn leave[const L: usize](order: &[u8; L], codes: &[u8], columns: &mut [[u8; L]]) -> () = leave_inner;
}

#[inline(always)]
fn leave_inner<const L: usize>(order: &[u8; L], codes: &[u8], columns: &mut [[u8; L]]) {
    for (g, columns) in columns.chunks_exact_mut(codes.len()).enumerate() {
        for (column, code) in columns.iter_mut().zip(codes) {
            for (c, one) in column.iter_mut().zip(counts(order, g, *code)) {
                *c = c.wrapping_sub(one);
            }
        }
    }
}

/// Adds the columns that come in to the sums before each column, and takes off those that leave.
fn step_rows<S: Sum, const L: usize>(level: Level, mut rows: Rows<L>, sums: &mut [[S; L]]) {
    if !vector::step(level, &mut rows, sums) {
        step(level, rows, sums);
    }
}

multiversion! {
    fn step['a, S: Sum, const L: usize](rows: Rows<'a, L>, sums: &mut [[S; L]]) -> () = step_inner;
}

#[inline(always)]
fn step_inner<S: Sum, const L: usize>(rows: Rows<L>, sums: &mut [[S; L]]) {
    let order = std::array::from_fn(|b| b as u8);
    let width = rows.into.len() / rows.groups;
    for g in 0..rows.groups {
        let part = g * width..(g + 1) * width;
        let sums = sums[g * (width + 1)..][1..width + 1].iter_mut();
        let mut carry = [S::default(); L];
        for (x, ((sum, into), out)) in sums.zip(&mut rows.into[part.clone()]).zip(&rows.out[part]).enumerate() {
            if let Some([enters, leaves]) = rows.moved {
                let (more, less) = (counts::<L>(&order, g, enters[x]), counts::<L>(&order, g, leaves[x]));
                for k in 0..L {
                    into[k] = into[k].wrapping_add(more[k]).wrapping_sub(less[k]);
                }
            }
            for k in 0..L {
                carry[k] = carry[k].plus(S::step(into[k], out[k]));
                sum[k] = sum[k].plus(carry[k]);
            }
        }
    }
}
