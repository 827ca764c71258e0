//! What is counted for a row of output voxels.

use std::ops::Range;

use super::sums::{NEVER, Row, Sum, Windows};
use crate::kernel::simd::Level;
use crate::multiversion;

/// Most voxels of a row of a tile of [`levels`](super::levels).
pub(super) const RUN: usize = 128;

/// What counts the voxels of a window.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum All {
    /// Its extents: none are missing.
    Inside,
    /// The top level: none lie above it.
    Top,
    /// A lane of its own, the last.
    Last,
}

/// Thresholds of one sweep, and the codes whose voxels it counts.
pub(super) struct Lanes {
    levels: usize,
    /// Threshold of the first lane; the others follow.
    first: usize,
    all: All,
    /// Codes of the sweep, where there is another one.
    pub part: Option<Range<usize>>,
}

impl Lanes {
    /// The sweeps that `levels` thresholds take with `lanes` lanes each: one, or two where a lane is missing.
    pub fn sweeps(levels: usize, all: All, lanes: usize) -> impl Iterator<Item = Lanes> {
        let own = lanes - usize::from(all == All::Last);
        let whole = levels <= own;
        let first = Lanes { levels, first: 0, all, part: (!whole).then_some(0..own - 1) };
        // Two levels about each interval of the second part, which starts where the first one has no level after the next.
        let more = Lanes { levels, first: own - 3, all, part: Some(own - 1..usize::from(NEVER) + 1) };
        [Some(first), (!whole).then_some(more)].into_iter().flatten()
    }

    pub fn thresholds<const L: usize>(&self) -> [u8; L] {
        std::array::from_fn(|k| match self.all == All::Last && k == L - 1 {
            true => NEVER - 1,
            false => (self.first + k) as u8,
        })
    }
}

/// Counts of a row.
pub(super) struct Counts {
    /// Voxels of the window.
    pub n: [u32; RUN],
    /// Those not above the level before the centre, and not above the next one.
    pub low: [u32; RUN],
    pub high: [u32; RUN],
    /// Those in the interval between levels before the centre's, and in the one after it.
    pub before: [u32; RUN],
    pub after: [u32; RUN],
    /// Some window lies between two levels as a whole.
    pub narrow: bool,
}

impl Counts {
    pub fn new() -> Counts {
        let none = [0; RUN];
        Counts { n: [1; RUN], low: none, high: none, before: none, after: none, narrow: false }
    }
}

/// Counts of a row whose windows have `rows` rows.
pub(super) fn count_row<S: Sum, const L: usize>(
    level: Level,
    centres: &[u8],
    row: Row<S, L>,
    windows: &Windows,
    rows: u32,
    lanes: &Lanes,
    counts: &mut Counts,
) {
    let mut codes = [0u8; RUN];
    codes[..centres.len()].copy_from_slice(centres);
    let (mut ends, mut starts) = ([0; RUN], [0; RUN]);
    places(level, &codes, windows, [L as u32, lanes.first as u32], &mut ends, &mut starts);
    let [mut ends_of, mut starts_of] = [[[S::default(); 4]; RUN]; 2];
    row.fours(&ends, &mut ends_of);
    row.fours(&starts, &mut starts_of);
    let all = match lanes.all {
        All::Inside => None,
        All::Top => Some(lanes.levels.saturating_sub(1).wrapping_sub(lanes.first) % L),
        All::Last => Some(L - 1),
    };
    match all {
        None => extents(level, windows, rows, &mut counts.n),
        Some(lane) => {
            let sizes = counts.n[..centres.len()].iter_mut().enumerate();
            sizes.for_each(|(x, n)| *n = row.count(&windows.of(x), lane));
        }
    }
    finish(level, &codes, &ends_of, &starts_of, [lanes.levels as u32, lanes.first as u32, L as u32], counts);
    counts.narrow = narrow(level, centres.len(), counts);
}

multiversion! {
    /// Where the sums of each voxel lie, at the end of its window and at its start: lanes of the two levels before and of the two
    /// that follow are neighbours, and are read at once.
    fn places[](
        codes: &[u8; RUN], windows: &Windows, lanes: [u32; 2], ends: &mut [u32; RUN], starts: &mut [u32; RUN],
    ) -> () = places_inner;
}

#[inline(always)]
fn places_inner(
    codes: &[u8; RUN],
    windows: &Windows,
    [lanes, first]: [u32; 2],
    ends: &mut [u32; RUN],
    starts: &mut [u32; RUN],
) {
    for x in 0..RUN {
        let lane = u32::from(codes[x]).saturating_sub(first + 2).min(lanes - 4);
        ends[x] = windows.end[x] * lanes + lane;
        starts[x] = windows.start[x] * lanes + lane;
    }
}

multiversion! {
    fn extents[](windows: &Windows, rows: u32, n: &mut [u32; RUN]) -> () = extents_inner;
}

#[inline(always)]
fn extents_inner(windows: &Windows, rows: u32, n: &mut [u32; RUN]) {
    for ((n, end), start) in n.iter_mut().zip(&windows.end).zip(&windows.start) {
        *n = rows * (end - start);
    }
}

multiversion! {
    /// Counts from the sums of four lanes at both places. Codes from `levels` on lie above all; lanes start at level `first`.
    fn finish[S: Sum](
        codes: &[u8; RUN], ends: &[[S; 4]; RUN], starts: &[[S; 4]; RUN], bounds: [u32; 3], counts: &mut Counts,
    ) -> () = finish_inner;
}

#[inline(always)]
fn finish_inner<S: Sum>(
    codes: &[u8; RUN],
    ends: &[[S; 4]; RUN],
    starts: &[[S; 4]; RUN],
    [levels, first, lanes]: [u32; 3],
    counts: &mut Counts,
) {
    for x in 0..RUN {
        let (code, n) = (u32::from(codes[x]), counts.n[x]);
        let [a, b, c, d] = std::array::from_fn(|i| -> u32 { ends[x][i].minus(starts[x][i]).into() });
        // Read were the two levels before the centre and the two that follow, or the nearest four: no voxel lies below the
        // first level, ...
        let (one, two) = (code < first + 2, code < first + 1);
        let [a, b, c, d] = if one { [0, a, b, c] } else { [a, b, c, d] };
        let [a, b, c, d] = if two { [0, a, b, c] } else { [a, b, c, d] };
        // ... and all of them below what follows the last lane.
        let (one, two) = (code > first + lanes - 2, code > first + lanes - 1);
        let [a, b, c, d] = if one { [b, c, d, n] } else { [a, b, c, d] };
        let [a, b, c, d] = if two { [b, c, d, n] } else { [a, b, c, d] };
        let c = if code >= levels { n } else { c };
        let d = if code + 1 >= levels { n } else { d };
        counts.low[x] = b;
        counts.high[x] = c;
        counts.before[x] = b.wrapping_sub(a);
        counts.after[x] = d.wrapping_sub(c);
    }
}

multiversion! {
    /// Whether one of the first `voxels` windows lies between two levels.
    fn narrow[](voxels: usize, counts: &Counts) -> bool = narrow_inner;
}

#[inline(always)]
fn narrow_inner(voxels: usize, counts: &Counts) -> bool {
    let mut any = 0;
    for x in 0..RUN {
        let inside = u32::from(x < voxels);
        any |= inside & u32::from(counts.high[x].wrapping_sub(counts.low[x]) == counts.n[x]);
    }
    any != 0
}
