//! The inner loop of [`super::sums`] written with intrinsics, beside the portable one that the compiler makes vectors of.

use super::moves::Moves;
use super::sums::Sum;
use crate::kernel::simd::Level;

/// Thresholds of the lanes in the order of the bytes of a column: those of the first half of the lanes are the even bytes, which
/// widening takes apart in one step.
pub(super) fn in_columns<const L: usize>(lanes: &[u8; L]) -> [u8; L] {
    std::array::from_fn(|b| lanes[b % 2 * (L / 2) + b / 2])
}

/// One row of columns in, another out; see [`step`].
pub(super) struct Rows<'a, const L: usize> {
    pub into: &'a mut [[u8; L]],
    pub out: &'a [[u8; L]],
    /// How the columns of `into` change first.
    pub moves: Option<Moves<'a, L>>,
    /// Columns differ by more than a signed byte holds.
    pub tall: bool,
}

/// Adds the columns that come in to the sums before each column, and takes off those that leave. True where there is a
/// vector form.
pub(super) fn step<S: Sum, const L: usize>(level: Level, rows: &mut Rows<L>, sums: &mut [[S; L]]) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 && (L == 32 || L == 64) {
        let width = rows.into.len();
        assert!(rows.out.len() == width && sums.len() == width + 1);
        assert!(rows.moves.is_none_or(|m| m.len() == width));
        // SAFETY: the level says that the CPU has AVX-512; the lengths were checked.
        unsafe {
            match (L, S::MOST > u64::from(u16::MAX)) {
                (32, false) => x86::narrow_32(rows, sums),
                (32, true) => x86::wide_32(rows, sums),
                (_, false) => x86::narrow_64(rows, sums),
                (_, true) => x86::wide_64(rows, sums),
            }
        }
        return true;
    }
    let _ = (level, rows, sums);
    false
}

/// Moves the columns of some rows, and the sums with them. True where there is a vector form.
pub(super) fn first<S: Sum, const L: usize>(
    level: Level,
    columns: &mut [[u8; L]],
    moves: Moves<L>,
    sums: &mut [[S; L]],
) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 && (L == 32 || L == 64) {
        assert!(moves.len() == columns.len());
        // SAFETY: the level says that the CPU has AVX-512; the lengths were checked.
        unsafe {
            match (L, S::MOST > u64::from(u16::MAX)) {
                (32, false) => x86::first_narrow_32(columns, moves, sums),
                (32, true) => x86::first_wide_32(columns, moves, sums),
                (_, false) => x86::first_narrow_64(columns, moves, sums),
                (_, true) => x86::first_wide_64(columns, moves, sums),
            }
        }
        return true;
    }
    let _ = (level, columns, moves, sums);
    false
}

/// Moves columns, and nothing else. True where there is a vector form.
pub(super) fn shift<const L: usize>(level: Level, columns: &mut [[u8; L]], moves: Moves<L>) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 && (L == 32 || L == 64) {
        assert!(moves.len() == columns.len());
        // SAFETY: the level says that the CPU has AVX-512; the lengths were checked.
        unsafe { if L == 32 { x86::shift_32(columns, moves) } else { x86::shift_64(columns, moves) } }
        return true;
    }
    let _ = (level, columns, moves);
    false
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Moves, Rows};

    macro_rules! steps {
        ($($narrow:ident, $wide:ident, $first_narrow:ident, $first_wide:ident, $shift_only:ident, $v:ty, $load:ident, $store:ident,
           $words:ident, $zero:ident, $sub8:ident, $add8:ident, $pairs:ident,
           $add16:ident, $add32:ident, $and:ident, $shift:ident, $sub16:ident,
           $low:ident, $high:ident;)*) => {$(
            steps!(@row $narrow, 2, [$load, $store, $words, $zero, $sub8, $add8, $pairs, $and, $shift, $sub16], $v, $add16,
                |a, b| [a, b]);
            steps!(@row $wide, 4, [$load, $store, $words, $zero, $sub8, $add8, $pairs, $and, $shift, $sub16], $v, $add32,
                |a, b| [$low(a), $high(a), $low(b), $high(b)]);
            steps!(@first $first_narrow, 2, [$load, $store, $words, $zero, $sub8, $add8, $pairs], $v,
                $add16, |a, b| [a, b]);
            steps!(@first $first_wide, 4, [$load, $store, $words, $zero, $sub8, $add8, $pairs], $v,
                $add32, |a, b| [$low(a), $high(a), $low(b), $high(b)]);
            /// # Safety
            /// As above; as many moves as columns.
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            pub unsafe fn $shift_only<const L: usize>(columns: &mut [[u8; L]], m: Moves<L>) {
                for (x, column) in columns.iter_mut().enumerate() {
                    // SAFETY: as the caller promised.
                    unsafe {
                        let [enters, leaves] = m.rows(x);
                        let column = column.as_mut_ptr().cast::<$v>();
                        let moved = $add8($load(column.cast_const().cast()), $load(enters.cast()));
                        $store(column.cast(), $sub8(moved, $load(leaves.cast())));
                    }
                }
            }
        )*};
        (@row $name:ident, $parts:literal,
         [$load:ident, $store:ident, $words:ident, $zero:ident, $sub8:ident, $add8:ident, $pairs:ident, $and:ident, $shift:ident,
          $sub16:ident],
         $v:ty, $add:ident, |$a:ident, $b:ident| $widened:expr) => {
            /// # Safety
            /// The CPU must have AVX-512, `L` must be the number of bytes of a vector, the sums of the type in the name, and the
            /// lengths must agree: as many columns everywhere, and one sum more.
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            pub unsafe fn $name<S, const L: usize>(rows: &mut Rows<L>, sums: &mut [[S; L]]) {
                // SAFETY: as the caller promised.
                unsafe {
                    // Even and odd bytes of signed differences.
                    let (even, odd) = ($words(0x0001), $words(0x0100));
                    let (into, out) = (rows.into.as_mut_ptr(), rows.out.as_ptr());
                    let mut carry = [$zero(); $parts];
                    let sums = sums.as_mut_ptr().add(1).cast::<$v>();
                    for x in 0..rows.into.len() {
                        let mut column = $load(into.add(x).cast());
                        if let Some(m) = rows.moves {
                            let [enters, leaves] = m.rows(x);
                            column = $sub8($add8(column, $load(enters.cast())), $load(leaves.cast()));
                            $store(into.add(x).cast(), column);
                        }
                        let leaving = $load(out.add(x).cast());
                        let ($a, $b) = if rows.tall {
                            let halves = |v| ($and(v, $words(0xff)), $shift::<8>(v));
                            let (into, out) = (halves(column), halves(leaving));
                            ($sub16(into.0, out.0), $sub16(into.1, out.1))
                        } else {
                            let change = $sub8(column, leaving);
                            ($pairs(even, change), $pairs(odd, change))
                        };
                        for (h, by) in $widened.into_iter().enumerate() {
                            let at = sums.add($parts * x + h);
                            carry[h] = $add(carry[h], by);
                            $store(at.cast(), $add($load(at.cast()), carry[h]));
                        }
                    }
                }
            }
        };
        (@first $name:ident, $parts:literal,
         [$load:ident, $store:ident, $words:ident, $zero:ident, $sub8:ident, $add8:ident, $pairs:ident],
         $v:ty, $add:ident, |$a:ident, $b:ident| $widened:expr) => {
            /// # Safety
            /// As above; as many moves as columns.
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            pub unsafe fn $name<S, const L: usize>(columns: &mut [[u8; L]], m: Moves<L>, sums: &mut [[S; L]]) {
                // SAFETY: as the caller promised.
                unsafe {
                    let (even, odd) = ($words(0x0001), $words(0x0100));
                    let (width, all) = (sums.len() - 1, columns.len());
                    let columns = columns.as_mut_ptr();
                    let mut carry = [$zero(); $parts];
                    let sums = sums.as_mut_ptr().add(1).cast::<$v>();
                    for x in 0..width {
                        let mut change = $zero();
                        let mut i = x;
                        while i < all {
                            let [enters, leaves] = m.rows(i);
                            let by = $sub8($load(enters.cast()), $load(leaves.cast()));
                            let column = columns.add(i).cast();
                            $store(column, $add8($load(column.cast_const().cast()), by));
                            change = $add8(change, by);
                            i += width;
                        }
                        let ($a, $b) = ($pairs(even, change), $pairs(odd, change));
                        for (h, by) in $widened.into_iter().enumerate() {
                            let at = sums.add($parts * x + h);
                            carry[h] = $add(carry[h], by);
                            $store(at.cast(), $add($load(at.cast()), carry[h]));
                        }
                    }
                }
            }
        };
    }

    steps! {
        narrow_32, wide_32, first_narrow_32, first_wide_32, shift_32, __m256i, _mm256_loadu_si256, _mm256_storeu_si256,
        _mm256_set1_epi16, _mm256_setzero_si256, _mm256_sub_epi8, _mm256_add_epi8, _mm256_maddubs_epi16, _mm256_add_epi16, _mm256_add_epi32, _mm256_and_si256, _mm256_srli_epi16,
        _mm256_sub_epi16, low_256, high_256;
        narrow_64, wide_64, first_narrow_64, first_wide_64, shift_64, __m512i, _mm512_loadu_si512, _mm512_storeu_si512,
        _mm512_set1_epi16, _mm512_setzero_si512, _mm512_sub_epi8, _mm512_add_epi8, _mm512_maddubs_epi16, _mm512_add_epi16, _mm512_add_epi32, _mm512_and_si512, _mm512_srli_epi16,
        _mm512_sub_epi16, low_512, high_512;
    }

    macro_rules! halves {
        ($($name:ident($a:ident: $t:ty) = $e:expr;)*) => {$(
            #[inline]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            fn $name($a: $t) -> $t { $e }
        )*};
    }
    halves! {
        low_256(a: __m256i) = _mm256_cvtepi16_epi32(_mm256_castsi256_si128(a));
        high_256(a: __m256i) = _mm256_cvtepi16_epi32(_mm256_extracti128_si256::<1>(a));
        low_512(a: __m512i) = _mm512_cvtepi16_epi32(_mm512_castsi512_si256(a));
        high_512(a: __m512i) = _mm512_cvtepi16_epi32(_mm512_extracti64x4_epi64::<1>(a));
    }
}
