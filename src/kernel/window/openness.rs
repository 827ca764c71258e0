//! Openness of rows of integer windows, 32 at a time: the arithmetic of [`super::math`] on vectors.

use super::estimate::{Code, Polarity, RowSum, Spread};
use crate::kernel::singles::{F32x32, SINGLES};

/// Codes of the centres (before `flip`), and their windows. All slices are of one length.
#[derive(Clone, Copy)]
pub struct Row<'a, T, X1> {
    pub v: &'a [T],
    pub flip: T,
    pub s1: &'a [X1],
    pub n: &'a [u32],
    /// Most voxels in a window.
    pub most: u64,
}

impl<T: Code, X1: RowSum> Row<'_, T, X1> {
    #[inline(always)]
    fn part(&self, from: usize, to: usize) -> Self {
        Row { v: &self.v[from..to], s1: &self.s1[from..to], n: &self.n[from..to], ..*self }
    }

    /// Products of a count and a code, and so all differences of such products and sums, fit in i32.
    fn narrow(&self) -> bool {
        T::TOP <= u16::MAX as u32 && size_of::<X1>() == 4 && (self.most as u128 * T::TOP as u128) < 1 << 31
    }
}

crate::on_singles! {
    /// A 3.2: `t^beta`, from extremes and sums.
    fn power_at[T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool](
        row: &Row<T, X1>, lo: &[T], hi: &[T], constant: f32, out: &mut [f32]
    ) = power_inner[T, X1, FLIPPED, NARROW];
}

/// A 3.2: `t^beta` of a row with extremes `lo` and `hi`.
pub fn cdf_power_row<T: Code, X1: RowSum>(
    level: crate::kernel::simd::Level,
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    polarity: Polarity,
    out: &mut [f32],
) {
    let len = out.len();
    if len < SINGLES {
        let (v, s1, n) = (padded(row.v, len), padded(row.s1, len), padded(row.n, len));
        let (lo, hi) = (padded(lo, len), padded(hi, len));
        let mut all = [0.0; SINGLES];
        cdf_power_row(level, &Row { v: &v, s1: &s1, n: &n, ..*row }, &lo, &hi, polarity, &mut all);
        out.copy_from_slice(&all[..len]);
        return;
    }
    let constant = polarity.constant;
    match (polarity.flipped, row.narrow()) {
        (false, false) => power_at::<T, X1, false, false>(level, row, lo, hi, constant, out),
        (false, true) => power_at::<T, X1, false, true>(level, row, lo, hi, constant, out),
        (true, false) => power_at::<T, X1, true, false>(level, row, lo, hi, constant, out),
        (true, true) => power_at::<T, X1, true, true>(level, row, lo, hi, constant, out),
    }
}

/// The first `len` values and the last of them again.
fn padded<T: Copy>(from: &[T], len: usize) -> [T; SINGLES] {
    std::array::from_fn(|i| from[i.min(len - 1)])
}

/// Values that go through the passes of a formula together. One pass would be a chain of 100 cycles of which a core can
/// start the next only when the first is half done, since it holds about 128 waiting operations; in passes through the
/// first-level cache several short chains run side by side. 2-core Zen 4 VM, AVX-512, 2026-11-26, `t^beta` of u8 rows in
/// cache: 0.76 ns per voxel in one pass, 0.72 in three (AVX2: 1.04 and 0.93).
const STRIP: usize = 256;

/// Runs `$body` for starts of blocks of 32 that cover `from..to`, at least 32 values; the last may overlap its neighbour, and
/// makes the same values again.
macro_rules! blocks {
    ($from:expr, $to:expr, |$at:ident| $body:block) => {
        let (from, to) = ($from, $to);
        let mut $at = from;
        loop {
            $body
            if $at + SINGLES >= to {
                break;
            }
            $at = ($at + SINGLES).min(to - SINGLES);
        }
    };
}

/// Runs `$body` for strips of at most [`STRIP`] values and at least 32 that cover `0..len`; the last may overlap.
macro_rules! strips {
    ($len:expr, |$from:ident, $to:ident| $body:block) => {
        let len = $len;
        assert!(len >= SINGLES);
        let mut $from = 0;
        loop {
            let $to = len.min($from + STRIP);
            $body
            if $to == len {
                break;
            }
            $from = $to.min(len - SINGLES);
        }
    };
}

#[inline(always)]
fn power_inner<L: F32x32, T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool>(
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    out: &mut [f32],
) {
    let (mut ratios, mut betas, mut exponents) = ([0f32; STRIP], [0f32; STRIP], [0f32; STRIP]);
    strips!(out.len(), |from, to| {
        let len = to - from;
        let (q, beta, x) = (&mut ratios[..len], &mut betas[..len], &mut exponents[..len]);
        let (row, lo, hi, out) = (row.part(from, to), &lo[from..to], &hi[from..to], &mut out[from..to]);
        if ratios_of::<L, T, X1, FLIPPED, NARROW>(&row, lo, hi, constant, q, beta) {
            out.fill(constant);
        } else {
            logarithms::<L>(q, beta, x);
            powers::<L>(x, out);
        }
    });
}

/// What [`logarithms`] asks for: t, or where it is at least 2/3 t - 1 (never +0 there), and beta. Returns whether all windows
/// are constant, as in air that a detector or a mask has set to one value.
#[inline(always)]
fn ratios_of<L: F32x32, T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool>(
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    ratios: &mut [f32],
    betas: &mut [f32],
) -> bool {
    let len = ratios.len();
    let (v, s1, n, lo, hi) = (&row.v[..len], &row.s1[..len], &row.n[..len], &lo[..len], &hi[..len]);
    assert!(len >= SINGLES && betas.len() == len);
    let mut all_flat = true;
    blocks!(0, len, |at| {
        // SAFETY: `at + 32 <= len`, the length of every slice.
        unsafe {
            let c = T::codes::<L>(v.as_ptr().add(at), row.flip);
            let l = T::codes::<L>(lo.as_ptr().add(at), T::default());
            let h = T::codes::<L>(hi.as_ptr().add(at), T::default());
            // Sums of (v_i - min) and (max - v_i): exact, so beta keeps its relative accuracy whatever its size.
            let (over, under) = if NARROW {
                let (s, count) = (L::load_u32(s1.as_ptr().add(at).cast()), L::load_u32(n.as_ptr().add(at))); // X1 is u32
                let over = L::of_int(L::less_int(s, L::times_int(count, l)));
                (over, L::of_int(L::less_int(L::times_int(count, h), s)))
            } else {
                let mut d = [[0f32; SINGLES]; 2];
                for i in 0..SINGLES {
                    d[0][i] = s1[at + i].minus(X1::times(n[at + i], lo[at + i].u32())).f32();
                }
                for i in 0..SINGLES {
                    d[1][i] = X1::times(n[at + i], hi[at + i].u32()).minus(s1[at + i]).f32();
                }
                (L::load(d[0].as_ptr()), L::load(d[1].as_ptr()))
            };
            let (below, range, above) = if T::TOP <= u16::MAX as u32 {
                (L::of_int(L::less_int(c, l)), L::of_int(L::less_int(h, l)), L::of_int(L::less_int(h, c)))
            } else {
                let mut d = [[0f32; SINGLES]; 3];
                for i in 0..SINGLES {
                    let (c, l, h) = (v[at + i].code(row.flip), lo[at + i], hi[at + i]);
                    (d[0][i], d[1][i], d[2][i]) = (c.above(l), h.above(l), h.above(c));
                }
                (L::load(d[0].as_ptr()), L::load(d[1].as_ptr()), L::load(d[2].as_ptr()))
            };
            let (a, b, p, q) = match FLIPPED {
                false => (below, above, over, under),
                true => (above, below, under, over),
            };
            let (ratio, beta, flat) = shape::<L>([a, b, range, p, q], constant);
            all_flat &= flat;
            ratio.store(ratios.as_mut_ptr().add(at));
            beta.store(betas.as_mut_ptr().add(at));
        }
    });
    all_flat
}

/// From v - min, max - v, their sum, and the sums of (v_i - min) and (max - v_i): what [`logarithms`] asks for, and whether all
/// windows are constant.
#[inline(always)]
fn shape<L: F32x32>([a, b, range, p, q]: [L; 5], constant: f32) -> (L, L, bool) {
    let beta = p.over(q).greater(L::splat(1e-6)).lesser(L::splat(1e6));
    let near = b.plus(b).is_below(a);
    let ratio = L::pick(near, L::splat(-0.0).minus(b), a).over(range);
    let flat = range.equals(L::splat(0.0));
    if !L::any(flat) {
        return (ratio, beta, false);
    }
    // 1 is (1 - 1) + 1, and another constant its own first power.
    let whole = L::splat(if constant == 1.0 { -0.0 } else { constant });
    (L::pick(flat, whole, ratio), L::pick(flat, L::splat(1.0), beta), L::all(flat))
}

/// `beta log2 t`, by [`super::math::power_of`]'s polynomial; far below 0 where t is 0.
#[inline(always)]
fn logarithms<L: F32x32>(ratios: &[f32], betas: &[f32], exponents: &mut [f32]) {
    let len = exponents.len();
    assert!(len >= SINGLES && ratios.len() == len && betas.len() == len);
    blocks!(0, len, |at| {
        // SAFETY: `at + 32 <= len`.
        unsafe {
            let q = L::load(ratios.as_ptr().add(at));
            let near = q.is_negative();
            let [exponent, mantissa] = q.split();
            let f = L::pick(near, q, mantissa);
            let e = L::pick(near, L::splat(0.0), exponent);
            let square = f.times(f);
            let low = f.fused(L::splat(-0.721_379_9), L::splat(1.442_694_8));
            let middle = f.fused(L::splat(-0.358_389_38), L::splat(0.480_960_9));
            let high = f.fused(L::splat(-0.279_993_83), L::splat(0.285_692_45));
            let top = square.fused(L::splat(0.246_199_53), high);
            let ratio = top.fused(square, middle).fused(square, low);
            let log = L::load(betas.as_ptr().add(at)).times(f.fused(ratio, e));
            L::pick(q.is_blank(), L::splat(-1000.0), log).store(exponents.as_mut_ptr().add(at));
        }
    });
}

/// `2^x` of exponents `x <= 0`.
#[inline(always)]
fn powers<L: F32x32>(exponents: &[f32], out: &mut [f32]) {
    let len = out.len();
    assert!(len >= SINGLES && exponents.len() == len);
    blocks!(0, len, |at| {
        // SAFETY: `at + 32 <= len`.
        unsafe { exp2(L::load(exponents.as_ptr().add(at))).store(out.as_mut_ptr().add(at)) };
    });
}

crate::on_singles! {
    /// A 3.3 and E 3.4 from the numerators of variances.
    fn spread_at[T: Code, X1: RowSum, const KIND: usize, const NARROW: bool](
        row: &Row<T, X1>, numerator: &[f64], polarity: Polarity, scale: f32, out: &mut [f32]
    ) = spread_inner[T, X1, KIND, NARROW];
}

const GAUSSIAN: usize = 0;
const CHEBYSHEV: usize = 1;
const LITERAL: usize = 2;

/// A 3.3 and E 3.4 of a row with numerators `n^2 variance`.
pub fn spread_row<T: Code, X1: RowSum>(
    level: crate::kernel::simd::Level,
    kind: Spread,
    row: &Row<T, X1>,
    numerator: &[f64],
    polarity: Polarity,
    out: &mut [f32],
) {
    let len = out.len();
    if len < SINGLES {
        let (v, s1, n) = (padded(row.v, len), padded(row.s1, len), padded(row.n, len));
        let mut all = [0.0; SINGLES];
        let row = Row { v: &v, s1: &s1, n: &n, ..*row };
        spread_row(level, kind, &row, &padded(numerator, len), polarity, &mut all);
        out.copy_from_slice(&all[..len]);
        return;
    }
    // Products of three deviations must stay below 2^128; a power of two changes no rounding.
    let bits = (row.most as u128 * T::TOP as u128).max(1).ilog2() as i32;
    let scale = 2f32.powi(-(bits - 38).max(0));
    macro_rules! go {
        ($kind:ident) => {
            match row.narrow() {
                true => spread_at::<T, X1, $kind, true>(level, row, numerator, polarity, scale, out),
                false => spread_at::<T, X1, $kind, false>(level, row, numerator, polarity, scale, out),
            }
        };
    }
    match kind {
        Spread::Gaussian => go!(GAUSSIAN),
        Spread::Chebyshev => go!(CHEBYSHEV),
        Spread::Literal => go!(LITERAL),
    }
}

#[inline(always)]
fn spread_inner<L: F32x32, T: Code, X1: RowSum, const KIND: usize, const NARROW: bool>(
    row: &Row<T, X1>,
    numerator: &[f64],
    polarity: Polarity,
    scale: f32,
    out: &mut [f32],
) {
    let len = out.len();
    let (v, s1, n, numerator) = (&row.v[..len], &row.s1[..len], &row.n[..len], &numerator[..len]);
    assert!(len >= SINGLES);
    let zero = L::splat(0.0);
    // What is made below is S1 - n v.
    let sign = L::splat(if polarity.flipped { scale } else { -scale });
    blocks!(0, len, |at| {
        // SAFETY: `at + 32 <= len`, the length of every slice.
        let d = unsafe {
            if NARROW {
                let c = T::codes::<L>(v.as_ptr().add(at), row.flip);
                let product = L::times_int(L::load_u32(n.as_ptr().add(at)), c);
                L::of_int(L::less_int(L::load_u32(s1.as_ptr().add(at).cast()), product)) // X1 is u32
            } else {
                let mut d = [0f32; SINGLES];
                for i in 0..SINGLES {
                    d[i] = s1[at + i].behind(n[at + i], v[at + i].code(row.flip).u32());
                }
                L::load(d.as_ptr())
            }
        };
        // SAFETY: as above.
        let m = unsafe { L::of_f64(numerator.as_ptr().add(at)) };
        let flat = m.equals(zero);
        let (d, m) = (d.times(sign), m.times(L::splat(scale * scale)));
        let constant = L::splat(polarity.constant);
        let y = if L::all(flat) {
            constant
        } else {
            let y = match KIND {
                GAUSSIAN => phi(d, m),
                // 1 - m / (m + d^2) without the cancellation
                CHEBYSHEV => d.greater(zero).times(d.greater(zero)).over(d.fused(d, m)),
                _ => L::pick(zero.is_below(d), m.over(d.fused(d, m)), L::splat(1.0)),
            };
            L::pick(flat, constant, y)
        };
        // SAFETY: as above.
        unsafe { y.store(out.as_mut_ptr().add(at)) };
    });
}

/// The standard normal distribution function of `d / sqrt(m)` by Abramowitz and Stegun 7.1.26, absolute error 4e-7, with one
/// division: with s = sqrt(m) and u = s + k |d| the quotients `s / u` and `d^2 / m` are multiples of `1 / (m u)`.
#[inline(always)]
fn phi<L: F32x32>(d: L, m: L) -> L {
    const K: f32 = 0.327_591_1 * std::f32::consts::FRAC_1_SQRT_2;
    let s = m.root();
    let u = d.magnitude().fused(L::splat(K), s);
    let inverse = L::splat(1.0).over(m.times(u));
    let t = s.times(m).times(inverse);
    let exponent = d.times(d).times(u.times(inverse)).times(L::splat(-0.5 * std::f32::consts::LOG2_E));
    let square = t.times(t);
    let low = t.fused(L::splat(-0.284_496_72 * 0.5), L::splat(0.254_829_6 * 0.5));
    let high = t.fused(L::splat(-1.453_152 * 0.5), L::splat(1.421_413_8 * 0.5));
    let p = square.fused(L::splat(1.061_405_4 * 0.5), high).fused(square, low).times(t);
    let tail = p.times(exp2(exponent));
    L::pick(d.is_below(L::splat(0.0)), tail, L::splat(1.0).minus(tail))
}

// Polynomials are split into pairs of terms, whose sums do not wait for each other.

/// [`super::math::exp2`] within its error, but 0 below -125.
#[inline(always)]
fn exp2<L: F32x32>(x: L) -> L {
    let magic = L::splat(12_582_912.0);
    let z = x.plus(magic);
    let f = x.minus(z.minus(magic));
    let square = f.times(f);
    let low = f.fused(L::splat(f32::from_bits(0x3f31_7215)), L::splat(1.0));
    let middle = f.fused(L::splat(0.055_507_336), L::splat(0.240_222_42));
    let high = f.fused(L::splat(0.001_326_472_7), L::splat(0.009_671_513));
    let p = high.fused(square, middle).fused(square, low);
    L::pick(x.is_below(L::splat(-125.0)), L::splat(0.0), p.scaled(z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    /// Windows of u16 codes with every order of size of beta, t and count, constant ones among them.
    struct Windows {
        v: Vec<u16>,
        lo: Vec<u16>,
        hi: Vec<u16>,
        s1: Vec<u64>,
        n: Vec<u32>,
    }

    fn windows(len: usize, most: u32) -> Windows {
        let mut state = 1u64;
        let mut next = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below.max(1)
        };
        let mut w = Windows { v: vec![], lo: vec![], hi: vec![], s1: vec![], n: vec![] };
        for i in 0..len {
            let lo = next(65_536);
            let range = next(65_536 - lo) >> next(16);
            let v = lo + [0, range, next(range + 1), range - next(range + 1) / 64][i % 4];
            let n = 3 + next(most as u64 - 3);
            // The extremes and the centre are in the window; the rest lies anywhere between.
            let rest = (n - 3) * lo + next((n - 3) * range + 1) / [1, 1000, 1_000_000][i % 3];
            w.v.push(v as u16);
            w.lo.push(lo as u16);
            w.hi.push((lo + range) as u16);
            w.s1.push(rest + lo + (lo + range) + v);
            w.n.push(n as u32);
        }
        w
    }

    fn row<'a, X1>(w: &'a Windows, s1: &'a [X1], flip: u16, most: u64) -> Row<'a, u16, X1> {
        Row { v: &w.v, flip, s1, n: &w.n, most }
    }

    #[test]
    fn power_is_within_2e6_of_the_formula_and_the_same_at_every_level_and_width() {
        for (len, flipped) in
            [(1, false), (31, true), (32, false), (33, true), (255, false), (700, true), (4000, false)]
        {
            let w = windows(len, 30_000);
            let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
            let polarity = Polarity { flipped, constant: if len % 2 == 0 { 0.5 } else { 1.0 } };
            let mut first: Option<Vec<f32>> = None;
            for level in Level::available() {
                let (mut wide, mut out) = (vec![7.0; len], vec![7.0; len]);
                cdf_power_row(level, &row(&w, &w.s1, 0, 30_000), &w.lo, &w.hi, polarity, &mut wide);
                cdf_power_row(level, &row(&w, &narrow, 0, 30_000), &w.lo, &w.hi, polarity, &mut out);
                assert_eq!(wide, out, "{level:?}");
                assert_eq!(first.get_or_insert_with(|| out.clone()), &out, "{level:?}");
                for (i, got) in out.iter().enumerate() {
                    let (v, lo, hi, s, n) =
                        (w.v[i] as f64, w.lo[i] as f64, w.hi[i] as f64, w.s1[i] as f64, w.n[i] as f64);
                    let (a, p, q) = match flipped {
                        false => (v - lo, s - n * lo, n * hi - s),
                        true => (hi - v, n * hi - s, s - n * lo),
                    };
                    let t = a / (hi - lo);
                    let log = if t > 0.5 { ((a - (hi - lo)) / (hi - lo)).ln_1p() } else { t.ln() };
                    let exact =
                        if hi == lo { polarity.constant as f64 } else { ((p / q).clamp(1e-6, 1e6) * log).exp() };
                    assert!((*got as f64 - exact).abs() < 2e-6, "{level:?} {i}: {got} {exact}");
                    assert!(hi > lo || *got == polarity.constant, "constant windows are exact");
                }
            }
        }
    }

    #[test]
    fn spreads_follow_their_formulas_and_are_the_same_at_every_level_and_width() {
        for (len, flipped) in [(1, false), (31, true), (40, false), (3000, true)] {
            let w = windows(len, 30_000);
            let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
            // Any spread is possible beside a sum; 0 stands for a constant window.
            let spread: Vec<f64> = (0..len).map(|i| if i % 7 == 0 { 0.0 } else { 10f64.powi(i as i32 % 18) }).collect();
            let polarity = Polarity { flipped, constant: 0.5 };
            for kind in [Spread::Gaussian, Spread::Chebyshev, Spread::Literal] {
                let mut first: Option<Vec<f32>> = None;
                for level in Level::available() {
                    let (mut wide, mut out) = (vec![7.0; len], vec![7.0; len]);
                    spread_row(level, kind, &row(&w, &w.s1, 0, 30_000), &spread, polarity, &mut wide);
                    spread_row(level, kind, &row(&w, &narrow, 0, 30_000), &spread, polarity, &mut out);
                    assert_eq!(wide, out, "{level:?}");
                    assert_eq!(first.get_or_insert_with(|| out.clone()), &out, "{level:?}");
                    for (i, got) in out.iter().enumerate() {
                        let d = w.n[i] as f64 * w.v[i] as f64 - w.s1[i] as f64;
                        let (d, m) = (if flipped { -d } else { d }, spread[i]);
                        let exact = match kind {
                            _ if m == 0.0 => 0.5,
                            Spread::Gaussian => crate::kernel::window::math::phi((d / m.sqrt()) as f32) as f64,
                            Spread::Chebyshev => {
                                if d > 0.0 {
                                    d * d / (m + d * d)
                                } else {
                                    0.0
                                }
                            }
                            Spread::Literal => {
                                if d > 0.0 {
                                    m / (m + d * d)
                                } else {
                                    1.0
                                }
                            }
                        };
                        assert!((*got as f64 - exact).abs() < 6e-7, "{kind:?} {level:?} {i}: {got} {exact}");
                    }
                }
            }
        }
    }

    /// Sums of 2^31 voxels of 32 bits: products of deviations would leave f32.
    #[test]
    fn huge_spreads_do_not_overflow() {
        let (v, n) = ([u32::MAX; 40], [i32::MAX as u32; 40]);
        let s1 = [n[0] as u64 * (u32::MAX as u64 / 2); 40];
        let deviation = n[0] as f64 * (u32::MAX as f64 / 2.0);
        for level in Level::available() {
            let mut out = [0.0; 40];
            let row = Row { v: &v, flip: 0, s1: &s1, n: &n, most: n[0] as u64 };
            let polarity = Polarity { flipped: false, constant: 1.0 };
            spread_row(level, Spread::Gaussian, &row, &[deviation * deviation; 40], polarity, &mut out);
            assert!(out.iter().all(|o| (o - 0.841_344_7).abs() < 1e-6), "{level:?} {out:?}");
        }
    }
}
