//! Truncated Gaussian moments (paper E).
//!
//! Three passes, x, y, z, over tiles of columns with a ring of planes each. A pass renormalises its weights to the voxels inside
//! `src`; since those form a box, the product is the renormalised 3-D weight. Means and spreads are taken relative to the centre tap
//! and variances pooled (variances plus spread of means), so constants give exactly themselves and 0, and nothing cancels.
//!
//! Results that are not finite (a missing voxel, an infinity or an overflow in the window) are computed once more by passes
//! that carry each cell's weight, which is the normalised convolution over the voxels that are left: only those rows, and the
//! planes that their windows see. Which of the two a voxel gets depends on its window alone.

mod rows;
pub mod shared;
mod taps;
mod tiles;
mod tiling;

use super::Context;
use crate::brick::scratch::{cut, padded};
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape};
use tiles::{Job, Out, Pass};
use tiling::{Tiling, Wanted};

/// Separable Gaussian of `sigma` voxels per axis, truncated at `ceil(3 sigma)`, weights renormalised to the voxels that
/// exist (inside `src`, not NaN, not `missing`). `mean` and `variance` have `src.dtype().result()`, or `mean` f64; scaled by `affine`. A
/// missing centre gives NaN. Panics if extents or types disagree.
///
/// Means in f32 are computed in f32 (within 4e-7 of the window's range), all else in f64.
#[allow(clippy::too_many_arguments)]
pub fn gaussian(
    src: AnyView,
    sigma: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    at: [usize; 3],
    mut mean: Option<AnyViewMut>,
    mut variance: Option<AnyViewMut>,
    cx: &mut Context,
) {
    let shapes = [&mean, &variance].map(|o| o.as_ref().map(AnyViewMut::shape));
    let Some(dst) = shapes[0].or(shapes[1]) else { return };
    assert!(shapes.iter().flatten().all(|s| *s == dst), "extents differ");
    let from = src.shape();
    assert!((0..3).all(|a| at[a] + dst[a] <= from[a]), "the output box sticks out of the source");
    if dst.contains(&0) {
        return;
    }
    let job = Job { src, missing, affine, at, dst, radius: radius(sigma, from), sigma, level: cx.level };
    let bytes = cx.scratch.take(scratch_bytes(src.dtype(), from, dst, sigma, true));
    let (flags, bytes) = cut::<u8>(bytes, Wanted::len(dst));
    let wanted = &mut Wanted::new(flags, dst);
    if src.dtype().result() == DType::F32 && !mean.as_ref().is_some_and(|m| m.dtype() == DType::F64) {
        if let Some(mean) = &mut mean {
            job.run::<f32>(bytes, Pass::Mean, Out { mean: Some(mean), variance: None }, wanted);
        }
        if let Some(variance) = &mut variance {
            job.run::<f64>(bytes, Pass::Variance, Out { mean: None, variance: Some(variance) }, wanted);
        }
    } else {
        let pass = if variance.is_some() { Pass::Variance } else { Pass::Mean };
        job.run::<f64>(bytes, pass, Out { mean: mean.as_mut(), variance: variance.as_mut() }, wanted);
    }
    if wanted.any() {
        job.mend(bytes, Out { mean: mean.as_mut(), variance: variance.as_mut() }, wanted);
    }
}

/// Half-width of the truncated kernel, voxels per axis.
pub fn reach(sigma: [f64; 3]) -> [usize; 3] {
    sigma.map(|s| (3.0 * s).ceil() as usize)
}

/// Bytes of scratch that [`gaussian`] takes at most.
pub fn scratch_bytes(_dtype: DType, src: Shape, dst: Shape, sigma: [f64; 3], _variance: bool) -> usize {
    let radius = radius(sigma, src);
    let bytes = |fields: usize| Tiling::new(src, dst, radius, fields * size_of::<f64>()).bytes::<f64>(fields);
    let single = Tiling::new(src, dst, radius, size_of::<f32>()).bytes::<f32>(1);
    // mean, variance and weight: where voxels are missing, all three are carried
    padded::<u8>(Wanted::len(dst)) + single.max(bytes(2)).max(bytes(3))
}

/// Half-widths, no larger than the source.
fn radius(sigma: [f64; 3], src: Shape) -> [usize; 3] {
    let reach = reach(sigma);
    std::array::from_fn(|a| reach[a].min(src[a].saturating_sub(1)))
}

#[cfg(test)]
mod tests;
