//! Exact sums of powers of codes over windows, by sums that run along z, y and x: their cost does not depend on the radius.
//!
//! Sums wrap at 64 bits. Where the final value fits, that is no loss; of those that do not fit a coarse sum beside it, of the
//! powers shifted right, says which multiple of 2^64 is missing. So the sums are exact, and their order never shows.

use std::ops::Range;

use crate::grid::{View, Voxel};
use crate::kernel::levels::sums::Tile;
use crate::kernel::simd::Level;
use crate::multiversion;

/// Voxels side by side in a row of sums.
pub const LANES: usize = 8;

/// Integers of at most 16 bits about the middle of their type.
pub trait Code: Voxel {
    /// The value that is 0.
    const MIDDLE: Self;
    fn centred(self) -> i32;
}

macro_rules! code {
    ($($t:ty: $middle:expr),*) => {$(
        impl Code for $t {
            const MIDDLE: $t = $middle;
            #[inline(always)]
            fn centred(self) -> i32 {
                self as i32 - $middle as i32
            }
        }
    )*};
}
code!(u8: 128, i8: 0, u16: 32768, i16: 0);

/// So many sums of a voxel; some voxels are missing (`M`), and the last sum counts the others.
#[derive(Clone, Copy)]
pub struct Sums<const C: usize, const M: bool>;

/// Bits by which the coarse sums of the fourth and of the third powers are shifted.
pub const COARSE: [u32; 2] = [30, 16];

/// What is summed of a voxel: its powers 1 to 4, coarse ones where there are more than four sums, and as the last 1 for a
/// voxel that is there (`M`: some are missing).
#[inline(always)]
fn powers<const C: usize, const M: bool>(code: i32, there: i64) -> [i64; C] {
    let square = (code * code) as i64;
    let (third, fourth) = (square * code as i64, square * square);
    let all = [code as i64, square, third, fourth, fourth >> COARSE[0], third >> COARSE[1]];
    std::array::from_fn(|c| if M && c + 1 == C { there } else { all[c] })
}

/// The sums of eight voxels; those beyond the row's end are 0.
#[inline(always)]
fn eight<T: Code, const C: usize, const M: bool>(row: &[T], missing: T) -> [[i64; LANES]; C] {
    let mut voxels = [if M { missing } else { T::MIDDLE }; LANES];
    match row.first_chunk() {
        Some(whole) => voxels = *whole,
        None => voxels[..row.len()].copy_from_slice(row),
    }
    let mut sums = [[0; LANES]; C];
    for i in 0..LANES {
        let there = !M || voxels[i] != missing;
        let code = if there { voxels[i].centred() } else { 0 };
        let p = powers::<C, M>(code, there as i64);
        for c in 0..C {
            sums[c][i] = p[c];
        }
    }
    sums
}

multiversion! {
    /// Adds a row of voxels to a row of sums and takes another away; an empty one stands for none.
    fn slide[T: Code, const C: usize, const M: bool](
        kind: Sums<C, M>, new: &[T], old: &[T], missing: T, sums: &mut [i64],
    ) -> () = slide_inner;
}

#[inline(always)]
fn slide_inner<T: Code, const C: usize, const M: bool>(
    _: Sums<C, M>,
    new: &[T],
    old: &[T],
    missing: T,
    sums: &mut [i64],
) {
    let blocks = new.len().max(old.len()).div_ceil(LANES);
    for (b, sums) in sums.chunks_exact_mut(LANES * C).take(blocks).enumerate() {
        let tail = (b * LANES).min(new.len())..;
        let new = eight::<T, C, M>(&new[tail], missing);
        let tail = (b * LANES).min(old.len())..;
        let old = eight::<T, C, M>(&old[tail], missing);
        for (c, sums) in sums.chunks_exact_mut(LANES).enumerate() {
            for i in 0..LANES {
                sums[i] = sums[i].wrapping_add(new[c][i]).wrapping_sub(old[c][i]);
            }
        }
    }
}

multiversion! {
    /// `run += new - old`.
    fn slide_rows[](new: &[i64], old: &[i64], run: &mut [i64]) -> () = slide_rows_inner;
}

#[inline(always)]
fn slide_rows_inner(new: &[i64], old: &[i64], run: &mut [i64]) {
    match (new.is_empty(), old.is_empty()) {
        (false, false) => {
            run.iter_mut().zip(new).zip(old).for_each(|((r, n), o)| *r = r.wrapping_add(*n).wrapping_sub(*o));
        }
        (false, true) => run.iter_mut().zip(new).for_each(|(r, n)| *r = r.wrapping_add(*n)),
        (true, false) => run.iter_mut().zip(old).for_each(|(r, o)| *r = r.wrapping_sub(*o)),
        (true, true) => {}
    }
}

multiversion! {
    /// Running sums along x, each sum in a line of its own of `pitch`: element `j` holds all columns before `j - front`, so
    /// that a window's sum is the difference of two elements.
    fn along[const C: usize, const M: bool](
        kind: Sums<C, M>, row: &[i64], columns: usize, front: usize, pitch: usize, out: &mut [i64],
    ) -> () = along_inner;
}

#[inline(always)]
fn along_inner<const C: usize, const M: bool>(
    _: Sums<C, M>,
    row: &[i64],
    columns: usize,
    front: usize,
    pitch: usize,
    out: &mut [i64],
) {
    let mut lines = out.chunks_exact_mut(pitch);
    let mut lines: [&mut [i64]; C] = std::array::from_fn(|_| lines.next().expect("a line for every sum"));
    let mut total = [0i64; C];
    lines.iter_mut().for_each(|l| l[..=front].fill(0));
    // Columns that no window of the row sees are left out.
    let most = columns.min(pitch - front - 1);
    for (b, block) in row.chunks_exact(LANES * C).take(most.div_ceil(LANES)).enumerate() {
        let first = front + 1 + b * LANES;
        let n = LANES.min(most - b * LANES);
        for (c, (line, sums)) in lines.iter_mut().zip(block.chunks_exact(LANES)).enumerate() {
            for (to, from) in line[first..first + n].iter_mut().zip(sums) {
                total[c] = total[c].wrapping_add(*from);
                *to = total[c];
            }
        }
    }
    for (line, total) in lines.iter_mut().zip(total) {
        line[front + 1 + most..].fill(total);
    }
}

/// Lengths of the buffers of [`sweep`] for `c` sums: a plane, a row, lines along x.
pub fn lengths(tile: &Tile, c: usize) -> [usize; 3] {
    let row = tile.src[2].next_multiple_of(LANES) * c;
    [tile.src[1] * row, row, pitch(tile) * c]
}

/// Elements of a line along x. Outputs are read in groups of [`super::rows::GROUP`].
pub fn pitch(tile: &Tile) -> usize {
    tile.dst[2].next_multiple_of(super::rows::GROUP) + 2 * tile.radius[2] + 1
}

/// Visits the output rows of a tile with their lines along x: `visit(z, y, lines)`. `tile.radius` is less than the tile's
/// source on every axis.
pub fn sweep<T: Code, const C: usize, const M: bool>(
    level: Level,
    src: View<T>,
    missing: T,
    tile: &Tile,
    [plane, run, lines]: [&mut [i64]; 3],
    mut visit: impl FnMut(usize, usize, &[i64]),
) {
    let row = run.len();
    plane.fill(0);
    let mut planes = 0..0;
    for z in 0..tile.dst[0] {
        let window = tile.window(0, z);
        step(&mut planes, window, |new, old| {
            for y in 0..tile.src[1] {
                let voxels = |z: Option<usize>| z.map_or(&[][..], |z| src.row_at(z, y));
                slide(level, Sums::<C, M>, voxels(new), voxels(old), missing, &mut plane[y * row..][..row]);
            }
        });
        run.fill(0);
        let mut rows = 0..0;
        for y in 0..tile.dst[1] {
            step(&mut rows, tile.window(1, y), |new, old| {
                let sums = |y: Option<usize>| y.map_or(&[][..], |y| &plane[y * row..][..row]);
                slide_rows(level, sums(new), sums(old), run);
            });
            let front = tile.radius[2] - tile.at[2].min(tile.radius[2]);
            along(level, Sums::<C, M>, run, tile.src[2], front, pitch(tile), lines);
            visit(z, y, lines);
        }
    }
}

/// Moves a window to `to`, its ends not before where they are: at each step a new element, one that leaves, or both.
fn step(at: &mut Range<usize>, to: Range<usize>, mut slide: impl FnMut(Option<usize>, Option<usize>)) {
    while at.end < to.end || at.start < to.start {
        let new = (at.end < to.end).then_some(at.end);
        let old = (at.start < to.start).then_some(at.start);
        slide(new, old);
        *at = at.start + old.is_some() as usize..at.end + new.is_some() as usize;
    }
}
