//! Box-window statistics and the openness estimators made from them (papers A and E), fused in one pass.

use super::Context;
use crate::grid::{AnyView, AnyViewMut, DType, Shape};
use crate::stage::{WindowChannel, WindowParams};

/// One requested result. Its element type must be: for `Min` and `Max` the input's type where the affine is the identity,
/// else `src.dtype().result()`; for everything else `src.dtype().result()`. An `Openness` may also ask for `u8` where
/// `src` is u8, i8, u16, i16 or f32: round half even of 255 O, within half a code + 2e-4.
pub struct WindowOut<'a> {
    pub channel: WindowChannel,
    pub dst: AnyViewMut<'a>,
}

/// Computes every channel of `outs` for the box that starts at voxel `at` of `src`; all outputs have the same shape.
/// Panics if extents or types disagree.
pub fn window(src: AnyView, params: &WindowParams, at: [usize; 3], outs: &mut [WindowOut], cx: &mut Context) {
    let _ = (src, params, at, outs, cx);
    todo!()
}

/// Bytes of scratch that [`window`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams, channels: &[WindowChannel]) -> usize {
    let _ = (dtype, src, dst, params, channels);
    todo!()
}
