//! Sums with weights per voxel and direction, and of colours: a piece of a row at once, in arrays of lanes.

use super::contribute;
use super::keys::LANES;
use super::lines::Family;
use super::scan::Hit;
use super::sinks::{Sink, Strip, Visit, add_turned, strides};
use crate::brick::scratch::cut;
use crate::grid::{Region, View};
use crate::kernel::simd::Level;
use crate::multiversion;

/// Bits after the point of the sums of [`WeightedSum`].
const WIDE: f64 = (1u64 << 30) as f64;
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

/// The sum of the weights of all directions of these families.
pub(super) fn uniform(families: &[Family]) -> i64 {
    families.iter().flat_map(|f| f.senses.iter().flatten()).map(|sense| fixed(sense.weight)).sum()
}

/// Openness or colour with weights per voxel and direction. Sums of each frame are in its order.
pub(super) struct WeightedSum<'a> {
    pub level: Level,
    /// The output tile, and the whole output box that `normal` covers.
    pub tile: Region,
    pub dst_box: Region,
    pub src_box: Region,
    /// Gradient on the output box; toward the solid, or away from it where `flipped`.
    pub normal: Option<[View<'a, f32>; 3]>,
    pub flipped: bool,
    /// Sum of all directions' weights, which is that of every voxel where there is no normal.
    pub uniform: i64,
    /// Empty without normals, as are those of openness.
    pub weights: [&'a mut [i64]; 2],
    pub open: [&'a mut [i64]; 2],
    /// Colour on the source box, if it is wanted.
    pub colour: Option<View<'a, [f32; 4]>>,
    /// Colour of the open.
    pub ambient: [f64; 3],
    /// Sums of colour.
    pub rgb: [[&'a mut [i64]; 2]; 3],
}

/// Sums of both frames.
pub(super) fn pair(bytes: &mut [u8], [natural, turned]: [usize; 2]) -> ([&mut [i64]; 2], &mut [u8]) {
    let (natural, bytes) = cut(bytes, natural);
    let (turned, bytes) = cut(bytes, turned);
    ([natural, turned], bytes)
}

impl<'a> WeightedSum<'a> {
    fn all(&mut self) -> impl Iterator<Item = &mut [&'a mut [i64]; 2]> {
        [&mut self.weights, &mut self.open].into_iter().chain(&mut self.rgb)
    }

    pub fn clear(&mut self) {
        self.all().flatten().for_each(|s| s.fill(0));
    }

    /// Adds the sums of the exchanged frame to those in natural order.
    pub fn merge(&mut self) {
        let n = self.tile.shape();
        for [natural, turned] in self.all().filter(|s| !s[0].is_empty()) {
            add_turned(n, natural, turned);
        }
    }

    /// Sums and weights of a row of the tile; without normals all weights are one number.
    fn row<'r>(&'r self, sums: &'r [i64], [z, y]: [usize; 2]) -> impl Iterator<Item = (i64, i64)> + use<'r, 'a> {
        let [row, plane] = strides(self.tile.shape());
        let first = z * plane + y * row;
        let weight = move |i: usize| self.weights[0].get(first + i).copied().unwrap_or(self.uniform);
        sums[first..].iter().enumerate().map(move |(i, &sum)| (sum, weight(i)))
    }

    /// Openness of row `[z, y]` of the tile, after [`Self::merge`].
    pub fn openness(&self, at: [usize; 2], out: &mut [f32]) {
        for (out, (sum, weight)) in out.iter_mut().zip(self.row(self.open[0], at)) {
            *out = if weight == 0 { 1.0 } else { (sum as f64 / weight as f64) as f32 };
        }
    }

    /// Component `c` of the colour of row `[z, y]` of the tile, after [`Self::merge`].
    pub fn colour_of(&self, at: [usize; 2], c: usize, out: &mut [f32]) {
        for (out, (sum, weight)) in out.iter_mut().zip(self.row(self.rgb[c][0], at)) {
            *out = if weight == 0 { self.ambient[c] as f32 } else { (sum as f64 / weight as f64) as f32 };
        }
    }
}

impl Sink for WeightedSum<'_> {
    fn add<H: Hit>(&mut self, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]) {
        add_strip(self.level, self, visit, strip, forward, backward);
    }
}

multiversion! {
    fn add_strip['a, 'v, 's, H: Hit](
        sum: &mut WeightedSum<'a>, visit: &Visit<'v>, strip: &Strip<'s>, forward: &[H], backward: &[H],
    ) -> () = add_pieces;
}

/// A number per lane.
type Lanes = [f64; LANES];

#[inline(always)]
fn add_pieces<H: Hit>(sum: &mut WeightedSum, visit: &Visit, strip: &Strip, forward: &[H], backward: &[H]) {
    for piece in strip.pieces(visit) {
        let n = piece.answers.len();
        let mut p = [piece.from; 3];
        p[visit.perm[strip.axis]] = piece.along;
        p[visit.perm[1 - strip.axis]] = piece.across;
        let last = visit.perm[2];
        let normals = match &sum.normal {
            Some(normal) => normals(normal, sum.dst_box, p, last, n, sum.flipped),
            None => [[0.0; LANES]; 3],
        };
        let frame = usize::from(last == 0);
        let first = contribute::start(strides(visit.perm.map(|a| sum.tile.shape()[a])), strip, &piece);
        // What both senses add, to the weights, to openness and to three colours: one way through memory for the two.
        let mut totals = [[0; LANES]; 5];
        for (way, answers) in [forward, backward].into_iter().enumerate() {
            let (Some(sense), false) = (&visit.family.senses[way], answers.is_empty()) else { continue };
            let answers = &answers[piece.answers.clone()];
            let mut weights = [sense.weight; LANES];
            if sum.normal.is_some() {
                let [d0, d1, d2] = sense.direction;
                let [z, y, x] = &normals;
                for l in 0..LANES {
                    let cosine = z[l] * d0 + y[l] * d1 + x[l] * d2;
                    let uniform = z[l] == 0.0 && y[l] == 0.0 && x[l] == 0.0;
                    weights[l] *= if uniform { 1.0 } else { cosine.max(0.0) };
                }
            }
            let mut seen = weights;
            for (seen, answer) in seen.iter_mut().zip(answers) {
                // The last entry is that of the open.
                let steps = answer.steps();
                *seen *= visit.family.rho[if steps >= visit.reach { visit.family.reach } else { steps }];
            }
            let [of_weights, open, rgb @ ..] = &mut totals;
            if sum.normal.is_some() {
                gather(of_weights, &weights);
                gather(open, &seen);
            }
            if let Some(colour) = &sum.colour {
                let colours = colours(colour, sum.ambient, sum.src_box, visit, way, strip.axis, p, answers);
                for (rgb, colour) in rgb.iter_mut().zip(&colours) {
                    let mut light = seen;
                    light.iter_mut().zip(colour).for_each(|(light, c)| *light *= c);
                    gather(rgb, &light);
                }
            }
        }
        let [of_weights, open, rgb @ ..] = &totals;
        if sum.normal.is_some() {
            spread(sum.weights[frame], of_weights, first, n);
            spread(sum.open[frame], open, first, n);
        }
        if sum.colour.is_some() {
            sum.rgb.iter_mut().zip(rgb).for_each(|(sums, lanes)| spread(sums[frame], lanes, first, n));
        }
    }
}

/// Adds lanes in units of the sums.
#[inline(always)]
fn gather(totals: &mut [i64; LANES], lanes: &Lanes) {
    totals.iter_mut().zip(lanes).for_each(|(total, l)| *total += fixed(*l));
}

/// Adds `n` lanes to sums.
#[inline(always)]
fn spread(sums: &mut [i64], lanes: &[i64; LANES], first: usize, n: usize) {
    let sums = &mut sums[first..first + n];
    match <&mut [i64; LANES]>::try_from(&mut *sums) {
        Ok(sums) => sums.iter_mut().zip(lanes).for_each(|(sum, l)| *sum += l),
        Err(_) => sums.iter_mut().zip(lanes).for_each(|(sum, l)| *sum += l),
    }
}

/// Components of the unit vectors toward the open side of `n` voxels from `p` on along axis `last`; zero where the gradient
/// vanishes or is not a number.
#[inline(always)]
fn normals(normal: &[View<f32>; 3], of: Region, p: [i64; 3], last: usize, n: usize, flipped: bool) -> [Lanes; 3] {
    let mut g = [[0.0; LANES]; 3];
    let [z, y, x] = std::array::from_fn(|a| (p[a] - of.lo[a]) as usize);
    for (to, view) in g.iter_mut().zip(normal) {
        if last == 2 {
            let row = &view.row_at(z, y)[x..x + n];
            to.iter_mut().zip(row).for_each(|(to, &v)| *to = v as f64);
        } else {
            to[..n].iter_mut().enumerate().for_each(|(i, to)| *to = view.at([z + i, y, x]) as f64);
        }
    }
    let toward = if flipped { 1.0 } else { -1.0 };
    let [z, y, x] = &mut g;
    for l in 0..LANES {
        let squares = z[l] * z[l] + y[l] * y[l] + x[l] * x[l];
        let usable = squares > 0.0 && squares.is_finite();
        let scale = toward / squares.sqrt();
        for c in [&mut *z, &mut *y, &mut *x] {
            c[l] = if usable { c[l] * scale } else { 0.0 };
        }
    }
    g
}

/// What each lane sees: the colour of its occluder, or that of the open. A colour that is not there is 0.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn colours<H: Hit>(
    colour: &View<[f32; 4]>,
    ambient: [f64; 3],
    src_box: Region,
    visit: &Visit,
    way: usize,
    axis: usize,
    p: [i64; 3],
    answers: &[H],
) -> [Lanes; 3] {
    let [a, b, c] = [visit.perm[axis], visit.perm[1 - axis], visit.perm[2]];
    let strides = [colour.plane, colour.row, 1].map(|s| s as i64);
    let from: i64 = (0..3).map(|x| (p[x] - src_box.lo[x]) * strides[x]).sum();
    let plane = (p[a] - visit.origin) as usize;
    let [shift_b, shift_c] = visit.shifts;
    let home = [shift_b[plane], shift_c[plane]];
    let mut out = ambient.map(|v| [v; LANES]);
    for (lane, answer) in answers.iter().enumerate() {
        let steps = answer.steps();
        if steps >= visit.reach {
            continue;
        }
        let j = if way == 0 { steps as i64 + 1 } else { -(steps as i64) - 1 };
        let to = (plane as i64 + j) as usize;
        let moved = [shift_b[to] - home[0], shift_c[to] - home[1]].map(|d| d as i64);
        let at = from + j * strides[a] + moved[0] * strides[b] + (lane as i64 + moved[1]) * strides[c];
        let seen = colour.data[at as usize];
        (0..3).for_each(|k| out[k][lane] = seen[k] as f64);
    }
    for lanes in &mut out {
        for v in lanes {
            *v = if v.is_nan() { 0.0 } else { v.clamp(-MAX_COLOUR, MAX_COLOUR) };
        }
    }
    out
}
