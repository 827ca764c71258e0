//! Sums of floats and merges of (n, sum, M2), where M2 is the sum of squared deviations from the mean.
//!
//! Chan, Golub and LeVeque's update: with `d = S_b - S_a n_b / n_a`, `M2 = M2_a + M2_b + d^2 n_a / (n_b (n_a + n_b))`.
//! Nothing large is subtracted but sums of neighbours, so a step of 1e6 elsewhere in the tile, or in the window, costs no
//! accuracy. The order of merges is that of [`super::parts`].

use crate::kernel::lanes::F64x8;

/// Counts are below it.
const SCALE: f64 = (1u64 << 31) as f64;

/// What the merge of two parts asks of their counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Weight {
    /// `n_b / n_a`; 0 where a part is empty.
    ratio: f64,
    /// `n_a / (n_b (n_a + n_b))`; 0 where a part is empty.
    share: f64,
    /// The counts times `2^-31`, so that no product of a sum overflows, and `2^31 / n_a` (0 where a part is empty).
    a: f64,
    b: f64,
    inverse: f64,
}

impl Weight {
    #[inline(always)]
    pub fn of(a: f64, b: f64) -> Weight {
        let some = a * b > 0.0;
        let [ratio, share, inverse] = [b / a, a / (b * (a + b)), SCALE / a].map(|v| if some { v } else { 0.0 });
        Weight { ratio, share, a: a / SCALE, b: b / SCALE, inverse }
    }
}

/// A weight for eight columns.
pub struct Weights<L> {
    ratio: L,
    share: L,
    a: L,
    b: L,
    inverse: L,
}

/// The same for all columns.
#[inline(always)]
pub fn splat<L: F64x8>(w: &Weight) -> Weights<L> {
    let Weight { ratio, share, a, b, inverse } = *w;
    Weights {
        ratio: L::splat(ratio),
        share: L::splat(share),
        a: L::splat(a),
        b: L::splat(b),
        inverse: L::splat(inverse),
    }
}

/// [`Weight::of`] for each column, the same operations in the same order.
#[inline(always)]
pub fn weigh<L: F64x8>(a: L, b: L) -> Weights<L> {
    let (scale, some) = (L::splat(SCALE), a.times(b));
    Weights {
        ratio: b.over(a).where_positive(some),
        share: a.over(b.times(a.plus(b))).where_positive(some),
        a: a.over(scale),
        b: b.over(scale),
        inverse: scale.over(a).where_positive(some),
    }
}

/// `base` and what the distance between the means of two parts adds to M2.
#[inline(always)]
pub fn spread<L: F64x8>(a: L, b: L, weight: &Weights<L>, base: L) -> L {
    let d = a.less(weight.ratio, b);
    d.times(d).fused(weight.share, base)
}

/// [`spread`] of sums that are pairs: the products with counts are exact.
#[inline(always)]
pub fn spread_pairs<L: F64x8>(a: [L; 2], b: [L; 2], weight: &Weights<L>, base: L) -> L {
    let (p, q) = (b[0].times(weight.a), a[0].times(weight.b));
    // Errors of the products: fma(x, w, -p) as -(p - x w).
    let (e, f) = (b[0].less(weight.a, p), a[0].less(weight.b, q));
    let low = f.minus(e).plus(b[1].times(weight.a).minus(a[1].times(weight.b)));
    let d = p.minus(q).plus(low).times(weight.inverse);
    d.times(d).fused(weight.share, base)
}

/// Knuth's two-sum of the high parts; its error joins the low parts.
#[inline(always)]
pub fn plus_pairs<L: F64x8>(a: [L; 2], b: [L; 2]) -> [L; 2] {
    let s = a[0].plus(b[0]);
    let t = s.minus(a[0]);
    let e = a[0].minus(s.minus(t)).plus(b[0].minus(t));
    [s, e.plus(a[1].plus(b[1]))]
}

/// Finished sum of f32 (f64) or of f64 (an unevaluated pair of f64).
pub trait Sum: bytemuck::Pod + Default + std::fmt::Debug {
    const PAIR: bool;
    /// A variance below this share of the squared mean is an error of rounding: two different numbers of the input's type
    /// among 2^31 make a larger one.
    const NOTHING: f64;
    /// The same in windows with gaps, whose counts are shares of lines and so not exact.
    const NOTHING_BESIDE_GAPS: f64;
    fn of(hi: f64, lo: f64) -> Self;
    /// `self - n * v`.
    fn less(self, n: f64, v: f64) -> f64;
    /// `self / n`, rounded once.
    fn over(self, n: f64) -> f64;
    fn rounded(self) -> f64;
}

impl Sum for f64 {
    const PAIR: bool = false;
    const NOTHING: f64 = 8.077_935_669_463_161e-28; // 2^-90
    const NOTHING_BESIDE_GAPS: f64 = Self::NOTHING;
    #[inline(always)]
    fn of(hi: f64, _: f64) -> f64 {
        hi
    }
    #[inline(always)]
    fn less(self, n: f64, v: f64) -> f64 {
        (-n).mul_add(v, self)
    }
    #[inline(always)]
    fn over(self, n: f64) -> f64 {
        self / n
    }
    #[inline(always)]
    fn rounded(self) -> f64 {
        self
    }
}

/// `hi + lo`, about 106 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Pair {
    hi: f64,
    lo: f64,
}

impl Sum for Pair {
    const PAIR: bool = true;
    const NOTHING: f64 = 7.006_492_321_624_085e-46; // 2^-150
    const NOTHING_BESIDE_GAPS: f64 = 7.888_609_052_210_118e-31; // 2^-100
    #[inline(always)]
    fn of(hi: f64, lo: f64) -> Pair {
        Pair { hi, lo }
    }
    #[inline(always)]
    fn less(self, n: f64, v: f64) -> f64 {
        let p = n * v;
        let e = n.mul_add(v, -p);
        ((self.hi - p) - e) + self.lo
    }
    #[inline(always)]
    fn over(self, n: f64) -> f64 {
        let q = self.hi / n;
        let r = ((-q).mul_add(n, self.hi) + self.lo) / n;
        if r.is_finite() { q + r } else { q }
    }
    #[inline(always)]
    fn rounded(self) -> f64 {
        self.hi
    }
}
