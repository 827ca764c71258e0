//! AVX-512: 32 lanes in two vectors.
//!
//! All of it is macros and functions, never closures: the compiler must inline it into code of this instruction set.

use std::arch::x86_64::*;

use super::{F32x32, FRACTION, TWO_THIRDS};

/// AVX-512.
#[derive(Clone, Copy)]
pub struct Avx512(__m512, __m512);

/// An operation on both vectors.
macro_rules! two {
    ($op:expr, $($operand:expr),*) => { unsafe { Avx512($op($($operand.0),*), $op($($operand.1),*)) } };
}

#[inline(always)]
unsafe fn split512(v: __m512) -> (__m512, __m512) {
    unsafe {
        let bits = _mm512_sub_epi32(_mm512_castps_si512(v), _mm512_set1_epi32(TWO_THIRDS as i32));
        let fraction = _mm512_and_si512(bits, _mm512_set1_epi32(FRACTION as i32));
        let one = _mm512_castsi512_ps(_mm512_add_epi32(fraction, _mm512_set1_epi32(TWO_THIRDS as i32)));
        (_mm512_cvtepi32_ps(_mm512_srai_epi32::<23>(bits)), _mm512_sub_ps(one, _mm512_set1_ps(1.0)))
    }
}

#[inline(always)]
unsafe fn scaled512(p: __m512, z: __m512) -> __m512 {
    let shifted = unsafe { _mm512_slli_epi32::<23>(_mm512_castps_si512(z)) };
    unsafe { _mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(p), shifted)) }
}

impl F32x32 for Avx512 {
    type Mask = (__mmask16, __mmask16);
    type Int = (__m512i, __m512i);
    #[inline(always)]
    fn splat(v: f32) -> Self {
        unsafe { Avx512(_mm512_set1_ps(v), _mm512_set1_ps(v)) }
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        unsafe { Avx512(_mm512_loadu_ps(from), _mm512_loadu_ps(from.add(16))) }
    }
    #[inline(always)]
    unsafe fn load_u8(from: *const u8, flip: u8) -> (__m512i, __m512i) {
        unsafe {
            let flip = _mm_set1_epi8(flip as i8);
            let (a, b) = (_mm_loadu_si128(from.cast()), _mm_loadu_si128(from.add(16).cast()));
            (_mm512_cvtepu8_epi32(_mm_xor_si128(a, flip)), _mm512_cvtepu8_epi32(_mm_xor_si128(b, flip)))
        }
    }
    #[inline(always)]
    unsafe fn load_u16(from: *const u16, flip: u16) -> (__m512i, __m512i) {
        unsafe {
            let flip = _mm256_set1_epi16(flip as i16);
            let (a, b) = (_mm256_loadu_si256(from.cast()), _mm256_loadu_si256(from.add(16).cast()));
            (_mm512_cvtepu16_epi32(_mm256_xor_si256(a, flip)), _mm512_cvtepu16_epi32(_mm256_xor_si256(b, flip)))
        }
    }
    #[inline(always)]
    unsafe fn load_u32(from: *const u32) -> (__m512i, __m512i) {
        unsafe { (_mm512_loadu_si512(from.cast()), _mm512_loadu_si512(from.add(16).cast())) }
    }
    #[inline(always)]
    fn less_int(a: (__m512i, __m512i), b: (__m512i, __m512i)) -> (__m512i, __m512i) {
        unsafe { (_mm512_sub_epi32(a.0, b.0), _mm512_sub_epi32(a.1, b.1)) }
    }
    #[inline(always)]
    fn times_int(a: (__m512i, __m512i), b: (__m512i, __m512i)) -> (__m512i, __m512i) {
        unsafe { (_mm512_mullo_epi32(a.0, b.0), _mm512_mullo_epi32(a.1, b.1)) }
    }
    #[inline(always)]
    fn of_int(v: (__m512i, __m512i)) -> Self {
        two!(_mm512_cvtepi32_ps, v)
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        unsafe {
            _mm512_storeu_ps(to, self.0);
            _mm512_storeu_ps(to.add(16), self.1);
        }
    }
    #[inline(always)]
    unsafe fn store_codes(self, to: *mut u8) {
        // One permutation takes the lowest bytes of both vectors: narrowing stores are slower.
        const LOWEST: [u8; 64] = {
            let mut at = [0; 64];
            let mut i = 0;
            while i < 32 {
                at[i] = 4 * i as u8;
                i += 1;
            }
            at
        };
        unsafe {
            let (a, b) = (_mm512_castps_si512(self.0), _mm512_castps_si512(self.1));
            let codes = _mm512_permutex2var_epi8(a, _mm512_loadu_si512(LOWEST.as_ptr().cast()), b);
            _mm256_storeu_si256(to.cast(), _mm512_castsi512_si256(codes));
        }
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        two!(_mm512_add_ps, self, o)
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        two!(_mm512_sub_ps, self, o)
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        two!(_mm512_mul_ps, self, o)
    }
    #[inline(always)]
    fn over(self, o: Self) -> Self {
        two!(_mm512_div_ps, self, o)
    }
    #[inline(always)]
    fn root(self) -> Self {
        two!(_mm512_sqrt_ps, self)
    }
    #[inline(always)]
    fn magnitude(self) -> Self {
        two!(_mm512_abs_ps, self)
    }
    #[inline(always)]
    fn fused(self, b: Self, c: Self) -> Self {
        two!(_mm512_fmadd_ps, self, b, c)
    }
    #[inline(always)]
    fn less(self, b: Self, c: Self) -> Self {
        two!(_mm512_fnmadd_ps, self, b, c)
    }
    #[inline(always)]
    fn greater(self, o: Self) -> Self {
        two!(_mm512_max_ps, self, o)
    }
    #[inline(always)]
    fn lesser(self, o: Self) -> Self {
        two!(_mm512_min_ps, self, o)
    }
    #[inline(always)]
    fn is_below(self, o: Self) -> (__mmask16, __mmask16) {
        unsafe { (_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, o.0), _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.1, o.1)) }
    }
    #[inline(always)]
    fn equals(self, o: Self) -> (__mmask16, __mmask16) {
        unsafe { (_mm512_cmp_ps_mask::<_CMP_EQ_OQ>(self.0, o.0), _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(self.1, o.1)) }
    }
    #[inline(always)]
    fn is_negative(self) -> (__mmask16, __mmask16) {
        unsafe {
            (_mm512_movepi32_mask(_mm512_castps_si512(self.0)), _mm512_movepi32_mask(_mm512_castps_si512(self.1)))
        }
    }
    #[inline(always)]
    fn is_blank(self) -> (__mmask16, __mmask16) {
        let (a, b) = unsafe { (_mm512_castps_si512(self.0), _mm512_castps_si512(self.1)) };
        unsafe { (_mm512_testn_epi32_mask(a, a), _mm512_testn_epi32_mask(b, b)) }
    }
    #[inline(always)]
    fn all(mask: (__mmask16, __mmask16)) -> bool {
        mask.0 & mask.1 == u16::MAX
    }
    #[inline(always)]
    fn any(mask: (__mmask16, __mmask16)) -> bool {
        mask.0 | mask.1 != 0
    }
    #[inline(always)]
    fn pick(mask: (__mmask16, __mmask16), yes: Self, no: Self) -> Self {
        unsafe { Avx512(_mm512_mask_blend_ps(mask.0, no.0, yes.0), _mm512_mask_blend_ps(mask.1, no.1, yes.1)) }
    }
    #[inline(always)]
    fn split(self) -> [Self; 2] {
        let ((e, f), (g, h)) = unsafe { (split512(self.0), split512(self.1)) };
        [Avx512(e, g), Avx512(f, h)]
    }
    #[inline(always)]
    fn scaled(self, z: Self) -> Self {
        two!(scaled512, self, z)
    }
}
