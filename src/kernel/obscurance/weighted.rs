//! Sums with weights per voxel and direction, and of colours: a piece of a row at once, in arrays of lanes.

use super::keys::LANES;
use super::lines::Family;
use super::scan::Hit;
use super::sinks::{Sink, Strip, Visit};
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

/// Openness or colour with weights per voxel and direction. Sums are in the natural order of the tile.
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
    /// Empty without normals.
    pub weights: &'a mut [i64],
    /// Sums of openness; empty where it is summed elsewhere.
    pub open: &'a mut [i64],
    /// Colour on the source box, if it is wanted.
    pub colour: Option<[View<'a, f32>; 3]>,
    /// Colour of the open.
    pub ambient: [f64; 3],
    /// Sums of colour.
    pub rgb: [&'a mut [i64]; 3],
}

impl WeightedSum<'_> {
    pub fn clear(&mut self) {
        self.weights.fill(0);
        self.open.fill(0);
        self.rgb.iter_mut().for_each(|s| s.fill(0));
    }

    fn weight(&self, i: usize) -> i64 {
        self.weights.get(i).copied().unwrap_or(self.uniform)
    }

    /// Openness of voxel `i` of the tile.
    pub fn openness(&self, i: usize) -> f32 {
        match self.weight(i) {
            0 => 1.0,
            weight => (self.open[i] as f64 / weight as f64) as f32,
        }
    }

    /// Component `c` of the colour of voxel `i` of the tile.
    pub fn colour_of(&self, i: usize, c: usize) -> f32 {
        match self.weight(i) {
            0 => self.ambient[c] as f32,
            weight => (self.rgb[c][i] as f64 / weight as f64) as f32,
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
        let extents = sum.tile.shape();
        let at: [usize; 3] = std::array::from_fn(|a| (p[a] - sum.tile.lo[a]) as usize);
        let first = (at[0] * extents[1] + at[1]) * extents[2] + at[2];
        let stride = if last == 2 { 1 } else { extents[1] * extents[2] };
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
                let steps = answer.steps();
                *seen *= if steps >= visit.reach { 1.0 } else { visit.family.rho[steps] };
            }
            if sum.normal.is_some() {
                spread(sum.weights, &weights, first, stride, n);
            }
            if !sum.open.is_empty() {
                spread(sum.open, &seen, first, stride, n);
            }
            if let Some(colour) = &sum.colour {
                let colours = colours(colour, sum.ambient, sum.src_box, visit, way, strip.axis, p, answers);
                for (rgb, colour) in sum.rgb.iter_mut().zip(&colours) {
                    let mut light = seen;
                    light.iter_mut().zip(colour).for_each(|(light, c)| *light *= c);
                    spread(rgb, &light, first, stride, n);
                }
            }
        }
    }
}

/// Adds `n` lanes to sums that stand `stride` apart.
#[inline(always)]
fn spread(sums: &mut [i64], lanes: &Lanes, first: usize, stride: usize, n: usize) {
    let mut values = [0; LANES];
    values.iter_mut().zip(lanes).for_each(|(v, l)| *v = fixed(*l));
    if stride == 1 {
        sums[first..first + n].iter_mut().zip(&values).for_each(|(sum, v)| *sum += v);
    } else {
        sums[first..].iter_mut().step_by(stride).zip(&values[..n]).for_each(|(sum, v)| *sum += v);
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
    colour: &[View<f32>; 3],
    ambient: [f64; 3],
    src_box: Region,
    visit: &Visit,
    way: usize,
    axis: usize,
    p: [i64; 3],
    answers: &[H],
) -> [Lanes; 3] {
    let [a, b, c] = [visit.perm[axis], visit.perm[1 - axis], visit.perm[2]];
    let strides = [colour[0].plane, colour[0].row, 1].map(|s| s as i64);
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
        (0..3).for_each(|k| out[k][lane] = colour[k].data[at as usize] as f64);
    }
    for lanes in &mut out {
        for v in lanes {
            *v = if v.is_nan() { 0.0 } else { v.clamp(-MAX_COLOUR, MAX_COLOUR) };
        }
    }
    out
}
