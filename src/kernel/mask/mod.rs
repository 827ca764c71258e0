//! Which voxels a scene needs (`where`).

mod band;
mod boxes;
mod distances;
mod lines;

pub use band::{Band, iso_band, scratch_bytes};
pub use boxes::{Cost, Part, Sight, boxes};

use super::values::{BLOCK, blocks, load_any};
use crate::grid::{Affine, AnyView, ViewMut};

/// 1 where `min <= v <= max` (scaled, either bound optional), else 0; NaN and `missing` are not needed. Panics if the
/// extents differ.
pub fn range(
    src: AnyView,
    affine: Affine,
    missing: Option<i64>,
    min: Option<f64>,
    max: Option<f64>,
    mut dst: ViewMut<u8>,
) {
    assert_eq!(src.shape(), dst.shape, "extents differ");
    let (min, max) = (min.unwrap_or(f64::NEG_INFINITY), max.unwrap_or(f64::INFINITY));
    let mut values = [0.0; BLOCK];
    for (at, n) in blocks(dst.shape) {
        load_scaled(&src, at, affine, missing, &mut values[..n]);
        let row = &mut dst.row_at(at[0], at[1])[at[2]..at[2] + n];
        row.iter_mut().zip(&values).for_each(|(d, v)| *d = (*v >= min && *v <= max) as u8);
    }
}

fn load_scaled(src: &AnyView, at: [usize; 3], affine: Affine, missing: Option<i64>, dst: &mut [f64]) {
    load_any(src, at, missing, dst);
    if !affine.is_identity() {
        dst.iter_mut().for_each(|v| *v = affine.apply(*v));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;

    #[test]
    fn range_is_inclusive_in_scaled_units_and_leaves_out_the_missing() {
        let v = Voxels::I16(vec![-3, 0, 1, 2, 3, 99]);
        let mut got = [9u8; 6];
        let run = |min, max, got: &mut [u8; 6]| {
            range(v.view([1, 2, 3]), Affine::new(-2.0, 1.0), Some(2), min, max, ViewMut::dense(got, [1, 2, 3]))
        };
        run(Some(-5.0), Some(1.0), &mut got); // scaled: 7 1 -1 (-3) -5 -197
        assert_eq!(got, [0, 1, 1, 0, 1, 0]);
        run(None, None, &mut got);
        assert_eq!(got, [1, 1, 1, 0, 1, 1]);
        let f = Voxels::F32(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.5, 0.0, -0.0]);
        range(f.view([1, 2, 3]), Affine::IDENTITY, None, Some(0.0), None, ViewMut::dense(&mut got, [1, 2, 3]));
        assert_eq!(got, [0, 1, 0, 1, 1, 1]);
    }
}
