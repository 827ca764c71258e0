//! Voxels as codes: how many levels lie below each.

use super::MOST_LEVELS;
use super::choose::{Levels, PARTS};
use super::sums::NEVER;
use crate::grid::Voxel;
use crate::multiversion;

/// A type whose voxels are compared with levels.
pub(crate) trait Coded: Voxel {
    /// As wide as the voxel, so that a comparison's result needs no widening.
    type Count: Copy + Default + std::ops::AddAssign + From<bool> + Into<u64>;
}

macro_rules! coded {
    ($($t:ty: $count:ty),*) => {$(impl Coded for $t { type Count = $count; })*};
}
coded!(u8: u8, i8: u8, u16: u16, i16: u16, u32: u32, i32: u32, f32: u32, f64: u64);

/// Levels as a kernel reads them.
pub(crate) struct Table<T> {
    levels: usize,
    pub flipped: bool,
    /// Stored values of the levels, from the least dense on.
    at: [T; MOST_LEVELS],
    step: [bool; MOST_LEVELS + 1],
    /// Stored value of the level before, and the way from it, negative where the order is turned; by code.
    base: [f64; MOST_LEVELS + 1],
    span: [f64; MOST_LEVELS + 1],
    /// Share of an interval that one code of an integer type is; 0 for floats.
    unit: [f64; MOST_LEVELS + 1],
    /// Share of an interval's voxels up to each part of the way through it.
    rise: [[f64; PARTS + 1]; MOST_LEVELS + 1],
}

impl<T: Coded> Table<T> {
    pub fn new(levels: &Levels, flipped: bool) -> Table<T> {
        let n = levels.at.len();
        let stored = |k: usize| if flipped { -levels.at[k] } else { levels.at[k] };
        let mut table = Table {
            levels: n,
            flipped,
            at: [T::default(); MOST_LEVELS],
            step: [true; MOST_LEVELS + 1],
            base: [0.0; MOST_LEVELS + 1],
            span: [1.0; MOST_LEVELS + 1],
            unit: [0.0; MOST_LEVELS + 1],
            rise: [[0.0; PARTS + 1]; MOST_LEVELS + 1],
        };
        for k in 0..n {
            table.at[k] = T::from_f64(stored(k));
            table.step[k] = k == 0 || levels.step[k];
            if !table.step[k] {
                table.base[k] = stored(k - 1);
                table.span[k] = stored(k) - stored(k - 1);
                table.rise[k][1..].copy_from_slice(&levels.rise[k]);
                table.unit[k] = if T::DTYPE.is_float() { 0.0 } else { 1.0 / table.span[k].abs() };
            }
        }
        table
    }

    pub fn levels(&self) -> usize {
        self.levels
    }

    /// Whether no value lies strictly between the code's level and the one before.
    pub fn steps(&self, code: usize) -> bool {
        self.step[code.min(MOST_LEVELS)]
    }

    /// How far `v` lies on the way from the level before its code's to that level.
    #[inline(always)]
    pub fn way(&self, v: T, code: u8) -> f64 {
        let code = usize::from(code).min(MOST_LEVELS);
        (v.to_f64() - self.base[code]) / self.span[code]
    }

    /// Share of the interval's voxels up to there; 1 at the level and where there is nothing in between.
    #[inline(always)]
    pub fn weight(&self, way: f64, code: u8) -> f64 {
        let code = usize::from(code).min(MOST_LEVELS);
        if self.step[code] { 1.0 } else { self.risen(way, code) }
    }

    /// The same for the values below.
    #[inline(always)]
    pub fn weight_below(&self, way: f64, code: u8) -> f64 {
        let code = usize::from(code).min(MOST_LEVELS);
        if self.step[code] { 0.0 } else { self.risen(way - self.unit[code], code) }
    }

    /// Linear in each part; exact at both ends.
    #[inline(always)]
    fn risen(&self, way: f64, code: usize) -> f64 {
        // Not a number, where the span overflowed, is the start.
        let place = (way * PARTS as f64).max(0.0);
        let part = (place as usize).min(PARTS - 1);
        let share = place - part as f64;
        self.rise[code][part] * (1.0 - share) + self.rise[code][part + 1] * share
    }
}

/// Whether a voxel is missing.
#[inline(always)]
pub(super) fn gone<T: Voxel>(v: T, missing: Option<T>) -> bool {
    #[allow(clippy::eq_op)] // only NaN differs from itself
    let nan = v != v;
    nan || missing == Some(v)
}

multiversion! {
    /// Codes of a row: levels below each voxel in the order of density, [`NEVER`] for a missing one. Returns whether any is.
    pub(super) fn fill_codes[T: Coded](row: &[T], missing: Option<T>, table: &Table<T>, codes: &mut [u8]) -> bool = fill_inner;
}

#[inline(always)]
fn fill_inner<T: Coded>(row: &[T], missing: Option<T>, table: &Table<T>, codes: &mut [u8]) -> bool {
    const RUN: usize = 64;
    let mut any = false;
    for (row, codes) in row.chunks(RUN).zip(codes.chunks_mut(RUN)) {
        let mut values = [T::default(); RUN];
        values[..row.len()].copy_from_slice(row);
        let mut counts = [T::Count::default(); RUN];
        if table.flipped {
            for level in &table.at[..table.levels] {
                counts.iter_mut().zip(&values).for_each(|(c, v)| *c += T::Count::from(*level > *v));
            }
        } else {
            for level in &table.at[..table.levels] {
                counts.iter_mut().zip(&values).for_each(|(c, v)| *c += T::Count::from(*level < *v));
            }
        }
        codes.iter_mut().zip(&counts).for_each(|(to, c)| *to = (*c).into() as u8);
        if missing.is_some() || T::DTYPE.is_float() {
            for (code, _) in codes.iter_mut().zip(row).filter(|(_, v)| gone(**v, missing)) {
                *code = NEVER;
                any = true;
            }
        }
    }
    any
}
