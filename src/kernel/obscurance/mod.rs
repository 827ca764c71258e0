//! Obscurance sweeps along parallel lattice lines (paper B).

use super::Context;
use crate::grid::{AnyView, AnyViewMut, DType, Region, Shape, View};
use crate::stage::{DirectionSet, DirectionWeights, Rho};

/// Parameters with units resolved.
#[derive(Debug, Clone, PartialEq)]
pub struct ObscuranceParams {
    pub directions: usize,
    pub set: DirectionSet,
    pub weights: DirectionWeights,
    pub rho: Rho,
    /// In voxels of the finest axis.
    pub max_distance: f64,
    /// Physical voxel size, `[z, y, x]`.
    pub spacing: [f64; 3],
    /// Smaller stored values are denser (`solid = "low"` or a negative slope, not both).
    pub flipped: bool,
    /// Stored value of integer types that marks a missing voxel; floats use NaN.
    pub missing: Option<i64>,
    pub ambient: [f64; 3],
}

/// Directions, lines and tables made once from the parameters.
#[derive(Debug, Clone)]
pub struct Prepared;

/// What a sweep reads besides densities, and writes.
pub struct ObscuranceIo<'a> {
    /// Colour of each voxel of `src` (linear r, g, b), for colour bleeding.
    pub colour: Option<[View<'a, f32>; 3]>,
    /// Components along z, y, x of the gradient on the *output* box, for `weight_by_normal`.
    pub normal: Option<[View<'a, f32>; 3]>,
    /// f32, the output box.
    pub openness: Option<AnyViewMut<'a>>,
    /// f32, the output box.
    pub rgb: Option<[AnyViewMut<'a>; 3]>,
}

impl Prepared {
    pub fn new(params: &ObscuranceParams) -> Prepared {
        let _ = params;
        todo!()
    }

    /// Halo in voxels per axis.
    pub fn reach(&self) -> [usize; 3] {
        todo!()
    }

    /// Sweeps every direction. `src` covers `src_box`: `dst_box` grown by [`Self::reach`] and clipped to the volume, in
    /// *global* indices (lines are tiled by them).
    pub fn sweep(&self, src: AnyView, src_box: Region, dst_box: Region, io: ObscuranceIo, cx: &mut Context) {
        let _ = (src, src_box, dst_box, io, cx);
        todo!()
    }

    /// Bytes of scratch that [`Self::sweep`] takes at most.
    pub fn scratch_bytes(&self, dtype: DType, src: Shape, dst: Shape, colour: bool, normal: bool) -> usize {
        let _ = (dtype, src, dst, colour, normal);
        todo!()
    }
}
