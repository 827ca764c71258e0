//! Powers of the centre's place between the extremes (A 3.2).

use super::{Row, exp2, padded};
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};
use crate::kernel::window::estimate::{Code, Polarity, RowSum};

/// Values that go through the passes of a formula together. One pass would be a chain of 100 cycles of which a core can
/// start the next only when the first is half done, since it holds about 128 waiting operations; in passes through the
/// first-level cache several short chains run side by side. 2-core Zen 4 VM, AVX-512, 2026-11-26, `t^beta` of u8 rows in
/// cache: 0.76 ns per voxel in one pass, 0.72 in three (AVX2: 1.04 and 0.93).
const STRIP: usize = 256;

crate::on_singles! {
    /// A 3.2: `t^beta`, from extremes and sums.
    fn power_at[T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool](
        row: &Row<T, X1>, lo: &[T], hi: &[T], constant: f32, out: &mut [f32]
    ) = power_inner[T, X1, FLIPPED, NARROW];
}

/// A 3.2: `t^beta` of a row with extremes `lo` and `hi`.
pub fn cdf_power_row<T: Code, X1: RowSum>(
    level: Level,
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

#[inline(always)]
fn power_inner<L: F32x32, T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool>(
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    out: &mut [f32],
) {
    let (mut ratios, mut betas, mut exponents) = ([0f32; STRIP], [0f32; STRIP], [0f32; STRIP]);
    assert!(out.len() >= SINGLES);
    let mut from = 0;
    loop {
        let to = out.len().min(from + STRIP);
        let len = to - from;
        let (q, beta, x) = (&mut ratios[..len], &mut betas[..len], &mut exponents[..len]);
        let (row, lo, hi) = (row.part(from, to), &lo[from..to], &hi[from..to]);
        if ratios_of::<L, T, X1, FLIPPED, NARROW>(&row, lo, hi, constant, q, beta) {
            out[from..to].fill(constant);
        } else {
            logarithms::<L>(q, beta, x);
            powers::<L>(x, &mut out[from..to]);
        }
        if to == out.len() {
            return;
        }
        // A last strip of less than a block starts earlier, and makes some values again.
        from = to.min(out.len() - SINGLES);
    }
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
    blocks!(len, |at| {
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

/// `beta log2 t`, by [`super::super::math::power`]'s polynomial; far below 0 where t is 0.
#[inline(always)]
fn logarithms<L: F32x32>(ratios: &[f32], betas: &[f32], exponents: &mut [f32]) {
    let len = exponents.len();
    assert!(len >= SINGLES && ratios.len() == len && betas.len() == len);
    blocks!(len, |at| {
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
    blocks!(len, |at| {
        // SAFETY: `at + 32 <= len`.
        unsafe { exp2(L::load(exponents.as_ptr().add(at))).store(out.as_mut_ptr().add(at)) };
    });
}
