//! Next greater voxel on each line of a sheet: a block of 64 parallel lines, one row of 64 keys per plane.

use std::ops::Range;

use super::keys::{Key, LANES};
use crate::kernel::simd::Level;

/// Steps without an occluder, per query: small enough to be stored for two senses of a sheet.
pub(super) trait Hit: Copy + Default + Send + Sync + 'static {
    fn of(steps: usize) -> Self;
    fn steps(self) -> usize;
    /// The same slice if answers are bytes, else an empty one.
    fn bytes(answers: &mut [Self]) -> &mut [u8];
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
    fn bytes(_: &mut [u32]) -> &mut [u8] {
        &mut []
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

/// For each lane the queries that are wanted, from and to, counted from the first; answers of others may be anything.
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

/// Reach times bytes of a key up to which brute force beats the stack: it costs about 1/100 ns per step and byte, the
/// stack 5 to 10 ns.
#[cfg(target_arch = "x86_64")]
const BRUTE: usize = 768;

/// Answers of both senses (growing plane numbers first); an empty slice of hits is a sense that is not asked for.
/// `rows` and `stack` have room for the planes, `turned` for what the AVX-512 search asks.
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
) {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 && size_of::<H>() == 1 {
        let hits = hits.map(H::bytes);
        // SAFETY: the level says that the CPU has AVX-512.
        return unsafe { super::wide::next_greater(sheet, spans, queries, reach, hits, turned) };
    }
    let _ = (turned, spans);
    let rows = &mut rows[..sheet.planes.len() * LANES];
    sheet.copy_to(rows);
    for (way, hits) in hits.into_iter().enumerate() {
        if hits.is_empty() {
            continue;
        }
        #[cfg(target_arch = "x86_64")]
        if size_of::<H>() == 1 && reach * size_of::<K>() <= BRUTE {
            let bytes = H::bytes(&mut *hits);
            if super::narrow::brute(level, rows, queries.clone(), reach, way == 0, bytes) {
                continue;
            }
        }
        stacked(rows, queries.clone(), reach, way == 0, hits, stack);
    }
}
