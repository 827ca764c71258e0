//! Pyramid cells from level-0 voxels, unrounded.

use crate::grid::{AnyView, AnyViewMut, Shape, View};
use crate::stage::Reduce;

/// Unrounded cells of one level, dense. Merges follow a tree fixed by cell indices, so that bricks never show.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cells {
    pub shape: Shape,
    pub kind: Reduce,
    /// Mean, Moments: sum of values. Min, Max, Stride: the value (NaN where none).
    pub value: Vec<f64>,
    /// Mean, Moments: valid voxels of the cell.
    pub count: Vec<f64>,
    /// Moments: sum of within-voxel variances.
    pub inner: Vec<f64>,
    /// Moments: sum of squared deviations of the means from the cell's mean.
    pub between: Vec<f64>,
    /// 1 where the cell holds only voxels that `where` excluded (its value is then theirs).
    pub excluded: Vec<u8>,
}
// to be completed by the owner of this file
pub(crate) type _Unused<'a> = (AnyView<'a>, AnyViewMut<'a>, View<'a, u8>);
