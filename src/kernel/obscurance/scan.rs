//! Next greater voxel on each line of a sheet: a block of 64 parallel lines, one row of 64 keys per plane.

use std::ops::Range;

use super::keys::{Key, LANES};
use crate::kernel::simd::Level;
use crate::multiversion;

/// Steps without an occluder, per query: small enough to be stored for two senses of a sheet.
pub(super) trait Hit: Copy + Default + Send + Sync + 'static {
    fn of(steps: usize) -> Self;
    fn steps(self) -> usize;
    /// As many bytes in the place of the answers, to be followed by [`Self::widen`].
    fn bytes(answers: &mut [Self]) -> &mut [u8];
    /// Turns the bytes of [`Self::bytes`] into answers.
    fn widen(answers: &mut [Self]);
    /// The same slice if answers are bytes.
    fn as_bytes(answers: &[Self]) -> Option<&[u8]>;
}

impl Hit for u8 {
    #[inline(always)]
    fn of(steps: usize) -> Self {
        steps as u8
    }
    #[inline(always)]
    fn steps(self) -> usize {
        self as usize
    }
    fn bytes(answers: &mut [u8]) -> &mut [u8] {
        answers
    }
    fn widen(_: &mut [u8]) {}
    #[inline(always)]
    fn as_bytes(answers: &[u8]) -> Option<&[u8]> {
        Some(answers)
    }
}

impl Hit for u32 {
    #[inline(always)]
    fn of(steps: usize) -> Self {
        steps as u32
    }
    #[inline(always)]
    fn steps(self) -> usize {
        self as usize
    }
    fn bytes(answers: &mut [u32]) -> &mut [u8] {
        let n = answers.len();
        &mut bytemuck::cast_slice_mut(answers)[..n]
    }
    fn widen(answers: &mut [u32]) {
        for i in (0..answers.len()).rev() {
            // Byte i lies in a word that is still to be written, or in this one.
            answers[i] = answers[i / 4].to_ne_bytes()[i % 4] as u32;
        }
    }
    fn as_bytes(_: &[u32]) -> Option<&[u8]> {
        None
    }
}

/// For each query plane in `queries` and each lane: `hits` gets the number of planes before the first one ahead with a
/// greater key, or `reach` where there is none within `reach` planes or inside the sheet. `ahead` says whether lines go
/// to growing plane numbers.
///
/// By a stack of candidates per line: time per voxel is bounded for any reach and any data. `stack` holds at least one
/// entry per plane.
fn stacked<K: Key, H: Hit>(
    sheet: &[K],
    queries: Range<usize>,
    reach: usize,
    ahead: bool,
    hits: &mut [H],
    stack: &mut [u32],
) {
    let planes = sheet.len() / LANES;
    for lane in 0..LANES {
        let mut top = 0;
        for step in 0..planes {
            // Planes ahead of a query are visited before it.
            let plane = if ahead { planes - 1 - step } else { step };
            let key = sheet[plane * LANES + lane];
            while top > 0 && sheet[stack[top - 1] as usize * LANES + lane] <= key {
                top -= 1;
            }
            if queries.contains(&plane) {
                let distance = if top > 0 { plane.abs_diff(stack[top - 1] as usize) } else { usize::MAX };
                let steps = if distance <= reach { distance - 1 } else { reach };
                hits[(plane - queries.start) * LANES + lane] = H::of(steps);
            }
            stack[top] = plane as u32;
            top += 1;
        }
    }
}

/// For each lane the queries that are wanted, from and to, counted from the first; others are answered, or open.
pub(super) type Spans = [[u32; 2]; LANES];

/// Planes of 64 keys, where they stand in a padded volume.
#[derive(Clone, Copy)]
pub(super) struct Sheet<'a, K> {
    pub data: &'a [K],
    /// Start of each plane in `data`; 0 is a place of zeros.
    pub planes: &'a [usize],
}

impl<K: Key> Sheet<'_, K> {
    /// Copies the planes into consecutive rows.
    pub fn copy_to(&self, rows: &mut [K]) {
        let (rows, _) = rows.as_chunks_mut::<LANES>();
        for (row, &start) in rows.iter_mut().zip(self.planes) {
            *row = *self.data[start..].first_chunk().expect("a plane has 64 keys");
        }
    }
}

/// Reach times bytes of a key up to which brute force (AVX2, SSE2) beats the stack: it costs about 1/100 ns per step and
/// byte, the stack 10 to 18 ns (2-core Zen 4 VM, 2026-11-23).
#[cfg(target_arch = "x86_64")]
const BRUTE: usize = 768;

/// Answers of both senses (growing plane numbers first); an empty slice of hits is a sense that is not asked for.
/// `rows` and `stack` have room for the planes, `turned` for what the AVX-512 search asks. Returns the lanes in which some
/// query is less than some plane: all others are open.
#[allow(clippy::too_many_arguments)]
pub(super) fn both<K: Key, H: Hit>(
    level: Level,
    sheet: Sheet<K>,
    spans: &Spans,
    queries: Range<usize>,
    reach: usize,
    hits: [&mut [H]; 2],
    rows: &mut [K],
    stack: &mut [u32],
    turned: &mut [u8],
) -> u64 {
    #[cfg(target_arch = "x86_64")]
    {
        let short = reach.min(SHORT);
        let mut hits = hits;
        if reach - short <= BEYOND
            && let Some(busy) = short_answers(level, sheet, spans, queries.clone(), short, &mut hits, rows, turned)
        {
            for (way, hits) in hits.into_iter().enumerate() {
                H::widen(hits);
                if reach > short && !hits.is_empty() {
                    beyond(sheet, queries.clone(), short, reach, way == 0, hits);
                }
            }
            return busy;
        }
        stacks(level, sheet, queries, reach, hits, rows, stack)
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        let _ = (spans, turned);
        stacks(level, sheet, queries, reach, hits, rows, stack)
    }
}

/// [`both`] by stacks.
fn stacks<K: Key, H: Hit>(
    level: Level,
    sheet: Sheet<K>,
    queries: Range<usize>,
    reach: usize,
    hits: [&mut [H]; 2],
    rows: &mut [K],
    stack: &mut [u32],
) -> u64 {
    let rows = &mut rows[..sheet.planes.len() * LANES];
    sheet.copy_to(rows);
    let busy = busy(level, rows, queries.clone());
    for (way, hits) in hits.into_iter().enumerate().filter(|(_, hits)| !hits.is_empty()) {
        match busy {
            0 => hits.fill(H::of(reach)),
            _ => stacked(rows, queries.clone(), reach, way == 0, hits, stack),
        }
    }
    busy
}

multiversion! {
    /// Lanes of consecutive rows of 64 keys in which some query is less than some plane.
    fn busy[K: Key](rows: &[K], queries: Range<usize>) -> u64 = busy_lanes;
}

#[inline(always)]
fn busy_lanes<K: Key>(rows: &[K], queries: Range<usize>) -> u64 {
    let (rows, _) = rows.as_chunks::<LANES>();
    let (mut most, mut least) = ([K::ZERO; LANES], [K::MAX; LANES]);
    for row in rows {
        most.iter_mut().zip(row).for_each(|(m, k)| *m = (*m).max(*k));
    }
    for row in &rows[queries] {
        least.iter_mut().zip(row).for_each(|(m, k)| *m = (*m).min(*k));
    }
    (0..LANES).fold(0, |busy, lane| busy | u64::from(most[lane] > least[lane]) << lane)
}

/// Longest reach whose answers are bytes.
#[cfg(target_arch = "x86_64")]
const SHORT: usize = u8::MAX as usize;
/// Planes after those that are looked at one by one, for the lanes that found nothing: `max_distance = 256` needs one.
#[cfg(target_arch = "x86_64")]
const BEYOND: usize = 8;

/// [`both`] by vectors, with answers left as bytes; `None` if there is no kernel for it and nothing was done.
#[cfg(target_arch = "x86_64")]
#[allow(clippy::too_many_arguments)]
fn short_answers<K: Key, H: Hit>(
    level: Level,
    sheet: Sheet<K>,
    spans: &Spans,
    queries: Range<usize>,
    reach: usize,
    hits: &mut [&mut [H]; 2],
    rows: &mut [K],
    turned: &mut [u8],
) -> Option<u64> {
    if level == Level::Avx512 {
        let hits = hits.each_mut().map(|h| H::bytes(h));
        // SAFETY: the level says that the CPU has AVX-512.
        return Some(unsafe { super::wide::next_greater(sheet, spans, queries, reach, hits, turned) });
    }
    if reach * size_of::<K>() > BRUTE {
        return None;
    }
    let rows = &mut rows[..sheet.planes.len() * LANES];
    sheet.copy_to(rows);
    let busy = busy(level, rows, queries.clone());
    // Lanes that somebody asks for and that can be occluded.
    let live = spans.iter().enumerate().fold(busy, |m, (lane, [from, end])| m & !(u64::from(from >= end) << lane));
    let asked = hits.iter_mut().enumerate().filter(|(_, hits)| !hits.is_empty());
    // A kernel is there for both senses or for none.
    let done = asked.fold(true, |all, (way, hits)| {
        all && super::narrow::brute(level, rows, live, queries.clone(), reach, way == 0, H::bytes(hits))
    });
    done.then_some(busy)
}

/// Goes on from `short` to `reach` planes for the lanes that are open so far.
#[cfg(target_arch = "x86_64")]
fn beyond<K: Key, H: Hit>(
    sheet: Sheet<K>,
    queries: Range<usize>,
    short: usize,
    reach: usize,
    ahead: bool,
    hits: &mut [H],
) {
    for (query, hits) in queries.zip(hits.chunks_exact_mut(LANES)) {
        let plane = |steps: usize| {
            let plane = if ahead { query + steps + 1 } else { query.wrapping_sub(steps + 1) };
            sheet.planes.get(plane).map(|&start| &sheet.data[start..start + LANES])
        };
        let keys = &sheet.data[sheet.planes[query]..][..LANES];
        for (lane, hit) in hits.iter_mut().enumerate().filter(|(_, hit)| hit.steps() == short) {
            let greater = |steps: &usize| plane(*steps).is_some_and(|keys_there| keys_there[lane] > keys[lane]);
            *hit = H::of((short..reach).find(greater).unwrap_or(reach));
        }
    }
}
