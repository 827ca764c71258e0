//! The full regression, for windows with missing voxels: weighted least squares of f ~ A z + B y + C x + D over the voxels
//! that are left, eight windows at once.
//!
//! Sums over z and y of whole columns serve all windows that see the column. They are taken over voxels that are there: of
//! the weights w times 1, y, z and their products, and of w times the value times 1, y, z. Weights depend on |offset|
//! only, so a block of 5 x 5 rows is first folded into sums and differences of rows that mirror each other. Values are
//! taken relative to a voxel of the column, and columns relative to the window's centre, so that a constant window gives
//! exactly zero and nothing depends on where a brick starts. Offsets are whole voxels; the same sums without weights are
//! integers, and say exactly whether a plane is determined. No fused operations, as in the kernel for full windows.

use super::{RUN, Table};
use crate::grid::{DType, Voxel};
use crate::kernel::lanes::{F64x8, LANES};
use crate::on_lanes;

/// What a column has, first rows in [`Columns`]: of each but the last two one per |dx|, since weights depend on it.
const WEIGHT: usize = 0;
const Y: usize = 3;
const Z: usize = 6;
// yy, zz and zy follow
const VALUE: usize = 18;
const VALUE_Y: usize = 21;
const VALUE_Z: usize = 24;
/// As those before `VALUE`, all weights 1 and one row each.
const COUNT: usize = 27;
/// What values are relative to.
const PIVOT: usize = 33;

/// Columns side by side: all that eight windows see, and some more. (Five groups of eight at once, so that no sum is read right
/// after it was written, are no faster: 2-core Zen 4 VM, AVX-512, 2026-11-27, 65.2 ns per voxel beside 61.5.)
type Columns = [[f64; 2 * LANES]; PIVOT + 1];

on_lanes! {
    /// Puts the regression into `parts` (z, y, x in turn, [`RUN`] apart) for those of `n` windows that hold a missing voxel,
    /// NaN where the centre is missing, and leaves the others. `rows` are the rows of the windows, from the first column
    /// that the first window sees. Zero where the voxels that are left do not determine a plane; NaN beside an infinity.
    pub(super) fn regress_gaps[const H: usize, T: Voxel](
        rows: &[[&[T]; 5]; 5], missing: Option<T>, n: usize, table: &Table, parts: &mut [f64]
    ) = regress_gaps_inner[H, T];
}

#[inline(always)]
fn regress_gaps_inner<V: F64x8, const H: usize, T: Voxel>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    n: usize,
    table: &Table,
    parts: &mut [f64],
) {
    let mut columns: Columns = [[0.0; 2 * LANES]; PIVOT + 1];
    // whether the second half of `columns` is what is now the first
    let mut held = false;
    for i in (0..n).step_by(LANES) {
        if !look::<V, T>(rows[H][H], i + H, missing, &mut parts[i..]) {
            held = false;
            continue;
        }
        if held {
            for row in &mut columns {
                row.copy_within(LANES.., 0);
            }
        }
        for half in usize::from(held)..2 {
            sum_columns::<V, H, T>(rows, missing, table, i + half * LANES, &mut columns, half * LANES);
        }
        held = true;
        let centre = eight::<V, T>(rows[H][H], i + H, missing).present();
        fit::<V, H>(&columns, centre, table, &mut parts[i..]);
    }
}

/// Whether the eight windows in the front of `parts`, whose centres stand from `i` on, may have a gap but are not all
/// without a centre; what has none becomes NaN.
#[inline(always)]
fn look<V: F64x8, T: Voxel>(centres: &[T], i: usize, missing: Option<T>, parts: &mut [f64]) -> bool {
    let [_, there] = eight::<V, T>(centres, i, missing).present();
    let half = V::splat(0.5);
    let mut whole = there;
    for a in 0..3 {
        let part = parts[a * RUN..][..LANES].as_mut_ptr();
        // SAFETY: eight values, just cut.
        unsafe {
            // a missing voxel makes a component NaN, since each but the centre has a weight in one at least
            whole = whole.where_positive(V::load(part).present()[1]);
            if half.minus(there).all_positive() {
                V::splat(f64::NAN).store(part);
            }
        }
    }
    !whole.all_positive() && !half.minus(there).all_positive()
}

/// Eight voxels from `i` on, missing ones NaN; past the row's end its last.
#[inline(always)]
fn eight<V: F64x8, T: Voxel>(row: &[T], i: usize, missing: Option<T>) -> V {
    let mut to = [0.0; LANES];
    match row.get(i..i + LANES) {
        // SAFETY: eight values of that very type.
        Some(from) if T::DTYPE == DType::F32 => return unsafe { V::load_f32(from.as_ptr().cast()) },
        // SAFETY: as above.
        Some(from) if T::DTYPE == DType::F64 => return unsafe { V::load(from.as_ptr().cast()) },
        Some(from) => {
            for l in 0..LANES {
                to[l] = if missing == Some(from[l]) { f64::NAN } else { from[l].to_f64() };
            }
        }
        None => {
            for (l, to) in to.iter_mut().enumerate() {
                let v = row[(i + l).min(row.len() - 1)];
                *to = if missing == Some(v) { f64::NAN } else { v.to_f64() };
            }
        }
    }
    // SAFETY: eight values.
    unsafe { V::load(to.as_ptr()) }
}

/// All sums of the eight columns from `i` on, into lanes `lane..` of `columns`.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // offsets index weights and rows alike
fn sum_columns<V: F64x8, const H: usize, T: Voxel>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    table: &Table,
    i: usize,
    columns: &mut Columns,
    lane: usize,
) {
    let zero = V::splat(0.0);
    let (mut value, mut there) = ([[zero; 5]; 5], [[zero; 5]; 5]);
    for z in 0..=2 * H {
        for y in 0..=2 * H {
            [value[z][y], there[z][y]] = eight::<V, T>(rows[z][y], i, missing).present();
        }
    }
    let pivot = pivot::<V, H>(&value, &there);
    for z in 0..=2 * H {
        for y in 0..=2 * H {
            value[z][y] = value[z][y].minus(pivot).where_positive(there[z][y]);
        }
    }
    fold::<V, H>(&mut value);
    fold::<V, H>(&mut there);
    for x in 0..=H {
        let sums = mask_sums::<V, H>(&there, &table.weight, x);
        for (k, sum) in sums.into_iter().enumerate() {
            put(columns, WEIGHT + 3 * k + x, lane, sum);
        }
        let sums = value_sums::<V, H>(&value, &table.weight, x);
        for (k, sum) in sums.into_iter().enumerate() {
            put(columns, VALUE + 3 * k + x, lane, sum);
        }
    }
    for (k, sum) in mask_sums::<V, H>(&there, &[[[1.0; 3]; 3]; 3], 0).into_iter().enumerate() {
        put(columns, COUNT + k, lane, sum);
    }
    put(columns, PIVOT, lane, pivot);
}

#[inline(always)]
fn put<V: F64x8>(columns: &mut Columns, row: usize, lane: usize, sum: V) {
    // SAFETY: eight values, just cut.
    unsafe { sum.store(columns[row][lane..][..LANES].as_mut_ptr()) }
}

/// The voxel in the middle of each column, or another that is there.
#[inline(always)]
fn pivot<V: F64x8, const H: usize>(value: &[[V; 5]; 5], there: &[[V; 5]; 5]) -> V {
    if there[H][H].all_positive() {
        return value[H][H];
    }
    let mut pivot = V::splat(0.0);
    for z in 0..=2 * H {
        for y in 0..=2 * H {
            pivot = value[z][y].choose(there[z][y], pivot);
        }
    }
    value[H][H].choose(there[H][H], pivot)
}

/// Sums and differences of rows that mirror each other, along y and then z: the sum of rows H + d and H - d stands at H + d,
/// their difference at H - d.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // two rows at a time
fn fold<V: F64x8, const H: usize>(rows: &mut [[V; 5]; 5]) {
    for row in rows.iter_mut().take(2 * H + 1) {
        for d in 1..=H {
            let (a, b) = (row[H + d], row[H - d]);
            (row[H + d], row[H - d]) = (a.plus(b), a.minus(b));
        }
    }
    for d in 1..=H {
        for y in 0..=2 * H {
            let (a, b) = (rows[H + d][y], rows[H - d][y]);
            (rows[H + d][y], rows[H - d][y]) = (a.plus(b), a.minus(b));
        }
    }
}

/// Weights by |dz|, |dy|, |dx|.
type Weights = [[[f64; 3]; 3]; 3];

/// Sums of w times 1, y, z, yy, zz, zy over folded rows, the weights those of columns `x` away.
#[inline(always)]
fn mask_sums<V: F64x8, const H: usize>(rows: &[[V; 5]; 5], weights: &Weights, x: usize) -> [V; 6] {
    let zero = V::splat(0.0);
    let [mut one, mut in_y, mut in_z, mut yy, mut zz, mut zy] = [zero; 6];
    for dz in 0..=H {
        let mut plane = zero;
        for dy in 0..=H {
            let w = weights[dz][dy][x];
            let even = V::splat(w).times(rows[H + dz][H + dy]);
            plane = plane.plus(even);
            if dy > 0 {
                yy = yy.plus(if dy > 1 { V::splat((dy * dy) as f64).times(even) } else { even });
                in_y = in_y.plus(V::splat(w * dy as f64).times(rows[H + dz][H - dy]));
            }
            if dz > 0 {
                in_z = in_z.plus(V::splat(w * dz as f64).times(rows[H - dz][H + dy]));
            }
            if dz > 0 && dy > 0 {
                zy = zy.plus(V::splat(w * (dz * dy) as f64).times(rows[H - dz][H - dy]));
            }
        }
        one = one.plus(plane);
        if dz > 0 {
            zz = zz.plus(V::splat((dz * dz) as f64).times(plane));
        }
    }
    [one, in_y, in_z, yy, zz, zy]
}

/// Sums of w times the value times 1, y, z, as [`mask_sums`].
#[inline(always)]
fn value_sums<V: F64x8, const H: usize>(rows: &[[V; 5]; 5], weights: &Weights, x: usize) -> [V; 3] {
    let [mut one, mut in_y, mut in_z] = [V::splat(0.0); 3];
    for dz in 0..=H {
        for dy in 0..=H {
            let w = weights[dz][dy][x];
            one = one.plus(V::splat(w).times(rows[H + dz][H + dy]));
            if dy > 0 {
                in_y = in_y.plus(V::splat(w * dy as f64).times(rows[H + dz][H - dy]));
            }
            if dz > 0 {
                in_z = in_z.plus(V::splat(w * dz as f64).times(rows[H - dz][H + dy]));
            }
        }
    }
    [one, in_y, in_z]
}

/// Eight columns of a row of sums, from `at` on.
#[inline(always)]
fn column<V: F64x8>(columns: &Columns, row: usize, at: usize) -> V {
    // SAFETY: eight values, just cut.
    unsafe { V::load(columns[row][at..][..LANES].as_ptr()) }
}

/// A row's sum over the columns of each window, the same times dx, and times dx squared;
/// `step` is 1 where rows differ by |dx|, else 0.
#[inline(always)]
fn across<V: F64x8, const H: usize>(columns: &Columns, row: usize, step: usize) -> [V; 3] {
    let mut sum = column::<V>(columns, row, H);
    let [mut first, mut second] = [V::splat(0.0); 2];
    for d in 1..=H {
        let [a, b] = [column::<V>(columns, row + d * step, H + d), column::<V>(columns, row + d * step, H - d)];
        let (even, odd) = (a.plus(b), a.minus(b));
        sum = sum.plus(even);
        first = first.plus(V::splat(d as f64).times(odd));
        second = second.plus(V::splat((d * d) as f64).times(even));
    }
    [sum, first, second]
}

/// Moments of eight windows: of the weight, its first (z, y, x) and its second (zz, zy, zx, yy, yx, xx).
#[inline(always)]
fn moments<V: F64x8, const H: usize>(columns: &Columns, row: usize, step: usize) -> (V, [V; 3], [V; 6]) {
    let next = 1 + 2 * step;
    let [one, x, xx] = across::<V, H>(columns, row, step);
    let [y, yx, _] = across::<V, H>(columns, row + next, step);
    let [z, zx, _] = across::<V, H>(columns, row + 2 * next, step);
    let [yy, ..] = across::<V, H>(columns, row + 3 * next, step);
    let [zz, ..] = across::<V, H>(columns, row + 4 * next, step);
    let [zy, ..] = across::<V, H>(columns, row + 5 * next, step);
    (one, [z, y, x], [zz, zy, zx, yy, yx, xx])
}

/// Sums of w times the value times 1, and times z, y, x; values relative to the centre's.
#[inline(always)]
fn value_moments<V: F64x8, const H: usize>(columns: &Columns, centre: V) -> (V, [V; 3]) {
    let [mut one, mut z, mut y, mut x] = [V::splat(0.0); 4];
    for k in 0..=2 * H {
        let d = k.abs_diff(H);
        let away = column::<V>(columns, PIVOT, k).minus(centre);
        let even = moved::<V>(columns, [VALUE + d, WEIGHT + d], k, away);
        one = one.plus(even);
        if d > 0 {
            x = x.plus(V::splat(k as f64 - H as f64).times(even));
        }
        y = y.plus(moved::<V>(columns, [VALUE_Y + d, Y + d], k, away));
        z = z.plus(moved::<V>(columns, [VALUE_Z + d, Z + d], k, away));
    }
    (one, [z, y, x])
}

/// A column's sum of values, all of them moved by `away`, from that sum and the one of weights.
#[inline(always)]
fn moved<V: F64x8>(columns: &Columns, [value, weight]: [usize; 2], at: usize, away: V) -> V {
    column::<V>(columns, value, at).plus(away.times(column::<V>(columns, weight, at)))
}

/// Fits the eight windows whose leftmost columns come first, and puts those with a gap into the front of `parts`.
#[inline(always)]
fn fit<V: F64x8, const H: usize>(columns: &Columns, [centre, there]: [V; 2], table: &Table, parts: &mut [f64]) {
    let (n, first, second) = moments::<V, H>(columns, COUNT, 0);
    let all = (2 * H + 1) * (2 * H + 1) * (2 * H + 1);
    let gap = V::splat(all as f64).minus(n);
    // the regression gives the centre no weight
    let spread = spread(n.minus(V::splat(1.0)), first, second);
    let slopes = solve(moments::<V, H>(columns, WEIGHT, 1), value_moments::<V, H>(columns, centre), spread);
    for a in 0..3 {
        let slope = slopes[a].over(V::splat(table.spacing[a]));
        let part = parts[a * RUN..][..LANES].as_mut_ptr();
        // SAFETY: eight values, just cut.
        unsafe { slope.choose(gap, V::load(part)).choose(there, V::splat(f64::NAN)).store(part) };
    }
}

/// Slopes (z, y, x; per voxel) from the moments of the weight and of the values; zero where a plane is not determined, which
/// is where `spread` is not above 0.
#[inline(always)]
fn solve<V: F64x8>(
    (total, [z, y, x], [zz, zy, zx, yy, yx, xx]): (V, [V; 3], [V; 6]),
    (value, [vz, vy, vx]): (V, [V; 3]),
    spread: V,
) -> [V; 3] {
    let one = V::splat(1.0);
    let share = one.over(total);
    let [mz, my, mx] = [z.times(share), y.times(share), x.times(share)];
    // the system without D, which is symmetric and positive definite
    let (a, b, c) = (zz.minus(z.times(mz)), zy.minus(z.times(my)), zx.minus(z.times(mx)));
    let (d, e, f) = (yy.minus(y.times(my)), yx.minus(y.times(mx)), xx.minus(x.times(mx)));
    let (p, q, r) = (vz.minus(mz.times(value)), vy.minus(my.times(value)), vx.minus(mx.times(value)));
    // elimination, z first
    let by_a = one.over(a);
    let (bz, cz) = (b.times(by_a), c.times(by_a));
    let (d, e, f) = (d.minus(bz.times(b)), e.minus(bz.times(c)), f.minus(cz.times(c)));
    let (q, r) = (q.minus(bz.times(p)), r.minus(cz.times(p)));
    let by_d = one.over(d);
    let ey = e.times(by_d);
    let (f, r) = (f.minus(ey.times(e)), r.minus(ey.times(q)));
    let in_x = r.over(f);
    let in_y = q.minus(e.times(in_x)).times(by_d);
    let in_z = p.minus(b.times(in_y)).minus(c.times(in_x)).times(by_a);
    let determined = one.where_positive(spread).where_positive(a).where_positive(d).where_positive(f);
    [
        number(in_z).where_positive(determined),
        number(in_y).where_positive(determined),
        number(in_x).where_positive(determined),
    ]
}

/// NaN for an infinity.
#[inline(always)]
fn number<V: F64x8>(v: V) -> V {
    v.plus(v.minus(v))
}

/// Determinant of n times the scatter of `n` offsets, from their moments: 0 where they lie in a plane, else at least 1.
/// Entries are integers below 2^16, so all of it is exact.
#[inline(always)]
fn spread<V: F64x8>(n: V, [z, y, x]: [V; 3], [zz, zy, zx, yy, yx, xx]: [V; 6]) -> V {
    let (a, b, c) = (n.times(zz).minus(z.times(z)), n.times(zy).minus(z.times(y)), n.times(zx).minus(z.times(x)));
    let (d, e, f) = (n.times(yy).minus(y.times(y)), n.times(yx).minus(y.times(x)), n.times(xx).minus(x.times(x)));
    let first = a.times(d.times(f).minus(e.times(e)));
    let second = b.times(e.times(c).minus(b.times(f)));
    let third = c.times(b.times(e).minus(d.times(c)));
    first.plus(second).plus(third)
}
