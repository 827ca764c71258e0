//! One row of one pass: moments of taps that lie at other places of a buffer, row by row, so that the same code serves x, y
//! and z. Every voxel sees its taps in the same order wherever its row starts. Rows are whole vectors: [`LANES`] divides their
//! length, and sums stay in registers from the first tap to the last.

use super::taps::{Edges, Taps};
use crate::grid::Voxel;
use crate::kernel::lanes::F64x8;
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};
use crate::kernel::values::missing_as;
use crate::{multiversion, on_lanes, on_singles};

/// What rows are multiples of.
pub(super) const LANES: usize = SINGLES;

/// What passes are computed in.
pub(super) trait Real: Voxel {
    fn narrow(v: f64) -> Self;
}

impl Real for f32 {
    #[inline(always)]
    fn narrow(v: f64) -> f32 {
        v as f32
    }
}

impl Real for f64 {
    #[inline(always)]
    fn narrow(v: f64) -> f64 {
        v
    }
}

multiversion! {
    /// Stored voxels as numbers to compute with; missing ones NaN.
    pub(super) fn load_row[T: Voxel, F: Real](src: &[T], missing: Option<i64>, dst: &mut [F]) -> () = load_inner;
}

#[inline(always)]
fn load_inner<T: Voxel, F: Real>(src: &[T], missing: Option<i64>, dst: &mut [F]) {
    match missing_as::<T>(missing) {
        None => dst.iter_mut().zip(src).for_each(|(d, s)| *d = F::narrow(s.to_f64())),
        Some(m) => {
            let nan = F::narrow(f64::NAN);
            dst.iter_mut().zip(src).for_each(|(d, s)| *d = if *s == m { nan } else { F::narrow(s.to_f64()) });
        }
    }
}

/// Weighted mean of the taps: `c + sum_k w_k ((a_k + b_k) - 2 c)`, exactly c where all are equal; with `edges`, by the weights
/// of each lane. The GPU's shader has the same operations in the same order.
///
/// Panics if the taps leave the buffer or the row is no multiple of [`LANES`].
pub(super) fn mean_row(level: Level, from: &[f32], taps: &Taps<f32>, edges: Option<&Edges<f32>>, out: &mut [f32]) {
    assert!(out.len().is_multiple_of(LANES) && taps.inside(out.len(), from.len()), "taps inside the buffer");
    match edges {
        None => means::<false>(level, from, taps, [&[]; 3], out),
        Some(edges) => means::<true>(level, from, taps, edges.lanes(taps, out.len()), out),
    }
}

on_singles! {
    /// `edges`: weights by lane, and the room before and after, where `EDGE`.
    fn means[const EDGE: bool](from: &[f32], taps: &Taps<f32>, edges: [&[f32]; 3], out: &mut [f32]) = means_inner[EDGE];
}

#[inline(always)]
fn means_inner<V: F32x32, const EDGE: bool>(from: &[f32], taps: &Taps<f32>, edges: [&[f32]; 3], out: &mut [f32]) {
    let n = out.len();
    let from = from.as_ptr();
    let [weights, before, after] = edges.map(|e| e.as_ptr());
    for i in (0..n).step_by(SINGLES) {
        // SAFETY: here and below, `mean_row` has checked that SINGLES divides n, that n values stand at every tap's place, and
        // that every lane has weights and room.
        let c = unsafe { V::load(from.add(taps.centre + i)) };
        let twice = c.plus(c);
        let mut sum = c;
        for (k, &[p, q]) in taps.pairs.iter().enumerate() {
            let (mut a, mut b) = unsafe { (V::load(from.add(p as usize + i)), V::load(from.add(q as usize + i))) };
            let mut w = V::splat(taps.weights[k + 1]);
            if EDGE {
                let far = V::splat((k + 1) as f32);
                let room = unsafe { [V::load(before.add(i)), V::load(after.add(i))] };
                a = V::pick(far.is_below(room[0]), a, c);
                b = V::pick(far.is_below(room[1]), b, c);
                w = unsafe { V::load(weights.add((k + 1) * n + i)) };
            }
            sum = sum.plus(w.times(a.plus(b).minus(twice)));
        }
        for (k, &[p, _]) in taps.singles.iter().enumerate() {
            let a = unsafe { V::load(from.add(p as usize + i)) };
            let w = V::splat(taps.weights[taps.pairs.len() + k + 1]);
            sum = sum.plus(w.times(a.plus(c).minus(twice)));
        }
        // SAFETY: as above.
        unsafe { sum.store(out.as_mut_ptr().add(i)) };
    }
}

/// Mean and variance of the taps, whose own variances are `within` (none: 0), as sums relative to the centre tap c:
/// `m = c + S`, `S = sum_k w_k (m_k - c)`; `V = sum_k w_k (V_k + (m_k - c)^2) - S^2`. The centre's own weight w bounds what
/// the difference can lose: `S^2` is at most 1 - w of the sum that it is taken from. Exactly c and 0 where all are equal.
///
/// Panics if the taps leave the buffer or the row is no multiple of [`LANES`].
pub(super) fn moment_row(
    level: Level,
    [means, within]: [&[f64]; 2],
    spread: bool,
    taps: &Taps<f64>,
    edges: Option<&Edges<f64>>,
    [mean, variance]: [&mut [f64]; 2],
) {
    let n = mean.len();
    let whole = n.is_multiple_of(LANES) && variance.len() == n && within.len() == means.len();
    assert!(whole && taps.inside(n, means.len()), "taps inside the buffer");
    match (edges, spread) {
        (None, false) => moments::<false, false>(level, [means, within], taps, [&[]; 3], [mean, variance]),
        (None, true) => moments::<true, false>(level, [means, within], taps, [&[]; 3], [mean, variance]),
        (Some(e), _) => moments::<false, true>(level, [means, within], taps, e.lanes(taps, n), [mean, variance]),
    }
}

on_lanes! {
    /// `SPREAD`: taps have variances; `EDGE`: as [`means`].
    fn moments[const SPREAD: bool, const EDGE: bool](
        from: [&[f64]; 2], taps: &Taps<f64>, edges: [&[f64]; 3], out: [&mut [f64]; 2]
    ) = moments_inner[SPREAD, EDGE];
}

/// Vectors of a row side by side: the chain of one sum hides behind the others'.
const ABREAST: usize = 2;

#[inline(always)]
fn moments_inner<V: F64x8, const SPREAD: bool, const EDGE: bool>(
    from: [&[f64]; 2],
    taps: &Taps<f64>,
    edges: [&[f64]; 3],
    [mean, variance]: [&mut [f64]; 2],
) {
    let n = mean.len();
    let [m, v] = from.map(|f| f.as_ptr());
    let [weights, before, after] = edges.map(|e| e.as_ptr());
    let zero = V::splat(0.0);
    for start in (0..n).step_by(8 * ABREAST) {
        let mut c = [zero; ABREAST];
        let (mut s, mut q) = ([zero; ABREAST], [zero; ABREAST]);
        for j in 0..ABREAST {
            let i = start + 8 * j;
            // SAFETY: here and below, `moment_row` has checked that 16 divides n, that n values stand at every tap's place, and
            // that every lane has weights and room.
            c[j] = unsafe { V::load(m.add(taps.centre + i)) };
            if SPREAD {
                q[j] = V::splat(taps.weights[0]).times(unsafe { V::load(v.add(taps.centre + i)) });
            }
        }
        for (k, &[left, right]) in taps.pairs.iter().enumerate() {
            let splat = V::splat(taps.weights[k + 1]);
            for j in 0..ABREAST {
                let i = start + 8 * j;
                let at = [left as usize + i, right as usize + i];
                let mut w = splat;
                let mut a = unsafe { V::load(m.add(at[0])) }.minus(c[j]);
                let mut b = unsafe { V::load(m.add(at[1])) }.minus(c[j]);
                if EDGE {
                    let far = V::splat((k + 1) as f64);
                    a = a.where_positive(unsafe { V::load(before.add(i)) }.minus(far));
                    b = b.where_positive(unsafe { V::load(after.add(i)) }.minus(far));
                    w = unsafe { V::load(weights.add((k + 1) * n + i)) };
                }
                let mut square = a.times(a);
                if SPREAD {
                    let own = unsafe { V::load(v.add(at[0])).plus(V::load(v.add(at[1]))) };
                    square = a.fused(a, own);
                }
                s[j] = w.fused(a.plus(b), s[j]);
                q[j] = w.fused(b.fused(b, square), q[j]);
            }
        }
        for (k, &[place, _]) in taps.singles.iter().enumerate() {
            let w = V::splat(taps.weights[taps.pairs.len() + k + 1]);
            for j in 0..ABREAST {
                let at = place as usize + start + 8 * j;
                let a = unsafe { V::load(m.add(at)) }.minus(c[j]);
                let own = if SPREAD { unsafe { V::load(v.add(at)) } } else { zero };
                s[j] = w.fused(a, s[j]);
                q[j] = w.fused(a.fused(a, own), q[j]);
            }
        }
        for j in 0..ABREAST {
            let i = start + 8 * j;
            // SAFETY: as above.
            unsafe {
                c[j].plus(s[j]).store(mean.as_mut_ptr().add(i));
                // a centre that is no number leaves none, also where it is the only tap
                let spread = s[j].less(s[j], q[j]).plus(c[j].minus(c[j]));
                not_below_zero(spread).store(variance.as_mut_ptr().add(i));
            }
        }
    }
}

/// `v`, or 0 where rounding left it below; NaN stays.
#[inline(always)]
fn not_below_zero<V: F64x8>(v: V) -> V {
    let below = V::splat(0.0).minus(v);
    v.plus(below.where_positive(below))
}

/// Mean, variance and weight of cells that may have no valid voxel (weight 0).
#[derive(Clone, Copy)]
pub(super) struct Pooled<'a> {
    pub mean: &'a [f64],
    pub variance: &'a [f64],
    pub weight: &'a [f64],
}

/// Pools the taps by their own weights times those of the pass, as [`moment_row`] does, relative to the centre where it is
/// valid, else to the nearest tap that is. What is not finite then (an infinity, an overflow) is made by [`pool_one`]. Without
/// variances (empty) means are the same.
///
/// Panics if the taps leave the buffer or the row is no multiple of [`LANES`].
pub(super) fn pool_row(level: Level, from: Pooled, taps: &Taps<f64>, out: [&mut [f64]; 3]) {
    let [mean, variance, weight] = out;
    let n = mean.len();
    let spread = !from.variance.is_empty();
    let whole = n.is_multiple_of(LANES) && weight.len() == n && variance.len() == if spread { n } else { 0 };
    let len = from.mean.len();
    let alike = from.weight.len() == len && from.variance.len() == if spread { len } else { 0 };
    assert!(whole && alike && taps.inside(n, len), "taps inside the buffer");
    let mut finite = true;
    let to = [&mut *mean, &mut *variance, &mut *weight];
    if spread {
        pooled::<true>(level, from, taps, to, &mut finite);
    } else {
        pooled::<false>(level, from, taps, to, &mut finite);
    }
    if finite {
        return;
    }
    for i in 0..n {
        let (good, apart) = (mean[i].is_finite(), variance.get(i).is_some_and(|v| !v.is_finite()));
        if !good || apart {
            let (m, v, w) = pool_one(&from, taps, i);
            if !good {
                (mean[i], weight[i]) = (m, w);
            }
            if spread {
                variance[i] = v;
            }
        }
    }
}

on_lanes! {
    /// `finite` says whether all is; `SPREAD`: with variances.
    fn pooled[const SPREAD: bool](from: Pooled, taps: &Taps<f64>, out: [&mut [f64]; 3], finite: &mut bool)
        = pooled_inner[SPREAD];
}

#[inline(always)]
fn pooled_inner<V: F64x8, const SPREAD: bool>(from: Pooled, taps: &Taps<f64>, out: [&mut [f64]; 3], finite: &mut bool) {
    let [mean, variance, weight] = out;
    let zero = V::splat(0.0);
    let mut blank = zero;
    for i in (0..mean.len()).step_by(8) {
        // SAFETY: `pool_row` has checked that 8 divides the length and that as many values stand at every tap's place.
        let cells = unsafe { Cells::<V>::after(&from, i) };
        let own = cells.weight(taps.centre);
        let c = cells.pivot(taps, own);
        let mut sums = [zero; 3];
        cells.add::<SPREAD>(taps.centre, taps.weights[0], c, &mut sums);
        for (&[left, right], &w) in taps.pairs.iter().zip(&taps.weights[1..]) {
            cells.add::<SPREAD>(left as usize, w, c, &mut sums);
            cells.add::<SPREAD>(right as usize, w, c, &mut sums);
        }
        for (&[place, _], &w) in taps.singles.iter().zip(&taps.weights[1 + taps.pairs.len()..]) {
            cells.add::<SPREAD>(place as usize, w, c, &mut sums);
        }
        let [total, s, q] = sums;
        let s = s.over(total).where_positive(total);
        let m = c.plus(s).where_positive(total);
        blank = blank.plus(m.minus(m));
        // SAFETY: as above.
        unsafe {
            m.store(mean.as_mut_ptr().add(i));
            total.store(weight.as_mut_ptr().add(i));
        }
        if SPREAD {
            let spread = not_below_zero(s.less(s, q.over(total))).where_positive(total);
            blank = blank.plus(spread.minus(spread));
            // SAFETY: as above.
            unsafe { spread.store(variance.as_mut_ptr().add(i)) };
        }
    }
    let mut sum = [0.0; 8];
    // SAFETY: eight values.
    unsafe { blank.store(sum.as_mut_ptr()) };
    *finite = sum == [0.0; 8];
}

/// Eight columns of cells, by the places of their rows.
struct Cells<V> {
    mean: *const f64,
    variance: *const f64,
    weight: *const f64,
    lanes: std::marker::PhantomData<V>,
}

impl<V: F64x8> Cells<V> {
    /// Columns `i` to `i + 8`.
    ///
    /// # Safety
    /// Places given to the methods have eight values from `i` on.
    #[inline(always)]
    unsafe fn after(from: &Pooled, i: usize) -> Cells<V> {
        // variances may be empty, and are not read then
        let [mean, variance, weight] = [from.mean, from.variance, from.weight].map(|f| f.as_ptr().wrapping_add(i));
        Cells { mean, variance, weight, lanes: std::marker::PhantomData }
    }

    #[inline(always)]
    fn weight(&self, place: usize) -> V {
        // SAFETY: the promise of `after`.
        unsafe { V::load(self.weight.add(place)) }
    }

    #[inline(always)]
    fn mean(&self, place: usize) -> V {
        // SAFETY: the promise of `after`.
        unsafe { V::load(self.mean.add(place)) }
    }

    /// The mean of the centre where its weight `own` is positive, else of the nearest tap whose is, else 0.
    #[inline(always)]
    fn pivot(&self, taps: &Taps<f64>, own: V) -> V {
        let centre = self.mean(taps.centre);
        if own.all_positive() {
            return centre;
        }
        let mut pivot = V::splat(0.0);
        for &[place, _] in taps.singles.iter().rev() {
            pivot = self.mean(place as usize).choose(self.weight(place as usize), pivot);
        }
        for &[left, right] in taps.pairs.iter().rev() {
            pivot = self.mean(right as usize).choose(self.weight(right as usize), pivot);
            pivot = self.mean(left as usize).choose(self.weight(left as usize), pivot);
        }
        centre.choose(own, pivot)
    }

    /// Adds a tap of weight `w` to the sums of weights, of weighted means from `c` on, and, where `SPREAD`, of weighted squares.
    #[inline(always)]
    fn add<const SPREAD: bool>(&self, place: usize, w: f64, c: V, sums: &mut [V; 3]) {
        let share = V::splat(w).times(self.weight(place));
        let away = self.mean(place).minus(c);
        sums[0] = sums[0].plus(share);
        sums[1] = share.fused(away, sums[1]);
        if SPREAD {
            // SAFETY: the promise of `after`.
            let own = unsafe { V::load(self.variance.add(place)) };
            sums[2] = share.fused(away.fused(away, own), sums[2]);
        }
    }
}

/// One voxel of [`pool_row`] in two passes, for what is not finite: sums are taken relative to a tap that is valid, except where
/// that overflows or an infinity stands.
fn pool_one(from: &Pooled, taps: &Taps<f64>, i: usize) -> (f64, f64, f64) {
    // calls f(w, m, v) for every valid tap
    let each = |f: &mut dyn FnMut(f64, f64, f64)| {
        let mut one = |place: u32, w: f64| {
            let at = place as usize + i;
            let w = w * from.weight[at];
            if w > 0.0 {
                f(w, from.mean[at], from.variance.get(at).copied().unwrap_or(0.0));
            }
        };
        for (pair, w) in taps.pairs.iter().zip(&taps.weights[1..]) {
            pair.iter().for_each(|p| one(*p, *w));
        }
        for ([place, _], w) in taps.singles.iter().zip(&taps.weights[1 + taps.pairs.len()..]) {
            one(*place, *w);
        }
        one(taps.centre as u32, taps.weights[0]);
    };
    let (mut total, mut plain, mut pivot) = (0.0, 0.0, 0.0);
    each(&mut |w, m, _| {
        total += w;
        plain += w * m;
        pivot = m;
    });
    if total == 0.0 {
        return (0.0, 0.0, 0.0);
    }
    let mut shift = 0.0;
    each(&mut |w, m, _| shift += w * (m - pivot));
    let mut mean = pivot + shift / total;
    if !mean.is_finite() {
        mean = plain / total;
    }
    let mut variance = 0.0;
    each(&mut |w, m, v| variance += w * (v + (m - mean) * (m - mean)));
    (mean, variance / total, total)
}

multiversion! {
    /// Stores `a v + b`, rounded once; returns whether every v is finite. Where it is not, NaN is stored.
    pub(super) fn store_row[F: Real, D: Real](row: &[F], a: f64, b: f64, dst: &mut [D]) -> bool = store_inner;
}

#[inline(always)]
fn store_inner<F: Real, D: Real>(row: &[F], a: f64, b: f64, dst: &mut [D]) -> bool {
    let mut finite = true;
    for (d, v) in dst.iter_mut().zip(row) {
        let v = v.to_f64();
        let good = v.is_finite();
        finite &= good;
        *d = D::narrow(if good { a * v + b } else { f64::NAN });
    }
    finite
}

multiversion! {
    /// Whether a result is NaN whose centre is not missing.
    pub(super) fn any_lost[T: Voxel, D: Real](centres: &[T], missing: Option<i64>, dst: &[D]) -> bool = any_lost_inner;
}

#[inline(always)]
fn any_lost_inner<T: Voxel, D: Real>(centres: &[T], missing: Option<i64>, dst: &[D]) -> bool {
    let missing = missing_as::<T>(missing);
    centres.iter().zip(dst).fold(false, |lost, (c, d)| lost | (d.to_f64().is_nan() & is_there(*c, missing)))
}

#[inline(always)]
fn is_there<T: Voxel>(v: T, missing: Option<T>) -> bool {
    missing != Some(v) && !v.to_f64().is_nan()
}

multiversion! {
    /// Stores `a v + b`, rounded once, where a result is NaN, its centre is not missing, and its weight above 0; `from` are v
    /// and weights.
    pub(super) fn fill_row[T: Voxel, F: Real, D: Real](
        centres: &[T], missing: Option<i64>, from: [&[F]; 2], scale: [f64; 2], dst: &mut [D],
    ) -> () = fill_inner;
}

#[inline(always)]
fn fill_inner<T: Voxel, F: Real, D: Real>(
    centres: &[T],
    missing: Option<i64>,
    [row, weight]: [&[F]; 2],
    [a, b]: [f64; 2],
    dst: &mut [D],
) {
    let missing = missing_as::<T>(missing);
    for (((d, c), v), w) in dst.iter_mut().zip(centres).zip(row).zip(weight) {
        let fill = d.to_f64().is_nan() & is_there(*c, missing) & (w.to_f64() > 0.0);
        *d = if fill { D::narrow(a * v.to_f64() + b) } else { *d };
    }
}
