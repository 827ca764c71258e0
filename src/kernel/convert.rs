//! Arrays between stages to output types.

use crate::grid::{AnyView, AnyViewMut};

/// How a channel's values become an output type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mapping {
    /// Values `lo` and `hi` map to 0 and the integer type's maximum (round half even, saturating); `None` keeps values.
    pub range: Option<[f64; 2]>,
    /// Integer outputs: what NaN becomes.
    pub fill: f64,
}

/// Converts voxel by voxel. Panics if the shapes differ.
pub fn convert(src: AnyView, mapping: Mapping, dst: AnyViewMut) {
    let _ = (src, mapping, dst);
    todo!()
}
