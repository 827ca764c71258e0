//! Openness between levels: counts at the two levels about a voxel, and how the volume rises from the one to the other.

use std::ops::{Add, Div, Mul, Sub};

use super::MOST_LEVELS;
use super::choose::{Levels, PARTS};
use super::codes::{Coded, Stored};
use super::counts::{Counts, RUN};
use crate::grid::Voxel;
use crate::kernel::simd::Level;
use crate::multiversion;
use crate::stage::Ties;

/// The float that openness is computed in.
pub(super) trait Real:
    Voxel + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    fn of(count: u32) -> Self;
    /// A voxel of a type whose values this one holds.
    fn exactly<T: Voxel>(v: T) -> Self;
    /// Not below `least`, which NaN becomes, nor above `most`.
    fn clamped(self, least: Self, most: Self) -> Self;
    /// The number of whole parts.
    ///
    /// # Safety
    /// It must lie from 0 to 2^31 - 1.
    unsafe fn whole(self) -> u32;
}

macro_rules! real {
    ($($t:ty),*) => {$(
        impl Real for $t {
            #[inline(always)]
            fn of(count: u32) -> $t { count as $t }
            #[inline(always)]
            fn exactly<T: Voxel>(v: T) -> $t { v.to_f64() as $t }
            #[inline(always)]
            fn clamped(self, least: $t, most: $t) -> $t {
                let v = if self > least { self } else { least };
                if v < most { v } else { most }
            }
            #[inline(always)]
            unsafe fn whole(self) -> u32 {
                // SAFETY: as the caller promised.
                unsafe { self.to_int_unchecked::<i32>() as u32 }
            }
        }
    )*};
}
real!(f32, f64);

/// Entries of the tables, a power of two: what no code has is never read, but need not be checked.
const CODES: usize = 256;
const PIECES: usize = 2048;
const _: () = assert!(PIECES >= (MOST_LEVELS + 1) * STEP);
/// Pieces of a code: [`PARTS`], and one for the level itself.
const STEP: usize = PARTS + 1;

/// How the distribution rises to each code's level from the one before, in [`PARTS`] linear pieces. R holds every value of T.
pub(super) struct Slopes<R> {
    /// Stored value of the level before, and the way from there, negative where the order is turned; by code.
    way: [[R; 2]; CODES],
    /// Parts of the way that one code of an integer type is, 0 for floats; and 1, or 0 where no value lies between the
    /// levels: there nothing is below a voxel but what the level before counts.
    below: [[R; 2]; CODES],
    /// Share of the interval's voxels up to a part, and what the part adds; by code and part.
    pieces: [[R; 2]; PIECES],
    /// For types of 8 bits, by place of the value: share up to it, and up to what lies below it, or 0 where that is nothing.
    values: Option<[[R; 2]; CODES]>,
}

impl<R: Real> Slopes<R> {
    pub fn new<T: Coded>(levels: &Levels, stored: &Stored<T>) -> Slopes<R> {
        let (zero, one) = (R::of(0), R::of(1));
        let mut slopes = Slopes {
            way: [[zero, one]; CODES],
            below: [[zero; 2]; CODES],
            pieces: [[one, zero]; PIECES],
            values: None,
        };
        for k in (1..levels.at.len()).filter(|k| !stored.steps(*k)) {
            let (from, to) = (R::from_f64(stored.levels()[k - 1].to_f64()), R::from_f64(stored.levels()[k].to_f64()));
            slopes.way[k] = [from, to - from];
            let unit = if T::DTYPE.is_float() { 0.0 } else { PARTS as f64 / (to - from).to_f64().abs() };
            slopes.below[k] = [R::from_f64(unit), one];
            let mut risen = 0.0;
            for (part, rise) in levels.rise[k].iter().enumerate() {
                slopes.pieces[k * STEP + part] = [R::from_f64(risen), R::from_f64(rise - risen)];
                risen = *rise;
            }
        }
        slopes.values = (T::VALUES == CODES).then(|| slopes.of_values(stored));
        slopes
    }

    fn of_values<T: Coded>(&self, stored: &Stored<T>) -> [[R; 2]; CODES] {
        let mut table = [0; CODES];
        stored.fill_table(&mut table);
        let mut values = [[R::of(0); 2]; CODES];
        let (lowest, mut line) = (T::DTYPE.range().0, Line::new());
        for (i, values) in values.chunks_exact_mut(RUN).enumerate() {
            let own = std::array::from_fn(|x| T::from_f64(lowest + (i * RUN + x) as f64));
            let codes = std::array::from_fn(|x| table[i * RUN + x]);
            // Every step is rounded alike on every level.
            self.follow_volume(Level::Baseline, &own, &codes, Ties::Mid, &mut line);
            values.iter_mut().enumerate().for_each(|(x, v)| *v = [line.share[x], line.below[x]]);
        }
        values
    }

    /// Shares of each voxel's interval up to it, and, where ties need them, up to what lies below it.
    fn follow_volume<T: Coded>(&self, level: Level, own: &[T; RUN], codes: &[u8; RUN], ties: Ties, line: &mut Line<R>) {
        let Line { at, found, place, share, below, .. } = line;
        at.iter_mut().zip(codes).for_each(|(at, code)| *at = u16::from(*code));
        pick(&self.way, at, found);
        go(level, own, found, place);
        parts(level, codes, place, at, share);
        pick(&self.pieces, at, found);
        along(level, found, share);
        if ties == Ties::Mid {
            for (x, place) in place.iter_mut().enumerate() {
                *place = *place - self.below[usize::from(codes[x])][0];
            }
            parts(level, codes, place, at, below);
            pick(&self.pieces, at, found);
            along(level, found, below);
            for (x, below) in below.iter_mut().enumerate() {
                *below = *below * self.below[usize::from(codes[x])][1];
            }
        }
    }

    /// Whether all ways from level to level are numbers of the type.
    pub fn all_finite(&self) -> bool {
        self.way.iter().all(|w| w[1].to_f64().is_finite())
    }
}

/// What is computed for a row of voxels, kept so that it is not cleared for every row.
pub(super) struct Line<R> {
    at: [u16; RUN],
    found: [[R; 2]; RUN],
    place: [R; RUN],
    share: [R; RUN],
    below: [R; RUN],
    pub open: [R; RUN],
}

impl<R: Real> Line<R> {
    pub fn new() -> Line<R> {
        let (none, found) = ([R::of(0); RUN], [[R::of(0); 2]; RUN]);
        Line { at: [0; RUN], found, place: none, share: none, below: none, open: none }
    }
}

/// A whole row: the slice itself, or a copy with rubbish at the end.
fn whole<'a, T: Copy>(row: &'a [T], copy: &'a mut [T; RUN]) -> &'a [T; RUN] {
    if let Ok(row) = row.try_into() {
        return row;
    }
    copy[..row.len()].copy_from_slice(row);
    copy
}

/// Entries of a table. Not compiled for vectors, which would gather: plain loads are the faster way.
#[inline(never)]
fn pick<R: Real, const N: usize>(table: &[[R; 2]; N], at: &[u16; RUN], to: &mut [[R; 2]; RUN]) {
    for x in 0..RUN {
        to[x] = table[usize::from(at[x]) % N];
    }
}

multiversion! {
    /// The piece that each place lies in, and how far.
    fn parts[R: Real](codes: &[u8; RUN], place: &[R; RUN], at: &mut [u16; RUN], rest: &mut [R; RUN]) -> () = parts_inner;
}

#[inline(always)]
fn parts_inner<R: Real>(codes: &[u8; RUN], place: &[R; RUN], at: &mut [u16; RUN], rest: &mut [R; RUN]) {
    for x in 0..RUN {
        let place = place[x].clamped(R::of(0), R::of(PARTS as u32));
        // SAFETY: from 0 to PARTS.
        let part = unsafe { place.whole() };
        at[x] = u16::from(codes[x]) * STEP as u16 + part as u16;
        rest[x] = place - R::of(part);
    }
}

multiversion! {
    /// The share there.
    fn along[R: Real](pieces: &[[R; 2]; RUN], rest: &mut [R; RUN]) -> () = along_inner;
}

#[inline(always)]
fn along_inner<R: Real>(pieces: &[[R; 2]; RUN], rest: &mut [R; RUN]) {
    for x in 0..RUN {
        rest[x] = pieces[x][0] + pieces[x][1] * rest[x];
    }
}

/// Openness of a row of voxels.
pub(super) fn interpolate<T: Coded, R: Real>(
    level: Level,
    values: &[T],
    codes: &[u8],
    slopes: &Slopes<R>,
    ties: Ties,
    counts: &Counts,
    line: &mut Line<R>,
) {
    if let Some(known) = &slopes.values {
        let Line { at, found, share, below, .. } = line;
        at.iter_mut().zip(values).for_each(|(at, v)| *at = v.place() as u16);
        pick(known, at, found);
        for x in 0..RUN {
            [share[x], below[x]] = found[x];
        }
    } else {
        let (mut own, mut code) = ([T::default(); RUN], [0; RUN]);
        slopes.follow_volume(level, whole(values, &mut own), whole(codes, &mut code), ties, line);
    }
    divide(level, ties, counts, &line.share, &line.below, &mut line.open);
}

multiversion! {
    /// Parts of the way from the level before: all of them at the level itself, where the quotient is 1.
    fn go[T: Coded, R: Real](own: &[T; RUN], ways: &[[R; 2]; RUN], place: &mut [R; RUN]) -> () = go_inner;
}

#[inline(always)]
fn go_inner<T: Coded, R: Real>(own: &[T; RUN], ways: &[[R; 2]; RUN], place: &mut [R; RUN]) {
    for x in 0..RUN {
        place[x] = (R::exactly(own[x]) - ways[x][0]) / ways[x][1] * R::of(PARTS as u32);
    }
}

multiversion! {
    /// Openness from counts and the shares of those between the levels, up to each voxel and, with `ties = "mid"`, below it.
    fn divide[R: Real](
        ties: Ties, counts: &Counts, share: &[R; RUN], below: &[R; RUN], open: &mut [R; RUN],
    ) -> () = divide_inner;
}

#[inline(always)]
fn divide_inner<R: Real>(ties: Ties, counts: &Counts, share: &[R; RUN], below: &[R; RUN], open: &mut [R; RUN]) {
    let (mid, times) = (ties == Ties::Mid, R::of(if ties == Ties::Mid { 2 } else { 1 }));
    for x in 0..RUN {
        let (before, after) = (counts.before[x], counts.after[x]);
        let own = counts.high[x].wrapping_sub(counts.low[x]);
        // How far the window leans to the interval after the centre's, from -1 to 1. The density rises or falls within the interval
        // as it does around it: shares still rise, and are the same at both ends.
        let all = before.wrapping_add(after).wrapping_add(own).max(1);
        let lean = (R::of(after) - R::of(before)) / R::of(all);
        let bent = |share: R| share - lean * (share * (R::of(1) - share));
        let share = if mid { bent(share[x]) + bent(below[x]) } else { bent(share[x]) };
        // Where the share is a whole number, the sum is exact.
        open[x] = (times * R::of(counts.low[x]) + R::of(own) * share) / (times * R::of(counts.n[x]));
    }
}
