//! What the kernel must compute, one voxel at a time, short enough to check by reading. Not fast, and without any guarantee:
//! the textbook's bounds, as rounded as f64 leaves them.

use super::Codes;
use crate::grid::{View, Voxel};
use crate::stage::WindowParams;

/// Bounds of one window's counts as real numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    pub n: f64,
    /// Of the voxels below the centre.
    pub lower: f64,
    /// Of the voxels not above it.
    pub upper: f64,
    /// How far from 0 the determinants are that the bounds hang on, relative to their terms: where it is small, as in windows of
    /// two or three values, rounding rules.
    pub condition: f64,
}

/// Bounds at voxel `c` of `src`, which is not missing. Codes stand for voxels where given.
pub fn voxel<T: Voxel>(src: View<T>, c: [usize; 3], codes: Option<&Codes>, params: &WindowParams) -> Bounds {
    let missing = |v: f64| v.is_nan() || !T::DTYPE.is_float() && params.missing.is_some_and(|m| m as f64 == v);
    let code = |v: f64| codes.map_or(v, |codes| f64::from(codes.of(v)));
    let turn = if params.flipped() { -1.0 } else { 1.0 };
    let centre = code(src.at(c).to_f64());
    let axis =
        |a: usize| c[a].saturating_sub(params.radius[a])..c[a].saturating_add(params.radius[a] + 1).min(src.shape[a]);
    let mut window = Vec::new();
    for (z, y) in axis(0).flat_map(|z| axis(1).map(move |y| (z, y))) {
        let row = src.row_at(z, y)[axis(2)].iter().map(|v| v.to_f64());
        window.extend(row.filter(|v| !missing(*v)).map(|v| turn * (code(v) - centre)));
    }
    of(&window)
}

/// Bounds of the counts of values below 0 and not above 0.
pub fn of(x: &[f64]) -> Bounds {
    let n = x.len() as f64;
    let scale = x.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    if scale == 0.0 {
        return Bounds { n, lower: 0.0, upper: n, condition: 1.0 };
    }
    let m: Vec<f64> = (0..5).map(|k| x.iter().map(|v| (v / scale).powi(k)).sum()).collect();
    // The quadratic q with sum(x q(x)) = sum(x^2 q(x)) = 0, that is q(x) = a2 x^2 + a1 x + a0.
    let (a2, a1, a0) = (m[2] * m[2] - m[1] * m[3], m[4] * m[1] - m[3] * m[2], m[3] * m[3] - m[2] * m[4]);
    let condition = (a2.abs() / (m[2] * m[2])).min(a0.abs() / (m[2] * m[4]));
    // Weight of the node at 0: the sum of q(x)/q(0), which vanishes at the others.
    let at_zero = (a2 * m[2] + a1 * m[1] + a0 * m[0]) / a0;
    let root = (a1 * a1 - 4.0 * a2 * a0).sqrt();
    let nodes = [(-a1 - root) / (2.0 * a2), (-a1 + root) / (2.0 * a2)];
    // Weight of node r: the sum of x (x - other) / (r (r - other)).
    let weight = |r: f64, other: f64| (m[2] - other * m[1]) / (r * (r - other));
    let below = [weight(nodes[0], nodes[1]), weight(nodes[1], nodes[0])];
    let lower = (0..2).filter(|&i| nodes[i] < 0.0).map(|i| below[i]).sum();
    Bounds { n, lower, upper: lower + at_zero, condition }
}
