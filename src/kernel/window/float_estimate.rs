//! From moments of one row of float windows to results.

use super::beta::{self, Terms};
use super::estimate::{Polarity, Spread};
use super::math;
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
    /// Voxels of windows of `lines` whole lines of `section` voxels.
    pub fn whole_counts_row[](lines: &[f64], section: f64, n: &mut [f64]) -> () = whole_counts_inner;
}

#[inline(always)]
fn whole_counts_inner(lines: &[f64], section: f64, n: &mut [f64]) {
    for (n, c) in n.iter_mut().zip(lines) {
        *n = section * c;
    }
}

crate::multiversion! {
    /// The same where voxels are missing: `share` are the voxels of a window in shares of whole windows.
    pub fn counts_row[](share: &[f64], lines: &[f64], section: f64, n: &mut [f64]) -> () = counts_inner;
}

#[inline(always)]
fn counts_inner(share: &[f64], lines: &[f64], section: f64, n: &mut [f64]) {
    for ((n, s), c) in n.iter_mut().zip(share).zip(lines) {
        *n = (s * (section * c)).round_ties_even(); // off by much less than half a voxel
    }
}

crate::multiversion! {
    /// M2 from M2 times the voxels of whole windows of `lines` lines of `section` voxels; 0 where it can only be an error of rounding, NaN where a window holds an infinity.
    pub fn settle_row[A: Sum](s: &[A], n: &[f64], lines: &[f64], section: f64, m: &mut [f64]) -> () = settle_inner;
}

#[inline(always)]
fn settle_inner<A: Sum>(s: &[A], n: &[f64], lines: &[f64], section: f64, m: &mut [f64]) {
    for (((m, s), n), c) in m.iter_mut().zip(s).zip(n).zip(lines) {
        let whole = section * c;
        let (v, s) = (*m / whole, s.rounded());
        let nothing = if *n == whole { A::NOTHING } else { A::NOTHING_BESIDE_GAPS };
        let v = if v * n > s * s * nothing { v } else { 0.0 };
        *m = if s.is_finite() { v } else { f64::NAN };
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
    /// Extremes, scaled; zeros lose their sign, which would depend on the order of comparisons.
    pub fn extreme_row[T: Voxel](from: &[T], affine: Affine, out: &mut [T]) -> () = extreme_inner;
}

#[inline(always)]
fn extreme_inner<T: Voxel>(from: &[T], affine: Affine, out: &mut [T]) {
    for (o, v) in out.iter_mut().zip(from) {
        *o = T::from_f64(affine.slope * v.to_f64() + affine.intercept); // with the identity exact: v + 0
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

crate::multiversion! {
    fn standard_row[T: Voxel, A: Sum](
        kind: Spread, v: &[T], lo: &[T], hi: &[T], s: &[A], m: &[f64], n: &[f64], polarity: Polarity, out: &mut [f32]
    ) -> bool = standard_inner;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn standard_inner<T: Voxel, A: Sum>(
    kind: Spread,
    v: &[T],
    lo: &[T],
    hi: &[T],
    s: &[A],
    m: &[f64],
    n: &[f64],
    polarity: Polarity,
    out: &mut [f32],
) -> bool {
    let len = out.len();
    let (v, lo, hi, s, m, n) = (&v[..len], &lo[..len], &hi[..len], &s[..len], &m[..len], &n[..len]);
    let sign = if polarity.flipped { 1.0 } else { -1.0 };
    let mut wild = 0u32;
    macro_rules! row {
        ($of:expr) => {
            for i in 0..len {
                // n (v - mean) / (n sigma); a spread that underflowed leaves only the sign.
                let d = sign * s[i].less(n[i], v[i].to_f64());
                let z = (d / (n[i] * m[i]).max(f64::MIN_POSITIVE).sqrt()) as f32;
                let y: f32 = $of(z);
                wild |= !s[i].rounded().is_finite() as u32;
                out[i] = if lo[i] == hi[i] { polarity.constant } else { y };
            }
        };
    }
    match kind {
        Spread::Gaussian => row!(math::phi),
        Spread::Chebyshev => row!(|z: f32| if z <= 0.0 { 0.0 } else { 1.0 - 1.0 / z.mul_add(z, 1.0) }),
        Spread::Literal => row!(|z: f32| if z <= 0.0 { 1.0 } else { 1.0 / z.mul_add(z, 1.0) }),
    }
    wild != 0
}

/// A 3.3 and E 3.4 for a row.
#[allow(clippy::too_many_arguments)]
pub fn spread_row<T: Voxel, A: Sum>(
    level: Level,
    kind: Spread,
    v: &[T],
    lo: &[T],
    hi: &[T],
    s: &[A],
    m: &[f64],
    n: &[f64],
    polarity: Polarity,
    out: &mut [f32],
) {
    if standard_row(level, kind, v, lo, hi, s, m, n, polarity, out) {
        for i in 0..out.len() {
            let (v, lo, hi) = (v[i].to_f64(), lo[i].to_f64(), hi[i].to_f64());
            if lo != hi && (lo.is_infinite() || hi.is_infinite()) {
                // Beyond the mean by as much as the spread: the limit hangs on how many infinities there are.
                let limits = match kind {
                    Spread::Gaussian => [f32::NAN; 2],
                    Spread::Chebyshev => [f32::NAN, 0.0],
                    Spread::Literal => [f32::NAN, 1.0],
                };
                out[i] = infinite(v, lo, hi, polarity.flipped, limits);
            }
        }
    }
}
