//! Next greater voxel by AVX-512: binary search along lines, 64 bytes of a line at once.
//!
//! A sheet is turned so that lines are contiguous. For each block of a line (one register: 64, 32, 16 or 8 keys)
//! `T_s[i]` is the greatest of the `2^s` keys from `i` on. A query that has passed `c` free planes looks up the greatest
//! of the next `2^s` with one two-register permutation and passes them all if it is not greater: log2 steps for a block
//! of reach, for all lanes at once, whatever the data. Two neighbouring blocks answer the one's queries ahead and the
//! other's behind, so that tables stay in registers where the reach is a block; where it is longer they are kept in the
//! first-level cache, and blocks further away are entered only by lanes that will meet their occluder there.

use std::arch::x86_64::*;
use std::hint::black_box;
use std::ops::Range;

use super::keys::{Key, LANES};
use super::scan::{Sheet, Spans};
use super::turn::{each, turn, turn_back};

/// Longest reach whose answers fit into the bytes that are turned back.
pub(super) const MAX_REACH: usize = u8::MAX as usize;

/// Bytes of scratch for sheets of at most `planes` planes of keys of `size` bytes, of which `queries` are asked.
pub(super) fn scratch_bytes(planes: usize, queries: usize, size: usize) -> usize {
    let lanes = 64 / size;
    let blocks = planes.div_ceil(lanes) + 2;
    let lines = LANES * (blocks | 1) * 64;
    let tables = (blocks + 2) * (6 + 1) * 64;
    let answers = 2 * LANES * (queries.div_ceil(64) | 1) * 64;
    lines + tables + answers
}

/// Answers of both senses and the lanes in which there can be any; see [`super::scan::both`]. An empty slice of hits is a sense that is not asked for.
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
) -> u64 {
    let planes = sheet.planes.len();
    assert!(reach <= MAX_REACH && queries.end <= planes);
    assert!(scratch.len() >= scratch_bytes(planes, queries.len(), size_of::<K>()));
    assert_eq!(scratch.as_ptr() as usize % 64, 0);
    assert!(hits.iter().all(|h| h.is_empty() || h.len() >= queries.len() * LANES));
    assert!(sheet.planes.iter().all(|start| start + LANES <= sheet.data.len()) && sheet.data.len() >= LANES);
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

/// The reach is less than a block, a block, or longer.
const LESS: u8 = 0;
const BLOCK: u8 = 1;
const LONGER: u8 = 2;

macro_rules! search {
    (
        $name:ident, $line:ident, $build:ident, $ahead:ident, $behind:ident, $pair:ident, $busy:ident, $t:ty,
        levels $levels:literal [$($level:literal)*] [$($lower:literal $below:literal)*], columns [$($column:literal)*],
        $permute:ident, $max:ident, $min:ident, $set1:ident, $add:ident, $sub:ident,
        $le:ident, $gt:ident, $mask_gt:ident, $eq:ident, $mask_add:ident, $blend:ident, $mask:ty, $lane_type:ty, $store:expr
    ) => {
        /// Tables of a block in a search of both senses.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        fn $build(keys: __m512i, next: &[__m512i; $levels], lane: __m512i, powers: &[__m512i; $levels]) -> [__m512i; $levels] {
            let mut t = [keys; $levels];
            $(t[$lower] = $max(t[$below], $permute(t[$below], $add(lane, powers[$below]), next[$below]));)*
            t
        }

        /// Planes passed ahead of each lane of block `near` within a block, and that a plane after the last one is not
        /// looked at unless `MODE` asks for it.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        fn $ahead<const MODE: u8>(
            key: __m512i,
            near: &[__m512i; $levels],
            far: &[__m512i; $levels],
            lane: __m512i,
            powers: &[__m512i; $levels],
        ) -> __m512i {
            let first = $add(lane, powers[0]);
            let mut at = first;
            $({
                const S: usize = $levels - 1 - $level;
                let m = $permute(near[S], at, far[S]);
                at = $mask_add(at, $le(m, key), at, powers[S]);
            })*
            if MODE != LESS {
                let m = $permute(near[0], at, far[0]);
                at = $mask_add(at, $le(m, key), at, powers[0]);
            }
            $sub(at, first)
        }

        /// The same behind each lane of block `near`, of which `far` is the one before.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        fn $behind<const MODE: u8>(
            key: __m512i,
            far: &[__m512i; $levels],
            near: &[__m512i; $levels],
            lane: __m512i,
            powers: &[__m512i; $levels],
        ) -> __m512i {
            const R: usize = 64 / size_of::<$t>();
            let from = $add(lane, $set1(R as $lane_type));
            // The place of the next table entry, as if the planes before it were not free; put right if they are.
            let mut at = from;
            $({
                const S: usize = $levels - 1 - $level;
                let place = $sub(at, powers[S]);
                let m = $permute(far[S], place, near[S]);
                at = $blend($le(m, key), at, place);
            })*
            if MODE != LESS {
                let place = $sub(at, powers[0]);
                let m = $permute(far[0], place, near[0]);
                at = $blend($le(m, key), at, place);
            }
            $sub(from, at)
        }

        /// Both searches of one pair of neighbouring blocks, ahead of `near` and behind `far`, step by step side by side:
        /// each step waits for the one before.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        fn $pair<const MODE: u8>(
            near: &[__m512i; $levels],
            far: &[__m512i; $levels],
            lane: __m512i,
            powers: &[__m512i; $levels],
        ) -> [__m512i; 2] {
            const R: usize = 64 / size_of::<$t>();
            let keys = [near[0], far[0]];
            let first = $add(lane, powers[0]);
            let from = $add(lane, $set1(R as $lane_type));
            let (mut at, mut back) = (first, from);
            $({
                const S: usize = $levels - 1 - $level;
                let place = $sub(back, powers[S]);
                let m = $permute(near[S], at, far[S]);
                let n = $permute(near[S], place, far[S]);
                at = $mask_add(at, $le(m, keys[0]), at, powers[S]);
                back = $blend($le(n, keys[1]), back, place);
            })*
            if MODE != LESS {
                let place = $sub(back, powers[0]);
                let m = $permute(near[0], at, far[0]);
                let n = $permute(near[0], place, far[0]);
                at = $mask_add(at, $le(m, keys[0]), at, powers[0]);
                back = $blend($le(n, keys[1]), back, place);
            }
            [$sub(at, first), $sub(from, back)]
        }

        /// Lines of which some query is less than some plane: only they can be occluded.
        ///
        /// # Safety
        /// 64 keys at every start.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        unsafe fn $busy(data: *const $t, starts: &[usize], queries: Range<usize>) -> u64 {
            const R: usize = 64 / size_of::<$t>();
            // SAFETY: the caller's promise.
            let row = |start: usize, column: usize| unsafe { _mm512_loadu_si512(data.add(start + column * R).cast()) };
            let mut most = each!([$($column)*] C => row(0, C));
            let mut least = each!([$($column)*] C => row(starts[queries.start], C));
            for &start in &starts[..queries.start] {
                $(most[$column] = $max(most[$column], row(start, $column));)*
            }
            for &start in &starts[queries.clone()] {
                $({
                    let v = row(start, $column);
                    most[$column] = $max(most[$column], v);
                    least[$column] = $min(least[$column], v);
                })*
            }
            for &start in &starts[queries.end..] {
                $(most[$column] = $max(most[$column], row(start, $column));)*
            }
            let mut busy = 0;
            $(busy |= ($gt(most[$column], least[$column]) as u64) << ($column * R % 64);)*
            busy
        }

        /// Answers of one line.
        ///
        /// # Safety
        /// `line` holds `blocks` blocks of keys, `tables` has room for two more, `answers` for the queries of the asked
        /// blocks from `asked.start` on (counted from block `front`); a null pointer is a sense that is not asked for.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        #[inline]
        #[allow(clippy::too_many_arguments)]
        unsafe fn $line<const MODE: u8>(
            line: *const $t,
            blocks: usize,
            front: usize,
            asked: Range<usize>,
            reach: usize,
            lane: __m512i,
            powers: &[__m512i; $levels],
            tables: *mut [__m512i; $levels],
            tops: *mut $t,
            answers: [*mut u8; 2],
        ) {
            const R: usize = 64 / size_of::<$t>();
            let zero = _mm512_setzero_si512();
            let limit = $set1(reach as $lane_type);
            let [ahead, behind] = answers;
            let (lo, hi) = (front + asked.start, front + asked.end);
            // SAFETY: a block of the line.
            let block = |b: usize| unsafe { _mm512_loadu_si512(line.add(b * R).cast()) };
            let store = |to: *mut u8, b: usize, v: __m512i| {
                // SAFETY: R bytes for the queries of an asked block.
                unsafe { $store(to.add((b - front) * R), $min(v, limit)) }
            };
            if MODE != LONGER {
                let mut near = [zero; $levels];
                if hi < blocks {
                    near = $build(block(hi), &near, lane, powers);
                }
                for b in (lo..hi).rev() {
                    let far = near;
                    near = $build(block(b), &far, lane, powers);
                    if !ahead.is_null() && !behind.is_null() && b + 1 < hi {
                        let [a, c] = $pair::<MODE>(&near, &far, lane, powers);
                        store(ahead, b, a);
                        store(behind, b + 1, c);
                        continue;
                    }
                    if !ahead.is_null() {
                        store(ahead, b, $ahead::<MODE>(near[0], &near, &far, lane, powers));
                    }
                    if !behind.is_null() && b + 1 < hi {
                        store(behind, b + 1, $behind::<MODE>(far[0], &near, &far, lane, powers));
                    }
                }
                if !behind.is_null() {
                    // Tables of the block before the line look into its first.
                    let far = $build(if lo > 0 { block(lo - 1) } else { zero }, &near, lane, powers);
                    store(behind, lo, $behind::<MODE>(near[0], &far, &near, lane, powers));
                }
                return;
            }
            // Blocks are counted from one that stands before the line. `tops` has the greatest of R keys from each on.
            let around = reach.div_ceil(R);
            let lowest = (lo + 1).saturating_sub(around);
            let highest = (hi + around).min(blocks + 1);
            let mut next = [zero; $levels];
            for b in (lowest..=highest).rev() {
                let keys = if b > 0 && b <= blocks { block(b - 1) } else { zero };
                let t = $build(keys, &next, lane, powers);
                let top = $max(t[$levels - 1], $permute(t[$levels - 1], $add(lane, powers[$levels - 1]), next[$levels - 1]));
                // SAFETY: one of blocks + 2 blocks.
                unsafe {
                    *tables.add(b) = t;
                    _mm512_store_si512(tops.add(b * R).cast(), top);
                }
                next = t;
            }
            // SAFETY: tables of one of blocks + 2 blocks.
            let table = |b: usize| unsafe { &*tables.add(b) };
            for b in lo..hi {
                let home = b + 1;
                let key = table(home)[0];
                if !ahead.is_null() {
                    let mut passed = $ahead::<MODE>(key, table(home), table(home + 1), lane, powers);
                    let mut open: $mask = $eq(passed, $set1(R as $lane_type));
                    for k in 1..around.min(blocks + 1 - home) {
                        // SAFETY: the keys from one after each lane on, in this block and the next.
                        let top = unsafe { _mm512_loadu_si512(tops.add((home + k) * R + 1).cast()) };
                        let here = $mask_gt(open, top, key);
                        if here != 0 {
                            let more = $ahead::<LESS>(key, table(home + k), table(home + k + 1), lane, powers);
                            passed = $blend(here, passed, $add(more, $set1((k * R) as $lane_type)));
                            open &= !here;
                        }
                    }
                    store(ahead, b, $blend(open, passed, limit));
                }
                if !behind.is_null() {
                    let mut passed = $behind::<MODE>(key, table(home - 1), table(home), lane, powers);
                    let mut open: $mask = $eq(passed, $set1(R as $lane_type));
                    for k in 1..around.min(home) {
                        // SAFETY: the keys from R before each lane on.
                        let top = unsafe { _mm512_load_si512(tops.add((home - k - 1) * R).cast()) };
                        let here = $mask_gt(open, top, key);
                        if here != 0 {
                            let more = $behind::<LESS>(key, table(home - k - 1), table(home - k), lane, powers);
                            passed = $blend(here, passed, $add(more, $set1((k * R) as $lane_type)));
                            open &= !here;
                        }
                    }
                    store(behind, b, $blend(open, passed, limit));
                }
            }
        }

        /// # Safety
        /// As [`next_greater`], with 64 keys at each of `starts` in `data`, and zeros at 0.
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
        unsafe fn $name(
            data: *const $t,
            starts: &[usize],
            spans: &Spans,
            queries: Range<usize>,
            reach: usize,
            hits: [&mut [u8]; 2],
            scratch: &mut [u8],
        ) -> u64 {
            /// Keys of a register, and of a block of a line.
            const R: usize = 64 / size_of::<$t>();
            // SAFETY: the caller's promise.
            let busy = unsafe { $busy(data, starts, queries.clone()) };
            if busy == 0 || reach == 0 {
                hits.into_iter().for_each(|hits| hits.fill(reach as u8));
                return if reach == 0 { 0 } else { busy };
            }
            let planes = starts.len();
            // Blocks are counted so that the first query starts one.
            let front = queries.start.div_ceil(R);
            let blocks = front + (planes - queries.start).div_ceil(R);
            let stride = (blocks | 1) * R;
            let answer_stride = (queries.len().div_ceil(64) | 1) * 64;
            let (lines, rest) = scratch.split_at_mut(LANES * stride * size_of::<$t>());
            let (tables, rest) = rest.split_at_mut((blocks + 2) * $levels * 64);
            let (tops, rest) = rest.split_at_mut((blocks + 2) * 64);
            let (answers_f, answers_b) = rest.split_at_mut(LANES * answer_stride);
            assert!(answers_b.len() >= LANES * answer_stride);
            let lines = lines.as_mut_ptr().cast::<$t>();
            let (tables, tops) = (tables.as_mut_ptr().cast::<[__m512i; $levels]>(), tops.as_mut_ptr().cast::<$t>());

            // Position p of a line is plane p + queries.start - front * R.
            let offset = queries.start as isize - (front * R) as isize;
            for block in 0..blocks {
                let first = (block * R) as isize + offset;
                let mut rows = [0; LANES];
                for (i, row) in rows[..R].iter_mut().enumerate() {
                    // A plane before the first is a huge number.
                    *row = starts.get((first + i as isize) as usize).copied().unwrap_or(0);
                }
                // SAFETY: 64 keys at each row, and room for the block in each line.
                unsafe {
                    let to = lines.add(block * R).cast::<u8>();
                    turn(size_of::<$t>(), data.cast(), &rows, to, stride * size_of::<$t>());
                }
            }

            let mut counting = [0 as $t; R];
            counting.iter_mut().enumerate().for_each(|(i, v)| *v = i as $t);
            // SAFETY: 64 bytes.
            let lane = unsafe { _mm512_loadu_si512(counting.as_ptr().cast()) };
            // The compiler would make two instructions of an addition of 1 under a mask if it knew.
            let powers = black_box(each!([$($level)*] S => $set1(1 << S)));
            let to = [!hits[0].is_empty(), !hits[1].is_empty()];
            for line in 0..LANES {
                let [from, end] = spans[line].map(|query| (query as usize).min(queries.len()));
                if from >= end {
                    for answers in [&mut *answers_f, &mut *answers_b] {
                        answers[line * answer_stride..][..answer_stride].fill(reach as u8);
                    }
                    continue;
                }
                let asked = from / R..end.div_ceil(R);
                let place = |way: usize, answers: &mut [u8]| match to[way] {
                    true => answers[line * answer_stride..][..answer_stride].as_mut_ptr(),
                    false => std::ptr::null_mut(),
                };
                let unasked = [0..asked.start * R, (asked.end * R).min(answer_stride)..answer_stride];
                for answers in [&mut *answers_f, &mut *answers_b] {
                    let line = &mut answers[line * answer_stride..][..answer_stride];
                    unasked.iter().for_each(|part| line[part.clone()].fill(reach as u8));
                }
                let answers = [place(0, answers_f), place(1, answers_b)];
                if busy >> line & 1 == 0 {
                    for to in answers.into_iter().filter(|to| !to.is_null()) {
                        // SAFETY: the answers of a line.
                        unsafe { to.add(asked.start * R).write_bytes(reach as u8, asked.len() * R) };
                    }
                    continue;
                }
                // SAFETY: a line of `blocks` blocks, tables for two more, answers for the asked blocks.
                unsafe {
                    let line = lines.add(line * stride);
                    match reach {
                        0..R => $line::<LESS>(line, blocks, front, asked, reach, lane, &powers, tables, tops, answers),
                        R => $line::<BLOCK>(line, blocks, front, asked, reach, lane, &powers, tables, tops, answers),
                        _ => $line::<LONGER>(line, blocks, front, asked, reach, lane, &powers, tables, tops, answers),
                    }
                }
            }
            for (hits, answers) in hits.into_iter().zip([answers_f, answers_b]) {
                if !hits.is_empty() {
                    // SAFETY: 64 rows of `answer_stride` bytes.
                    unsafe { turn_back(answers.as_ptr(), answer_stride, queries.len(), hits) };
                }
            }
            busy
        }
    };
}

search!(
    keys_u8, line_u8, build_u8, ahead_u8, behind_u8, pair_u8, busy_u8, u8,
    levels 6 [0 1 2 3 4 5] [1 0 2 1 3 2 4 3 5 4], columns [0],
    _mm512_permutex2var_epi8, _mm512_max_epu8, _mm512_min_epu8,
    _mm512_set1_epi8, _mm512_add_epi8, _mm512_sub_epi8, _mm512_cmple_epu8_mask, _mm512_cmpgt_epu8_mask,
    _mm512_mask_cmpgt_epu8_mask, _mm512_cmpeq_epu8_mask,
    _mm512_mask_add_epi8, _mm512_mask_blend_epi8, u64, i8,
    |to: *mut u8, v| _mm512_storeu_si512(to.cast(), v)
);
search!(
    keys_u16, line_u16, build_u16, ahead_u16, behind_u16, pair_u16, busy_u16, u16,
    levels 5 [0 1 2 3 4] [1 0 2 1 3 2 4 3], columns [0 1],
    _mm512_permutex2var_epi16, _mm512_max_epu16, _mm512_min_epu16,
    _mm512_set1_epi16, _mm512_add_epi16, _mm512_sub_epi16, _mm512_cmple_epu16_mask, _mm512_cmpgt_epu16_mask,
    _mm512_mask_cmpgt_epu16_mask, _mm512_cmpeq_epu16_mask,
    _mm512_mask_add_epi16, _mm512_mask_blend_epi16, u32, i16,
    |to: *mut u8, v| _mm256_storeu_si256(to.cast(), _mm512_cvtepi16_epi8(v))
);
search!(
    keys_u32, line_u32, build_u32, ahead_u32, behind_u32, pair_u32, busy_u32, u32,
    levels 4 [0 1 2 3] [1 0 2 1 3 2], columns [0 1 2 3],
    _mm512_permutex2var_epi32, _mm512_max_epu32, _mm512_min_epu32,
    _mm512_set1_epi32, _mm512_add_epi32, _mm512_sub_epi32, _mm512_cmple_epu32_mask, _mm512_cmpgt_epu32_mask,
    _mm512_mask_cmpgt_epu32_mask, _mm512_cmpeq_epu32_mask,
    _mm512_mask_add_epi32, _mm512_mask_blend_epi32, u16, i32,
    |to: *mut u8, v| _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(v))
);
search!(
    keys_u64, line_u64, build_u64, ahead_u64, behind_u64, pair_u64, busy_u64, u64,
    levels 3 [0 1 2] [1 0 2 1], columns [0 1 2 3 4 5 6 7],
    _mm512_permutex2var_epi64, _mm512_max_epu64, _mm512_min_epu64,
    _mm512_set1_epi64, _mm512_add_epi64, _mm512_sub_epi64, _mm512_cmple_epu64_mask, _mm512_cmpgt_epu64_mask,
    _mm512_mask_cmpgt_epu64_mask, _mm512_cmpeq_epu64_mask,
    _mm512_mask_add_epi64, _mm512_mask_blend_epi64, u8, i64,
    |to: *mut u8, v| _mm_storel_epi64(to.cast(), _mm512_cvtepi64_epi8(v))
);
