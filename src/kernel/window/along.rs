//! Extremes of windows along a row with AVX-512, by doubling in registers: two-source permutes shift a vector into its
//! neighbour. Other levels use the trees of [`super::lines`], which give the same: extremes do not depend on an order.

use super::lines::Pitches;
use crate::kernel::simd::Level;

/// Elements beyond the last result, rounded up to 64, that may be read.
pub const SLACK: usize = 64;

/// Elements that a source for `n` results must hold.
pub fn roomy(n: usize) -> usize {
    n.next_multiple_of(64) + SLACK
}

/// Element types with extremes in registers.
pub trait RowExtremes: Sized {
    /// In every row `out_lo[i]` is the least of `lo[i..i + w]` and `out_hi[i]` the greatest of `hi[i..i + w]` for `i < n`,
    /// with sources of `roomy(n)` and of `n + w + 63` elements, results of `n` rounded up to 64 and `work` twice `n + w + 63`.
    /// Returns false, with nothing done, where the level asks for the tree.
    #[allow(clippy::too_many_arguments)]
    fn windows(
        _level: Level,
        _lo: &[Self],
        _hi: &[Self],
        _w: usize,
        _n: usize,
        _out_lo: &mut [Self],
        _out_hi: &mut [Self],
        _pitches: Pitches,
        _work: &mut [Self],
    ) -> bool {
        false
    }
}

#[cfg(not(target_arch = "x86_64"))]
mod wide {
    use super::RowExtremes;
    impl RowExtremes for u8 {}
    impl RowExtremes for u16 {}
    impl RowExtremes for u32 {}
    impl RowExtremes for f32 {}
    impl RowExtremes for f64 {}
}

#[cfg(target_arch = "x86_64")]
mod wide {
    use std::arch::x86_64::*;

    use super::{Pitches, RowExtremes, SLACK, roomy};
    use crate::kernel::simd::Level;

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn min_f32(a: __m512i, b: __m512i) -> __m512i {
        _mm512_castps_si512(_mm512_min_ps(_mm512_castsi512_ps(a), _mm512_castsi512_ps(b)))
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn max_f32(a: __m512i, b: __m512i) -> __m512i {
        _mm512_castps_si512(_mm512_max_ps(_mm512_castsi512_ps(a), _mm512_castsi512_ps(b)))
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn min_f64(a: __m512i, b: __m512i) -> __m512i {
        _mm512_castpd_si512(_mm512_min_pd(_mm512_castsi512_pd(a), _mm512_castsi512_pd(b)))
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn max_f64(a: __m512i, b: __m512i) -> __m512i {
        _mm512_castpd_si512(_mm512_max_pd(_mm512_castsi512_pd(a), _mm512_castsi512_pd(b)))
    }

    /// Levels of doubling below `P`: each keeps its vector for the one before.
    macro_rules! grow {
        ($p:ident, $shifts:ident, $op:ident, $permute:ident, $a:ident, $right:ident; $($k:literal)*) => {$(
            if $k < $p {
                let next = $op($a, $permute($a, $shifts[$k], $right[$k]));
                $right[$k] = $a;
                $a = next;
            }
        )*};
    }

    macro_rules! extremes {
        ($($t:ident, $index:ident, $lanes:literal, $name:ident, $long:ident, $min:ident, $max:ident, $permute:ident;)*) => {$(
            impl RowExtremes for $t {
                fn windows(
                    level: Level,
                    lo: &[$t],
                    hi: &[$t],
                    w: usize,
                    n: usize,
                    out_lo: &mut [$t],
                    out_hi: &mut [$t],
                    pitches: Pitches,
                    work: &mut [$t],
                ) -> bool {
                    if level != Level::Avx512 || w == 0 {
                        return false;
                    }
                    let (from, to) = (lo.len().min(hi.len()), out_lo.len().min(out_hi.len()));
                    if pitches.rows == 0 {
                        return true;
                    }
                    let last = pitches.rows - 1;
                    if w >= 2 * $lanes || w > SLACK + 1 {
                        let most = n + w + 63;
                        assert!(last * pitches.from + most <= from && 2 * most <= work.len());
                        assert!(last * pitches.to + n.next_multiple_of(64) <= to);
                        // SAFETY: the level says that the CPU has AVX-512; the lengths were checked.
                        unsafe { $long(lo, hi, w, n, out_lo, out_hi, pitches, work) };
                        return true;
                    }
                    assert!(last * pitches.from + roomy(n) <= from && last * pitches.to + n.next_multiple_of(64) <= to);
                    // SAFETY: the level says that the CPU has AVX-512; the lengths were checked.
                    unsafe {
                        match w.ilog2() {
                            0 => $name::<0>(lo, hi, w, n, out_lo, out_hi, pitches),
                            1 => $name::<1>(lo, hi, w, n, out_lo, out_hi, pitches),
                            2 => $name::<2>(lo, hi, w, n, out_lo, out_hi, pitches),
                            3 => $name::<3>(lo, hi, w, n, out_lo, out_hi, pitches),
                            4 => $name::<4>(lo, hi, w, n, out_lo, out_hi, pitches),
                            5 => $name::<5>(lo, hi, w, n, out_lo, out_hi, pitches),
                            _ => $name::<6>(lo, hi, w, n, out_lo, out_hi, pitches),
                        }
                    }
                    true
                }
            }

            /// Windows of a vector's length by doubling as in the other function, kept in `work`; those of `w` are joined from
            /// them.
            #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
            #[allow(clippy::too_many_arguments)]
            unsafe fn $long(
                lo: &[$t],
                hi: &[$t],
                w: usize,
                n: usize,
                out_lo: &mut [$t],
                out_hi: &mut [$t],
                pitches: Pitches,
                work: &mut [$t],
            ) {
                const P: usize = ($lanes as usize).ilog2() as usize;
                let mut shifts = [_mm512_setzero_si512(); 6];
                for k in 0..P {
                    let ramp: [$index; $lanes] = std::array::from_fn(|j| (j + (1 << k)) as $index);
                    // SAFETY: a vector of indices.
                    shifts[k] = unsafe { _mm512_loadu_si512(ramp.as_ptr().cast()) };
                }
                let (work_lo, work_hi) = work.split_at_mut(work.len() / 2);
                // Windows of a vector's length that take part, and vectors of results.
                let (short, vectors) = ((n + w - $lanes).div_ceil($lanes), n.div_ceil($lanes));
                // SAFETY: less than `n + w + 63` elements, as the caller checked, in sources and halves of `work`.
                macro_rules! at {
                    ($s:ident, $i:expr) => { unsafe { _mm512_loadu_si512($s.as_ptr().add($i).cast()) } };
                }
                macro_rules! put {
                    ($s:ident, $i:expr, $v:expr) => { unsafe { _mm512_storeu_si512($s.as_mut_ptr().add($i).cast(), $v) } };
                }
                for k in 0..pitches.rows {
                    let (lo, hi) = (&lo[k * pitches.from..], &hi[k * pitches.from..]);
                    let (out_lo, out_hi) = (&mut out_lo[k * pitches.to..], &mut out_hi[k * pitches.to..]);
                    let (mut right_lo, mut right_hi) = ([at!(lo, short * $lanes); 6], [at!(hi, short * $lanes); 6]);
                    for i in (0..short + 1).rev() {
                        let (mut a, mut b) = (at!(lo, i * $lanes), at!(hi, i * $lanes));
                        grow!(P, shifts, $min, $permute, a, right_lo; 0 1 2 3 4 5);
                        grow!(P, shifts, $max, $permute, b, right_hi; 0 1 2 3 4 5);
                        if i < short {
                            put!(work_lo, i * $lanes, a);
                            put!(work_hi, i * $lanes, b);
                        }
                    }
                    for i in 0..vectors {
                        let at = i * $lanes;
                        let last = at + w - $lanes;
                        let (mut least, mut most) = (at!(work_lo, last), at!(work_hi, last));
                        for k in 0..w / $lanes {
                            least = $min(least, at!(work_lo, at + k * $lanes));
                            most = $max(most, at!(work_hi, at + k * $lanes));
                        }
                        put!(out_lo, at, least);
                        put!(out_hi, at, most);
                    }
                }
            }

            /// Vectors from the last to the first; each level keeps its vector for the one before.
            #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
            #[allow(clippy::too_many_arguments)]
            unsafe fn $name<const P: usize>(
                lo: &[$t],
                hi: &[$t],
                w: usize,
                n: usize,
                out_lo: &mut [$t],
                out_hi: &mut [$t],
                pitches: Pitches,
            ) {
                // Lane j takes lane j + by of a vector and its right neighbour, as a part of one long ramp says.
                const RAMP: [$index; 2 * $lanes] = {
                    let mut ramp = [0; 2 * $lanes];
                    let mut j = 0;
                    while j < 2 * $lanes {
                        ramp[j] = j as $index;
                        j += 1;
                    }
                    ramp
                };
                macro_rules! shift {
                    // SAFETY: shifts are less than a vector.
                    ($by:expr) => { unsafe { _mm512_loadu_si512(RAMP[$by..$by + $lanes].as_ptr().cast()) } };
                }
                let last = shift!(w - (1 << P));
                let mut shifts = [last; 6];
                for k in 0..P.min(6) {
                    shifts[k] = shift!(1 << k);
                }
                let vectors = n.div_ceil($lanes);
                // The last window reaches one vector beyond the last result, or two.
                let start = vectors + 1 + (w > $lanes + 1) as usize;
                // A macro, as a closure may be left out of line.
                macro_rules! at {
                    // SAFETY: `start` vectors are less than `roomy(n)` elements, as the caller checked.
                    ($s:ident, $i:expr) => { unsafe { _mm512_loadu_si512($s.as_ptr().add($i * $lanes).cast()) } };
                }
                for k in 0..pitches.rows {
                    let (lo, hi) = (&lo[k * pitches.from..], &hi[k * pitches.from..]);
                    let (out_lo, out_hi) = (&mut out_lo[k * pitches.to..], &mut out_hi[k * pitches.to..]);
                    let (mut right_lo, mut right_hi) = ([at!(lo, start - 1); 7], [at!(hi, start - 1); 7]);
                    for i in (0..start).rev() {
                        let (mut a, mut b) = (at!(lo, i), at!(hi, i));
                        grow!(P, shifts, $min, $permute, a, right_lo; 0 1 2 3 4 5);
                        grow!(P, shifts, $max, $permute, b, right_hi; 0 1 2 3 4 5);
                        let least = $min(a, $permute(a, last, right_lo[P]));
                        let most = $max(b, $permute(b, last, right_hi[P]));
                        (right_lo[P], right_hi[P]) = (a, b);
                        if i < vectors {
                            // SAFETY: as for reading.
                            unsafe {
                                _mm512_storeu_si512(out_lo.as_mut_ptr().add(i * $lanes).cast(), least);
                                _mm512_storeu_si512(out_hi.as_mut_ptr().add(i * $lanes).cast(), most);
                            }
                        }
                    }
                }
            }
        )*};
    }
    extremes! {
        u8, u8, 64, extremes_u8, long_u8, _mm512_min_epu8, _mm512_max_epu8, _mm512_permutex2var_epi8;
        u16, u16, 32, extremes_u16, long_u16, _mm512_min_epu16, _mm512_max_epu16, _mm512_permutex2var_epi16;
        u32, u32, 16, extremes_u32, long_u32, _mm512_min_epu32, _mm512_max_epu32, _mm512_permutex2var_epi32;
        f32, u32, 16, extremes_f32, long_f32, min_f32, max_f32, _mm512_permutex2var_epi32;
        f64, u64, 8, extremes_f64, long_f64, min_f64, max_f64, _mm512_permutex2var_epi64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::window::lines;

    fn numbers<T>(of: impl Fn(u32) -> T, len: usize) -> Vec<T> {
        (0..len as u32).map(|i| of(i.wrapping_mul(2_654_435_761) >> 3)).collect()
    }

    fn check_extremes<T: lines::Elem>(of: impl Fn(u32) -> T) {
        for level in Level::available() {
            for w in (1..=67).chain([127, 128, 129, 200, 255, 333]) {
                for n in [1, 15, 63, 64, 65, 130, 256] {
                    let (a, b) = (numbers(&of, roomy(n) + w + 7), numbers(|i| of(i ^ 0x5a5a_5a5a), roomy(n) + w + 7));
                    let mut work = vec![T::LEAST; 2 * (n + w + 63)];
                    let (mut lo, mut hi) = (vec![T::LEAST; 2 * roomy(n)], vec![T::LEAST; 2 * roomy(n)]);
                    let pitches = Pitches { from: 7, to: roomy(n) - 5, rows: 2 };
                    if <T as RowExtremes>::windows(level, &a, &b, w, n, &mut lo, &mut hi, pitches, &mut work) {
                        for (k, i) in (0..2).flat_map(|k| (0..n).map(move |i| (k, i))) {
                            let (from, to) = (k * pitches.from + i, k * pitches.to + i);
                            let least = a[from..from + w].iter().fold(T::GREATEST, |m, v| m.lo(*v));
                            let most = b[from..from + w].iter().fold(T::LEAST, |m, v| m.hi(*v));
                            assert!(lo[to] == least && hi[to] == most, "{level:?} {w} {n} {k} {i}");
                        }
                    } else {
                        assert!(level < Level::Avx512);
                    }
                }
            }
        }
    }

    #[test]
    fn extremes_in_registers_equal_direct_windows() {
        check_extremes(|i| (i >> 9) as u8);
        check_extremes(|i| (i >> 7) as u16);
        check_extremes(|i| i);
        check_extremes(|i| i as f32 - 1e8);
        check_extremes(|i| i as f64 - 1e8);
    }
}
