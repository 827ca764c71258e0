//! The second half of the float kernel: from moments of windows of f32 that another device made to results, by the same row
//! functions.

use super::emit::Emit;
use super::float::{Row, emit_row};
use super::plan::cut;
use super::{WindowOut, check};
use crate::brick::scratch::padded;
use crate::grid::{AnyView, Shape, View};
use crate::kernel::Context;
use crate::stage::WindowParams;

/// One window.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moments {
    /// Least and greatest voxel.
    pub lo: f32,
    pub hi: f32,
    pub n: u32,
    pub sum: f64,
    /// Sum of squared deviations from the mean.
    pub m2: f64,
}

/// Writes the voxels of one part of the outputs of a call like [`super::window`] (same `src`, `params`, `at`, `outs`): the
/// box of `shape` from `lo` on. `window` tells the moments of the window of a voxel of the part, x fastest; what no channel
/// needs may be anything.
///
/// Panics where `window` does, or if the part sticks out.
#[allow(clippy::too_many_arguments)]
pub fn finish_floats(
    src: View<f32>,
    params: &WindowParams,
    at: [usize; 3],
    outs: &mut [WindowOut],
    lo: [usize; 3],
    shape: Shape,
    window: impl Fn(usize) -> Moments,
    cx: &mut Context,
) {
    let Some(dst) = outs.first().map(|o| o.dst.shape()) else { return };
    check(AnyView::F32(src), params, at, dst, outs);
    assert!((0..3).all(|a| lo[a] + shape[a] <= dst[a]), "a part outside {dst:?}");
    let [nz, ny, nx] = shape;
    let mut bytes = cx.scratch.take(scratch_bytes(nx));
    let mut emit = Emit::new(outs, params, cx.level, [nx; 2], &mut bytes);
    let bytes = &mut bytes;
    let (least, greatest) = (cut::<f32>(bytes, nx), cut::<f32>(bytes, nx));
    let (sums, m2) = (cut::<f64>(bytes, nx), cut::<f64>(bytes, nx));
    for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
        for x in 0..nx {
            let w = window((z * ny + y) * nx + x);
            (least[x], greatest[x], sums[x]) = (w.lo, w.hi, w.sum);
            emit.numerator[x] = w.n as f64;
            // A window of equal voxels has no spread, whatever was rounded.
            m2[x] = if w.lo == w.hi { 0.0 } else { w.m2 };
        }
        let to = [lo[0] + z, lo[1] + y, lo[2]];
        let centre = [at[0] + to[0], at[1] + to[1], at[2] + to[2]];
        let v = &src.row_at(centre[0], centre[1])[centre[2]..][..nx];
        emit_row(&mut emit, Row { v, lo: least, hi: greatest, s: sums, m: m2, whole: None, skip: 0 }, to, true);
    }
}

/// Bytes of scratch that [`finish_floats`] takes for rows of `width` voxels.
pub fn scratch_bytes(width: usize) -> usize {
    Emit::bytes(width, width) + 2 * padded::<f32>(width) + 2 * padded::<f64>(width)
}
