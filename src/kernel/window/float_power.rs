//! Openness as a power of the centre's place between the extremes (A 3.2) for rows of float windows, in strips: quotients by
//! plain loops, then the powers of the integers' kernel ([`super::openness`]).

use super::estimate::Polarity;
use super::float_estimate::infinite;
use super::math;
use super::merge::{Pair, Sum};
use super::openness::{STRIP, Strip, padded, powers};
use crate::grid::Voxel;
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};

/// Windows of one row, all slices of one length; of `v` NaN is a missing voxel, whose result means nothing.
#[derive(Clone, Copy)]
pub struct Windows<'a, T: Centre> {
    pub v: &'a [T],
    pub lo: &'a [T],
    pub hi: &'a [T],
    pub s: &'a [T::Total],
    pub n: &'a [f64],
}

impl<'a, T: Centre> Windows<'a, T> {
    #[inline(always)]
    fn part(&self, from: usize, to: usize) -> Self {
        let Windows { v, lo, hi, s, n } = *self;
        Windows { v: &v[from..to], lo: &lo[from..to], hi: &hi[from..to], s: &s[from..to], n: &n[from..to] }
    }
}

/// Float voxels at the centre of a window.
pub trait Centre: Voxel {
    type Total: Sum;
    /// Quotients of a strip: t, or where it is at least 2/3 t - 1 (never +0 there), and beta, for windows that f32 holds
    /// them of. Whether there are others.
    fn quotients<const FLIPPED: bool>(row: &Windows<Self>, constant: f32, out: [&mut [f32]; 2]) -> bool;
    /// Whether its window is one of those others.
    fn is_wild(v: Self, lo: Self, hi: Self) -> bool;
}

/// A range between `$small` and `$large` lets neither it nor n times it overflow or vanish; a share of it that is less than
/// `$least` times the range might vanish.
macro_rules! centre {
    ($t:ident, $total:ty, $small:literal, $large:literal, $least:literal) => {
        impl Centre for $t {
            type Total = $total;

            #[inline(always)]
            fn quotients<const FLIPPED: bool>(
                row: &Windows<$t>,
                constant: f32,
                [ratios, betas]: [&mut [f32]; 2],
            ) -> bool {
                let len = ratios.len();
                let (v, lo, hi, betas) = (&row.v[..len], &row.lo[..len], &row.hi[..len], &mut betas[..len]);
                let (s, n) = (&row.s[..len], &row.n[..len]);
                // 1 is (1 - 1) + 1, and another constant its own first power.
                let whole = if constant == 1.0 { -0.0 } else { constant };
                let mut wild = 0u32;
                for i in 0..len {
                    wild |= Self::is_wild(v[i], lo[i], hi[i]) as u32;
                    // A zero that is added takes the sign of another away.
                    let (below, above, range) = (v[i] - lo[i] + 0.0, hi[i] - v[i] + 0.0, hi[i] - lo[i]);
                    // Both lie in range..n range, and the sum is right to 2^-53 of itself or exact where that matters.
                    let over = s[i].less(n[i], lo[i] as f64) as $t;
                    let under = -s[i].less(n[i], hi[i] as f64) as $t;
                    let (a, b, p, q) = if FLIPPED { (above, below, under, over) } else { (below, above, over, under) };
                    let ratio = (if b + b < a { -b } else { a } / range) as f32;
                    let beta = (p / q) as f32;
                    let flat = range == 0.0;
                    ratios[i] = if flat { whole } else { ratio };
                    betas[i] = if flat { 1.0 } else { beta };
                }
                wild != 0
            }

            #[inline(always)]
            #[allow(clippy::eq_op)]
            fn is_wild(v: $t, lo: $t, hi: $t) -> bool {
                let (below, above, range) = (v - lo, hi - v, hi - lo);
                let least = range * $least;
                let shares = (below >= least || below == 0.0) & (above >= least || above == 0.0);
                let fits = (range > $small) & (range < $large) & shares;
                !(fits | (range == 0.0) | (v != v))
            }
        }
    };
}
centre!(f32, f64, 8.077_936e-28, 1.237_940_1e27, 8.077_936e-28); // 2^-90 and 2^90
centre!(f64, Pair, 3.872_591_914_849_318e-121, 2.582_249_878_086_908_6e120, 8.077_935_669_463_161e-28); // 2^-400, 2^400, 2^-90

crate::on_singles! {
    fn power_at[T: Centre, const FLIPPED: bool](row: &Windows<T>, constant: f32, out: &mut [f32], endless: &mut bool) =
        power_inner[T, FLIPPED];
}

/// A 3.2 for a row; absolute error 1e-6.
pub fn cdf_power<T: Centre>(level: Level, row: &Windows<T>, polarity: Polarity, out: &mut [f32]) {
    let len = out.len();
    if len < SINGLES {
        // As the first values of a row of a block.
        if len > 0 {
            let (v, lo, hi) = (padded(row.v, len), padded(row.lo, len), padded(row.hi, len));
            let (s, n, mut all) = (padded(row.s, len), padded(row.n, len), [0.0; SINGLES]);
            cdf_power(level, &Windows { v: &v, lo: &lo, hi: &hi, s: &s, n: &n }, polarity, &mut all);
            out.copy_from_slice(&all[..len]);
        }
        return;
    }
    let mut endless = false;
    match polarity.flipped {
        false => power_at::<T, false>(level, row, polarity.constant, out, &mut endless),
        true => power_at::<T, true>(level, row, polarity.constant, out, &mut endless),
    }
    if endless {
        for (i, o) in out.iter_mut().enumerate() {
            let [v, lo, hi] = [row.v[i], row.lo[i], row.hi[i]].map(T::to_f64);
            if lo == hi {
                *o = polarity.constant;
            } else if lo.is_infinite() || hi.is_infinite() {
                *o = infinite(v, lo, hi, polarity.flipped, [1.0, 0.0]);
            }
        }
    }
}

/// [`cdf_power`] of f32, which tests and benches outside the crate judge over its whole domain.
#[doc(hidden)]
pub fn power_row(level: Level, [v, lo, hi]: [&[f32]; 3], s: &[f64], n: &[f64], out: &mut [f32]) {
    cdf_power(level, &Windows { v, lo, hi, s, n }, Polarity { flipped: false, constant: 0.0 }, out);
}

#[inline(always)]
fn power_inner<L: F32x32, T: Centre, const FLIPPED: bool>(
    row: &Windows<T>,
    constant: f32,
    out: &mut [f32],
    endless: &mut bool,
) {
    let [mut ratios, mut betas, mut exponents] = [const { Strip([0.0; STRIP]) }; 3];
    let mut from = 0;
    loop {
        let to = out.len().min(from + STRIP);
        let (part, len) = (row.part(from, to), to - from);
        if T::quotients::<FLIPPED>(&part, constant, [&mut ratios.0[..len], &mut betas.0[..len]]) {
            for i in (0..len).filter(|i| T::is_wild(part.v[*i], part.lo[*i], part.hi[*i])) {
                [ratios.0[i], betas.0[i]] = wild_quotients::<T, FLIPPED>(&part, i);
                *endless |= part.lo[i].to_f64().is_infinite() | part.hi[i].to_f64().is_infinite();
            }
        }
        let strips = [ratios.0.as_ptr(), betas.0.as_ptr()];
        // SAFETY: `len` is at least 32, at most that of a strip, and so much of them was written.
        unsafe { powers::<L, f32>(strips, exponents.0.as_mut_ptr(), &mut out[from..to]) };
        if to == out.len() {
            break;
        }
        // A last strip of less than a block starts earlier, and makes some values again.
        from = to.min(out.len() - SINGLES);
    }
}

/// The quotients of window `i`, finite but wild, in f64.
fn wild_quotients<T: Centre, const FLIPPED: bool>(row: &Windows<T>, i: usize) -> [f32; 2] {
    let [v, lo, hi] = [row.v[i], row.lo[i], row.hi[i]].map(T::to_f64);
    // Halves: the range of f64 values may exceed the largest of them.
    let (below, above, range) = (0.5 * v - 0.5 * lo + 0.0, 0.5 * hi - 0.5 * v + 0.0, 0.5 * hi - 0.5 * lo);
    let (over, under) = (row.s[i].less(row.n[i], lo), -row.s[i].less(row.n[i], hi));
    let (a, b, p, q) = if FLIPPED { (above, below, under, over) } else { (below, above, over, under) };
    let (near, beta) = (b + b < a, p / q);
    let ratio = (if near { -b } else { a } / range) as f32;
    if near || a == 0.0 || ratio >= f32::MIN_POSITIVE {
        return [ratio, beta as f32];
    }
    // Smaller than f32 can be: t^beta is a power of 2^-64, too.
    const SMALL: f32 = 5.421_011e-20; // 2^-64
    let log = math::log2(a) - math::log2(range);
    [SMALL, (beta.clamp(1e-6, 1e6) * log / -64.0) as f32]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows of windows from 0 to `range` with every place of the centre, whose voxels have the mean that makes `beta`.
    fn check<T: Centre>(of: impl Fn(f64) -> T, sum: impl Fn(f64) -> T::Total, range: f64) -> f64 {
        let n = 1000.0;
        let mut worst = 0f64;
        for (len, j) in [1, 31, 32, 33, 300, 700].into_iter().flat_map(|len| (-20..=20).map(move |j| (len, j))) {
            // p / q = beta with p + q = n range.
            let beta = 10f64.powf(j as f64 * 0.3);
            let v: Vec<T> = (0..len).map(|i| of(range * ((1 + i * i * 97 % 65535) as f64 / 65535.0))).collect();
            let (lo, hi) = (vec![of(0.0); len], vec![of(range); len]);
            let top = hi[0].to_f64();
            let (s, n) = (vec![sum(n * top * (beta / (1.0 + beta))); len], vec![n; len]);
            let row = Windows { v: &v, lo: &lo, hi: &hi, s: &s, n: &n };
            for flipped in [false, true] {
                let polarity = Polarity { flipped, constant: 0.5 };
                let mut first = None;
                for level in Level::available() {
                    let mut out = vec![f32::NAN; len];
                    cdf_power(level, &row, polarity, &mut out);
                    for (o, v) in out.iter().zip(&v) {
                        let (below, above) = (v.to_f64() / top, (top - v.to_f64()) / top);
                        let (t, rest, beta) = if flipped { (above, below, 1.0 / beta) } else { (below, above, beta) };
                        let log = if rest < 0.5 { (-rest).ln_1p() } else { t.ln() };
                        worst = worst.max((*o as f64 - (beta.clamp(1e-6, 1e6) * log).exp()).abs());
                    }
                    let bits: Vec<u32> = out.iter().map(|o| o.to_bits()).collect();
                    assert_eq!(&bits, first.get_or_insert(bits.clone()), "{level:?}");
                }
            }
        }
        worst
    }

    #[test]
    fn powers_are_within_1e6_of_exact_for_every_beta_and_range() {
        for range in [1.0, 65535.0, 1e-20, 1e25] {
            let worst = check(|v| v as f32, |s| s, range);
            assert!(worst < 1.2e-6, "f32, {range}: {worst}");
        }
        for range in [1.0, 1e-100, 1e110, 1e-200, 1e250] {
            let worst = check(|v| v, |s| Pair::of(s, 0.0), range);
            assert!(worst < 1.2e-6, "f64, {range}: {worst}");
        }
    }

    #[test]
    fn ends_constants_signed_zeros_and_infinities_are_exact() {
        let inf = f64::INFINITY;
        let rows: [([f64; 3], f32); 10] = [
            ([0.0, 0.0, 2.0], 0.0),
            ([-0.0, 0.0, 2.0], 0.0),
            ([0.0, -0.0, 2.0], 0.0),
            ([2.0, 0.0, 2.0], 1.0),
            ([0.0, -2.0, -0.0], 1.0),
            ([-0.0, -2.0, 0.0], 1.0),
            ([3.0, 3.0, 3.0], 0.25),
            ([-0.0, 0.0, -0.0], 0.25),
            ([inf, 0.0, inf], 1.0),
            ([-inf, -inf, 0.0], 0.0),
        ];
        for k in 0..rows.len() {
            // Alone and among others.
            for order in [vec![k], (0..90).map(|i| (k + i) % rows.len()).collect()] {
                let of = |a: usize| order.iter().map(|i| rows[*i].0[a]).collect::<Vec<f64>>();
                let (v, lo, hi, n) = (of(0), of(1), of(2), vec![8.0; order.len()]);
                let half = |i: usize| 4.0 * lo[i] + 4.0 * hi[i];
                let s: Vec<f64> = (0..order.len()).map(half).collect();
                let pairs: Vec<Pair> = s.iter().map(|s| Pair::of(*s, 0.0)).collect();
                let narrow = [&v, &lo, &hi].map(|a| a.iter().map(|v| *v as f32).collect::<Vec<f32>>());
                let polarity = Polarity { flipped: false, constant: 0.25 };
                for level in Level::available() {
                    let mut out = [vec![9.0; order.len()], vec![9.0; order.len()]];
                    let row = Windows { v: &narrow[0], lo: &narrow[1], hi: &narrow[2], s: &s, n: &n };
                    cdf_power(level, &row, polarity, &mut out[0]);
                    cdf_power(level, &Windows { v: &v, lo: &lo, hi: &hi, s: &pairs, n: &n }, polarity, &mut out[1]);
                    let expected: Vec<f32> = order.iter().map(|i| rows[*i].1).collect();
                    assert_eq!(out, [expected.clone(), expected], "{level:?} {order:?}");
                }
            }
        }
    }
}
