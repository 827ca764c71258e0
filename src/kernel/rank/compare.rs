//! Counting by comparison: every voxel of a window against its centre, one vector of centres at a time. Along y, four output
//! rows share each load.

use super::{Counts, Key, MOST_LANES, Plan};
use crate::multiversion;
use crate::stage::Ties;

/// Output rows that share loads.
pub(super) const ROWS: usize = 4;

/// Fills `counts` for up to [`MOST_LANES`] output voxels from `[z, y, x]` on in each of `rows` rows. `keys` and `valid` are
/// the padded source; `valid` is given where voxels are missing.
pub(super) fn count<K: Key, const L: usize>(
    level: crate::kernel::simd::Level,
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
            compare_all(level, keys, None, plan, place, rows, &mut totals);
        } else {
            above_all(level, keys, None, plan, place, rows, &mut totals);
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
            above_all(level, valid, Some(0), plan, place, rows, &mut totals);
            counts.iter_mut().zip(&totals).for_each(|(c, t)| c.n = t[0]);
        }
    }
}

/// Totals of one run: per row, keys above the centre and keys not below it.
type Totals<const L: usize> = [[[u32; L]; 2]; ROWS];

multiversion! {
    fn above_all[K: Key, const L: usize](
        keys: &[K], centre: Option<K>, plan: &Plan, place: [usize; 3], rows: usize, totals: &mut Totals<L>,
    ) -> () = windows::<K, L, false>;
}

multiversion! {
    fn compare_all[K: Key, const L: usize](
        keys: &[K], centre: Option<K>, plan: &Plan, place: [usize; 3], rows: usize, totals: &mut Totals<L>,
    ) -> () = windows::<K, L, true>;
}

/// Compares the windows about `L` voxels of each of `rows` output rows with their centres, or with `centre`.
#[inline(always)]
fn windows<K: Key, const L: usize, const MID: bool>(
    keys: &[K],
    centre: Option<K>,
    plan: &Plan,
    [z, y, x]: [usize; 3],
    rows: usize,
    totals: &mut Totals<L>,
) {
    let rx = plan.radius[2];
    let row = |z: usize, y: usize| &keys[(z * plan.src[1] + y) * plan.width + x..][..L + 2 * rx];
    let centres: [[K; L]; ROWS] = std::array::from_fn(|j| match centre {
        Some(c) => [c; L],
        None => row(plan.at[0] + z, plan.at[1] + y + j.min(rows - 1))[rx..rx + L].try_into().unwrap(),
    });
    let bands: [_; ROWS] = std::array::from_fn(|j| plan.window(1, y + j.min(rows - 1)));
    // rows of the source that all output rows see are loaded once for all
    let shared =
        if plan.reach.is_empty() && rows == ROWS { *bands[ROWS - 1].start()..*bands[0].end() + 1 } else { 0..0 };
    let mut runs: [Run<K, L>; ROWS] = std::array::from_fn(|_| Run::default());
    for sz in plan.window(0, z) {
        let dz = sz as i64 - (plan.at[0] + z) as i64;
        for sy in shared.clone() {
            let row = row(sz, sy);
            runs.iter_mut().zip(totals.iter_mut()).for_each(|(r, t)| r.make_room::<MID>(2 * rx + 1, t));
            compare_rows::<K, L, MID>(row, &centres, &mut runs, totals);
        }
        for j in 0..rows {
            for sy in bands[j].clone().filter(|sy| !shared.contains(sy)) {
                let dy = sy as i64 - (plan.at[1] + y + j) as i64;
                let Some(reach) = plan.reach(dz, dy) else { continue };
                let part = &row(sz, sy)[rx - reach..][..L + 2 * reach];
                runs[j].make_room::<MID>(2 * reach + 1, &mut totals[j]);
                compare_row::<K, L, MID>(part, &centres[j], &mut runs[j], &mut totals[j]);
            }
        }
    }
    runs.iter_mut().zip(totals.iter_mut()).for_each(|(r, t)| r.flush::<MID>(t));
}

/// Counts in lanes as narrow as the keys, emptied into totals before they overflow.
struct Run<K: Key, const L: usize> {
    above: [K::Count; L],
    not_below: [K::Count; L],
    used: usize,
}

impl<K: Key, const L: usize> Default for Run<K, L> {
    #[inline(always)]
    fn default() -> Self {
        Run { above: [Default::default(); L], not_below: [Default::default(); L], used: 0 }
    }
}

impl<K: Key, const L: usize> Run<K, L> {
    #[inline(always)]
    fn flush<const MID: bool>(&mut self, totals: &mut [[u32; L]; 2]) {
        for l in 0..L {
            let count: u64 = self.above[l].into();
            totals[0][l] += count as u32;
            if MID {
                let count: u64 = self.not_below[l].into();
                totals[1][l] += count as u32;
            }
        }
        *self = Run::default();
    }

    /// Makes room for `n` more comparisons, or as many as fit.
    #[inline(always)]
    fn make_room<const MID: bool>(&mut self, n: usize, totals: &mut [[u32; L]; 2]) {
        if self.used + n > K::MOST {
            self.flush::<MID>(totals);
        }
        self.used += n;
    }
}

/// Compares each of the `row.len() - L + 1` vectors of a row with the centres of all output rows.
#[inline(always)]
fn compare_rows<K: Key, const L: usize, const MID: bool>(
    row: &[K],
    centres: &[[K; L]; ROWS],
    runs: &mut [Run<K, L>; ROWS],
    totals: &mut Totals<L>,
) {
    if row.len() - L + 1 > K::MOST {
        for j in 0..ROWS {
            compare_row::<K, L, MID>(row, &centres[j], &mut runs[j], &mut totals[j]);
        }
        return;
    }
    let mut above: [[K::Count; L]; ROWS] = std::array::from_fn(|j| runs[j].above);
    let mut not_below: [[K::Count; L]; ROWS] = std::array::from_fn(|j| runs[j].not_below);
    for v in row.windows(L) {
        let v: &[K; L] = v.try_into().unwrap();
        for j in 0..ROWS {
            for l in 0..L {
                above[j][l] += K::Count::from(v[l] > centres[j][l]);
            }
            if MID {
                for l in 0..L {
                    not_below[j][l] += K::Count::from(v[l] >= centres[j][l]);
                }
            }
        }
    }
    for j in 0..ROWS {
        runs[j].above = above[j];
        runs[j].not_below = not_below[j];
    }
}

/// As [`compare_rows`] for one output row, of any length.
#[inline(always)]
fn compare_row<K: Key, const L: usize, const MID: bool>(
    row: &[K],
    centre: &[K; L],
    run: &mut Run<K, L>,
    totals: &mut [[u32; L]; 2],
) {
    let n = row.len() - L + 1;
    for first in (0..n).step_by(K::MOST) {
        if first > 0 || n > K::MOST {
            run.flush::<MID>(totals);
            run.used = K::MOST;
        }
        let (mut above, mut not_below) = (run.above, run.not_below);
        for v in row[first..(first + K::MOST + L - 1).min(row.len())].windows(L) {
            let v: &[K; L] = v.try_into().unwrap();
            for l in 0..L {
                above[l] += K::Count::from(v[l] > centre[l]);
            }
            if MID {
                for l in 0..L {
                    not_below[l] += K::Count::from(v[l] >= centre[l]);
                }
            }
        }
        run.above = above;
        run.not_below = not_below;
    }
}
