//! Penner's filterable occlusion map: a pyramid of pooled moments (paper E).

use super::Context;
use crate::grid::{Affine, AnyView, Region};

/// Unrounded pooled moments of one level, dense over a box: `variance` is the population variance of the pooled values.
/// A cell without valid voxels has NaN in both.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    pub mean: Vec<f64>,
    pub variance: Vec<f64>,
}

/// Level 0: the data, scaled, variance 0; missing voxels NaN.
pub fn base(src: AnyView, affine: Affine, missing: Option<i64>, dst: &mut Moments) {
    let _ = (src, affine, missing, dst);
    todo!()
}

/// The box of the finer level (shape `fine_volume`) that [`coarsen`] needs for the box `coarse` of the next level, where
/// `halve[a]` says whether axis a is blurred and halved.
pub fn needed(coarse: Region, halve: [bool; 3], fine_volume: [usize; 3]) -> Region {
    let _ = (coarse, halve, fine_volume);
    todo!()
}

/// One step of the chain: on each halved axis the 5 taps (1 4 6 4 1)/16, renormalised to the voxels that exist, then
/// cell-centred halving (cell i pools blurred 2i and 2i + 1, where they exist). `fine` covers `fine_box` of a level of shape
/// `fine_volume`, `dst` gets `coarse_box` of the next.
#[allow(clippy::too_many_arguments)]
pub fn coarsen(
    fine: &Moments,
    fine_box: Region,
    fine_volume: [usize; 3],
    halve: [bool; 3],
    coarse_box: Region,
    dst: &mut Moments,
    cx: &mut Context,
) {
    let _ = (fine, fine_box, fine_volume, halve, coarse_box, dst, cx);
    todo!()
}
