//! What another device needs: half-widths, weights, and the last step from unscaled moments to results.

use super::rows::store_row;
use super::taps::{bell, total};
use crate::grid::{Affine, AnyViewMut, Shape};
use crate::kernel::simd::Level;

/// Half-widths of the kernel, no larger than the source.
pub fn radius(sigma: [f64; 3], src: Shape) -> [usize; 3] {
    super::radius(sigma, src)
}

/// Weights of the taps 1, 2, ... `radius` steps from position `p` of an axis of `n`, as the f32 passes use them; the
/// centre's is what is left. A tap that exists at neither side weighs 0.
pub fn weights(sigma: f64, radius: usize, p: usize, n: usize) -> impl Iterator<Item = f32> {
    let (before, after) = (p, n - 1 - p);
    let total = total(|k| bell(sigma, k), radius, before, after);
    (1..=radius).map(move |k| {
        let exists = k <= before || k <= after;
        if exists { (bell(sigma, k) / total) as f32 } else { 0.0 }
    })
}

/// What is left for the centre.
pub fn centre_weight(sigma: f64, radius: usize, p: usize, n: usize) -> f32 {
    (1.0 / total(|k| bell(sigma, k), radius, p, n - 1 - p)) as f32
}

/// Scales one row of means as [`super::gaussian`] does (variances by the squared slope and no intercept), into voxels `to..` of a row of `dst`.
///
/// Panics if `dst` is not f32.
pub fn finish(level: Level, row: &[f32], affine: Affine, dst: &mut AnyViewMut, [z, y, x]: [usize; 3]) {
    match dst {
        AnyViewMut::F32(d) => {
            store_row(level, row, affine.slope, affine.intercept, &mut d.row_at(z, y)[x..x + row.len()]);
        }
        other => panic!("a Gaussian mean of small integers is not {}", other.dtype()),
    }
}
