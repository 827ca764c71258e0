//! Truncated Gaussian moments (paper E).

use super::Context;
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape};

/// Separable Gaussian of `sigma` voxels per axis, truncated at `ceil(3 sigma)`, weights renormalised to the voxels that
/// exist (inside `src`, not NaN, not `missing`). `mean` and `variance` have `src.dtype().result()`; scaled by `affine`.
#[allow(clippy::too_many_arguments)]
pub fn gaussian(
    src: AnyView,
    sigma: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    at: [usize; 3],
    mean: Option<AnyViewMut>,
    variance: Option<AnyViewMut>,
    cx: &mut Context,
) {
    let _ = (src, sigma, affine, missing, at, mean, variance, cx);
    todo!()
}

/// Half-width of the truncated kernel, voxels per axis.
pub fn reach(sigma: [f64; 3]) -> [usize; 3] {
    sigma.map(|s| (3.0 * s).ceil() as usize)
}

/// Bytes of scratch that [`gaussian`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, sigma: [f64; 3], variance: bool) -> usize {
    let _ = (dtype, src, dst, sigma, variance);
    todo!()
}
