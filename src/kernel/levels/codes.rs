//! Voxels as codes: how many levels lie below each.

use super::MOST_LEVELS;
use super::choose::Levels;
use super::search;
use super::sums::NEVER;
use crate::grid::Voxel;
use crate::kernel::simd::Level;
use crate::multiversion;

/// A type whose voxels are compared with levels.
pub(crate) trait Coded: Voxel {
    /// As wide as the voxel, so that a comparison's result needs no widening.
    type Count: Copy + Default + std::ops::AddAssign + From<bool> + Into<u64>;
    /// Values of the type, where it has at most 16 bits; else 0.
    const VALUES: usize;
    /// Place among them, ascending with the value.
    fn place(self) -> usize;
    /// Writes the codes of a row by a search in registers; false where there is none (see [`search`]).
    fn search(_level: Level, _row: &[Self], _levels: &[Self], _flipped: bool, _codes: &mut [u8]) -> bool {
        false
    }
}

macro_rules! coded {
    ($($t:ty: $count:ty, $values:expr, $place:expr $(, $search:expr)?;)*) => {$(
        impl Coded for $t {
            type Count = $count;
            const VALUES: usize = $values;
            #[inline(always)]
            fn place(self) -> usize { ($place)(self) }
            $(
                #[inline(always)]
                fn search(level: Level, row: &[Self], levels: &[Self], flipped: bool, codes: &mut [u8]) -> bool {
                    ($search)(level, row, levels, flipped, codes)
                }
            )?
        }
    )*};
}
coded! {
    u8: u8, 1 << 8, |v: u8| usize::from(v);
    i8: u8, 1 << 8, |v: i8| usize::from(v as u8 ^ 0x80);
    u16: u16, 1 << 16, |v: u16| usize::from(v), |level, row, levels, flipped, codes| {
        search::words(level, row, levels, if flipped { 0x7fff } else { 0x8000 }, codes)
    };
    i16: u16, 1 << 16, |v: i16| usize::from(v as u16 ^ 0x8000), |level, row, levels, flipped, codes| {
        search::words(level, as_u16(row), as_u16(levels), if flipped { 0xffff } else { 0 }, codes)
    };
    u32: u32, 0, |_| 0;
    i32: u32, 0, |_| 0;
    f32: u32, 0, |_| 0, search::floats;
    f64: u64, 0, |_| 0;
}

/// The same bits.
fn as_u16(v: &[i16]) -> &[u16] {
    // SAFETY: both have the same size and alignment, and every bit pattern is a number of either.
    unsafe { std::slice::from_raw_parts(v.as_ptr().cast(), v.len()) }
}

/// Stored values of the levels, from the least dense on.
pub(crate) struct Stored<T> {
    count: usize,
    pub flipped: bool,
    at: [T; MOST_LEVELS],
    step: [bool; MOST_LEVELS + 1],
}

impl<T: Coded> Stored<T> {
    pub fn new(levels: &Levels, flipped: bool) -> Stored<T> {
        let count = levels.at.len();
        let mut stored = Stored { count, flipped, at: [T::default(); MOST_LEVELS], step: [true; MOST_LEVELS + 1] };
        for (k, at) in levels.at.iter().enumerate() {
            stored.at[k] = T::from_f64(if flipped { -at } else { *at });
            stored.step[k] = k == 0 || levels.step[k];
        }
        stored
    }

    pub fn levels(&self) -> &[T] {
        &self.at[..self.count]
    }

    /// Whether no value lies strictly between the code's level and the one before.
    pub fn steps(&self, code: usize) -> bool {
        self.step[code.min(MOST_LEVELS)]
    }

    /// Codes of all values of the type; `table` has [`Coded::VALUES`] elements.
    pub fn fill_table(&self, table: &mut [u8]) {
        let places = self.levels().iter().map(|v| v.place()).enumerate();
        table.fill(self.count as u8);
        if T::VALUES == 0 {
            return;
        }
        // Values above the level before, up to the level.
        if self.flipped {
            places.fold(T::VALUES, |end, (k, at)| {
                table[at..end].fill(k as u8);
                at
            });
        } else {
            places.fold(0, |start, (k, at)| {
                table[start..=at].fill(k as u8);
                at + 1
            });
        }
    }
}

/// Whether a voxel is missing.
#[inline(always)]
pub(super) fn gone<T: Voxel>(v: T, missing: Option<T>) -> bool {
    #[allow(clippy::eq_op)] // only NaN differs from itself
    let nan = v != v;
    nan || missing == Some(v)
}

/// What the codes of a box hold beside levels.
#[derive(Default, Clone, Copy)]
pub(super) struct Seen {
    /// Missing voxels.
    pub gaps: bool,
    /// Voxels above every level.
    pub above: bool,
}

/// Codes of a row: levels below each voxel in the order of density, [`NEVER`] for a missing one. `table` holds the codes of
/// all values or is empty.
pub(super) fn fill_codes<T: Coded>(
    level: Level,
    row: &[T],
    missing: Option<T>,
    stored: &Stored<T>,
    table: &[u8],
    codes: &mut [u8],
    seen: &mut Seen,
) {
    let found = T::search(level, row, stored.levels(), stored.flipped, codes);
    match (found, T::VALUES) {
        (true, _) => {}
        (false, 0) => count_levels(level, row, stored, codes),
        (false, values) => match (search::as_bytes(row), table.first_chunk()) {
            (Some(row), Some(table)) => search::bytes(level, row, table, T::default().place() as u8, codes),
            // Not compiled for vectors, which would gather: plain loads are the faster way.
            _ => {
                let table = &table[..values];
                codes.iter_mut().zip(row).for_each(|(code, v)| *code = table[v.place()]);
            }
        },
    }
    see(level, row, missing, stored.count as u8, codes, seen);
}

multiversion! {
    /// Marks missing voxels.
    fn see[T: Coded](row: &[T], missing: Option<T>, top: u8, codes: &mut [u8], seen: &mut Seen) -> () = see_inner;
}

#[inline(always)]
fn see_inner<T: Coded>(row: &[T], missing: Option<T>, top: u8, codes: &mut [u8], seen: &mut Seen) {
    if missing.is_some() || T::DTYPE.is_float() {
        let mut gaps = false;
        for (code, v) in codes.iter_mut().zip(row) {
            let lost = gone(*v, missing);
            *code = if lost { NEVER } else { *code };
            gaps |= lost;
        }
        seen.gaps |= gaps;
    }
    seen.above |= codes.iter().fold(false, |above, code| above | (*code == top));
}

multiversion! {
    /// Levels below each voxel, by comparing it with all.
    fn count_levels[T: Coded](row: &[T], stored: &Stored<T>, codes: &mut [u8]) -> () = count_levels_inner;
}

#[inline(always)]
fn count_levels_inner<T: Coded>(row: &[T], stored: &Stored<T>, codes: &mut [u8]) {
    const RUN: usize = 64;
    for (row, codes) in row.chunks(RUN).zip(codes.chunks_mut(RUN)) {
        let mut values = [T::default(); RUN];
        values[..row.len()].copy_from_slice(row);
        let mut counts = [T::Count::default(); RUN];
        if stored.flipped {
            for level in stored.levels() {
                counts.iter_mut().zip(&values).for_each(|(c, v)| *c += T::Count::from(*level > *v));
            }
        } else {
            for level in stored.levels() {
                counts.iter_mut().zip(&values).for_each(|(c, v)| *c += T::Count::from(*level < *v));
            }
        }
        codes.iter_mut().zip(&counts).for_each(|(to, c)| *to = (*c).into() as u8);
    }
}
