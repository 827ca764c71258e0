//! Lattice lines: how a direction cuts the volume into parallel lines of voxels (SPEC section 4, obscurance).

use super::ObscuranceParams;
use crate::grid::Shape;
use crate::stage::{DirectionSet, Rho, directions};

/// No axis of a volume is longer; keeps tables bounded whatever `max_distance` says.
pub(super) const MAX_REACH: usize = 1 << 20;

/// One of the two ways along the lines of a [`Family`].
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sense {
    /// Physical unit vector, `[z, y, x]`.
    pub direction: [f64; 3],
    /// Weights of all directions sum to their number.
    pub weight: f64,
    /// Fixed-point contribution after `c` steps without an occluder: `table[c]` where the next voxel occludes,
    /// `table[reach]` where none does.
    pub table: Vec<u32>,
}

/// Parallel lines that tile the volume. Opposite directions share them: `D(k)` is the same number for both.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Family {
    /// Dominant axis, 0 = z.
    pub axis: usize,
    /// Voxels per plane along each axis as the index along `axis` grows (1 along `axis` itself).
    pub slope: [f64; 3],
    /// Planes in reach.
    pub reach: usize,
    /// `rho(d_j)` at `[j - 1]`, and 1 at `[reach]`.
    pub rho: Vec<f64>,
    /// Along growing and along falling indices of `axis`.
    pub senses: [Option<Sense>; 2],
}

/// `D_b(k)` for the global index `k` along the dominant axis.
pub(super) fn displacement(slope: f64, index: i64) -> i64 {
    (index as f64 * slope + 0.5).floor() as i64
}

/// Dimming at distance `d` of an occluder.
pub fn rho(kind: Rho, d: f64, max: f64) -> f64 {
    let t = (d / max).min(1.0); // d may exceed max by the 1e-9 that the reach allows
    match kind {
        Rho::Step => 0.0,
        Rho::Linear => t,
        Rho::Exponential => 1.0 - (-t).exp(),
        Rho::Sqrt => t.sqrt(),
    }
}

/// Bits after the point of a contribution: as many as let `directions` of them be summed in 32 bits, at most 22, so that
/// a contribution has three bytes. The error of a mean is at most `2^-(bits + 1)`.
fn fraction_bits(directions: usize) -> u32 {
    (1..=22).rev().find(|&b| directions as u64 * ((1u64 << b) + 2) < 1 << 32).unwrap_or(1)
}

/// The families of all directions, and the sum of all contributions where nothing occludes. No voxel of `volume` sees further
/// than its planes.
pub(super) fn families(p: &ObscuranceParams, volume: Shape) -> (Vec<Family>, u64) {
    let set = directions::directions(p.set, p.directions.max(1));
    let weights = directions::weights(p.weights, &set);
    let scale = (1u64 << fraction_bits(set.len())) as f64;
    let mut out: Vec<Family> = Vec::new();
    let mut total = 0;
    for (w, weight) in set.into_iter().zip(weights) {
        let (mut family, way) = family_of(w, p, volume);
        let table: Vec<u32> = family.rho.iter().map(|r| (r * weight * scale).round_ties_even() as u32).collect();
        total += table[family.reach] as u64;
        let sense = Sense { direction: w, weight, table };
        let same = |f: &&mut Family| f.senses[way].is_none() && f.axis == family.axis && f.slope == family.slope;
        // An antipode stands at a fixed distance in a Fibonacci set; looking everywhere is cheap enough.
        match out.iter_mut().find(same) {
            Some(f) => f.senses[way] = Some(sense),
            None => {
                family.senses[way] = Some(sense);
                out.push(family);
            }
        }
    }
    (out, total)
}

/// The lines of one direction, and which way along them it goes.
fn family_of(w: [f64; 3], p: &ObscuranceParams, volume: Shape) -> (Family, usize) {
    let u: [f64; 3] = std::array::from_fn(|b| w[b] / p.spacing[b]);
    let rounded = u.map(|c| (c.abs() * 1e12).round());
    let axis = (1..3).fold(0, |best, b| if rounded[b] > rounded[best] { b } else { best });
    let finest = p.spacing.iter().copied().fold(f64::INFINITY, f64::min);
    let mut squares: [f64; 3] = std::array::from_fn(|b| (p.spacing[b] * u[b] / u[axis].abs()).powi(2));
    squares.sort_by(f64::total_cmp);
    let step = (squares[0] + squares[1] + squares[2]).sqrt() / finest;
    let reach = ((p.max_distance / step + 1e-9).floor().max(0.0) as usize).min(MAX_REACH);
    let reach = reach.min(volume[axis].saturating_sub(1));
    let mut rho_of: Vec<f64> = (1..=reach).map(|j| rho(p.rho, j as f64 * step, p.max_distance)).collect();
    rho_of.push(1.0);
    let slope = std::array::from_fn(|b| if b == axis { 1.0 } else { u[b] / u[axis] + 0.0 });
    let way = usize::from(u[axis] < 0.0);
    (Family { axis, slope, reach, rho: rho_of, senses: [None, None] }, way)
}

impl Family {
    /// Sum of the contributions of both senses where nothing occludes.
    pub fn open(&self) -> u64 {
        self.senses.iter().flatten().map(|s| s.table[self.reach] as u64).sum()
    }

    /// Voxels per axis that a line may move within reach.
    pub fn halo(&self) -> [usize; 3] {
        std::array::from_fn(|b| match self.slope[b].abs() {
            m if b == self.axis => (m * self.reach as f64) as usize,
            m if m == 0.0 || self.reach == 0 => 0,
            m => ((self.reach as f64 * m).floor() as usize + 1).min(self.reach),
        })
    }
}

/// Whether the parameters name a set that exists.
pub fn is_valid_count(set: DirectionSet, count: usize) -> bool {
    match set {
        DirectionSet::Icosahedron => directions::icosahedron_level(count).is_some(),
        DirectionSet::Fibonacci => count > 0,
    }
}
