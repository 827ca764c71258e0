//! Which voxels a scene needs (`where`).

use crate::grid::{Affine, AnyView, Region, ViewMut};

/// 1 where `min <= v <= max` (scaled, either bound optional); NaN and `missing` are not needed.
pub fn range(src: AnyView, affine: Affine, missing: Option<i64>, min: Option<f64>, max: Option<f64>, dst: ViewMut<u8>) {
    let _ = (src, affine, missing, min, max, dst);
    todo!()
}

/// 1 within `band` of an isosurface crossing: between 6-neighbours a < iso <= b, at the linear point. Euclidean, in voxels
/// of the finest axis of `spacing`. `src` covers `src_box` (the output box `dst_box` grown by [`iso_reach`], clipped).
#[allow(clippy::too_many_arguments)]
pub fn iso_band(
    src: AnyView,
    src_box: Region,
    affine: Affine,
    missing: Option<i64>,
    iso: &[f64],
    band: f64,
    spacing: [f64; 3],
    dst: ViewMut<u8>,
    dst_box: Region,
) {
    let _ = (src, src_box, affine, missing, iso, band, spacing, dst, dst_box);
    todo!()
}

/// Halo that [`iso_band`] needs, voxels per axis.
pub fn iso_reach(band: f64, spacing: [f64; 3]) -> [usize; 3] {
    let _ = (band, spacing);
    todo!()
}
