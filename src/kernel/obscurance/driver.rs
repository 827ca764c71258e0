//! Walks the lines of every direction: families, tiles, sheets and senses. Knows nothing of what is accumulated.
//!
//! Lines become columns of rows of 64 voxels: plane `i` of a sheet holds the voxels `[s_b + D_b(i), s_c + D_c(i)..]`, so
//! one copy of a sheet into the first-level cache serves both senses, and a step along 64 lines is one row. Directions
//! dominated by x run on a copy with x and z exchanged.

use std::ops::Range;

use super::contribute;
use super::keys::{Key, LANES, Volume};
use super::lines::{Family, displacement};
use super::scan::{self, Hit, Sheet, Spans};
use super::sinks::{Sink, Strip, Visit};
use super::wanted::{self, LineCounts, Look, Wanted};
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
    /// One entry per plane of the source: along the shared axis, and along the last one for each family.
    pub shifts: [&'a mut [i32]; 1 + TOGETHER],
    /// One entry per answer, of each family for each sense.
    pub tables: [[&'a mut [u32]; TOGETHER]; 2],
}

/// Families that are swept together at most: those that move alike along the one axis across sheets cross the same
/// rows, which stay in the second-level cache between them. The sets of 12, 42 and 162 directions have up to three such
/// families. 2-core Zen 4 VM, AVX-512, 2026-11-26: see benches/results/obscurance.md.
pub(super) const TOGETHER: usize = 4;

/// Frame axis along which lines of a family run, and the one across which its sheets follow each other.
pub(super) fn axes(family: &Family) -> [usize; 2] {
    let along = usize::from(family.axis == 1);
    [along, 1 - along]
}

/// Frame of the keys that a family reads; see [`FRAMES`].
pub(super) fn frame_of(family: &Family) -> usize {
    usize::from(family.axis == 2)
}

/// Families sorted so that those that can be swept together stand together.
pub(super) fn sort(families: &mut [Family]) {
    let key = |f: &Family| (f.axis, f.slope[FRAMES[frame_of(f)][axes(f)[1]]]);
    families.sort_by(|a, b| key(a).0.cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)));
}

/// Runs of sorted families that are swept together.
pub(super) fn groups(families: &[Family]) -> impl Iterator<Item = &[Family]> {
    let alike = |f: &Family, g: &Family| {
        let b = FRAMES[frame_of(f)][axes(f)[1]];
        f.axis == g.axis && f.slope[b] == g.slope[b]
    };
    families.chunk_by(alike).flat_map(|run| run.chunks(TOGETHER))
}

/// Planes that a family looks ahead in a source of `extent` planes.
pub(super) fn reach_in(family: &Family, extent: usize) -> usize {
    family.reach.min(extent.saturating_sub(1))
}

/// Sweeps both senses of a group of families (see [`groups`]) over `tile` (natural order), reading the keys of their
/// frame and looking `most` planes ahead at most. Answers are "open" wherever nothing is in reach, and for lines without a
/// voxel that is `wanted`.
#[allow(clippy::too_many_arguments)]
pub(super) fn sweep_group<K: Key, S: Sink>(
    level: Level,
    group: &[Family],
    most: usize,
    volume: Volume<K>,
    tile: Region,
    wanted: Option<Wanted>,
    buffers: &mut Buffers<K>,
    sink: &mut S,
) -> LineCounts {
    let perm = FRAMES[frame_of(&group[0])];
    let [a, b] = axes(&group[0]);
    let planes = volume.region.shape()[a];
    let origin = volume.region.lo[a];
    let Buffers { sheet, hits, stack, starts, turned, shifts, tables } = buffers;
    let [shift_b, shift_c @ ..] = shifts;
    let fill = |shift: &mut [i32], slope: f64| {
        shift[..planes].iter_mut().zip(origin..).for_each(|(s, i)| *s = displacement(slope, i) as i32);
    };
    fill(shift_b, group[0].slope[perm[b]]);
    let mut bytes = [[[[0; 256]; 3]; 2]; TOGETHER];
    for (i, family) in group.iter().enumerate() {
        fill(shift_c[i], family.slope[perm[2]]);
        let reach = reach_in(family, planes).min(most);
        for (tables, sense) in tables.iter_mut().zip(&family.senses) {
            let table = &mut tables[i];
            if let Some(sense) = sense {
                table[..reach].copy_from_slice(&sense.table[..reach]);
                table[reach] = sense.table[family.reach];
            }
        }
        contribute::split(tables.each_ref().map(|t| &t[i][..=reach]), &mut bytes[i]);
    }
    let visits: [Visit; TOGETHER] = std::array::from_fn(|i| {
        let family = group.get(i).unwrap_or(&group[0]);
        let reach = reach_in(family, planes).min(most);
        Visit {
            family,
            perm,
            reach,
            tables: tables.each_ref().map(|t| &t[i][..=reach]),
            bytes: &bytes[i],
            shifts: [&shift_b[..planes], &shift_c[i][..planes]],
            origin,
        }
    });
    let mut room = Room { rows: sheet, stack, starts, turned };
    let visits = &visits[..group.len()];
    let job = Job { volume, tile: in_frame(tile, perm), axis: a, visits, wanted };
    let [forward, backward] = hits;
    if visits.iter().all(|visit| visit.reach <= u8::MAX as usize) {
        run::<K, u8, S>(level, &job, [bytes_of(forward), bytes_of(backward)], &mut room, sink)
    } else {
        run::<K, u32, S>(level, &job, [forward, backward], &mut room, sink)
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
    /// They share the axis and the displacement along the other axis across it.
    visits: &'a [Visit<'a>],
    wanted: Option<Wanted<'a>>,
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
fn planes_inside(shift: &[i32], of: Range<usize>, start: i64, lo: i64, hi: i64) -> Range<usize> {
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

fn run<K: Key, H: Hit, S: Sink>(
    level: Level,
    job: &Job<K>,
    hits: [&mut [H]; 2],
    room: &mut Room<K>,
    sink: &mut S,
) -> LineCounts {
    let Job { volume, tile, axis, visits, wanted } = job;
    let mut counts = LineCounts::default();
    let (a, b) = (*axis, 1 - *axis);
    let origin = volume.region.lo[a];
    let whole = (tile.lo[a] - origin) as usize..(tile.hi[a] - origin) as usize;
    let shift_b = visits[0].shifts[0];
    let [forward, backward] = hits;
    let (least, most) = span(&shift_b[whole.clone()]);
    for s_b in tile.lo[b] - most..tile.hi[b] - least {
        let inside = planes_inside(shift_b, whole.clone(), s_b, tile.lo[b], tile.hi[b]);
        if inside.is_empty() {
            continue;
        }
        for (i, visit) in visits.iter().enumerate() {
            let shift_c = visit.shifts[1];
            let (least, most) = span(&shift_c[inside.clone()]);
            for s_c in (tile.lo[2] - most..tile.hi[2] - least).step_by(LANES) {
                let last = LANES as i64 - 1;
                let planes = planes_inside(shift_c, inside.clone(), s_c, tile.lo[2] - last, tile.hi[2]);
                if planes.is_empty() {
                    continue;
                }
                let mut strip = Strip { axis: a, planes, start: [s_b, s_c], tile, rows: &[] };
                let mut spans = spans(&shift_c[strip.planes.clone()], s_c, tile);
                let asked = |spans: &Spans| spans.iter().filter(|[from, end]| from < end).count() as u64;
                let all = asked(&spans);
                counts.total += all;
                let look = wanted.as_ref().map(|wanted| wanted.look(visit, &strip));
                if let Some(look) = &look {
                    counts.masked += all - look.live.count_ones() as u64;
                    if look.live == 0 {
                        continue;
                    }
                    (strip.planes, spans) = (look.planes.clone(), look.spans);
                    strip.rows = look.rows();
                }
                if i == 0 {
                    sink.expect(visit, &strip);
                }
                let sparse = look.as_ref().filter(|look| look.is_sparse(visit.reach));
                let busy =
                    sheet(level, volume, visit, &strip, &spans, sparse, [&mut *forward, &mut *backward], room, sink);
                let searched =
                    spans.iter().enumerate().filter(|(lane, [from, end])| from < end && busy >> lane & 1 == 0);
                counts.open += searched.count() as u64;
            }
        }
    }
    counts
}

/// Searches the lines of one strip, hands the answers on, and returns the lanes that could have been occluded.
#[allow(clippy::too_many_arguments)]
fn sheet<K: Key, H: Hit, S: Sink>(
    level: Level,
    volume: &Volume<K>,
    visit: &Visit,
    strip: &Strip,
    spans: &Spans,
    sparse: Option<&Look>,
    hits: [&mut [H]; 2],
    room: &mut Room<K>,
    sink: &mut S,
) -> u64 {
    let [shift_b, shift_c] = visit.shifts;
    let Range { start, end } = strip.planes;
    // Lines that leave the source see nothing more: in a volume of few planes they leave it long before their reach.
    let Region { lo, hi } = volume.region;
    let (b, last) = (1 - strip.axis, LANES as i64 - 1);
    let near = start.saturating_sub(visit.reach)..(end + visit.reach).min(shift_b.len());
    let near = planes_inside(shift_b, near, strip.start[0], lo[b], hi[b]);
    let near = planes_inside(shift_c, near, strip.start[1], lo[2] - last, hi[2]);
    let first = near.start;
    let starts = &mut room.starts[..near.len()];
    place(volume, strip.axis, shift_b, shift_c, strip.start, first, starts);
    let sheet = Sheet { data: volume.data(), planes: starts };
    let count = strip.planes.len() * LANES;
    let mut answers: [&mut [H]; 2] = [&mut [], &mut []];
    for (way, hits) in hits.into_iter().enumerate() {
        if visit.family.senses[way].is_some() {
            answers[way] = &mut hits[..count];
        }
    }
    let asked = answers.each_mut().map(|a| &mut **a);
    let queries = start - first..end - first;
    let busy = match sparse {
        Some(look) => {
            wanted::walk(sheet, look.rows(), queries, visit.reach, asked);
            u64::MAX
        }
        None => scan::both(level, sheet, spans, queries, visit.reach, asked, room.rows, room.stack, room.turned),
    };
    let [forward, backward] = answers;
    sink.add(visit, strip, forward, backward);
    busy
}

/// The planes of each lane that lie inside the tile.
fn spans(shift_c: &[i32], s_c: i64, tile: &Region) -> Spans {
    let (least, most) = span(shift_c);
    let n = shift_c.len();
    let mut spans = [[0, n as u32]; LANES];
    if s_c + least >= tile.lo[2] && s_c + most + LANES as i64 <= tile.hi[2] {
        return spans;
    }
    // Lines of higher lanes enter and leave earlier where the displacement rises, later where it falls.
    let rising = shift_c[0] <= shift_c[n - 1];
    let passes = |bound: i64, lane: usize| {
        let least = bound - s_c - lane as i64;
        move |i: usize| shift_c[i] as i64 >= least
    };
    let (mut lo, mut hi) = if rising { (n, n) } else { (0, 0) };
    for (lane, span) in spans.iter_mut().enumerate() {
        let (above, beyond) = (passes(tile.lo[2], lane), passes(tile.hi[2], lane));
        if rising {
            while lo > 0 && above(lo - 1) {
                lo -= 1;
            }
            while hi > 0 && beyond(hi - 1) {
                hi -= 1;
            }
            *span = [lo as u32, hi as u32];
        } else {
            while lo < n && beyond(lo) {
                lo += 1;
            }
            while hi < n && above(hi) {
                hi += 1;
            }
            *span = [lo as u32, hi as u32];
        }
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
    let Region { lo, hi } = volume.region;
    let last = hi[2] - lo[2];
    let shifts = shift_b[first..].iter().zip(&shift_c[first..]);
    for ((plane, start), (&d_b, &d_c)) in (first..).zip(starts).zip(shifts) {
        let (j, k) = (s_b + d_b as i64, s_c + d_c as i64 - lo[2]);
        let inside = (lo[b]..hi[b]).contains(&j) && (-(LANES as i64)..last).contains(&k);
        let row = volume.sheared.map_or(j - lo[b], |first| s_b - first) as usize;
        let (i0, i1) = if a == 0 { (plane, row) } else { (row, plane) };
        *start = if inside { volume.start(i0, i1, k) } else { 0 };
    }
}
