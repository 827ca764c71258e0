//! From moments of one row of float windows to results.

use super::beta::{self, Terms};
use super::estimate::Polarity;
use super::merge::Sum;
use crate::grid::{Affine, Voxel};
use crate::kernel::simd::Level;

crate::multiversion! {
    pub fn mean_row[A: Sum](s: &[A], n: &[f64], out: &mut [f64]) -> () = mean_inner;
}

#[inline(always)]
fn mean_inner<A: Sum>(s: &[A], n: &[f64], out: &mut [f64]) {
    for ((o, s), n) in out.iter_mut().zip(s).zip(n) {
        *o = s.over(*n);
    }
}

crate::multiversion! {
    /// Finished sums from their parts; `lo` is empty where they have one.
    pub fn totals_row[A: Sum](hi: &[f64], lo: &[f64], out: &mut [A]) -> () = totals_inner;
}

#[inline(always)]
fn totals_inner<A: Sum>(hi: &[f64], lo: &[f64], out: &mut [A]) {
    let hi = &hi[..out.len()];
    if A::PAIR {
        let lo = &lo[..out.len()];
        for i in 0..out.len() {
            out[i] = A::of(hi[i], lo[i]);
        }
    } else {
        for i in 0..out.len() {
            out[i] = A::of(hi[i], 0.0);
        }
    }
}

crate::multiversion! {
    /// Voxels of windows of `lines` whole lines of `section` voxels, and their reciprocals.
    pub fn whole_row[](lines: &[f64], section: f64, whole: &mut [f64], inverse: &mut [f64]) -> () = whole_inner;
}

#[inline(always)]
fn whole_inner(lines: &[f64], section: f64, whole: &mut [f64], inverse: &mut [f64]) {
    for ((w, i), c) in whole.iter_mut().zip(inverse).zip(lines) {
        *w = section * c;
        *i = 1.0 / *w;
    }
}

crate::multiversion! {
    /// Voxels of windows where some are missing: `share` are those of a window in shares of the `whole` one.
    pub fn counts_row[](share: &[f64], whole: &[f64], n: &mut [f64]) -> () = counts_inner;
}

#[inline(always)]
fn counts_inner(share: &[f64], whole: &[f64], n: &mut [f64]) {
    for ((n, s), w) in n.iter_mut().zip(share).zip(whole) {
        *n = (s * w).round_ties_even(); // off by much less than half a voxel
    }
}

crate::multiversion! {
    /// M2 from M2 times the voxels of `whole` windows, whose reciprocals are `inverse`; 0 where it can only be an error of
    /// rounding, NaN where a window holds an infinity.
    pub fn settle_row[A: Sum](s: &[A], n: &[f64], whole: &[f64], inverse: &[f64], m: &mut [f64]) -> () = settle_inner;
}

#[inline(always)]
fn settle_inner<A: Sum>(s: &[A], n: &[f64], whole: &[f64], inverse: &[f64], m: &mut [f64]) {
    let len = m.len();
    let (s, n, whole, inverse) = (&s[..len], &n[..len], &whole[..len], &inverse[..len]);
    for i in 0..len {
        let (v, s) = (m[i] * inverse[i], s[i].rounded());
        let nothing = if n[i] == whole[i] { A::NOTHING } else { A::NOTHING_BESIDE_GAPS };
        let v = if v * n[i] > s * s * nothing { v } else { 0.0 };
        m[i] = if s.is_finite() { v } else { f64::NAN };
    }
}

crate::multiversion! {
    pub fn variance_row[](m: &[f64], n: &[f64], out: &mut [f64]) -> () = variance_inner;
}

#[inline(always)]
fn variance_inner(m: &[f64], n: &[f64], out: &mut [f64]) {
    for ((o, m), n) in out.iter_mut().zip(m).zip(n) {
        *o = m / n;
    }
}

crate::multiversion! {
    /// The same of windows where no voxel is missing, from the reciprocals of their counts: a division takes 16 cycles for eight
    /// on some cores.
    pub fn whole_variance_row[](m: &[f64], inverse: &[f64], out: &mut [f64]) -> () = whole_variance_inner;
}

#[inline(always)]
fn whole_variance_inner(m: &[f64], inverse: &[f64], out: &mut [f64]) {
    for ((o, m), i) in out.iter_mut().zip(m).zip(inverse) {
        *o = m * i;
    }
}

crate::multiversion! {
    /// The same where some may be missing, with the bits of [`whole_variance_row`] where none is.
    pub fn gapped_variance_row[](m: &[f64], n: &[f64], whole: &[f64], inverse: &[f64], out: &mut [f64]) -> () =
        gapped_variance_inner;
}

#[inline(always)]
fn gapped_variance_inner(m: &[f64], n: &[f64], whole: &[f64], inverse: &[f64], out: &mut [f64]) {
    let len = out.len();
    let (m, n, whole, inverse) = (&m[..len], &n[..len], &whole[..len], &inverse[..len]);
    for i in 0..len {
        out[i] = if n[i] == whole[i] { m[i] * inverse[i] } else { m[i] / n[i] };
    }
}

crate::multiversion! {
    /// Extremes, scaled; zeros lose their sign, which would depend on the order of comparisons.
    pub fn extreme_row[T: Voxel](from: &[T], affine: Affine, out: &mut [T]) -> () = extreme_inner;
}

#[inline(always)]
fn extreme_inner<T: Voxel>(from: &[T], affine: Affine, out: &mut [T]) {
    if affine.is_identity() {
        for (o, v) in out.iter_mut().zip(from) {
            *o = if *v == T::default() { T::default() } else { *v };
        }
        return;
    }
    for (o, v) in out.iter_mut().zip(from) {
        *o = T::from_f64(affine.slope * v.to_f64() + affine.intercept);
    }
}

/// Openness of a window that holds an infinity and is not constant: 1 at +inf, 0 at -inf; else `above` where there is
/// only +inf, `below` where there is only -inf, NaN where both meet.
pub fn infinite(v: f64, lo: f64, hi: f64, flipped: bool, [below, above]: [f32; 2]) -> f32 {
    let (v, lo, hi) = if flipped { (-v, -hi, -lo) } else { (v, lo, hi) };
    if v == f64::INFINITY {
        1.0
    } else if v == f64::NEG_INFINITY {
        0.0
    } else if lo.is_infinite() && hi.is_infinite() {
        f32::NAN
    } else if hi.is_infinite() {
        above
    } else {
        below
    }
}

/// [`super::beta`] for a row. Everything is halved, since the range of f64 values may exceed the largest of them.
#[allow(clippy::too_many_arguments)]
pub fn beta_row<T: Voxel, A: Sum>(
    level: Level,
    v: &[T],
    lo: &[T],
    hi: &[T],
    s: &[A],
    m: &[f64],
    n: &[f64],
    polarity: Polarity,
    out: &mut [f32],
) {
    let terms = |i: usize| {
        let (v, lo, hi) = (v[i].to_f64(), lo[i].to_f64(), hi[i].to_f64());
        let (below, above) = (0.5 * v - 0.5 * lo, 0.5 * hi - 0.5 * v);
        let (over, under) = (s[i].less(n[i], lo), -s[i].less(n[i], hi));
        let numerator = n[i] * m[i];
        match polarity.flipped {
            false => Terms { below, above, over, under, numerator },
            true => Terms { below: above, above: below, over: under, under: over, numerator },
        }
    };
    beta::beta_row(level, terms, polarity.constant, out);
    for i in 0..out.len() {
        let (v, lo, hi) = (v[i].to_f64(), lo[i].to_f64(), hi[i].to_f64());
        if lo != hi && (lo.is_infinite() || hi.is_infinite()) {
            out[i] = infinite(v, lo, hi, polarity.flipped, [1.0, 0.0]);
        }
    }
}
