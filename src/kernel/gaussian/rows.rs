//! One row of one pass: moments of taps that lie at other places of a buffer, row by row, so that the same code serves x, y
//! and z. Loops run along the row; every voxel sees its taps in the same order wherever its row starts.

use crate::grid::Voxel;
use crate::kernel::values::missing_as;
use crate::multiversion;

/// What passes are computed in.
pub(super) trait Real:
    Voxel + std::ops::Add<Output = Self> + std::ops::Sub<Output = Self> + std::ops::Mul<Output = Self>
{
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

/// Taps of one row: for k = 1, 2, ... the two rows k steps before and after, by their place in the buffer, and their
/// weights. A row that does not exist stands at the centre's place, and its own weight is 0.
pub(super) struct Taps<'a> {
    pub centre: usize,
    /// Places before and after, in turn.
    pub places: &'a [u32],
    /// `[w]`: weight of the centre, then before and after in turn.
    pub weights: &'a [f64],
}

impl Taps<'_> {
    /// Places and weights of pair k, from 0; the larger weight is the pair's, since one of them may not exist.
    #[inline(always)]
    fn pair(&self, k: usize) -> ([usize; 2], [f64; 2]) {
        let places = [self.places[2 * k] as usize, self.places[2 * k + 1] as usize];
        (places, [self.weights[2 * k + 1], self.weights[2 * k + 2]])
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

multiversion! {
    /// Weighted mean of the taps: `c + sum_k w_k ((a_k + b_k) - 2 c)`, exactly c where all are equal.
    pub(super) fn mean_row[F: Real](buffer: &[F], taps: &Taps, out: &mut [F]) -> () = mean_inner;
}

#[inline(always)]
fn mean_inner<F: Real>(buffer: &[F], taps: &Taps, out: &mut [F]) {
    let n = out.len();
    let c = &buffer[taps.centre..][..n];
    out.copy_from_slice(c);
    let pairs = taps.places.len() / 2;
    let row = |place: usize| &buffer[place..][..n];
    let pair = |k: usize| {
        let (places, weights) = taps.pair(k);
        (row(places[0]), row(places[1]), F::narrow(weights[0].max(weights[1])))
    };
    let mut k = 0;
    // three pairs a time: fewer trips of the sum through memory, in the same order
    while k + 3 <= pairs {
        let ((a0, b0, w0), (a1, b1, w1), (a2, b2, w2)) = (pair(k), pair(k + 1), pair(k + 2));
        for i in 0..n {
            let twice = c[i] + c[i];
            let sum = out[i] + w0 * ((a0[i] + b0[i]) - twice);
            let sum = sum + w1 * ((a1[i] + b1[i]) - twice);
            out[i] = sum + w2 * ((a2[i] + b2[i]) - twice);
        }
        k += 3;
    }
    while k < pairs {
        let (a, b, w) = pair(k);
        for i in 0..n {
            out[i] = out[i] + w * ((a[i] + b[i]) - (c[i] + c[i]));
        }
        k += 1;
    }
}

multiversion! {
    /// Pooled variance of the taps about `mean`: `sum_k w_k (V_k + (m_k - mean)^2)`; without `within` the V are 0.
    pub(super) fn variance_row[F: Real](
        means: &[F], within: Option<&[F]>, taps: &Taps, mean: &[F], out: &mut [F],
    ) -> () = variance_inner;
}

#[inline(always)]
fn variance_inner<F: Real>(means: &[F], within: Option<&[F]>, taps: &Taps, mean: &[F], out: &mut [F]) {
    let n = out.len();
    let mean = &mean[..n];
    let mut add = |place: usize, w: f64, first: bool| {
        let w = F::narrow(w);
        let m = &means[place..][..n];
        match (within, first) {
            (Some(v), true) => {
                let v = &v[place..][..n];
                (0..n).for_each(|i| out[i] = w * (v[i] + (m[i] - mean[i]) * (m[i] - mean[i])));
            }
            (Some(v), false) => {
                let v = &v[place..][..n];
                (0..n).for_each(|i| out[i] = out[i] + w * (v[i] + (m[i] - mean[i]) * (m[i] - mean[i])));
            }
            (None, true) => (0..n).for_each(|i| out[i] = w * ((m[i] - mean[i]) * (m[i] - mean[i]))),
            (None, false) => (0..n).for_each(|i| out[i] = out[i] + w * ((m[i] - mean[i]) * (m[i] - mean[i]))),
        }
    };
    add(taps.centre, taps.weights[0], true);
    for k in 0..taps.places.len() / 2 {
        let (places, weights) = taps.pair(k);
        add(places[0], weights[0], false);
        add(places[1], weights[1], false);
    }
}

/// Mean, variance and weight of cells that may have no valid voxel (weight 0).
pub(super) struct Pooled<'a, F> {
    pub mean: &'a [F],
    pub variance: &'a [F],
    pub weight: &'a [F],
}

multiversion! {
    /// Pools the taps by their own weights times those of the pass. Constants stay exact: sums are taken relative to a tap
    /// that is valid (the centre's where it is), except where that overflows or an infinity stands.
    pub(super) fn pool_row[F: Real](
        from: &Pooled<F>, taps: &Taps, mean: &mut [F], variance: &mut [F], weight: &mut [F],
    ) -> () = pool_inner;
}

#[inline(always)]
fn pool_inner<F: Real>(from: &Pooled<F>, taps: &Taps, mean: &mut [F], variance: &mut [F], weight: &mut [F]) {
    for i in 0..mean.len() {
        let (m, v, w) = pool_one(from, taps, i);
        (mean[i], variance[i], weight[i]) = (F::narrow(m), F::narrow(v), F::narrow(w));
    }
}

#[inline(always)]
fn pool_one<F: Real>(from: &Pooled<F>, taps: &Taps, i: usize) -> (f64, f64, f64) {
    // calls f(w, m, v) for every valid tap
    let each = |f: &mut dyn FnMut(f64, f64, f64)| {
        let mut one = |place: usize, w: f64| {
            let w = w * from.weight[place + i].to_f64();
            if w > 0.0 {
                f(w, from.mean[place + i].to_f64(), from.variance[place + i].to_f64());
            }
        };
        for k in 0..taps.places.len() / 2 {
            let (places, weights) = taps.pair(k);
            one(places[0], weights[0]);
            one(places[1], weights[1]);
        }
        one(taps.centre, taps.weights[0]);
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
