//! Powers of the centre's place between the extremes (A 3.2).

use std::mem::MaybeUninit;

use super::{Openness, ROUNDED, Row, Rows, Target, exp2};
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};
use crate::kernel::window::estimate::{Code, Polarity, RowSum};

/// Values that go through the passes of a formula together. One pass would be a chain of 100 cycles of which a core can
/// start the next only when the first is half done, since it holds about 128 waiting operations; in passes through the
/// first-level cache several short chains run side by side. 2-core Zen 4 VM, AVX-512, 2026-11-26, `t^beta` of u8 rows in
/// cache: 0.76 ns per voxel in one pass, 0.72 in three (AVX2: 1.04 and 0.93). 2026-11-27, cdf_power of u8 to bytes, whole
/// kernel: 1.61 in two passes, 1.50 in three over strips of whole cache lines.
pub const STRIP: usize = 256;

/// A strip of values between two passes, in whole cache lines.
#[repr(align(64))]
pub struct Strip<A>(pub A);

crate::on_singles! {
    /// A 3.2: `t^beta`, from extremes and sums.
    fn power_at[T: Code, X1: RowSum, O: Openness, const FLIPPED: bool, const NARROW: bool](
        rows: &Rows<T, X1>, lo: &[T], hi: &[T], constant: f32, out: &mut Target<O>
    ) = power_inner[T, X1, O, FLIPPED, NARROW];
}

/// A 3.2: `t^beta` of rows with extremes `lo` and `hi`.
pub fn cdf_power_rows<T: Code, X1: RowSum, O: Openness>(
    level: Level,
    rows: &Rows<T, X1>,
    lo: &[T],
    hi: &[T],
    polarity: Polarity,
    out: &mut Target<O>,
) {
    let len = rows.len;
    if len < SINGLES {
        for k in 0..rows.rows {
            let (lo, hi) = (super::padded(&lo[k * rows.pitch..], len), super::padded(&hi[k * rows.pitch..], len));
            let one = |rows: &Rows<T, X1>, out: &mut Target<O>| cdf_power_rows(level, rows, &lo, &hi, polarity, out);
            super::one_padded(rows, k, out, one);
        }
        return;
    }
    let constant = polarity.constant;
    match (polarity.flipped, rows.narrow()) {
        (false, false) => power_at::<T, X1, O, false, false>(level, rows, lo, hi, constant, out),
        (false, true) => power_at::<T, X1, O, false, true>(level, rows, lo, hi, constant, out),
        (true, false) => power_at::<T, X1, O, true, false>(level, rows, lo, hi, constant, out),
        (true, true) => power_at::<T, X1, O, true, true>(level, rows, lo, hi, constant, out),
    }
}

#[inline(always)]
fn power_inner<L: F32x32, T: Code, X1: RowSum, O: Openness, const FLIPPED: bool, const NARROW: bool>(
    rows: &Rows<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    out: &mut Target<O>,
) {
    // Never read before they are written: clearing them would cost every call 48 stores.
    let mut strips = [const { Strip(MaybeUninit::uninit()) }; 3];
    let strips = strips.each_mut().map(|strip: &mut Strip<MaybeUninit<[f32; STRIP]>>| strip.0.as_mut_ptr().cast());
    assert!(rows.len >= SINGLES);
    for k in 0..rows.rows {
        let row = rows.row(k);
        let (lo, hi) = (&lo[k * rows.pitch..][..rows.len], &hi[k * rows.pitch..][..rows.len]);
        let out = &mut out.data[k * out.pitch..][..rows.len];
        let mut from = 0;
        loop {
            let to = rows.len.min(from + STRIP);
            let (part, lo, hi, out) = (row.part(from, to), &lo[from..to], &hi[from..to], &mut out[from..to]);
            // SAFETY: a part has at least 32 and at most STRIP values, for which each strip has room.
            unsafe { strip::<L, T, X1, O, FLIPPED, NARROW>(&part, lo, hi, constant, strips, out) };
            if to == rows.len {
                break;
            }
            // A last strip of less than a block starts earlier, and makes some values again.
            from = to.min(rows.len - SINGLES);
        }
    }
}

/// # Safety
/// `out` has at least 32 values, and each of `strips` room for as many.
#[inline(always)]
unsafe fn strip<L: F32x32, T: Code, X1: RowSum, O: Openness, const FLIPPED: bool, const NARROW: bool>(
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    [ratios, betas, exponents]: [*mut f32; 3],
    out: &mut [O],
) {
    // SAFETY: the caller's promise; each pass writes what the next reads.
    unsafe {
        if quotients_of::<L, T, X1, FLIPPED, NARROW>(row, lo, hi, constant, [ratios, betas]) {
            out.fill(O::of(constant));
        } else {
            powers::<L, O>([ratios.cast_const(), betas.cast_const()], exponents, out);
        }
    }
}

/// `t^beta` of a strip of quotients: t, or where they are negative (-0 counts) t - 1; beta is clamped to 1e-6..1e6.
///
/// # Safety
/// `out` has at least 32 values, each of `ratios` and `betas` as many that are written, and `exponents` room for as many.
#[inline(always)]
pub unsafe fn powers<L: F32x32, O: Openness>([ratios, betas]: [*const f32; 2], exponents: *mut f32, out: &mut [O]) {
    let len = out.len();
    // SAFETY: the caller's promise; each pass writes what the next reads.
    unsafe {
        blocks!(len, |at| {
            let (q, beta) = (L::load(ratios.add(at)), L::load(betas.add(at)));
            if O::COARSE {
                coarse_logarithm(q, beta).store(exponents.add(at));
            } else {
                logarithm(q, beta.greater(L::splat(1e-6)).lesser(L::splat(1e6))).store(exponents.add(at));
            }
        });
        if O::COARSE {
            blocks!(len, |at| {
                coarse_power(L::load(exponents.add(at))).store_codes(out.as_mut_ptr().add(at).cast())
            });
        } else {
            blocks!(len, |at| { O::put(exp2(L::load(exponents.add(at))), out.as_mut_ptr().add(at)) });
        }
    }
}

/// Two quotients of one divisor: t, or where it is at least 2/3 t - 1 (never +0 there), and beta. Returns whether all windows
/// are constant, as in air that a detector or a mask has set to one value.
///
/// The divisor is a product, which adds three roundings, 2e-7 of a quotient, and saves a division, by far the slowest
/// operation (2-core Zen 4 VM, AVX-512, 2026-11-27: 10 cycles for 16 values, all the rest 25; divided in the next pass,
/// cdf_power of u8 took 1.56 ns per voxel instead of 1.50).
///
/// # Safety
/// As for [`strip`].
#[inline(always)]
unsafe fn quotients_of<L: F32x32, T: Code, X1: RowSum, const FLIPPED: bool, const NARROW: bool>(
    row: &Row<T, X1>,
    lo: &[T],
    hi: &[T],
    constant: f32,
    [ratios, betas]: [*mut f32; 2],
) -> bool {
    let len = row.v.len();
    let (v, s1, n, lo, hi) = (&row.v[..len], &row.s1[..len], &row.n[..len], &lo[..len], &hi[..len]);
    assert!(len >= SINGLES);
    let mut all_flat = true;
    blocks!(len, |at| {
        // SAFETY: `at + 32 <= len`, the length of every slice; the strips have as much room.
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
            let near = b.plus(b).is_below(a);
            let inverse = L::splat(1.0).over(q.times(range));
            let mut ratio = L::pick(near, L::splat(-0.0).minus(b), a).times(q).times(inverse);
            let mut beta = p.times(range).times(inverse);
            let flat = range.equals(L::splat(0.0));
            if L::any(flat) {
                // 1 is (1 - 1) + 1, and another constant its own first power.
                let whole = L::splat(if constant == 1.0 { -0.0 } else { constant });
                ratio = L::pick(flat, whole, ratio);
                beta = L::pick(flat, L::splat(1.0), beta);
                all_flat &= L::all(flat);
            } else {
                all_flat = false;
            }
            ratio.store(ratios.add(at));
            beta.store(betas.add(at));
        }
    });
    all_flat
}

/// `x = 2^e (1 + f)` for the quotient of [`quotients_of`]: `[e, f]`, and where it is t - 1 `[0, t - 1]`.
#[inline(always)]
fn parts_of<L: F32x32>(q: L) -> [L; 2] {
    let near = q.is_negative();
    let [exponent, mantissa] = q.split();
    [L::pick(near, L::splat(0.0), exponent), L::pick(near, q, mantissa)]
}

/// `beta log2 t`; far below 0 where t is 0.
///
/// With E = beta log2 t the absolute error of 2^E is E ln2 2^E times the *relative* error of E, at most 0.37 of it. So all
/// that matters is a relatively accurate logarithm: near t = 1 it is log1p of t - 1, whose numerator the quotients have
/// without cancellation. Absolute error of the power at most 1e-6 for every beta.
#[inline(always)]
fn logarithm<L: F32x32>(q: L, beta: L) -> L {
    let [e, f] = parts_of(q);
    let square = f.times(f);
    let low = f.fused(L::splat(-0.721_379_9), L::splat(1.442_694_8));
    let middle = f.fused(L::splat(-0.358_389_38), L::splat(0.480_960_9));
    let high = f.fused(L::splat(-0.279_993_83), L::splat(0.285_692_45));
    let top = square.fused(L::splat(0.246_199_53), high);
    let ratio = top.fused(square, middle).fused(square, low);
    L::pick(q.is_blank(), L::splat(-1000.0), beta.times(f.fused(ratio, e)))
}

/// [`logarithm`] within 5e-5 of itself, which moves a power by at most 1.8e-5.
#[inline(always)]
fn coarse_logarithm<L: F32x32>(q: L, beta: L) -> L {
    let [e, f] = parts_of(q);
    let ratio = f
        .fused(L::splat(0.325_629_9), L::splat(-0.397_268_2))
        .fused(f, L::splat(0.479_372_8))
        .fused(f, L::splat(-0.720_300_4))
        .fused(f, L::splat(1.442_703_7));
    L::pick(q.is_blank(), L::splat(-100.0), beta.times(f.fused(ratio, e)))
}

/// 2^23 and the rounded `255 2^x` of exponents `x <= 0`, within 1.0e-4 of itself before it is rounded; 255 of 0, so that
/// constant windows are exact.
#[inline(always)]
fn coarse_power<L: F32x32>(x: L) -> L {
    let magic = L::splat(12_582_912.0);
    let x = x.greater(L::splat(-100.0));
    let z = x.plus(magic);
    let f = x.minus(z.minus(magic));
    let p =
        f.fused(L::splat(14.027_277), L::splat(61.763_795)).fused(f, L::splat(176.787_15)).fused(f, L::splat(255.0));
    p.scaled(z).plus(L::splat(ROUNDED))
}
