//! The inner loop of counting by comparison, written with intrinsics: f32 at radius 5 takes 67 ns per voxel, with the
//! compiler's own vectors 1469 (2-core Zen 4 VM, AVX-512, 2026-11-23, `cargo bench --bench kernels_more`).

use super::Key;
use crate::kernel::simd::Level;

/// Counts per lane, written over from zero: keys above the centre, and keys not below it (`MID` only).
pub(crate) struct Lanes<'a, K: Key, const L: usize, const R: usize> {
    pub above: &'a mut [[K::Count; L]; R],
    pub not_below: &'a mut [[K::Count; L]; R],
}

/// A block of the padded keys: `rows` rows, `stride` apart, of `shifts` runs of L keys each, from the slice's start.
#[derive(Clone, Copy)]
pub(crate) struct Block<'a, K> {
    pub keys: &'a [K],
    pub stride: usize,
    pub rows: usize,
    pub shifts: usize,
}

/// Compares each run of L keys of a block with the L centres of each of R output rows. Panics if L is not the number of
/// keys in 64 bytes, or the block sticks out. Counts wrap if the block has more runs than they hold.
#[inline(always)]
pub(super) fn compare<K: Key, const L: usize, const R: usize, const MID: bool>(
    level: Level,
    block: Block<K>,
    centres: &[[K; L]; R],
    lanes: Lanes<K, L, R>,
) {
    let Block { keys, stride, rows, shifts } = block;
    assert!(L * size_of::<K>() == 64 && rows > 0 && shifts > 0);
    assert!((rows - 1) * stride + shifts - 1 + L <= keys.len(), "the block sticks out");
    #[cfg(target_arch = "x86_64")]
    match level {
        // SAFETY: a level above `Baseline` comes from `detect` or `available`, which asked the CPU; extents were checked.
        Level::Avx512 => return unsafe { K::avx512::<L, R, MID>(block, centres, lanes) },
        // SAFETY: as above.
        Level::Avx2 => return unsafe { K::avx2::<L, R, MID>(block, centres, lanes) },
        Level::Baseline => {}
    }
    let _ = level;
    let Lanes { above, not_below } = lanes;
    for v in (0..rows).flat_map(|r| keys[r * stride..][..shifts + L - 1].windows(L)) {
        for j in 0..R {
            for l in 0..L {
                above[j][l] += K::Count::from(v[l] > centres[j][l]);
                if MID {
                    not_below[j][l] += K::Count::from(v[l] >= centres[j][l]);
                }
            }
        }
    }
}

/// Vector forms of the loop in [`compare`].
pub(crate) trait Vector: Sized {
    /// # Safety
    /// The CPU must have AVX-512 F and BW, L keys must fill 64 bytes, and the block must not stick out.
    #[cfg(target_arch = "x86_64")]
    unsafe fn avx512<const L: usize, const R: usize, const MID: bool>(
        block: Block<Self>,
        centres: &[[Self; L]; R],
        lanes: Lanes<Self, L, R>,
    ) where
        Self: Key;

    /// # Safety
    /// The CPU must have AVX2, L keys must fill 64 bytes, and the block must not stick out.
    #[cfg(target_arch = "x86_64")]
    unsafe fn avx2<const L: usize, const R: usize, const MID: bool>(
        block: Block<Self>,
        centres: &[[Self; L]; R],
        lanes: Lanes<Self, L, R>,
    ) where
        Self: Key;
}

#[cfg(not(target_arch = "x86_64"))]
mod other {
    macro_rules! none { ($($key:ty),*) => {$(impl super::Vector for $key {})*}; }
    none!(i8, i16, i32, f32, f64);
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Block, Key, Lanes, Vector};

    /// The loop over shifts with vectors of `$bits`, `$parts` to 64 bytes.
    macro_rules! body {
        ($block:ident, $centres:ident, $lanes:ident, $key:ty, $parts:literal, $load:path, $zero:path, $st:path, $gt:path, $ge:path, $add:path) => {{
            const PER: usize = 64 / size_of::<$key>() / $parts;
            let start = $block.keys.as_ptr();
            // SAFETY: the block holds at least one run of L keys.
            let mut c = [[unsafe { $load(start.cast()) }; $parts]; R];
            let mut above = [[$zero(); $parts]; R];
            let mut not_below = [[$zero(); $parts]; R];
            for j in 0..R {
                for p in 0..$parts {
                    // SAFETY: each array of L keys fills 64 bytes.
                    unsafe {
                        c[j][p] = $load($centres[j].as_ptr().add(p * PER).cast());
                    }
                }
            }
            for row in 0..$block.rows {
                for shift in 0..$block.shifts {
                    for p in 0..$parts {
                        // SAFETY: the caller saw to it that the last run of the last row lies in the keys.
                        let v = unsafe { $load(start.add(row * $block.stride + shift + p * PER).cast()) };
                        for j in 0..R {
                            above[j][p] = $add(above[j][p], $gt(v, c[j][p]));
                            if MID {
                                not_below[j][p] = $add(not_below[j][p], $ge(v, c[j][p]));
                            }
                        }
                    }
                }
            }
            for j in 0..R {
                for p in 0..$parts {
                    // SAFETY: each array of L counts, as wide as keys, fills 64 bytes.
                    unsafe {
                        $st($lanes.above[j].as_mut_ptr().add(p * PER).cast(), above[j][p]);
                        if MID {
                            $st($lanes.not_below[j].as_mut_ptr().add(p * PER).cast(), not_below[j][p]);
                        }
                    }
                }
            }
        }};
    }

    macro_rules! vector {
        ($($key:ty: ($load512:path, $gt512:path, $ge512:path, $add512:path), ($load256:path, $gt256:path, $ge256:path, $add256:path);)*) => {$(
            impl Vector for $key {
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
                unsafe fn avx512<const L: usize, const R: usize, const MID: bool>(
                    block: Block<$key>, centres: &[[$key; L]; R], lanes: Lanes<$key, L, R>,
                ) where $key: Key {
                    body!(block, centres, lanes, $key, 1, $load512, _mm512_setzero_si512, _mm512_storeu_si512, $gt512, $ge512, $add512)
                }

                #[target_feature(enable = "avx2")]
                unsafe fn avx2<const L: usize, const R: usize, const MID: bool>(
                    block: Block<$key>, centres: &[[$key; L]; R], lanes: Lanes<$key, L, R>,
                ) where $key: Key {
                    body!(block, centres, lanes, $key, 2, $load256, _mm256_setzero_si256, _mm256_storeu_si256, $gt256, $ge256, $add256)
                }
            }
        )*};
    }
    vector! {
        i8: (_mm512_loadu_si512, _mm512_cmpgt_epi8_mask, _mm512_cmpge_epi8_mask, add8), (_mm256_loadu_si256, _mm256_cmpgt_epi8, ge8, _mm256_sub_epi8);
        i16: (_mm512_loadu_si512, _mm512_cmpgt_epi16_mask, _mm512_cmpge_epi16_mask, add16), (_mm256_loadu_si256, _mm256_cmpgt_epi16, ge16, _mm256_sub_epi16);
        i32: (_mm512_loadu_si512, _mm512_cmpgt_epi32_mask, _mm512_cmpge_epi32_mask, add32), (_mm256_loadu_si256, _mm256_cmpgt_epi32, ge32, _mm256_sub_epi32);
        f32: (_mm512_loadu_ps, _mm512_cmp_ps_mask::<_CMP_GT_OQ>, _mm512_cmp_ps_mask::<_CMP_GE_OQ>, add32), (_mm256_loadu_ps, gt_ps, ge_ps, _mm256_sub_epi32);
        f64: (_mm512_loadu_pd, _mm512_cmp_pd_mask::<_CMP_GT_OQ>, _mm512_cmp_pd_mask::<_CMP_GE_OQ>, add64), (_mm256_loadu_pd, gt_pd, ge_pd, _mm256_sub_epi64);
    }

    macro_rules! small {
        ($features:literal; $($name:ident($a:ident: $at:ty, $b:ident: $bt:ty) -> $r:ty = $e:expr;)*) => {$(
            #[inline]
            #[target_feature(enable = $features)]
            fn $name($a: $at, $b: $bt) -> $r { $e }
        )*};
    }
    small! { "avx512f,avx512bw";
        add8(a: __m512i, m: __mmask64) -> __m512i = _mm512_mask_add_epi8(a, m, a, _mm512_set1_epi8(1));
        add16(a: __m512i, m: __mmask32) -> __m512i = _mm512_mask_add_epi16(a, m, a, _mm512_set1_epi16(1));
        add32(a: __m512i, m: __mmask16) -> __m512i = _mm512_mask_add_epi32(a, m, a, _mm512_set1_epi32(1));
        add64(a: __m512i, m: __mmask8) -> __m512i = _mm512_mask_add_epi64(a, m, a, _mm512_set1_epi64(1));
    }
    small! { "avx2";
        ge8(v: __m256i, c: __m256i) -> __m256i = _mm256_xor_si256(_mm256_cmpgt_epi8(c, v), _mm256_set1_epi8(-1));
        ge16(v: __m256i, c: __m256i) -> __m256i = _mm256_xor_si256(_mm256_cmpgt_epi16(c, v), _mm256_set1_epi8(-1));
        ge32(v: __m256i, c: __m256i) -> __m256i = _mm256_xor_si256(_mm256_cmpgt_epi32(c, v), _mm256_set1_epi8(-1));
        gt_ps(v: __m256, c: __m256) -> __m256i = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_GT_OQ>(v, c));
        ge_ps(v: __m256, c: __m256) -> __m256i = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_GE_OQ>(v, c));
        gt_pd(v: __m256d, c: __m256d) -> __m256i = _mm256_castpd_si256(_mm256_cmp_pd::<_CMP_GT_OQ>(v, c));
        ge_pd(v: __m256d, c: __m256d) -> __m256i = _mm256_castpd_si256(_mm256_cmp_pd::<_CMP_GE_OQ>(v, c));
    }
}
