//! What a sweep accumulates. The driver hands every sink the answers of both senses for a piece of a row; sums are
//! integers, so that order never matters.

use std::ops::Range;

use super::contribute::{self, ByteTables};
use super::keys::LANES;
use super::lines::Family;
use super::scan::Hit;
use crate::grid::{Region, Shape, View};
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
    /// The pieces of the planes of the strip, without those outside of the tile.
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
            (from < to).then_some(Piece { along, across, from, answers })
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
fn strides(n: Shape) -> [usize; 2] {
    let plane = n[1] * n[2];
    [n[2], if plane < 1024 { plane } else { plane.next_multiple_of(1024) + 272 }]
}

/// Sums that a tile of extents `n` needs for the frame `perm`.
pub(super) fn sums_len(n: Shape, perm: [usize; 3]) -> usize {
    let n = perm.map(|a| n[a]);
    n[0] * strides(n)[1]
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
        const TILE: usize = 16;
        let [nz, ny, nx] = self.tile.shape();
        let [natural, turned] = &mut self.sums;
        let ([row, plane], [to_row, to_plane]) = (strides([nx, ny, nz]), strides([nz, ny, nx]));
        for y in 0..ny {
            for z0 in (0..nz).step_by(TILE) {
                for x0 in (0..nx).step_by(TILE) {
                    let (tz, tx) = (TILE.min(nz - z0), TILE.min(nx - x0));
                    let mut part = [[0; TILE]; TILE];
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

/// Bits after the point of the sums of [`WeightedSum`].
pub(super) const WIDE: f64 = (1u64 << 30) as f64;
/// Colours beyond this are cut off, so that sums of thousands fit.
const MAX_COLOUR: f64 = (1u64 << 18) as f64;

/// `v` in units of `1 / WIDE`, rounded half to even; `|v|` below 2^21, which a clamped colour times a weight below 8 is.
/// An addition rounds as fast on every CPU, where the instruction that rounds may be a call.
#[inline(always)]
fn fixed(v: f64) -> i64 {
    /// Beside it doubles are integers.
    const MAGIC: f64 = (3u64 << 51) as f64;
    ((v * WIDE + MAGIC).to_bits() as i64).wrapping_sub(MAGIC.to_bits() as i64)
}

/// Openness or colour with weights per voxel and direction. Sums are in the natural order of the tile.
pub(super) struct WeightedSum<'a> {
    /// The output tile, and the whole output box that `normal` covers.
    pub tile: Region,
    pub dst_box: Region,
    pub src_box: Region,
    /// Gradient on the output box; toward the solid, or away from it where `flipped`.
    pub normal: Option<[View<'a, f32>; 3]>,
    pub flipped: bool,
    pub weights: &'a mut [i64],
    /// Sums of openness.
    pub open: &'a mut [i64],
    /// Colour on the source box, if it is wanted.
    pub colour: Option<[View<'a, f32>; 3]>,
    /// Colour of the open.
    pub ambient: [f64; 3],
    /// Sums of colour.
    pub rgb: [&'a mut [i64]; 3],
}

/// Components of a unit vector toward the open side; zero where the gradient vanishes or is not a number.
#[inline(always)]
fn normal_at(normal: &[View<f32>; 3], at: [usize; 3], flipped: bool) -> [f64; 3] {
    let g = normal.map(|v| v.at(at) as f64);
    let squares = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    if !(squares > 0.0 && squares.is_finite()) {
        return [0.0; 3];
    }
    let scale = if flipped { 1.0 } else { -1.0 } / squares.sqrt();
    g.map(|c| c * scale)
}

impl WeightedSum<'_> {
    pub fn clear(&mut self) {
        self.weights.fill(0);
        self.open.fill(0);
        self.rgb.iter_mut().for_each(|s| s.fill(0));
    }

    /// Openness of voxel `i` of the tile.
    pub fn openness(&self, i: usize) -> f32 {
        if self.weights[i] == 0 { 1.0 } else { (self.open[i] as f64 / self.weights[i] as f64) as f32 }
    }

    /// Component `c` of the colour of voxel `i` of the tile.
    pub fn colour_of(&self, i: usize, c: usize) -> f32 {
        match self.weights[i] {
            0 => self.ambient[c] as f32,
            weight => (self.rgb[c][i] as f64 / weight as f64) as f32,
        }
    }

    /// One answer of one voxel: `p` is its global index in natural order.
    #[inline(always)]
    fn one(&mut self, visit: &Visit, way: usize, p: [i64; 3], normal: [f64; 3], steps: usize, axis: usize) {
        let sense = visit.family.senses[way].as_ref().expect("answers come from senses that are swept");
        let w = sense.direction;
        let cosine = if normal == [0.0; 3] { 1.0 } else { normal[0] * w[0] + normal[1] * w[1] + normal[2] * w[2] };
        if cosine <= 0.0 {
            return;
        }
        let weight = sense.weight * cosine;
        let open = steps == visit.reach;
        let rho = if open { 1.0 } else { visit.family.rho[steps] };
        let n = self.tile.shape();
        let local: [usize; 3] = std::array::from_fn(|a| (p[a] - self.tile.lo[a]) as usize);
        let i = (local[0] * n[1] + local[1]) * n[2] + local[2];
        self.weights[i] += fixed(weight);
        self.open[i] += fixed(weight * rho);
        let Some(colour) = &self.colour else { return };
        let seen = if open {
            self.ambient
        } else {
            let at = occluder(visit, way, p, steps, axis);
            let at: [usize; 3] = std::array::from_fn(|a| (at[a] - self.src_box.lo[a]) as usize);
            colour.map(|v| v.at(at) as f64)
        };
        for (sum, c) in self.rgb.iter_mut().zip(seen) {
            // A colour that is not there adds nothing.
            let c = if c.is_nan() { 0.0 } else { c.clamp(-MAX_COLOUR, MAX_COLOUR) };
            sum[i] += fixed(weight * rho * c);
        }
    }
}

/// Global index, natural order, of the voxel that occludes `p` after `steps` free planes.
#[inline(always)]
fn occluder(visit: &Visit, way: usize, p: [i64; 3], steps: usize, axis: usize) -> [i64; 3] {
    let j = steps as i64 + 1;
    let from = p[visit.perm[axis]];
    let to = if way == 0 { from + j } else { from - j };
    let shift = |s: usize| {
        let at = |k: i64| visit.shifts[s][(k - visit.origin) as usize] as i64;
        at(to) - at(from)
    };
    let mut q = p;
    q[visit.perm[axis]] = to;
    q[visit.perm[1 - axis]] += shift(0);
    q[visit.perm[2]] += shift(1);
    q
}

impl Sink for WeightedSum<'_> {
    #[inline(always)]
    fn add<H: Hit>(&mut self, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]) {
        for piece in strip.pieces(visit) {
            for (i, answer) in piece.answers.clone().enumerate() {
                let mut p = [piece.from + i as i64; 3];
                p[visit.perm[strip.axis]] = piece.along;
                p[visit.perm[1 - strip.axis]] = piece.across;
                let normal = self.normal.as_ref().map_or([0.0; 3], |n| {
                    let at = std::array::from_fn(|a| (p[a] - self.dst_box.lo[a]) as usize);
                    normal_at(n, at, self.flipped)
                });
                for (way, answers) in [forward, backward].into_iter().enumerate() {
                    if let Some(answer) = answers.get(answer) {
                        self.one(visit, way, p, normal, answer.steps(), strip.axis);
                    }
                }
            }
        }
    }
}
