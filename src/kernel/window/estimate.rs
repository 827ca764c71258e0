//! From exact integer sums of one row of windows to results. Codes are unsigned: a stored value is `code - offset`.

use super::beta::{self, Terms};
use super::lines::Elem;
use super::math;
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};

/// Integer that sums are kept in; arithmetic wraps, and the caller proves that final values fit.
pub trait Acc: bytemuck::Pod + Default + PartialOrd + std::fmt::Debug {
    fn plus(self, o: Self) -> Self;
    fn minus(self, o: Self) -> Self;
    fn wide(self) -> u128;
    fn low(self) -> u64;
    /// Exact for values below 2^52.
    fn small(self) -> f64;
}

macro_rules! acc {
    ($($t:ident: |$s:ident| $small:expr;)*) => {$(
        impl Acc for $t {
            #[inline(always)]
            fn plus(self, o: $t) -> $t { self.wrapping_add(o) }
            #[inline(always)]
            fn minus(self, o: $t) -> $t { self.wrapping_sub(o) }
            #[inline(always)]
            fn wide(self) -> u128 { self as u128 }
            #[inline(always)]
            fn low(self) -> u64 { self as u64 }
            #[inline(always)]
            fn small(self) -> f64 { let $s = self; $small }
        }
    )*};
}
acc! {
    u16: |s| s as f64;
    u32: |s| s as f64;
    u64: |s| small(s);
    u128: |s| small(s as u64);
}

/// The integer that first sums of a row end in: u32 or u64.
pub trait RowSum: Acc {
    /// `n * code`, which fits where the sum of a window fits.
    fn times(n: u32, code: u32) -> Self;
    /// Rounded once.
    fn f32(self) -> f32;
    /// `self - n * code` of any sign, rounded once.
    fn behind(self, n: u32, code: u32) -> f32;
}
impl RowSum for u32 {
    #[inline(always)]
    fn times(n: u32, code: u32) -> u32 {
        n.wrapping_mul(code)
    }
    #[inline(always)]
    fn f32(self) -> f32 {
        self as f32
    }
    #[inline(always)]
    fn behind(self, n: u32, code: u32) -> f32 {
        (-(n as f64)).mul_add(code as f64, self as f64) as f32 // below 2^33: exact before the cast
    }
}
impl RowSum for u64 {
    #[inline(always)]
    fn times(n: u32, code: u32) -> u64 {
        n as u64 * code as u64
    }
    #[inline(always)]
    fn f32(self) -> f32 {
        self as f32
    }
    #[inline(always)]
    fn behind(self, n: u32, code: u32) -> f32 {
        self.wrapping_sub(n as u64 * code as u64) as i64 as f32
    }
}

/// Unsigned codes of integer voxels.
pub trait Code: Elem {
    type Square: Copy;
    /// Largest code.
    const TOP: u32;
    fn u32(self) -> u32;
    /// Exact: u8 in u16, u16 in u32, u32 in u64.
    fn square(self) -> Self::Square;
    /// `self - other >= 0`, rounded once.
    fn above(self, other: Self) -> f32;
    /// The codes of 32 stored values.
    ///
    /// # Safety
    /// 32 values can be read from `from` on.
    unsafe fn codes<L: F32x32>(from: *const Self, flip: Self) -> L::Int;
}
impl Code for u8 {
    type Square = u16;
    const TOP: u32 = u8::MAX as u32;
    #[inline(always)]
    fn u32(self) -> u32 {
        self as u32
    }
    #[inline(always)]
    fn square(self) -> u16 {
        self as u16 * self as u16
    }
    #[inline(always)]
    fn above(self, other: u8) -> f32 {
        (self as i32 - other as i32) as f32
    }
    #[inline(always)]
    unsafe fn codes<L: F32x32>(from: *const u8, flip: u8) -> L::Int {
        // SAFETY: the caller's promise.
        unsafe { L::load_u8(from, flip) }
    }
}
impl Code for u16 {
    type Square = u32;
    const TOP: u32 = u16::MAX as u32;
    #[inline(always)]
    fn u32(self) -> u32 {
        self as u32
    }
    #[inline(always)]
    fn square(self) -> u32 {
        self as u32 * self as u32
    }
    #[inline(always)]
    fn above(self, other: u16) -> f32 {
        (self as i32 - other as i32) as f32
    }
    #[inline(always)]
    unsafe fn codes<L: F32x32>(from: *const u16, flip: u16) -> L::Int {
        // SAFETY: the caller's promise.
        unsafe { L::load_u16(from, flip) }
    }
}
impl Code for u32 {
    type Square = u64;
    const TOP: u32 = u32::MAX;
    #[inline(always)]
    fn u32(self) -> u32 {
        self
    }
    #[inline(always)]
    fn square(self) -> u64 {
        self as u64 * self as u64
    }
    #[inline(always)]
    fn above(self, other: u32) -> f32 {
        self.wrapping_sub(other) as f32
    }
    #[inline(always)]
    unsafe fn codes<L: F32x32>(from: *const u32, flip: u32) -> L::Int {
        // SAFETY: the caller's promise.
        let codes = unsafe { from.cast::<[u32; SINGLES]>().read_unaligned() }.map(|v| v ^ flip);
        // SAFETY: 32 values.
        unsafe { L::load_u32(codes.as_ptr()) }
    }
}

/// Exact for values below 2^52, in two operations on any vector unit.
#[inline(always)]
fn small(v: u64) -> f64 {
    f64::from_bits(v | 0x4330_0000_0000_0000) - 4_503_599_627_370_496.0
}

/// How the numerator n S2 - S1^2 = n^2 variance is made exact.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Width {
    /// Everything is below 2^53: no product rounds.
    Small,
    /// S1, S2 < 2^52: `S1^2 = p + e` by a fused product, `(n S2 - p) - e`. Below 2^53 every step is exact (all are
    /// integers); above, e is 2^-53 of p at most and the result is off by 1.5 * 2^-53 of itself at most.
    Direct,
    /// The same on codes less 32768, whose squares are four times smaller (16-bit types).
    Centred,
    /// u128.
    Big,
}

impl Width {
    /// For windows of at most `n` voxels of codes up to `top`.
    pub fn of(n: u64, top: u32) -> Width {
        let limit = 1u128 << 52;
        if (n as u128 * top as u128).pow(2) < 1 << 53 {
            Width::Small
        } else if n as u128 * (top as u128).pow(2) < limit {
            Width::Direct
        } else if top == u16::MAX as u32 && (n as u128) << 30 < limit {
            Width::Centred
        } else {
            Width::Big
        }
    }
}

crate::multiversion! {
    /// Numerators of a row.
    pub fn numerator_row[X1: RowSum, X2: Acc](s1: &[X1], s2: &[X2], n: &[u32], width: Width, out: &mut [f64]) -> () = numerator_inner;
}

/// Runs `$body` for every window of a row with its numerator `n S2 - S1^2`, exactly zero only for equal values: one loop for
/// each [`Width`]. A macro, as what is called for every value must be inlined.
macro_rules! numerators {
    ($s1:ident, $s2:ident, $n:ident, $width:expr, |$i:ident, $numerator:ident| $body:block) => {{
        use $crate::kernel::window::estimate::{Width, numerator as by};
        let len = $s1.len();
        let (s2, n) = (&$s2[..len], &$n[..len]);
        macro_rules! each {
            ($of:ident) => {
                for $i in 0..len {
                    let $numerator = by::$of($s1[$i], s2[$i], n[$i]);
                    $body
                }
            };
        }
        match $width {
            Width::Small => each!(small),
            Width::Direct => each!(direct),
            Width::Centred => each!(centred),
            Width::Big => each!(big),
        }
    }};
}
pub(super) use numerators;

/// The numerator of one window by each [`Width`].
pub mod numerator {
    use super::{Acc, RowSum};
    use crate::kernel::window::exact;

    #[inline(always)]
    fn fused(n: f64, s1: f64, s2: f64) -> f64 {
        let p = s1 * s1;
        let e = s1.mul_add(s1, -p);
        n.mul_add(s2, -p) - e
    }

    #[inline(always)]
    pub fn small<X1: RowSum, X2: Acc>(s1: X1, s2: X2, n: u32) -> f64 {
        let a = s1.small();
        (n as f64).mul_add(s2.small(), -(a * a))
    }

    #[inline(always)]
    pub fn direct<X1: RowSum, X2: Acc>(s1: X1, s2: X2, n: u32) -> f64 {
        fused(n as f64, s1.small(), s2.small())
    }

    #[inline(always)]
    pub fn centred<X1: RowSum, X2: Acc>(s1: X1, s2: X2, n: u32) -> f64 {
        let (a, m) = (s1.low(), n as u64);
        let centred = s2.low().wrapping_sub(a << 16).wrapping_add(m << 30);
        let m = m as f64;
        fused(m, (-32768f64).mul_add(m, s1.small()), centred.small())
    }

    #[inline(always)]
    pub fn big<X1: RowSum, X2: Acc>(s1: X1, s2: X2, n: u32) -> f64 {
        let (a, m) = (s1.wide(), n as u128);
        exact::split(m.wrapping_mul(s2.wide()).wrapping_sub(a * a))[0]
    }
}

#[inline(always)]
fn numerator_inner<X1: RowSum, X2: Acc>(s1: &[X1], s2: &[X2], n: &[u32], width: Width, out: &mut [f64]) {
    let s1 = &s1[..out.len()];
    numerators!(s1, s2, n, width, |i, m| { out[i] = m });
}

crate::multiversion! {
    /// Mean of the stored values (`code - offset`), f64; `exact` says that S1 < 2^52. `inverse` holds the reciprocals of `n`.
    pub fn mean_row[X1: RowSum](s1: &[X1], n: &[u32], inverse: &[f64], offset: f64, exact: bool, out: &mut [f64]) -> () = mean_inner;
}

#[inline(always)]
fn mean_inner<X1: RowSum>(s1: &[X1], n: &[u32], inverse: &[f64], offset: f64, exact: bool, out: &mut [f64]) {
    let len = out.len();
    let (s1, n, inverse) = (&s1[..len], &n[..len], &inverse[..len]);
    if exact {
        for i in 0..len {
            out[i] = exact_mean(s1[i], n[i], inverse[i], offset);
        }
    } else {
        for i in 0..len {
            out[i] = long_mean(s1[i], n[i], offset);
        }
    }
}

/// The mean of a window where S1 < 2^52.
#[inline(always)]
pub fn exact_mean<X1: RowSum>(s1: X1, n: u32, inverse: f64, offset: f64) -> f64 {
    let m = n as f64;
    let s = (-offset).mul_add(m, s1.small()); // an integer below 2^53: exact
    // A quotient without a division: q is off by less than two units in the last place, and one step with the
    // exact remainder rounds as the division does, since s / n lies at least 2^-32 units from any midpoint.
    let q = s * inverse;
    (-q).mul_add(m, s).mul_add(inverse, q)
}

/// The mean of any window.
#[inline(always)]
pub fn long_mean<X1: RowSum>(s1: X1, n: u32, offset: f64) -> f64 {
    // Quotient and remainder: only the sum rounds, the fraction's own rounding lies 2^-53 below it.
    let (s, m) = (s1.low(), n.max(1) as u64);
    ((s / m) as f64 - offset) + (s % m) as f64 / m as f64
}

/// What the estimators of openness share.
#[derive(Debug, Clone, Copy)]
pub struct Polarity {
    /// The method is applied to -v.
    pub flipped: bool,
    /// Openness of a window of equal values.
    pub constant: f32,
}

/// Estimators that use the mean and the variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spread {
    Gaussian,
    Chebyshev,
    Literal,
}

/// [`super::beta`] from codes of the centre, extremes, S1 and the numerator row.
#[allow(clippy::too_many_arguments)]
pub fn beta_row<T: Code, X1: RowSum>(
    level: Level,
    v: &[T],
    flip: T,
    lo: &[T],
    hi: &[T],
    s1: &[X1],
    n: &[u32],
    numerator: &[f64],
    polarity: Polarity,
    out: &mut [f32],
) {
    let terms = |i: usize| {
        let (c, lo, hi) = (v[i].code(flip).u32(), lo[i].u32(), hi[i].u32());
        let below = c as f64 - lo as f64;
        let above = hi as f64 - c as f64;
        let over = s1[i].minus(X1::times(n[i], lo)).low() as f64;
        let under = X1::times(n[i], hi).minus(s1[i]).low() as f64;
        let numerator = numerator[i];
        match polarity.flipped {
            false => Terms { below, above, over, under, numerator },
            true => Terms { below: above, above: below, over: under, under: over, numerator },
        }
    };
    beta::beta_row(level, terms, polarity.constant, out);
}

crate::multiversion! {
    /// [`math::quantise`] of a row.
    pub fn quantise_row[](openness: &[f32], out: &mut [u8]) -> () = quantise_inner;
}

#[inline(always)]
fn quantise_inner(openness: &[f32], out: &mut [u8]) {
    for (o, v) in out.iter_mut().zip(openness) {
        *o = math::quantise(*v);
    }
}

crate::multiversion! {
    /// Reciprocals of counts.
    pub fn inverse_row[](n: &[u32], out: &mut [f64]) -> () = inverse_inner;
}

#[inline(always)]
fn inverse_inner(n: &[u32], out: &mut [f64]) {
    for (o, n) in out.iter_mut().zip(n) {
        *o = 1.0 / *n as f64;
    }
}
