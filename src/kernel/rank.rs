//! Exact local rank: openness as the share of the window's voxels that are not above the centre (A 2.3).

use super::Context;
use crate::grid::{AnyView, AnyViewMut, DType, Shape};
use crate::stage::{Ties, WindowParams, WindowShape};

/// Writes the exact openness of the box that starts at voxel `at` of `src`. `dst` has `src.dtype().result()`.
pub fn rank(
    src: AnyView,
    params: &WindowParams,
    shape: WindowShape,
    ties: Ties,
    at: [usize; 3],
    dst: AnyViewMut,
    cx: &mut Context,
) {
    let _ = (src, params, shape, ties, at, dst, cx);
    todo!()
}

/// Bytes of scratch that [`rank`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams, shape: WindowShape) -> usize {
    let _ = (dtype, src, dst, params, shape);
    todo!()
}
