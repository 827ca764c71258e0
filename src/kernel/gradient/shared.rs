//! What another device needs: the weights of full windows.

use super::Table;
use crate::stage::GradientWeight;

/// Weights of a component by the magnitudes of the offsets along z, y, x, divided by the component's denominator.
pub type Along = [[[f64; 3]; 3]; 3];

/// Weights of the components z, y, x of a window of `size` voxels per axis.
pub fn along(size: usize, weight: GradientWeight, spacing: [f64; 3]) -> [Along; 3] {
    Table::new(size / 2, weight, spacing).along
}
