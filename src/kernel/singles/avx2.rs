//! AVX2 with FMA: 32 lanes in four vectors.
//!
//! All of it is macros and functions, never closures: the compiler must inline it into code of this instruction set.

use std::arch::x86_64::*;

use super::{F32x32, FRACTION, TWO_THIRDS};

/// AVX2 with FMA.
#[derive(Clone, Copy)]
pub struct Avx2(__m256, __m256, __m256, __m256);
type Int = (__m256i, __m256i, __m256i, __m256i);

/// An operation on all four vectors.
macro_rules! four {
    ($op:expr, $($operand:expr),*) => {
        unsafe { Avx2($op($($operand.0),*), $op($($operand.1),*), $op($($operand.2),*), $op($($operand.3),*)) }
    };
}

#[inline(always)]
unsafe fn load_u8(from: *const u8, flip: u8) -> __m256i {
    unsafe { _mm256_cvtepu8_epi32(_mm_xor_si128(_mm_loadl_epi64(from.cast()), _mm_set1_epi8(flip as i8))) }
}

#[inline(always)]
unsafe fn load_u16(from: *const u16, flip: u16) -> __m256i {
    unsafe { _mm256_cvtepu16_epi32(_mm_xor_si128(_mm_loadu_si128(from.cast()), _mm_set1_epi16(flip as i16))) }
}

#[inline(always)]
unsafe fn blank256(v: __m256) -> __m256 {
    unsafe { _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_castps_si256(v), _mm256_setzero_si256())) }
}

#[inline(always)]
unsafe fn abs256(v: __m256) -> __m256 {
    unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), v) }
}

#[inline(always)]
unsafe fn exponent256(v: __m256) -> __m256 {
    unsafe {
        let bits = _mm256_sub_epi32(_mm256_castps_si256(v), _mm256_set1_epi32(TWO_THIRDS as i32));
        _mm256_cvtepi32_ps(_mm256_srai_epi32::<23>(bits))
    }
}

#[inline(always)]
unsafe fn fraction256(v: __m256) -> __m256 {
    unsafe {
        let base = _mm256_set1_epi32(TWO_THIRDS as i32);
        let bits = _mm256_sub_epi32(_mm256_castps_si256(v), base);
        let fraction = _mm256_and_si256(bits, _mm256_set1_epi32(FRACTION as i32));
        _mm256_sub_ps(_mm256_castsi256_ps(_mm256_add_epi32(fraction, base)), _mm256_set1_ps(1.0))
    }
}

#[inline(always)]
unsafe fn scaled256(p: __m256, z: __m256) -> __m256 {
    let shifted = unsafe { _mm256_slli_epi32::<23>(_mm256_castps_si256(z)) };
    unsafe { _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), shifted)) }
}

impl F32x32 for Avx2 {
    type Mask = Avx2;
    type Int = Int;
    #[inline(always)]
    fn splat(v: f32) -> Self {
        let v = unsafe { _mm256_set1_ps(v) };
        Avx2(v, v, v, v)
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        unsafe {
            let (a, b) = (_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(8)));
            Avx2(a, b, _mm256_loadu_ps(from.add(16)), _mm256_loadu_ps(from.add(24)))
        }
    }
    #[inline(always)]
    unsafe fn load_u8(from: *const u8, flip: u8) -> Int {
        unsafe {
            let (a, b) = (load_u8(from, flip), load_u8(from.add(8), flip));
            (a, b, load_u8(from.add(16), flip), load_u8(from.add(24), flip))
        }
    }
    #[inline(always)]
    unsafe fn load_u16(from: *const u16, flip: u16) -> Int {
        unsafe {
            let (a, b) = (load_u16(from, flip), load_u16(from.add(8), flip));
            (a, b, load_u16(from.add(16), flip), load_u16(from.add(24), flip))
        }
    }
    #[inline(always)]
    unsafe fn load_u32(from: *const u32) -> Int {
        let from: *const __m256i = from.cast();
        unsafe {
            let (a, b) = (_mm256_loadu_si256(from), _mm256_loadu_si256(from.add(1)));
            (a, b, _mm256_loadu_si256(from.add(2)), _mm256_loadu_si256(from.add(3)))
        }
    }
    #[inline(always)]
    fn less_int(a: Int, b: Int) -> Int {
        unsafe {
            let (c, d) = (_mm256_sub_epi32(a.0, b.0), _mm256_sub_epi32(a.1, b.1));
            (c, d, _mm256_sub_epi32(a.2, b.2), _mm256_sub_epi32(a.3, b.3))
        }
    }
    #[inline(always)]
    fn times_int(a: Int, b: Int) -> Int {
        unsafe {
            let (c, d) = (_mm256_mullo_epi32(a.0, b.0), _mm256_mullo_epi32(a.1, b.1));
            (c, d, _mm256_mullo_epi32(a.2, b.2), _mm256_mullo_epi32(a.3, b.3))
        }
    }
    #[inline(always)]
    fn of_int(v: Int) -> Self {
        four!(_mm256_cvtepi32_ps, v)
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        unsafe {
            _mm256_storeu_ps(to, self.0);
            _mm256_storeu_ps(to.add(8), self.1);
            _mm256_storeu_ps(to.add(16), self.2);
            _mm256_storeu_ps(to.add(24), self.3);
        }
    }
    #[inline(always)]
    unsafe fn store_codes(self, to: *mut u8) {
        unsafe {
            let low = _mm256_set1_epi32(0xff);
            let a = _mm256_and_si256(_mm256_castps_si256(self.0), low);
            let b = _mm256_and_si256(_mm256_castps_si256(self.1), low);
            let c = _mm256_and_si256(_mm256_castps_si256(self.2), low);
            let d = _mm256_and_si256(_mm256_castps_si256(self.3), low);
            let (a, b) = (_mm256_packs_epi32(a, b), _mm256_packs_epi32(c, d));
            // Packing interleaves the halves of its operands, in fours.
            let order = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
            let codes = _mm256_permutevar8x32_epi32(_mm256_packus_epi16(a, b), order);
            _mm256_storeu_si256(to.cast(), codes);
        }
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        four!(_mm256_add_ps, self, o)
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        four!(_mm256_sub_ps, self, o)
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        four!(_mm256_mul_ps, self, o)
    }
    #[inline(always)]
    fn over(self, o: Self) -> Self {
        four!(_mm256_div_ps, self, o)
    }
    #[inline(always)]
    fn root(self) -> Self {
        four!(_mm256_sqrt_ps, self)
    }
    #[inline(always)]
    fn magnitude(self) -> Self {
        four!(abs256, self)
    }
    #[inline(always)]
    fn fused(self, b: Self, c: Self) -> Self {
        four!(_mm256_fmadd_ps, self, b, c)
    }
    #[inline(always)]
    fn less(self, b: Self, c: Self) -> Self {
        four!(_mm256_fnmadd_ps, self, b, c)
    }
    #[inline(always)]
    fn greater(self, o: Self) -> Self {
        four!(_mm256_max_ps, self, o)
    }
    #[inline(always)]
    fn lesser(self, o: Self) -> Self {
        four!(_mm256_min_ps, self, o)
    }
    #[inline(always)]
    fn is_below(self, o: Self) -> Self {
        four!(_mm256_cmp_ps::<_CMP_LT_OQ>, self, o)
    }
    #[inline(always)]
    fn equals(self, o: Self) -> Self {
        four!(_mm256_cmp_ps::<_CMP_EQ_OQ>, self, o)
    }
    #[inline(always)]
    fn is_negative(self) -> Self {
        self // only sign bits of masks are read
    }
    #[inline(always)]
    fn is_blank(self) -> Self {
        four!(blank256, self)
    }
    #[inline(always)]
    fn all(mask: Self) -> bool {
        unsafe {
            let (a, b) = (_mm256_and_ps(mask.0, mask.1), _mm256_and_ps(mask.2, mask.3));
            _mm256_movemask_ps(_mm256_and_ps(a, b)) == 0xff
        }
    }
    #[inline(always)]
    fn any(mask: Self) -> bool {
        unsafe {
            let (a, b) = (_mm256_or_ps(mask.0, mask.1), _mm256_or_ps(mask.2, mask.3));
            _mm256_movemask_ps(_mm256_or_ps(a, b)) != 0
        }
    }
    #[inline(always)]
    fn pick(mask: Self, yes: Self, no: Self) -> Self {
        four!(_mm256_blendv_ps, no, yes, mask)
    }
    #[inline(always)]
    fn split(self) -> [Self; 2] {
        [four!(exponent256, self), four!(fraction256, self)]
    }
    #[inline(always)]
    fn scaled(self, z: Self) -> Self {
        four!(scaled256, self, z)
    }
}
