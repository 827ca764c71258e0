//! Walks the lines of every direction: families, tiles, sheets and senses. Knows nothing of what is accumulated.
//!
//! Lines become columns of rows of 64 voxels: plane `i` of a sheet holds the voxels `[s_b + D_b(i), s_c + D_c(i)..]`, so
//! one copy of a sheet into the first-level cache serves both senses, and a step along 64 lines is one row. Directions
//! dominated by x run on a copy with x and z exchanged.

use super::contribute;
use super::keys::{Key, LANES, Volume};
use super::lines::{Family, displacement};
use super::scan::{self, Hit, Sheet, Spans};
use super::sinks::{Piece, Sink, Visit};
use crate::grid::Region;
use crate::kernel::simd::Level;

/// Natural axis of each frame axis, for frames whose lines run along z or y, and along x.
pub(super) const FRAMES: [[usize; 3]; 2] = [[0, 1, 2], [2, 1, 0]];

/// A box with its axes in the order of a frame.
pub(super) fn in_frame(r: Region, perm: [usize; 3]) -> Region {
    Region::new(perm.map(|a| r.lo[a]), perm.map(|a| r.hi[a]))
}

/// Working memory of a sweep, apart from keys and sums.
pub(super) struct Buffers<'a, K> {
    /// Planes of a sheet: those of the tile and the reach on both sides.
    pub sheet: &'a mut [K],
    /// Answers of both senses for the planes of the tile, in bytes.
    pub hits: [&'a mut [u32]; 2],
    /// One entry per plane of a sheet.
    pub stack: &'a mut [u32],
    /// Where the planes of a sheet stand.
    pub starts: &'a mut [usize],
    /// For the AVX-512 search.
    pub turned: &'a mut [u8],
    /// One entry per plane of the source.
    pub shifts: [&'a mut [i32]; 2],
    /// One entry per answer.
    pub tables: [&'a mut [u32]; 2],
}

/// Planes that a family looks ahead in a source of `extent` planes.
pub(super) fn reach_in(family: &Family, extent: usize) -> usize {
    family.reach.min(extent.saturating_sub(1))
}

/// Sweeps both senses of one family over `tile` (natural order), reading the keys of the family's frame and looking
/// `reach` planes ahead (at most [`reach_in`]).
pub(super) fn sweep_family<K: Key, S: Sink>(
    level: Level,
    family: &Family,
    reach: usize,
    volume: Volume<K>,
    tile: Region,
    buffers: &mut Buffers<K>,
    sink: &mut S,
) {
    let perm = FRAMES[usize::from(family.axis == 2)];
    let axis = usize::from(family.axis == 1);
    let planes = volume.region.shape()[axis];
    let origin = volume.region.lo[axis];
    let Buffers { sheet, hits, stack, starts, turned, shifts, tables } = buffers;
    for (shift, slope) in shifts.iter_mut().zip([family.slope[perm[1 - axis]], family.slope[perm[2]]]) {
        for (i, s) in shift[..planes].iter_mut().enumerate() {
            *s = displacement(slope, origin + i as i64) as i32;
        }
    }
    for (table, sense) in tables.iter_mut().zip(&family.senses) {
        if let Some(sense) = sense {
            table[..reach].copy_from_slice(&sense.table[..reach]);
            table[reach] = sense.table[family.reach];
        }
    }
    let mut bytes = [[[0; 256]; 3]; 2];
    contribute::split([&tables[0][..=reach], &tables[1][..=reach]], &mut bytes);
    let visit = Visit {
        bytes: &bytes,
        family,
        perm,
        reach,
        tables: [&tables[0][..=reach], &tables[1][..=reach]],
        shifts: [&shifts[0][..planes], &shifts[1][..planes]],
        origin,
    };
    let mut room = Room { rows: sheet, stack, starts, turned };
    let job = Job { volume, tile: in_frame(tile, perm), axis, visit };
    let [forward, backward] = hits;
    if reach <= u8::MAX as usize {
        run::<K, u8, S>(level, &job, [bytes_of(forward), bytes_of(backward)], &mut room, sink);
    } else {
        run::<K, u32, S>(level, &job, [forward, backward], &mut room, sink);
    }
}

fn bytes_of(words: &mut [u32]) -> &mut [u8] {
    // SAFETY: four bytes per word, without padding and without alignment; every bit pattern is valid for both.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), words.len() * 4) }
}

struct Job<'a, K> {
    volume: Volume<'a, K>,
    /// In frame order.
    tile: Region,
    /// Frame axis along which the lines run.
    axis: usize,
    visit: Visit<'a>,
}

/// Parts of [`Buffers`] that the search needs.
struct Room<'a, K> {
    rows: &'a mut [K],
    stack: &'a mut [u32],
    starts: &'a mut [usize],
    turned: &'a mut [u8],
}

/// Planes `i` (counted from the source's first) in `of` at which `lo <= start + shift[i] < hi`; `shift` is monotone.
#[inline(always)]
fn planes_inside(shift: &[i32], of: std::ops::Range<usize>, start: i64, lo: i64, hi: i64) -> std::ops::Range<usize> {
    let part = &shift[of.clone()];
    let at = |s: i32| start + s as i64;
    let rising = part.first() <= part.last();
    let from = part.partition_point(|&s| if rising { at(s) < lo } else { at(s) >= hi });
    let to = part.partition_point(|&s| if rising { at(s) < hi } else { at(s) >= lo });
    of.start + from..of.start + to.max(from)
}

/// Least and largest of the ends of a monotone slice. Panics if it is empty.
#[inline(always)]
fn span(shift: &[i32]) -> (i64, i64) {
    let (a, b) = (shift[0] as i64, shift[shift.len() - 1] as i64);
    (a.min(b), a.max(b))
}

fn run<K: Key, H: Hit, S: Sink>(level: Level, job: &Job<K>, hits: [&mut [H]; 2], room: &mut Room<K>, sink: &mut S) {
    let Job { volume, tile, axis, visit } = job;
    let (a, b) = (*axis, 1 - *axis);
    let origin = volume.region.lo[a];
    let whole = (tile.lo[a] - origin) as usize..(tile.hi[a] - origin) as usize;
    let [shift_b, shift_c] = visit.shifts;
    let (least, most) = span(&shift_b[whole.clone()]);
    let [forward, backward] = hits;
    for s_b in tile.lo[b] - most..tile.hi[b] - least {
        let inside = planes_inside(shift_b, whole.clone(), s_b, tile.lo[b], tile.hi[b]);
        if inside.is_empty() {
            continue;
        }
        let (least, most) = span(&shift_c[inside.clone()]);
        for s_c in (tile.lo[2] - most..tile.hi[2] - least).step_by(LANES) {
            let last = LANES as i64 - 1;
            let queries = planes_inside(shift_c, inside.clone(), s_c, tile.lo[2] - last, tile.hi[2]);
            if queries.is_empty() {
                continue;
            }
            let first = queries.start.saturating_sub(visit.reach);
            let end = (queries.end + visit.reach).min(shift_b.len());
            let starts = &mut room.starts[..end - first];
            place(volume, a, shift_b, shift_c, [s_b, s_c], first, starts);
            let sheet = Sheet { data: volume.data(), planes: starts };
            let count = queries.len() * LANES;
            let local = queries.start - first..queries.end - first;
            let mut answers: [&mut [H]; 2] = [&mut [], &mut []];
            for (way, hits) in [&mut *forward, &mut *backward].into_iter().enumerate() {
                if visit.family.senses[way].is_some() {
                    answers[way] = &mut hits[..count];
                }
            }
            let piece_of = |plane: usize| {
                let start = s_c + shift_c[plane] as i64;
                let mut at = [0, 0, start.max(tile.lo[2])];
                at[a] = origin + plane as i64;
                at[b] = s_b + shift_b[plane] as i64;
                (Piece { at, axis: a }, start)
            };
            queries.clone().for_each(|plane| sink.expect(visit, &piece_of(plane).0));
            let spans = spans(&shift_c[queries.clone()], s_c, tile);
            let asked = answers.each_mut().map(|a| &mut **a);
            scan::both(level, sheet, &spans, local, visit.reach, asked, room.rows, room.stack, room.turned);
            for (row, plane) in queries.enumerate() {
                let (piece, start) = piece_of(plane);
                let (lo, hi) = (piece.at[2], (start + LANES as i64).min(tile.hi[2]));
                if lo >= hi {
                    continue;
                }
                let lanes = row * LANES + (lo - start) as usize..row * LANES + (hi - start) as usize;
                let of = |answers: &'_ [H]| if answers.is_empty() { 0..0 } else { lanes.clone() };
                let (f, b) = (&answers[0][of(answers[0])], &answers[1][of(answers[1])]);
                sink.add(visit, &piece, f, b);
            }
        }
    }
}

/// The planes of each lane that lie inside the tile.
fn spans(shift_c: &[i32], s_c: i64, tile: &Region) -> Spans {
    let (least, most) = span(shift_c);
    let mut spans = [[0, shift_c.len() as u32]; LANES];
    if s_c + least >= tile.lo[2] && s_c + most + LANES as i64 <= tile.hi[2] {
        return spans;
    }
    for (lane, span) in spans.iter_mut().enumerate() {
        let inside = planes_inside(shift_c, 0..shift_c.len(), s_c + lane as i64, tile.lo[2], tile.hi[2]);
        *span = [inside.start as u32, inside.end as u32];
    }
    spans
}

/// Finds the planes of a sheet from plane `first` on; what lies outside of the source is at 0, where zeros stand.
fn place<K: Key>(
    volume: &Volume<K>,
    a: usize,
    shift_b: &[i32],
    shift_c: &[i32],
    [s_b, s_c]: [i64; 2],
    first: usize,
    starts: &mut [usize],
) {
    let b = 1 - a;
    let n = volume.region.shape();
    let (lo_b, lo_c) = (volume.region.lo[b], volume.region.lo[2]);
    let shifts = shift_b[first..].iter().zip(&shift_c[first..]);
    for ((plane, start), (&d_b, &d_c)) in (first..).zip(starts).zip(shifts) {
        let (j, k) = (s_b + d_b as i64 - lo_b, s_c + d_c as i64 - lo_c);
        let inside = (0..n[b] as i64).contains(&j) && (-(LANES as i64)..n[2] as i64).contains(&k);
        let (i0, i1) = if a == 0 { (plane, j as usize) } else { (j as usize, plane) };
        *start = if inside { volume.start(i0, i1, k) } else { 0 };
    }
}
