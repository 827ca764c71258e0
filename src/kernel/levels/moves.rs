//! How columns change when their windows go down one plane: a voxel enters and one leaves, whose lanes a small table holds.

use std::ops::Range;

use super::vector;
use crate::kernel::simd::Level;
use crate::multiversion;

/// Moves columns that no sum is made of.
pub(super) fn shift<const L: usize>(level: Level, columns: &mut [[u8; L]], moves: Moves<L>) {
    if !columns.is_empty() && !vector::shift(level, columns, moves) {
        columns.iter_mut().enumerate().for_each(|(x, column)| *column = moves.apply(x, *column));
    }
}

/// Lanes that count a voxel, by its step: the number of lanes that do not.
pub(super) struct Steps<'a, const L: usize> {
    /// Bytes as those of a column, 1 where the lane counts the voxel: rows for 0 to L steps.
    rows: &'a [[u8; L]],
    /// Threshold of the first lane, how many follow it one by one, and the last threshold. Any lanes between these have the last
    /// threshold as well.
    first: u8,
    regular: u8,
    last: u8,
}

impl<'a, const L: usize> Steps<'a, L> {
    pub fn new(lanes: &[u8; L], rows: &'a mut [[u8; L]]) -> Steps<'a, L> {
        let rows = &mut rows[..L + 1];
        for (step, row) in rows.iter_mut().enumerate() {
            *row = vector::in_columns(&std::array::from_fn(|k| u8::from(k >= step)));
        }
        let (first, last) = (lanes[0], lanes[L - 1]);
        let regular = lanes.iter().zip(first..=u8::MAX).take_while(|(lane, next)| **lane == *next).count();
        assert!(lanes[regular..].iter().all(|lane| *lane == last), "lanes {lanes:?} are no row of thresholds");
        Steps { rows, first, regular: regular as u8, last }
    }
}

/// How columns change when a voxel of each is replaced: the place in the table of steps, in bytes, of the voxel that enters and
/// of the one that leaves.
#[derive(Clone, Copy)]
pub(super) struct Moves<'a, const L: usize> {
    steps: &'a [[u8; L]],
    enter: &'a [u16],
    leave: &'a [u16],
}

impl<'a, const L: usize> Moves<'a, L> {
    pub fn between(
        level: Level,
        steps: &Steps<'a, L>,
        enters: &[u8],
        leaves: &[u8],
        places: &'a mut [u16],
    ) -> Moves<'a, L> {
        let (enter, leave) = places.split_at_mut(enters.len());
        let bounds = [steps.first, steps.regular, steps.last, L as u8];
        find_places(level, bounds, enters, enter);
        find_places(level, bounds, leaves, leave);
        Moves { steps: steps.rows, enter, leave }
    }

    pub fn cut(&self, columns: Range<usize>) -> Moves<'a, L> {
        let [enter, leave] = [self.enter, self.leave].map(|m| &m[columns.clone()]);
        Moves { enter, leave, ..*self }
    }

    /// Columns that move.
    #[inline(always)]
    pub fn len(&self) -> usize {
        self.enter.len().min(self.leave.len())
    }

    /// Rows of lanes that are added to column `x` and taken off it.
    ///
    /// # Safety
    /// `x` must be less than [`Moves::len`].
    #[inline(always)]
    pub unsafe fn rows(&self, x: usize) -> [*const u8; 2] {
        let table = self.steps.as_ptr().cast::<u8>();
        // SAFETY: as the caller promised; places are those of rows of the table, see `find_places_inner`.
        unsafe { [self.enter, self.leave].map(|m| table.add(usize::from(*m.get_unchecked(x)))) }
    }

    /// Change of column `x`.
    #[inline(always)]
    pub fn change(&self, x: usize) -> [u8; L] {
        let [enters, leaves] = [self.enter[x], self.leave[x]].map(|place| &self.steps[usize::from(place) / L]);
        std::array::from_fn(|k| enters[k].wrapping_sub(leaves[k]))
    }

    /// Column `x` moved.
    #[inline(always)]
    pub fn apply(&self, x: usize, column: [u8; L]) -> [u8; L] {
        let change = self.change(x);
        std::array::from_fn(|k| column[k].wrapping_add(change[k]))
    }
}

multiversion! {
    /// Places of codes in the table of steps.
    fn find_places[](bounds: [u8; 4], codes: &[u8], places: &mut [u16]) -> () = find_places_inner;
}

#[inline(always)]
fn find_places_inner([first, regular, last, lanes]: [u8; 4], codes: &[u8], places: &mut [u16]) {
    for (place, code) in places.iter_mut().zip(codes) {
        let step = if *code > last { lanes } else { code.saturating_sub(first).min(regular) };
        *place = u16::from(step) * u16::from(lanes);
    }
}
