//! Rows of stored voxels as f64, missing ones as NaN: what kernels that look at few voxels start from.

use crate::grid::{AnyView, AnyViewMut, Shape, Voxel};
use crate::with_view;

/// Voxels converted at a time: small enough for the stack and the L1 cache.
pub(crate) const BLOCK: usize = 256;

/// The stored value that marks a missing voxel of type `T`: `None` for floats (NaN marks it there) and for values that
/// the type cannot hold.
pub(crate) fn missing_as<T: Voxel>(missing: Option<i64>) -> Option<T> {
    if T::DTYPE.is_float() {
        return None;
    }
    missing.filter(|&m| T::from_f64(m as f64).to_f64() == m as f64).map(|m| T::from_f64(m as f64))
}

/// Stored voxels as f64; missing ones become NaN (a float's NaN is one already).
#[inline(always)]
pub(crate) fn load<T: Voxel>(src: &[T], missing: Option<T>, dst: &mut [f64]) {
    match missing {
        None => dst.iter_mut().zip(src).for_each(|(d, s)| *d = s.to_f64()),
        Some(m) => {
            dst.iter_mut().zip(src).for_each(|(d, s)| *d = if *s == m { f64::NAN } else { s.to_f64() });
        }
    }
}

/// [`load`] of `dst.len()` voxels from voxel `[z, y, x]` of a view of any type.
pub(crate) fn load_any(src: &AnyView, [z, y, x]: [usize; 3], missing: Option<i64>, dst: &mut [f64]) {
    fn one<T: Voxel>(row: &[T], missing: Option<i64>, dst: &mut [f64]) {
        load(row, missing_as::<T>(missing), dst);
    }
    with_view!(AnyView, src, v => one(&v.row_at(z, y)[x..x + dst.len()], missing, dst))
}

/// Rounds `src` once to the type of `dst` and stores it from voxel `[z, y, x]` on.
pub(crate) fn store_any(dst: &mut AnyViewMut, [z, y, x]: [usize; 3], src: &[f64]) {
    fn one<T: Voxel>(row: &mut [T], src: &[f64]) {
        row.iter_mut().zip(src).for_each(|(d, s)| *d = T::from_f64(*s));
    }
    with_view!(AnyViewMut, dst, v => one(&mut v.row_at(z, y)[x..x + src.len()], src))
}

/// Starts `[z, y, x]` and lengths of runs of at most [`BLOCK`] voxels along x that cover a shape.
pub(crate) fn blocks(shape: Shape) -> impl Iterator<Item = ([usize; 3], usize)> {
    let [nz, ny, nx] = shape;
    (0..nz).flat_map(move |z| {
        (0..ny).flat_map(move |y| (0..nx).step_by(BLOCK).map(move |x| ([z, y, x], BLOCK.min(nx - x))))
    })
}
