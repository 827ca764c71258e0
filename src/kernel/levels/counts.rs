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
        let first = Lanes { levels, first: 0, all, part: (!whole).then_some(0..own) };
        let more = Lanes { levels, first: own - 1, all, part: Some(own..usize::from(NEVER) + 1) };
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
    /// Some window lies between two levels as a whole.
    pub narrow: bool,
}

impl Counts {
    pub fn new() -> Counts {
        Counts { n: [1; RUN], low: [0; RUN], high: [0; RUN], narrow: false }
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
    let (ends, starts) = (row.pairs(&ends), row.pairs(&starts));
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
    finish(level, &codes, &ends, &starts, [lanes.levels as u32, (lanes.first + L) as u32], counts);
    counts.narrow = narrow(level, centres.len(), counts);
}

multiversion! {
    /// Where the sums of each voxel lie, at the end of its window and at its start: lanes of the level before and of the next one
    /// are neighbours, and are read as a pair.
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
        let lane = (u32::from(codes[x].max(1)) - 1).wrapping_sub(first).min(lanes - 2);
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
    /// Counts from the sums of both lanes at both places. Codes from `levels` on lie above all, and `beyond` is the one whose first
    /// lane is the last.
    fn finish[S: Sum](
        codes: &[u8; RUN], ends: &[[S; 2]; RUN], starts: &[[S; 2]; RUN], bounds: [u32; 2], counts: &mut Counts,
    ) -> () = finish_inner;
}

#[inline(always)]
fn finish_inner<S: Sum>(
    codes: &[u8; RUN],
    ends: &[[S; 2]; RUN],
    starts: &[[S; 2]; RUN],
    [levels, beyond]: [u32; 2],
    counts: &mut Counts,
) {
    for x in 0..RUN {
        let code = u32::from(codes[x]);
        let one: u32 = ends[x][0].minus(starts[x][0]).into();
        let two: u32 = ends[x][1].minus(starts[x][1]).into();
        let low = if code == beyond { two } else { one };
        counts.low[x] = if code == 0 { 0 } else { low };
        let high = if code == 0 { one } else { two };
        counts.high[x] = if code >= levels { counts.n[x] } else { high };
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
