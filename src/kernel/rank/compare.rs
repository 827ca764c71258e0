//! Counting by comparison: every voxel of a window against its centre, one vector of centres at a time. Along y, four output
//! rows share each load.

use std::ops::Range;

use super::vector::{self, Block, Lanes};
use super::{Counts, Key, MOST_LANES, Plan};
use crate::kernel::simd::Level;
use crate::multiversion;
use crate::stage::Ties;

/// Output rows that share loads.
pub(super) const ROWS: usize = 4;

/// Fills `counts` for up to [`MOST_LANES`] output voxels from `[z, y, x]` on in each of `rows` rows. `keys` and `valid` are
/// the padded source; `valid` is given where voxels are missing.
pub(super) fn count<K: Key, const L: usize>(
    level: Level,
    keys: &[K],
    valid: Option<&[i8]>,
    plan: &Plan,
    place: [usize; 3],
    rows: usize,
    counts: &mut [Counts; ROWS],
) {
    for x in (0..MOST_LANES).step_by(L) {
        let place = [place[0], place[1], place[2] + x];
        if place[2] >= plan.dst[2] {
            break;
        }
        let mut totals = [[[0u32; L]; 2]; ROWS];
        if plan.ties == Ties::Mid {
            windows::<K, L, true>(level, keys, None, plan, place, rows, &mut totals);
        } else {
            windows::<K, L, false>(level, keys, None, plan, place, rows, &mut totals);
        }
        for (counts, totals) in counts.iter_mut().zip(&totals) {
            counts.above[x..x + L].copy_from_slice(&totals[0]);
            counts.not_below[x..x + L].copy_from_slice(&totals[1]);
        }
    }
    match valid {
        None => {
            for (j, counts) in counts[..rows].iter_mut().enumerate() {
                plan.sizes(place[0], place[1] + j, place[2], &mut counts.n);
            }
        }
        Some(valid) => {
            let mut totals = [[[0u32; MOST_LANES]; 2]; ROWS];
            windows::<i8, MOST_LANES, false>(level, valid, Some(0), plan, place, rows, &mut totals);
            counts.iter_mut().zip(&totals).for_each(|(c, t)| c.n = t[0]);
        }
    }
}

/// Totals of one run: per row, keys above the centre and keys not below it.
type Totals<const L: usize> = [[[u32; L]; 2]; ROWS];

/// Compares the windows about `L` voxels of each of `rows` output rows with their centres, or with `centre`.
fn windows<K: Key, const L: usize, const MID: bool>(
    level: Level,
    keys: &[K],
    centre: Option<K>,
    plan: &Plan,
    [z, y, x]: [usize; 3],
    rows: usize,
    totals: &mut Totals<L>,
) {
    let rx = plan.radius[2];
    let start = |z: usize, y: usize| (z * plan.src[1] + y) * plan.width + x;
    let centres: [[K; L]; ROWS] = std::array::from_fn(|j| match centre {
        Some(c) => [c; L],
        None => {
            let from = start(plan.at[0] + z, plan.at[1] + y + j.min(rows - 1)) + rx;
            keys[from..from + L].try_into().unwrap()
        }
    });
    let bands: [_; ROWS] = std::array::from_fn(|j| {
        let band = plan.window(1, y + j.min(rows - 1));
        *band.start()..*band.end() + 1
    });
    // rows of the source that all output rows see are loaded once for all
    let mut shared = bands[0].end..bands[0].end;
    if plan.reach.is_empty() && rows == ROWS && bands[ROWS - 1].start < bands[0].end {
        shared.start = bands[ROWS - 1].start;
    }
    for sz in plan.window(0, z) {
        let dz = sz as i64 - (plan.at[0] + z) as i64;
        let block = |ys: &Range<usize>, reach: usize| Block {
            keys: &keys[start(sz, ys.start) + rx - reach..],
            stride: plan.width,
            rows: ys.len(),
            shifts: 2 * reach + 1,
        };
        if !shared.is_empty() {
            count_block::<K, L, ROWS, MID>(level, block(&shared, rx), &centres, totals);
        }
        for j in 0..rows {
            let (centre, total) = (std::array::from_ref(&centres[j]), std::array::from_mut(&mut totals[j]));
            if plan.reach.is_empty() {
                for ys in [bands[j].start..shared.start.min(bands[j].end), shared.end.max(bands[j].start)..bands[j].end]
                {
                    if !ys.is_empty() {
                        count_block::<K, L, 1, MID>(level, block(&ys, rx), centre, total);
                    }
                }
                continue;
            }
            for sy in bands[j].clone() {
                let dy = sy as i64 - (plan.at[1] + y + j) as i64;
                if let Some(reach) = plan.reach(dz, dy) {
                    count_block::<K, L, 1, MID>(level, block(&(sy..sy + 1), reach), centre, total);
                }
            }
        }
    }
}

/// Counts a block in parts that narrow counters hold, and adds them to the totals.
#[inline(always)]
fn count_block<K: Key, const L: usize, const R: usize, const MID: bool>(
    level: Level,
    block: Block<K>,
    centres: &[[K; L]; R],
    totals: &mut [[[u32; L]; 2]; R],
) {
    let rows = (K::MOST / block.shifts).max(1);
    for first in (0..block.rows).step_by(rows) {
        for shift in (0..block.shifts).step_by(K::MOST) {
            let part = Block {
                keys: &block.keys[first * block.stride + shift..],
                rows: rows.min(block.rows - first),
                shifts: K::MOST.min(block.shifts - shift),
                ..block
            };
            let (mut above, mut not_below) = ([[K::Count::default(); L]; R], [[K::Count::default(); L]; R]);
            let lanes = Lanes { above: &mut above, not_below: &mut not_below };
            vector::compare::<K, L, R, MID>(level, part, centres, lanes);
            add_counts(level, &above, 0, totals);
            if MID {
                add_counts(level, &not_below, 1, totals);
            }
        }
    }
}

multiversion! {
    fn add_counts[C: Copy + Into<u64>, const L: usize, const R: usize](
        counts: &[[C; L]; R], which: usize, totals: &mut [[[u32; L]; 2]; R],
    ) -> () = add_counts_inner;
}

#[inline(always)]
fn add_counts_inner<C: Copy + Into<u64>, const L: usize, const R: usize>(
    counts: &[[C; L]; R],
    which: usize,
    totals: &mut [[[u32; L]; 2]; R],
) {
    for (total, counts) in totals.iter_mut().zip(counts) {
        for (t, c) in total[which].iter_mut().zip(counts) {
            let c: u64 = (*c).into();
            *t += c as u32;
        }
    }
}
