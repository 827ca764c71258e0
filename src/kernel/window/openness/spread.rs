//! The normal distribution (A 3.3) and Chebyshev's bounds (E 3.4) from mean and variance.

use super::{Openness, Row, Rows, Target, exp2, padded};
use crate::kernel::simd::Level;
use crate::kernel::singles::{F32x32, SINGLES};
use crate::kernel::window::estimate::{Acc, Code, Polarity, RowSum, Spread, Width, numerators};

crate::on_singles! {
    /// A 3.3 and E 3.4 from sums of values and of squares.
    fn spread_at[T: Code, X1: RowSum, X2: Acc, O: Openness, const KIND: usize, const NARROW: bool](
        rows: &Rows<T, X1>, squares: &Squares<X2>, polarity: Polarity, scale: f32, out: &mut Target<O>
    ) = spread_inner[T, X1, X2, O, KIND, NARROW];
}

pub const GAUSSIAN: usize = 0;
pub const CHEBYSHEV: usize = 1;
pub const LITERAL: usize = 2;

/// Sums of squares of the windows of [`Rows`], and how exact numerators are made of them.
#[derive(Clone, Copy)]
pub struct Squares<'a, X2> {
    pub s2: &'a [X2],
    pub width: Width,
}

/// A 3.3 and E 3.4 of rows.
pub fn spread_rows<T: Code, X1: RowSum, X2: Acc, O: Openness>(
    level: Level,
    kind: Spread,
    rows: &Rows<T, X1>,
    squares: &Squares<X2>,
    polarity: Polarity,
    out: &mut Target<O>,
) {
    if rows.len < SINGLES {
        for k in 0..rows.rows {
            let s2 = &padded(&squares.s2[k * rows.pitch..], rows.len);
            let squares = Squares { s2, ..*squares };
            let one = |rows: &Rows<T, X1>, out: &mut Target<O>| spread_rows(level, kind, rows, &squares, polarity, out);
            super::one_padded(rows, k, out, one);
        }
        return;
    }
    // Products of three deviations must stay below 2^128; a power of two changes no rounding.
    let bits = (rows.most as u128 * T::TOP as u128).max(1).ilog2() as i32;
    let scale = 2f32.powi(-(bits - 38).max(0));
    macro_rules! go {
        ($kind:ident) => {
            match rows.narrow() {
                true => spread_at::<T, X1, X2, O, $kind, true>(level, rows, squares, polarity, scale, out),
                false => spread_at::<T, X1, X2, O, $kind, false>(level, rows, squares, polarity, scale, out),
            }
        };
    }
    match kind {
        Spread::Gaussian => go!(GAUSSIAN),
        Spread::Chebyshev => go!(CHEBYSHEV),
        Spread::Literal => go!(LITERAL),
    }
}

/// Numerators `n^2 variance`, rounded to f32, that are made together and stay in the first-level cache.
const STRIP: usize = 256;

#[inline(always)]
fn spread_inner<L: F32x32, T: Code, X1: RowSum, X2: Acc, O: Openness, const KIND: usize, const NARROW: bool>(
    rows: &Rows<T, X1>,
    squares: &Squares<X2>,
    polarity: Polarity,
    scale: f32,
    out: &mut Target<O>,
) {
    let mut strip = [0f32; STRIP];
    assert!(rows.len >= SINGLES);
    for k in 0..rows.rows {
        let (row, s2) = (rows.row(k), &squares.s2[k * rows.pitch..][..rows.len]);
        let out = &mut out.data[k * out.pitch..][..rows.len];
        let mut from = 0;
        loop {
            let to = rows.len.min(from + STRIP);
            let (part, numerator) = (row.part(from, to), &mut strip[..to - from]);
            let (s1, s2, n) = (part.s1, &s2[from..to], part.n);
            numerators!(s1, s2, n, squares.width, |i, m| { numerator[i] = m as f32 });
            spread::<L, T, X1, O, KIND, NARROW>(&part, numerator, polarity, scale, &mut out[from..to]);
            if to == rows.len {
                break;
            }
            // A last strip of less than a block starts earlier, and makes some values again.
            from = to.min(rows.len - SINGLES);
        }
    }
}

#[inline(always)]
fn spread<L: F32x32, T: Code, X1: RowSum, O: Openness, const KIND: usize, const NARROW: bool>(
    row: &Row<T, X1>,
    numerator: &[f32],
    polarity: Polarity,
    scale: f32,
    out: &mut [O],
) {
    let len = out.len();
    let (v, s1, n, numerator) = (&row.v[..len], &row.s1[..len], &row.n[..len], &numerator[..len]);
    assert!(len >= SINGLES);
    // What is made below is S1 - n v.
    let sign = L::splat(if polarity.flipped { scale } else { -scale });
    blocks!(len, |at| {
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
        let m = unsafe { L::load(numerator.as_ptr().add(at)) };
        let flat = m.equals(L::splat(0.0));
        let (d, m) = (d.times(sign), m.times(L::splat(scale * scale)));
        let y = opened::<L, KIND>(d, m, flat, L::splat(polarity.constant));
        // SAFETY: as above.
        unsafe { O::put(y, out.as_mut_ptr().add(at)) };
    });
}

/// [`spread_rows`] of at least 32 windows whose numbers are there: `d`, n times what the centre lies above the mean (below it, where
/// smaller is denser), and `m`, `n^2 variance`, 0 where a window is constant. Products of three of them and of their roots must
/// be normal.
#[inline(always)]
pub fn spread_strip<L: F32x32, const KIND: usize>(d: &[f32], m: &[f32], constant: f32, out: &mut [f32]) {
    let len = out.len();
    let (d, m) = (&d[..len], &m[..len]);
    assert!(len >= SINGLES);
    blocks!(len, |at| {
        // SAFETY: `at + 32 <= len`, the length of every slice.
        let (d, m) = unsafe { (L::load(d.as_ptr().add(at)), L::load(m.as_ptr().add(at))) };
        let y = opened::<L, KIND>(d, m, m.equals(L::splat(0.0)), L::splat(constant));
        // SAFETY: as above.
        unsafe { y.store(out.as_mut_ptr().add(at)) };
    });
}

#[inline(always)]
fn opened<L: F32x32, const KIND: usize>(d: L, m: L, flat: L::Mask, constant: L) -> L {
    if L::all(flat) {
        return constant;
    }
    let zero = L::splat(0.0);
    let y = match KIND {
        GAUSSIAN => phi(d, m),
        // 1 - m / (m + d^2) without the cancellation
        CHEBYSHEV => d.greater(zero).times(d.greater(zero)).over(d.fused(d, m)),
        _ => L::pick(zero.is_below(d), m.over(d.fused(d, m)), L::splat(1.0)),
    };
    L::pick(flat, constant, y)
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
