//! Counting by histograms that slide, for keys of 8 bits (Perreault, Hebert 2007, Median filtering in constant time, in 3-D).
//!
//! Every column (one x, the window's rows and planes) has a histogram of 256 bins and one of 16 coarse bins; going one row
//! down exchanges the voxels of one row in each. A window is the sum of its columns; going one voxel along x exchanges two of
//! them, in the coarse bins at once, in the 16 fine bins of a coarse one only when a centre asks for that one.

use std::ops::Range;

use super::{Counts, MOST_LANES, Plan};
use crate::multiversion;

/// Bins of a column: fine, then coarse.
const BINS: usize = 256 + 16;

/// Elements of u16 that the columns take.
pub(super) fn columns(plan: &Plan) -> usize {
    (plan.dst[2] + 2 * plan.radius[2]) * BINS
}

/// Columns that hold voxels of the source.
fn existing(plan: &Plan) -> Range<usize> {
    let shift = plan.radius[2] as i64 - plan.at[2] as i64;
    let end = (plan.src[2] as i64 + shift).min((plan.dst[2] + 2 * plan.radius[2]) as i64);
    shift.max(0) as usize..end.max(0) as usize
}

/// Bin of a key: bins ascend with keys.
#[inline(always)]
fn bin(key: i8) -> usize {
    (key as u8 ^ 0x80) as usize
}

multiversion! {
    /// Brings the columns to output row `[z, y]`: made anew for the first row of a plane, else from the row before.
    pub(super) fn move_columns[](
        keys: &[i8], valid: Option<&[i8]>, plan: &Plan, place: [usize; 2], columns: &mut [u16],
    ) -> () = move_inner;
}

#[inline(always)]
fn move_inner(keys: &[i8], valid: Option<&[i8]>, plan: &Plan, [z, y]: [usize; 2], columns: &mut [u16]) {
    let zs = *plan.window(0, z).start()..*plan.window(0, z).end() + 1;
    let band = |y: usize| *plan.window(1, y).start()..*plan.window(1, y).end() + 1;
    let (old, new) = if y == 0 { (0..0, band(0)) } else { (band(y - 1), band(y)) };
    // rows that leave and enter: one each, but for the edges of the source and the first row
    let leaving = old.start..new.start.min(old.end);
    let entering = new.start.max(old.end)..new.end;
    if y == 0 {
        columns.fill(0);
    }
    let place = |sz: usize, sy: usize| (sz * plan.src[1] + sy) * plan.width;
    let exists = |at: usize| valid.is_none_or(|v| v[at] != 0);
    for x in existing(plan) {
        let column: &mut [u16; BINS] = (&mut columns[x * BINS..(x + 1) * BINS]).try_into().unwrap();
        if leaving.len() == 1 && entering.len() == 1 && valid.is_none() {
            exchange(column, keys, zs.clone().map(|sz| [place(sz, leaving.start) + x, place(sz, entering.start) + x]));
            continue;
        }
        let mut count = |key: i8, by: u16| {
            let bin = bin(key);
            column[bin] = column[bin].wrapping_add(by);
            column[256 + bin / 16] = column[256 + bin / 16].wrapping_add(by);
        };
        for sz in zs.clone() {
            for at in leaving.clone().map(|sy| place(sz, sy) + x).filter(|at| exists(*at)) {
                count(keys[at], u16::MAX);
            }
            for at in entering.clone().map(|sy| place(sz, sy) + x).filter(|at| exists(*at)) {
                count(keys[at], 1);
            }
        }
    }
}

/// 1 in one of 16 bins.
const ONE: [[u16; 16]; 16] = {
    let mut one = [[0; 16]; 16];
    let mut b = 0;
    while b < 16 {
        one[b][b] = 1;
        b += 1;
    }
    one
};

/// Takes the first key of each pair out of a column and puts the second one in. Neighbours share coarse bins, so those are
/// summed in registers: one counter after another in memory would wait for each store.
#[inline(always)]
fn exchange(column: &mut [u16; BINS], keys: &[i8], pairs: impl Iterator<Item = [usize; 2]>) {
    let mut coarse: [u16; 16] = column[256..].try_into().unwrap();
    for [out, into] in pairs {
        let (out, into) = (bin(keys[out]), bin(keys[into]));
        if out != into {
            column[out] = column[out].wrapping_sub(1);
            column[into] = column[into].wrapping_add(1);
            let (less, more) = (&ONE[out / 16], &ONE[into / 16]);
            for b in 0..16 {
                coarse[b] = coarse[b].wrapping_sub(less[b]).wrapping_add(more[b]);
            }
        }
    }
    column[256..].copy_from_slice(&coarse);
}

/// Histogram of the window about one voxel of a row.
#[derive(Default)]
pub(super) struct Window {
    coarse: [u32; 16],
    fine: [[u32; 16]; 16],
    /// Voxel, plus 1, for which each row of `fine` is right; 0 for none.
    upto: [usize; 16],
}

multiversion! {
    /// Counts for up to [`MOST_LANES`] voxels of an output row from `[z, y, x]` on. Runs of a row must follow each other,
    /// with the same window. Without `gaps` the counts hold n already.
    pub(super) fn count[](
        keys: &[i8], gaps: bool, plan: &Plan, place: [usize; 3], columns: &[u16], window: &mut Window,
        counts: &mut Counts,
    ) -> () = count_inner;
}

#[inline(always)]
fn count_inner(
    keys: &[i8],
    gaps: bool,
    plan: &Plan,
    [z, y, x]: [usize; 3],
    columns: &[u16],
    window: &mut Window,
    counts: &mut Counts,
) {
    let (span, exist) = (2 * plan.radius[2] + 1, existing(plan));
    let centres = ((plan.at[0] + z) * plan.src[1] + plan.at[1] + y) * plan.width + plan.radius[2];
    let part =
        |column: usize, first: usize| -> &[u16; 16] { columns[column * BINS + first..][..16].try_into().unwrap() };
    for i in 0..MOST_LANES.min(plan.dst[2] - x) {
        let x = x + i;
        // columns x .. x + span; the window of voxel x - 1 began and ended one before
        let entering = if x == 0 { 0..span } else { x + span - 1..x + span };
        for column in entering.start.max(exist.start)..entering.end.min(exist.end) {
            add(&mut window.coarse, part(column, 256));
        }
        if x > 0 && exist.contains(&(x - 1)) {
            sub(&mut window.coarse, part(x - 1, 256));
        }
        let bin = bin(keys[centres + x]);
        let coarse = bin / 16;
        let mut fine = window.fine[coarse]; // a copy, so that it stays in a register
        let behind = x + 1 - window.upto[coarse];
        if window.upto[coarse] > 0 && 2 * behind < span {
            for step in x + 1 - behind..x + 1 {
                if exist.contains(&(step + span - 1)) {
                    add(&mut fine, part(step + span - 1, bin / 16 * 16));
                }
                if exist.contains(&(step - 1)) {
                    sub(&mut fine, part(step - 1, bin / 16 * 16));
                }
            }
        } else {
            fine = [0; 16];
            for column in x.max(exist.start)..(x + span).min(exist.end) {
                add(&mut fine, part(column, bin / 16 * 16));
            }
        }
        window.upto[coarse] = x + 1;
        window.fine[coarse] = fine;
        let below = sum_before(&window.coarse, coarse) + sum_before(&fine, bin % 16);
        if gaps {
            counts.n[i] = window.coarse.iter().sum();
        }
        let n = counts.n[i];
        counts.not_below[i] = n - below;
        counts.above[i] = n - below - fine[bin % 16];
    }
}

#[inline(always)]
fn add(window: &mut [u32; 16], column: &[u16; 16]) {
    for b in 0..16 {
        window[b] = window[b].wrapping_add(u32::from(column[b]));
    }
}

#[inline(always)]
fn sub(window: &mut [u32; 16], column: &[u16; 16]) {
    for b in 0..16 {
        window[b] = window[b].wrapping_sub(u32::from(column[b]));
    }
}

/// Sum of the bins before `end`.
#[inline(always)]
fn sum_before(bins: &[u32; 16], end: usize) -> u32 {
    let mut sum = 0;
    for (b, count) in bins.iter().enumerate() {
        sum += if b < end { *count } else { 0 };
    }
    sum
}
