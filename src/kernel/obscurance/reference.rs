//! Obscurance by the definition (SPEC section 4): every voxel, every direction, step by step.

use super::{ObscuranceParams, rho};
use crate::grid::{Region, Voxel};
use crate::stage::directions;

/// A small volume in memory; `region` gives its global indices.
pub(super) struct Field<'a, T> {
    pub data: &'a [T],
    pub region: Region,
}

impl<T: Voxel> Field<'_, T> {
    pub fn index(&self, p: [i64; 3]) -> Option<usize> {
        let n = self.region.shape();
        (0..3).all(|a| (self.region.lo[a]..self.region.hi[a]).contains(&p[a])).then(|| {
            let [z, y, x] = [0, 1, 2].map(|a| (p[a] - self.region.lo[a]) as usize);
            (z * n[1] + y) * n[2] + x
        })
    }
}

pub(super) fn missing<T: Voxel>(v: T, p: &ObscuranceParams) -> bool {
    if T::DTYPE.is_float() { v.to_f64().is_nan() } else { p.missing.is_some_and(|m| v.to_f64() == m as f64) }
}

/// The first occluder of voxel `at` in direction `w`, with its distance in voxels of the finest axis.
pub(super) fn occluder<T: Voxel>(
    field: &Field<T>,
    p: &ObscuranceParams,
    w: [f64; 3],
    at: [i64; 3],
) -> Option<([i64; 3], f64)> {
    let u = [0, 1, 2].map(|a| w[a] / p.spacing[a]);
    let twelve = u.map(|c| (c.abs() * 1e12).round());
    let mut a = 0;
    for b in [1, 2] {
        if twelve[b] > twelve[a] {
            a = b;
        }
    }
    let sign = if u[a] < 0.0 { -1 } else { 1 };
    let d = |b: usize, k: i64| (k as f64 * (u[b] / u[a].abs()) + 0.5).floor() as i64;
    let finest = p.spacing.iter().copied().fold(f64::MAX, f64::min);
    let d1 = (0..3).map(|b| (p.spacing[b] * u[b] / u[a].abs()).powi(2)).sum::<f64>().sqrt() / finest;
    let k = sign * at[a];
    let value = field.data[field.index(at)?];
    for j in 1..=(p.max_distance / d1 + 1e-9).floor() as i64 {
        let q = [0, 1, 2].map(|b| if b == a { at[a] + sign * j } else { at[b] + d(b, k + j) - d(b, k) });
        let other = field.data[field.index(q)?]; // once outside, always outside
        let denser = if p.flipped { other < value } else { other > value };
        if denser && !missing(other, p) {
            return Some((q, j as f64 * d1));
        }
    }
    None
}

/// Openness and colour of one voxel by the formula, in f64.
pub(super) fn obscurance<T: Voxel>(
    field: &Field<T>,
    p: &ObscuranceParams,
    colour: Option<&[Vec<f32>; 3]>,
    gradient: Option<[f32; 3]>,
    at: [i64; 3],
) -> (f64, [f64; 3]) {
    if missing(field.data[field.index(at).unwrap()], p) {
        return (f64::NAN, [f64::NAN; 3]);
    }
    let set = directions::directions(p.set, p.directions);
    let weights = directions::weights(p.weights, &set);
    let (mut sum, mut open, mut rgb) = (0.0, 0.0, [0.0; 3]);
    for (w, weight) in set.iter().zip(weights) {
        let cosine = gradient.filter(|g| g.iter().all(|c| c.is_finite()) && *g != [0.0; 3]).map_or(1.0, |g| {
            let length = g.iter().map(|&c| c as f64 * c as f64).sum::<f64>().sqrt();
            let toward = if p.flipped { 1.0 } else { -1.0 };
            (0..3).map(|a| toward * g[a] as f64 / length * w[a]).sum::<f64>().max(0.0)
        });
        let weight = weight * cosine;
        let (seen, light) = match occluder(field, p, *w, at) {
            None => (1.0, p.ambient),
            Some((q, d)) => {
                let i = field.index(q).unwrap();
                (rho(p.rho, d, p.max_distance), colour.map_or([0.0; 3], |c| [0, 1, 2].map(|k| c[k][i] as f64)))
            }
        };
        sum += weight;
        open += weight * seen;
        (0..3).for_each(|c| rgb[c] += weight * seen * light[c]);
    }
    (open / sum, rgb.map(|c| c / sum))
}
