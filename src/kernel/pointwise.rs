//! Stages that look at one voxel: transfer tables, openness windows, modulation, ambient light, combination.

use crate::grid::{Affine, AnyView, AnyViewMut};
use crate::stage::{CombineKind, TransferPoint, WindowMode};

/// Piecewise-linear table (B, A): scaled value to `opacity` and linear `rgb`, clamped at the ends. `points` ascend in their
/// first entry. NaN and `missing` give NaN.
pub fn transfer(
    src: AnyView,
    affine: Affine,
    missing: Option<i64>,
    points: &[TransferPoint],
    opacity: Option<AnyViewMut>,
    rgb: Option<[AnyViewMut; 3]>,
) {
    let _ = (src, affine, missing, points, opacity, rgb);
    todo!()
}

/// B 5.1: below `low` 0, above `high` 1, between kept or stretched.
pub fn openness_window(src: AnyView, low: f64, high: f64, mode: WindowMode, dst: AnyViewMut) {
    let _ = (src, low, high, mode, dst);
    todo!()
}

/// A 4.2: `opacity * min(by / sigma_max2, 1)`.
pub fn modulate_by_variance(opacity: AnyView, by: AnyView, sigma_max2: f64, dst: AnyViewMut) {
    let _ = (opacity, by, sigma_max2, dst);
    todo!()
}

/// B 5.2: `clamp(opacity * s * gain, 0, 1)`, 0 where the saliency s is below `threshold`.
pub fn modulate_by_saliency(opacity: AnyView, by: AnyView, threshold: f64, gain: f64, dst: AnyViewMut) {
    let _ = (opacity, by, threshold, gain, dst);
    todo!()
}

/// A eq. 5, one component: `k * openness * colour`.
pub fn ambient_light(openness: AnyView, colour: AnyView, k: f64, dst: AnyViewMut) {
    let _ = (openness, colour, k, dst);
    todo!()
}

/// Joins inputs of one shape, voxel by voxel, in the order given; arithmetic in f64, scaled by each input's affine.
pub fn combine(inputs: &[(AnyView, Affine, Option<i64>)], kind: CombineKind, dst: AnyViewMut) {
    let _ = (inputs, kind, dst);
    todo!()
}

/// Scaled values: `slope * stored + intercept`; NaN and `missing` give NaN.
pub fn scale(src: AnyView, affine: Affine, missing: Option<i64>, dst: AnyViewMut) {
    let _ = (src, affine, missing, dst);
    todo!()
}
