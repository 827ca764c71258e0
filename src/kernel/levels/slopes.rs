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
    fn clamped(self, least: Self, most: Self) -> Self;
    fn whole(self) -> u32;
}

macro_rules! real {
    ($($t:ty),*) => {$(
        impl Real for $t {
            #[inline(always)]
            fn of(count: u32) -> $t { count as $t }
            #[inline(always)]
            fn exactly<T: Voxel>(v: T) -> $t { v.to_f64() as $t }
            #[inline(always)]
            fn clamped(self, least: $t, most: $t) -> $t { self.max(least).min(most) } // NaN is the least
            #[inline(always)]
            fn whole(self) -> u32 { self as i32 as u32 }
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
}

impl<R: Real> Slopes<R> {
    pub fn new<T: Coded>(levels: &Levels, stored: &Stored<T>) -> Slopes<R> {
        let (zero, one) = (R::of(0), R::of(1));
        let mut slopes = Slopes { way: [[zero, one]; CODES], below: [[zero; 2]; CODES], pieces: [[one, zero]; PIECES] };
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
        slopes
    }

    /// Whether all ways from level to level are numbers of the type.
    pub fn all_finite(&self) -> bool {
        self.way.iter().all(|w| w[1].to_f64().is_finite())
    }

    /// Share of an interval's voxels up to `place` parts of the way, for each voxel of a row.
    fn shares(&self, level: Level, codes: &[u8; RUN], place: &[R; RUN], shares: &mut [R; RUN]) {
        let mut at = [0; RUN];
        parts(level, codes, place, &mut at, shares);
        let mut pieces = [[R::of(0); 2]; RUN];
        pick(&self.pieces, &at, &mut pieces);
        along(level, &pieces, shares);
    }
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
        let part = place.whole();
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
    open: &mut [R; RUN],
) {
    let (mut own, mut code, mut at) = ([T::default(); RUN], [0u8; RUN], [0u16; RUN]);
    own[..values.len()].copy_from_slice(values);
    code[..codes.len()].copy_from_slice(codes);
    at.iter_mut().zip(&code).for_each(|(at, code)| *at = u16::from(*code));
    let mut ways = [[R::of(0); 2]; RUN];
    pick(&slopes.way, &at, &mut ways);
    let mut place = [R::of(0); RUN];
    go(level, &own, &ways, &mut place);
    let mut share = [R::of(0); RUN];
    slopes.shares(level, &code, &place, &mut share);
    if ties == Ties::Mid {
        let mut belows = [[R::of(0); 2]; RUN];
        pick(&slopes.below, &at, &mut belows);
        place.iter_mut().zip(&belows).for_each(|(place, below)| *place = *place - below[0]);
        let mut below = [R::of(0); RUN];
        slopes.shares(level, &code, &place, &mut below);
        for x in 0..RUN {
            share[x] = share[x] + belows[x][1] * below[x];
        }
    }
    divide(level, ties, counts, &share, open);
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
    /// Openness from counts and the share (with `ties = "mid"`, the sum of two) of those between the levels.
    fn divide[R: Real](ties: Ties, counts: &Counts, share: &[R; RUN], open: &mut [R; RUN]) -> () = divide_inner;
}

#[inline(always)]
fn divide_inner<R: Real>(ties: Ties, counts: &Counts, share: &[R; RUN], open: &mut [R; RUN]) {
    let times = R::of(if ties == Ties::Mid { 2 } else { 1 });
    for x in 0..RUN {
        let (low, more) = (counts.low[x], counts.high[x].wrapping_sub(counts.low[x]));
        // Where the share is a whole number, the sum is exact.
        open[x] = (times * R::of(low) + R::of(more) * share[x]) / (times * R::of(counts.n[x]));
    }
}
