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
}

/// Queries that share one pass over the planes ahead.
const QUERIES: usize = 4;
/// Steps between two looks at whether all queries are answered, and at most what a `u8` key can count.
const BURST: usize = 16;

/// For each query plane in `queries` and each lane: `hits` gets the number of planes before the first one ahead with a
/// greater key, or `reach` where there is none within `reach` planes or inside the sheet.
///
/// `sheet` holds planes of [`LANES`] keys; `ahead` says whether lines go to growing plane numbers. `L` divides [`LANES`].
#[inline(always)]
pub(super) fn brute<K: Key, H: Hit, const L: usize>(
    sheet: &[K],
    queries: Range<usize>,
    reach: usize,
    ahead: bool,
    hits: &mut [H],
) {
    let planes = sheet.len() / LANES;
    for (group, out) in hits.chunks_mut(QUERIES * LANES).enumerate() {
        let first = queries.start + group * QUERIES;
        if first >= queries.end {
            break;
        }
        let count = QUERIES.min(queries.end - first);
        for lane in (0..LANES).step_by(L) {
            if count == QUERIES {
                burst::<K, H, L, QUERIES>(sheet, planes, first, lane, reach, ahead, out);
            } else {
                for q in 0..count {
                    burst::<K, H, L, 1>(sheet, planes, first + q, lane, reach, ahead, &mut out[q * LANES..]);
                }
            }
        }
    }
}

/// `Q` query planes from `first` on, lanes `lane..lane + L`.
#[inline(always)]
fn burst<K: Key, H: Hit, const L: usize, const Q: usize>(
    sheet: &[K],
    planes: usize,
    first: usize,
    lane: usize,
    reach: usize,
    ahead: bool,
    out: &mut [H],
) {
    let row = |plane: usize| -> &[K; L] { sheet[plane * LANES + lane..][..L].first_chunk().unwrap() };
    let query: [[K; L]; Q] = std::array::from_fn(|q| *row(first + q));
    let mut alive = [[K::MAX; L]; Q];
    let mut total = [[H::default(); L]; Q];
    // Planes that every query of the group can look at, then those left to single ones.
    let room = |q: usize| if ahead { planes - 1 - (first + q) } else { first + q };
    let common = if ahead { room(Q - 1) } else { room(0) }.min(reach);
    let mut done = 0;
    while done < common {
        let steps = BURST.min(common - done);
        let mut count = [[K::ZERO; L]; Q];
        for j in done + 1..=done + steps {
            for q in 0..Q {
                let r = row(if ahead { first + q + j } else { first + q - j });
                for l in 0..L {
                    alive[q][l] = if r[l] > query[q][l] { K::ZERO } else { alive[q][l] };
                    count[q][l] = count[q][l].wrapping_add(alive[q][l].and(K::ONE));
                }
            }
        }
        done += steps;
        let mut any = K::ZERO;
        for q in 0..Q {
            for l in 0..L {
                total[q][l] = H::of(total[q][l].steps() + count[q][l].to_usize());
                any = any.max(alive[q][l]);
            }
        }
        if any == K::ZERO {
            break;
        }
    }
    for q in 0..Q {
        for l in 0..L {
            let mut steps = total[q][l].steps();
            if alive[q][l] != K::ZERO {
                let more = |j: &usize| {
                    let plane = if ahead { first + q + j } else { first + q - j };
                    sheet[plane * LANES + lane + l] > query[q][l]
                };
                steps = (common + 1..=room(q).min(reach)).find(more).map_or(reach, |j| j - 1);
            }
            out[q * LANES + lane + l] = H::of(steps);
        }
    }
}

/// The same by a stack of candidates per line: time per voxel is bounded for any reach and any data.
/// `stack` holds at least one entry per plane.
#[inline(always)]
pub(super) fn stacked<K: Key, H: Hit>(
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

/// Answers of both senses (growing plane numbers first); an empty slice of hits is a sense that is not asked for.
pub(super) fn both<K: Key, H: Hit>(
    level: Level,
    sheet: &[K],
    queries: Range<usize>,
    reach: usize,
    hits: [&mut [H]; 2],
    stack: &mut [u32],
    turned: &mut [u8],
) {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 && size_of::<H>() == 1 {
        let hits = hits.map(H::bytes);
        // SAFETY: the level says that the CPU has AVX-512.
        return unsafe { super::wide::next_greater(sheet, queries, reach, hits, turned) };
    }
    let _ = turned;
    for (way, hits) in hits.into_iter().enumerate() {
        if !hits.is_empty() {
            next_greater(level, sheet, queries.clone(), reach, way == 0, hits, stack);
        }
    }
}

crate::multiversion! {
    /// Chooses between the two; see [`brute`] for the arguments.
    pub(super) fn next_greater[K: Key, H: Hit](
        sheet: &[K], queries: Range<usize>, reach: usize, ahead: bool, hits: &mut [H], stack: &mut [u32]
    ) -> () = next_greater_inner;
}

/// Chooses between the two: brute force costs about 1/100 ns per step and byte of a key, the stack about 10 ns.
#[inline(always)]
fn next_greater_inner<K: Key, H: Hit>(
    sheet: &[K],
    queries: Range<usize>,
    reach: usize,
    ahead: bool,
    hits: &mut [H],
    stack: &mut [u32],
) {
    let planes = sheet.len() / LANES;
    if reach.min(planes) * size_of::<K>() > 1024 {
        return stacked(sheet, queries, reach, ahead, hits, stack);
    }
    match size_of::<K>() {
        1 => brute::<K, H, 64>(sheet, queries, reach, ahead, hits),
        2 => brute::<K, H, 32>(sheet, queries, reach, ahead, hits),
        4 => brute::<K, H, 16>(sheet, queries, reach, ahead, hits),
        _ => brute::<K, H, 8>(sheet, queries, reach, ahead, hits),
    }
}
