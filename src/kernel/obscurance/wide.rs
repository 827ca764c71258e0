//! Next greater voxel by AVX-512: binary search along lines, 64 bytes of a line at once.
//!
//! A sheet is turned so that lines are contiguous. For each block of a line (one register: 64, 32, 16 or 8 keys)
//! `T_s[i]` is the greatest of the `2^s` keys from `i` on. A query that has passed `c` free planes looks up the greatest
//! of the next `2^s` with one two-register permutation and passes them all if it is not greater: log2 steps for a block
//! of reach, for all lanes at once, whatever the data. Blocks further away are entered only if some lane that still
//! searches is less than their greatest key.

use std::arch::x86_64::*;
use std::ops::Range;

use super::keys::{Key, LANES};
use super::scan::{Sheet, Spans};

/// Longest reach whose answers fit into the bytes that are turned back.
pub(super) const MAX_REACH: usize = u8::MAX as usize;

/// Bytes of scratch for sheets of at most `planes` planes of keys of `size` bytes, of which `queries` are asked.
pub(super) fn scratch_bytes(planes: usize, queries: usize, size: usize) -> usize {
    let lanes = 64 / size;
    let blocks = planes.div_ceil(lanes) + 2;
    let lines = LANES * (blocks | 1) * 64;
    let tables = (blocks + 2) * (6 * 64 + 8);
    let answers = 2 * LANES * (queries.div_ceil(64) | 1) * 64;
    lines + tables.next_multiple_of(64) + answers
}

/// Answers of both senses; see [`super::scan::next_greater`]. An empty slice of hits is a sense that is not asked for.
/// Panics if `reach` is beyond [`MAX_REACH`] or the scratch is shorter than [`scratch_bytes`].
///
/// # Safety
/// The CPU must have [`crate::kernel::simd::Level::Avx512`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
pub(super) unsafe fn next_greater<K: Key>(
    sheet: Sheet<K>,
    spans: &Spans,
    queries: Range<usize>,
    reach: usize,
    hits: [&mut [u8]; 2],
    scratch: &mut [u8],
) {
    let planes = sheet.planes.len();
    assert!(reach <= MAX_REACH && queries.end <= planes);
    assert!(scratch.len() >= scratch_bytes(planes, queries.len(), size_of::<K>()));
    assert_eq!(scratch.as_ptr() as usize % 64, 0);
    assert!(hits.iter().all(|h| h.is_empty() || h.len() >= queries.len() * LANES));
    assert!(sheet.planes.iter().all(|start| start + LANES <= sheet.data.len()));
    let (data, starts) = (sheet.data.as_ptr(), sheet.planes);
    // SAFETY: `Key` is implemented for these four types only, told apart by their size; extents were checked above.
    unsafe {
        match size_of::<K>() {
            1 => keys_u8(data.cast(), starts, spans, queries, reach, hits, scratch),
            2 => keys_u16(data.cast(), starts, spans, queries, reach, hits, scratch),
            4 => keys_u32(data.cast(), starts, spans, queries, reach, hits, scratch),
            _ => keys_u64(data.cast(), starts, spans, queries, reach, hits, scratch),
        }
    }
}

/// 16 x 16 bytes turned inside each 128-bit lane: each round rotates the address (4 bits of row, 4 of column) by one.
#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
fn turn_bytes(t: [__m512i; 16]) -> [__m512i; 16] {
    round(round(round(round(t))))
}

#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
fn round(t: [__m512i; 16]) -> [__m512i; 16] {
    let mut n = t;
    for i in 0..8 {
        n[2 * i] = _mm512_unpacklo_epi8(t[i], t[i + 8]);
        n[2 * i + 1] = _mm512_unpackhi_epi8(t[i], t[i + 8]);
    }
    n
}

/// Turns answers `[line][query]` (rows of `stride` bytes) into rows of 64 lines per query.
///
/// # Safety
/// 64 rows of `stride` bytes, `stride` at least `count` rounded up to 64; the CPU has AVX-512.
#[target_feature(enable = "avx512f,avx512bw")]
unsafe fn turn_back(answers: *const u8, stride: usize, count: usize, hits: &mut [u8]) {
    assert!(hits.len() >= count * LANES);
    for block in (0..count).step_by(64) {
        let whole = block + 64 <= count;
        for group in 0..4 {
            // SAFETY: inside the 64 rows of `stride` bytes.
            let rows = std::array::from_fn(|i| unsafe {
                _mm512_loadu_si512(answers.add((group * 16 + i) * stride + block).cast())
            });
            for (j, v) in turn_bytes(rows).into_iter().enumerate() {
                let quarters = [
                    _mm512_castsi512_si128(v),
                    _mm512_extracti32x4_epi32::<1>(v),
                    _mm512_extracti32x4_epi32::<2>(v),
                    _mm512_extracti32x4_epi32::<3>(v),
                ];
                for (l, quarter) in quarters.into_iter().enumerate() {
                    let query = block + l * 16 + j;
                    if whole || query < count {
                        // SAFETY: 16 bytes of the row of a query below `count`; `hits` has `count` rows.
                        unsafe { _mm_storeu_si128(hits.as_mut_ptr().add(query * LANES + group * 16).cast(), quarter) };
                    }
                }
            }
        }
    }
}

macro_rules! search {
    (
        $name:ident, $t:ty, levels $levels:literal, group $group:literal, rounds [$($round:ident)*],
        $unpacklo:ident, $unpackhi:ident, $permute:ident, $max:ident, $min:ident, $set1:ident, $add:ident, $sub:ident,
        $le:ident, $mask_gt:ident, $mask_add:ident, $blend:ident, $mask:ty, $lane_type:ty, $store:expr
    ) => {
        /// # Safety
        /// As [`next_greater`], with 64 keys at each of `starts` in `data`.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        unsafe fn $name(
            data: *const $t,
            starts: &[usize],
            spans: &Spans,
            queries: Range<usize>,
            reach: usize,
            hits: [&mut [u8]; 2],
            scratch: &mut [u8],
        ) {
            /// Keys of a register, and of a block of a line.
            const R: usize = 64 / size_of::<$t>();
            const LEVELS: usize = $levels;
            /// Rows that are turned at once: 16 bytes of a line.
            const GROUP: usize = $group;
            let planes = starts.len();
            // Blocks are counted so that the first query starts one.
            let front = queries.start.div_ceil(R);
            let blocks = front + (planes - queries.start).div_ceil(R);
            let stride = (blocks | 1) * R;
            let answer_stride = (queries.len().div_ceil(64) | 1) * 64;
            let (lines, rest) = scratch.split_at_mut(LANES * stride * size_of::<$t>());
            let (tables, rest) = rest.split_at_mut((blocks + 2) * LEVELS * 64);
            let (tops, rest) = rest.split_at_mut(((blocks + 2) * 8).next_multiple_of(64));
            let (answers_f, answers_b) = rest.split_at_mut(LANES * answer_stride);
            assert!(answers_b.len() >= LANES * answer_stride);
            let (lines, tops) = (lines.as_mut_ptr().cast::<$t>(), tops.as_mut_ptr().cast::<$t>());
            let tables = tables.as_mut_ptr().cast::<__m512i>();
            let zero = _mm512_setzero_si512();

            // Turn the sheet: position p of a line is plane p + queries.start - front * R.
            let offset = queries.start as isize - (front * R) as isize;
            for p in (0..blocks * R).step_by(GROUP) {
                for column in 0..LANES / R {
                    let mut t = [zero; GROUP];
                    for (i, t) in t.iter_mut().enumerate() {
                        let plane = (p + i) as isize + offset;
                        if let Some(&start) = starts.get(plane as usize) {
                            // SAFETY: 64 keys start there. (A plane before the first is a huge number.)
                            *t = unsafe { _mm512_loadu_si512(data.add(start + column * R).cast()) };
                            // The sheet that comes next stands 64 keys further on. Prefetching touches nothing.
                            _mm_prefetch::<_MM_HINT_T0>(data.wrapping_add(start + 2 * LANES + column * R).cast());
                        }
                    }
                    $({
                        let $round = t;
                        for i in 0..GROUP / 2 {
                            t[2 * i] = $unpacklo($round[i], $round[i + GROUP / 2]);
                            t[2 * i + 1] = $unpackhi($round[i], $round[i + GROUP / 2]);
                        }
                    })*
                    for (c, &v) in t.iter().enumerate() {
                        let quarters = [
                            _mm512_castsi512_si128(v),
                            _mm512_extracti32x4_epi32::<1>(v),
                            _mm512_extracti32x4_epi32::<2>(v),
                            _mm512_extracti32x4_epi32::<3>(v),
                        ];
                        for (l, quarter) in quarters.into_iter().enumerate() {
                            let line = column * R + l * GROUP + c;
                            // SAFETY: 16 bytes at positions p..p + GROUP of one of the 64 lines.
                            unsafe { _mm_storeu_si128(lines.add(line * stride + p).cast(), quarter) };
                        }
                    }
                }
            }

            let mut counting = [0 as $t; R];
            counting.iter_mut().enumerate().for_each(|(i, v)| *v = i as $t);
            // SAFETY: 64 bytes.
            let lane = unsafe { _mm512_loadu_si512(counting.as_ptr().cast()) };
            let number = |n: usize| $set1(n as $lane_type);
            let one = number(1);
            let past = number(R);
            let limit = number(reach);
            // SAFETY: `tables` has LEVELS registers and `tops` one key for each of blocks + 2 blocks.
            let table = |block: usize, s: usize| unsafe { _mm512_load_si512(tables.add(block * LEVELS + s).cast()) };
            // Blocks of zeros stand before and after each line. The one before is made with the others, since its
            // tables look into the first block.
            for s in 0..LEVELS {
                // SAFETY: as above.
                unsafe { _mm512_store_si512(tables.add((blocks + 1) * LEVELS + s).cast(), zero) };
            }
            // SAFETY: as above.
            unsafe { *tops.add(blocks + 1) = 0 };
            for line in 0..LANES {
                let mut next = [zero; LEVELS];
                let [from, to] = spans[line].map(|query| query as usize);
                if from >= to {
                    continue;
                }
                let asked = from / R..to.min(queries.len()).div_ceil(R);
                let around = reach.div_ceil(R);
                let lowest = (front + asked.start + 1).saturating_sub(around);
                let highest = (front + asked.end + around).min(blocks);
                for block in (lowest..=highest).rev() {
                    let mut t = zero;
                    if block > 0 {
                        // SAFETY: one of the blocks of the line.
                        t = unsafe { _mm512_loadu_si512(lines.add(line * stride + (block - 1) * R).cast()) };
                    }
                    let mut current = [zero; LEVELS];
                    for s in 0..LEVELS {
                        current[s] = t;
                        // SAFETY: `block` is below blocks + 2.
                        unsafe { _mm512_store_si512(tables.add(block * LEVELS + s).cast(), t) };
                        if s + 1 < LEVELS {
                            t = $max(t, $permute(t, $add(lane, number(1 << s)), next[s]));
                        }
                    }
                    next = current;
                    // SAFETY: the last table was just stored; its first and middle entries span the block.
                    unsafe {
                        let last = tables.add(block * LEVELS + LEVELS - 1).cast::<$t>();
                        *tops.add(block) = (*last).max(*last.add(R / 2));
                    }
                }
                for q in asked {
                    let home = front + q + 1; // in tables
                    let key = table(home, 0);
                    // SAFETY: tables and tops of a block and its neighbour.
                    let top = |block: usize| unsafe { (*tops.add(block)).max(*tops.add(block + 1)) };
                    if !hits[0].is_empty() {
                        let mut answer = limit;
                        let mut open: $mask = !0;
                        let rounds = (blocks - home + 1).min(around);
                        for k in 0..rounds {
                            let (near, far) = (home + k, home + k + 1);
                            if $mask_gt(open, $set1(top(near) as $lane_type), key) != 0 {
                                let mut at = $add(lane, one);
                                for s in (0..LEVELS).rev() {
                                    let m = $permute(table(near, s), at, table(far, s));
                                    at = $mask_add(at, $le(m, key), at, number(1 << s));
                                }
                                let found = $mask_gt(open, $permute(table(near, 0), at, table(far, 0)), key);
                                let steps = $add($sub(at, $add(lane, one)), number(k * R));
                                answer = $blend(found, answer, steps);
                                open &= !found;
                            }
                            // Asked in this order: the second question cannot be predicted.
                            if k + 1 < rounds && open == 0 {
                                break;
                            }
                        }
                        // SAFETY: R bytes of the row of this line.
                        unsafe {
                            $store(answers_f.as_mut_ptr().add(line * answer_stride + q * R), $min(answer, limit))
                        };
                    }
                    if !hits[1].is_empty() {
                        let mut answer = limit;
                        let mut open: $mask = !0;
                        let rounds = home.min(around);
                        for k in 0..rounds {
                            let (far, near) = (home - k - 1, home - k);
                            if $mask_gt(open, $set1(top(far) as $lane_type), key) != 0 {
                                let mut at = $add(lane, past);
                                for s in (0..LEVELS).rev() {
                                    let before = $sub(at, number(1 << s));
                                    let m = $permute(table(far, s), before, table(near, s));
                                    at = $blend($le(m, key), at, before);
                                }
                                let m = $permute(table(far, 0), $sub(at, one), table(near, 0));
                                let found = $mask_gt(open, m, key);
                                let steps = $add($sub($add(lane, past), at), number(k * R));
                                answer = $blend(found, answer, steps);
                                open &= !found;
                            }
                            if k + 1 < rounds && open == 0 {
                                break;
                            }
                        }
                        // SAFETY: as above.
                        unsafe {
                            $store(answers_b.as_mut_ptr().add(line * answer_stride + q * R), $min(answer, limit))
                        };
                    }
                }
            }
            for (hits, answers) in hits.into_iter().zip([answers_f, answers_b]) {
                if !hits.is_empty() {
                    // SAFETY: 64 rows of `answer_stride` bytes.
                    unsafe { turn_back(answers.as_ptr(), answer_stride, queries.len(), hits) };
                }
            }
        }
    };
}

search!(
    keys_u8, u8, levels 6, group 16, rounds [a b c d],
    _mm512_unpacklo_epi8, _mm512_unpackhi_epi8, _mm512_permutex2var_epi8, _mm512_max_epu8, _mm512_min_epu8,
    _mm512_set1_epi8, _mm512_add_epi8, _mm512_sub_epi8, _mm512_cmple_epu8_mask, _mm512_mask_cmpgt_epu8_mask,
    _mm512_mask_add_epi8, _mm512_mask_blend_epi8, u64, i8,
    |to: *mut u8, v| _mm512_storeu_si512(to.cast(), v)
);
search!(
    keys_u16, u16, levels 5, group 8, rounds [a b c],
    _mm512_unpacklo_epi16, _mm512_unpackhi_epi16, _mm512_permutex2var_epi16, _mm512_max_epu16, _mm512_min_epu16,
    _mm512_set1_epi16, _mm512_add_epi16, _mm512_sub_epi16, _mm512_cmple_epu16_mask, _mm512_mask_cmpgt_epu16_mask,
    _mm512_mask_add_epi16, _mm512_mask_blend_epi16, u32, i16,
    |to: *mut u8, v| _mm256_storeu_si256(to.cast(), _mm512_cvtepi16_epi8(v))
);
search!(
    keys_u32, u32, levels 4, group 4, rounds [a b],
    _mm512_unpacklo_epi32, _mm512_unpackhi_epi32, _mm512_permutex2var_epi32, _mm512_max_epu32, _mm512_min_epu32,
    _mm512_set1_epi32, _mm512_add_epi32, _mm512_sub_epi32, _mm512_cmple_epu32_mask, _mm512_mask_cmpgt_epu32_mask,
    _mm512_mask_add_epi32, _mm512_mask_blend_epi32, u16, i32,
    |to: *mut u8, v| _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(v))
);
search!(
    keys_u64, u64, levels 3, group 2, rounds [a],
    _mm512_unpacklo_epi64, _mm512_unpackhi_epi64, _mm512_permutex2var_epi64, _mm512_max_epu64, _mm512_min_epu64,
    _mm512_set1_epi64, _mm512_add_epi64, _mm512_sub_epi64, _mm512_cmple_epu64_mask, _mm512_mask_cmpgt_epu64_mask,
    _mm512_mask_add_epi64, _mm512_mask_blend_epi64, u8, i64,
    |to: *mut u8, v| _mm_storel_epi64(to.cast(), _mm512_cvtepi64_epi8(v))
);
