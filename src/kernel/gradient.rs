//! Gradients by 4-D linear regression (paper N, as used in B 4).

use super::Context;
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape};
use crate::stage::GradientWeight;

/// What to compute. Element types are `src.dtype().result()`.
#[derive(Default)]
pub struct GradientOut<'a> {
    pub magnitude: Option<AnyViewMut<'a>>,
    /// Components along z, y, x.
    pub vector: Option<[AnyViewMut<'a>; 3]>,
}

/// Regression over `size`^3 voxels (3 or 5) around each voxel of the output box, which starts at `at` of `src`. `src` holds
/// the full window of every output voxel (the caller extended it by border `nearest`). `spacing` is physical; components
/// are scaled by the slope of `affine`. A NaN or `missing` voxel in a window: the full regression over the others; a missing
/// centre: NaN.
#[allow(clippy::too_many_arguments)]
pub fn gradient(
    src: AnyView,
    size: usize,
    weight: GradientWeight,
    spacing: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    at: [usize; 3],
    out: GradientOut,
    cx: &mut Context,
) {
    let _ = (src, size, weight, spacing, affine, missing, at, out, cx);
    todo!()
}

/// Bytes of scratch that [`gradient`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, size: usize) -> usize {
    let _ = (dtype, src, dst, size);
    todo!()
}
