//! Next greater voxel by brute force on x86 vectors: one compare, mask and count per step along 16 to 64 lines.

use std::arch::x86_64::*;
use std::ops::Range;

use super::keys::{Key, LANES};
use crate::kernel::simd::Level;

/// Longest reach whose answers fit into bytes.
pub(super) const MAX_REACH: usize = u8::MAX as usize;

/// Steps between two looks at whether all lanes have met their occluder.
const BURST: usize = 8;

/// Answers of one sense on consecutive rows of 64 keys; see [`super::scan::both`]. Lanes that are not `live` are open. False if this CPU and key have no
/// kernel here, and nothing was done. Panics if `reach` is beyond [`MAX_REACH`].
pub(super) fn brute<K: Key>(
    level: Level,
    rows: &[K],
    live: u64,
    queries: Range<usize>,
    reach: usize,
    ahead: bool,
    hits: &mut [u8],
) -> bool {
    assert!(reach <= MAX_REACH && queries.end * LANES <= rows.len() && hits.len() >= queries.len() * LANES);
    let (from, planes) = (rows.as_ptr(), rows.len() / LANES);
    // SAFETY: the level says what the CPU has (every x86-64 has SSE2), extents were checked, and `Key` is implemented
    // for one type of each size.
    unsafe {
        match (size_of::<K>(), level >= Level::Avx2) {
            (1, true) => avx2_u8(from.cast(), live, planes, queries, reach, ahead, hits),
            (2, true) => avx2_u16(from.cast(), live, planes, queries, reach, ahead, hits),
            (4, true) => avx2_u32(from.cast(), live, planes, queries, reach, ahead, hits),
            (1, false) => sse2_u8(from.cast(), live, planes, queries, reach, ahead, hits),
            (2, false) => sse2_u16(from.cast(), live, planes, queries, reach, ahead, hits),
            _ => return false,
        }
    }
    true
}

macro_rules! brute {
    ($name:ident, $feature:literal, $t:ty, $v:ty, $load:ident, $store:ident, $zero:expr, $and:ident, $or:ident, $sub:ident,
     $some:expr, $le:expr) => {
        /// # Safety
        /// `planes` rows of 64 keys from `rows` on; `queries` among them; the CPU has the feature.
        #[target_feature(enable = $feature)]
        unsafe fn $name(
            rows: *const $t,
            live: u64,
            planes: usize,
            queries: Range<usize>,
            reach: usize,
            ahead: bool,
            hits: &mut [u8],
        ) {
            const R: usize = size_of::<$v>() / size_of::<$t>();
            let (mut on, mut off) = ([0 as $t; LANES], [0 as $t; LANES]);
            for (lane, (on, off)) in on.iter_mut().zip(&mut off).enumerate() {
                *on = if live >> lane & 1 == 0 { 0 } else { <$t>::MAX };
                *off = !*on;
            }
            for (query, hits) in queries.zip(hits.chunks_exact_mut(LANES)) {
                let steps = reach.min(if ahead { planes - 1 - query } else { query });
                let stride = if ahead { LANES as isize } else { -(LANES as isize) };
                for lane in (0..LANES).step_by(R) {
                    if live >> lane & (u64::MAX >> (64 - R)) == 0 {
                        hits[lane..lane + R].fill(reach as u8);
                        continue;
                    }
                    let mut at = rows.wrapping_add(query * LANES + lane);
                    // SAFETY: a row of the sheet.
                    let key = unsafe { $load(at.cast()) };
                    // SAFETY: one flag per lane.
                    let (mut alive, mut count): ($v, $v) = (unsafe { $load(on.as_ptr().add(lane).cast()) }, $zero);
                    let mut left = steps;
                    while left > 0 && $some(alive) {
                        let burst = left.min(BURST);
                        for _ in 0..burst {
                            at = at.wrapping_offset(stride);
                            // SAFETY: at most `steps` rows from the query, all in the sheet.
                            let other = unsafe { $load(at.cast()) };
                            alive = $and(alive, $le(other, key));
                            count = $sub(count, alive);
                        }
                        left -= burst;
                    }
                    let (mut counts, mut open) = ([0 as $t; R], [0 as $t; R]);
                    // SAFETY: arrays of the size of a vector.
                    unsafe {
                        $store(counts.as_mut_ptr().cast(), count);
                        // Lanes that were never on are open as well.
                        let off = $load(off.as_ptr().add(lane).cast());
                        $store(open.as_mut_ptr().cast(), $or(alive, off));
                    }
                    for ((hit, count), open) in hits[lane..].iter_mut().zip(counts).zip(open) {
                        *hit = if open != 0 { reach as u8 } else { count as u8 };
                    }
                }
            }
        }
    };
}

brute!(
    avx2_u8,
    "avx2",
    u8,
    __m256i,
    _mm256_loadu_si256,
    _mm256_storeu_si256,
    _mm256_setzero_si256(),
    _mm256_and_si256,
    _mm256_or_si256,
    _mm256_sub_epi8,
    |v| _mm256_testz_si256(v, v) == 0,
    |r, q| _mm256_cmpeq_epi8(_mm256_max_epu8(r, q), q)
);
brute!(
    avx2_u16,
    "avx2",
    u16,
    __m256i,
    _mm256_loadu_si256,
    _mm256_storeu_si256,
    _mm256_setzero_si256(),
    _mm256_and_si256,
    _mm256_or_si256,
    _mm256_sub_epi16,
    |v| _mm256_testz_si256(v, v) == 0,
    |r, q| _mm256_cmpeq_epi16(_mm256_max_epu16(r, q), q)
);
brute!(
    avx2_u32,
    "avx2",
    u32,
    __m256i,
    _mm256_loadu_si256,
    _mm256_storeu_si256,
    _mm256_setzero_si256(),
    _mm256_and_si256,
    _mm256_or_si256,
    _mm256_sub_epi32,
    |v| _mm256_testz_si256(v, v) == 0,
    |r, q| _mm256_cmpeq_epi32(_mm256_max_epu32(r, q), q)
);
brute!(
    sse2_u8,
    "sse2",
    u8,
    __m128i,
    _mm_loadu_si128,
    _mm_storeu_si128,
    _mm_setzero_si128(),
    _mm_and_si128,
    _mm_or_si128,
    _mm_sub_epi8,
    |v| _mm_movemask_epi8(v) != 0,
    |r, q| _mm_cmpeq_epi8(_mm_max_epu8(r, q), q)
);
brute!(
    sse2_u16,
    "sse2",
    u16,
    __m128i,
    _mm_loadu_si128,
    _mm_storeu_si128,
    _mm_setzero_si128(),
    _mm_and_si128,
    _mm_or_si128,
    _mm_sub_epi16,
    |v| _mm_movemask_epi8(v) != 0,
    |r, q| _mm_cmpeq_epi16(_mm_subs_epu16(r, q), _mm_setzero_si128())
);
