//! What a sweep accumulates. The driver hands every sink the answers of both senses for a piece of a row; sums are
//! integers, so that order never matters.

use std::ops::Range;

use super::contribute::{self, ByteTables};
use super::keys::LANES;
use super::lines::Family;
use super::scan::Hit;
use crate::grid::{Region, Shape};
use crate::kernel::simd::Level;

/// Constants of one family in one brick.
pub(super) struct Visit<'a> {
    pub family: &'a Family,
    /// Natural axis of each frame axis.
    pub perm: [usize; 3],
    /// Planes looked at: the family's reach, or less where the brick is smaller. Answers equal to it mean "open".
    pub reach: usize,
    /// Contributions by answer, `reach + 1` per sense.
    pub tables: [&'a [u32]; 2],
    /// The three bytes of each contribution, by sense, byte and answer; for answers below 256.
    pub bytes: &'a ByteTables,
    /// Displacement along the two other frame axes at each plane of the source, counted from `origin`.
    pub shifts: [&'a [i32]; 2],
    /// First global plane of the source.
    pub origin: i64,
}

/// The queries of a sheet: a row of 64 lanes for each of its planes, of which some lanes lie inside the tile.
pub(super) struct Strip<'a> {
    /// Frame axis along which lines run (0 or 1).
    pub axis: usize,
    /// Counted from the first plane of the source.
    pub planes: Range<usize>,
    /// Frame indices that displacements are added to: along the other one of the first two axes, and of lane 0 along
    /// the last axis.
    pub start: [i64; 2],
    /// The output tile, in frame order.
    pub tile: &'a Region,
    /// Needed lanes of each plane; empty where all are.
    pub rows: &'a [u64],
}

/// A piece of a row of the output tile.
pub(super) struct Piece {
    /// Global frame indices of its first voxel: along the lines, along the other one of the first two axes, and along
    /// the last.
    pub along: i64,
    pub across: i64,
    pub from: i64,
    /// Where its voxels stand among the answers of the strip.
    pub answers: Range<usize>,
}

impl Strip<'_> {
    /// The pieces of the planes of the strip, without those outside of the tile or without a needed voxel.
    #[inline(always)]
    pub fn pieces(&self, visit: &Visit) -> impl Iterator<Item = Piece> {
        let shifts = visit.shifts.map(|s| &s[self.planes.clone()]);
        let origin = visit.origin + self.planes.start as i64;
        let ([s_b, s_c], [lo, hi]) = (self.start, [self.tile.lo[2], self.tile.hi[2]]);
        shifts[0].iter().zip(shifts[1]).enumerate().filter_map(move |(row, (&d_b, &d_c))| {
            let start = s_c + d_c as i64;
            let (from, to) = (start.max(lo), (start + LANES as i64).min(hi));
            let first = row * LANES;
            let answers = first + (from - start) as usize..first + (to - start) as usize;
            let (along, across) = (origin + row as i64, s_b + d_b as i64);
            (from < to && self.rows.get(row).is_none_or(|&lanes| lanes != 0)).then_some(Piece {
                along,
                across,
                from,
                answers,
            })
        })
    }
}

/// Accumulates answers.
pub(super) trait Sink {
    /// `forward` and `backward` hold [`LANES`] answers per plane of the strip; they are empty for a sense that is not
    /// swept. Answers of voxels outside of the tile may be anything.
    fn add<H: Hit>(&mut self, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]);
    /// Told of a strip before its lines are searched, so that its sums can be fetched.
    fn expect(&self, _visit: &Visit, _strip: &Strip) {}
}

impl<A: Sink, B: Sink> Sink for (A, B) {
    #[inline(always)]
    fn add<H: Hit>(&mut self, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]) {
        self.0.add(visit, strip, forward, backward);
        self.1.add(visit, strip, forward, backward);
    }
    fn expect(&self, visit: &Visit, strip: &Strip) {
        self.0.expect(visit, strip);
    }
}

/// Row and plane strides of the sums of a tile of extents `n`: sheets cross the planes, which would fall into a few
/// cache sets if they stood a multiple of a page apart. Grows with the extents.
pub(super) fn strides(n: Shape) -> [usize; 2] {
    let plane = n[1] * n[2];
    [n[2], if plane < 1024 { plane } else { plane.next_multiple_of(1024) + 272 }]
}

/// Sums that a tile of extents `n` needs for the frame `perm`.
pub(super) fn sums_len(n: Shape, perm: [usize; 3]) -> usize {
    let n = perm.map(|a| n[a]);
    n[0] * strides(n)[1]
}

/// Adds sums of the exchanged frame of a tile of extents `n` to those in natural order.
pub(super) fn add_turned<T: Copy + Default + std::ops::AddAssign>(n: Shape, natural: &mut [T], turned: &[T]) {
    const TILE: usize = 16;
    let [nz, ny, nx] = n;
    let ([row, plane], [to_row, to_plane]) = (strides([nx, ny, nz]), strides([nz, ny, nx]));
    for y in 0..ny {
        for z0 in (0..nz).step_by(TILE) {
            for x0 in (0..nx).step_by(TILE) {
                let (tz, tx) = (TILE.min(nz - z0), TILE.min(nx - x0));
                let mut part = [[T::default(); TILE]; TILE];
                for (x, part) in part[..tx].iter_mut().enumerate() {
                    part[..tz].copy_from_slice(&turned[(x0 + x) * plane + y * row + z0..][..tz]);
                }
                for z in 0..tz {
                    let to = &mut natural[(z0 + z) * to_plane + y * to_row + x0..][..tx];
                    for (to, part) in to.iter_mut().zip(&part) {
                        *to += part[z];
                    }
                }
            }
        }
    }
}

/// Openness with weights that depend on the direction only. One buffer for each frame, each in the frame's order.
pub(super) struct OpenSum<'a> {
    pub level: Level,
    pub sums: [&'a mut [u32]; 2],
    /// The output tile, natural order.
    pub tile: Region,
}

impl OpenSum<'_> {
    pub fn clear(&mut self) {
        self.sums.iter_mut().for_each(|s| s.fill(0));
    }

    /// Adds the sums of the exchanged frame to those in natural order.
    pub fn merge(&mut self) {
        let [natural, turned] = &mut self.sums;
        add_turned(self.tile.shape(), natural, turned);
    }

    /// Openness of row `[z, y]` of the tile, after [`Self::merge`]; `total` is the sum where nothing occludes, and `open` what
    /// every voxel has beside its sums.
    pub fn openness(&self, [z, y]: [usize; 2], open: u64, total: u64, out: &mut [f32]) {
        let [row, plane] = strides(self.tile.shape());
        for (out, &sum) in out.iter_mut().zip(&self.sums[0][z * plane + y * row..]) {
            *out = ((sum as u64 + open) as f64 / total as f64) as f32;
        }
    }
}

impl Sink for OpenSum<'_> {
    fn add<H: Hit>(&mut self, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]) {
        let strides = strides(visit.perm.map(|a| self.tile.shape()[a]));
        let sums = &mut *self.sums[usize::from(visit.perm[2] == 0)];
        contribute::add(self.level, sums, strides, forward, backward, visit, strip);
    }

    #[inline(always)]
    fn expect(&self, visit: &Visit, strip: &Strip) {
        #[cfg(target_arch = "x86_64")]
        for piece in strip.pieces(visit) {
            use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
            let strides = strides(visit.perm.map(|a| self.tile.shape()[a]));
            let sums = self.sums[usize::from(visit.perm[2] == 0)].as_ptr();
            let sums = sums.wrapping_add(contribute::start(strides, strip, &piece));
            for line in 0..5 {
                // SAFETY: prefetching touches nothing, wherever the address points; every x86-64 has SSE.
                unsafe { _mm_prefetch::<_MM_HINT_T1>(sums.wrapping_add(16 * line).cast()) };
            }
        }
        let _ = (visit, strip);
    }
}
