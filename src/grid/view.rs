//! Borrowed voxels with an extent: all that a kernel sees.

use super::{DType, Shape, Voxel};

/// Voxels of a box: `data[z * plane + y * row + x]` for `[z, y, x]` inside `shape`.
#[derive(Clone, Copy)]
pub struct View<'a, T> {
    pub data: &'a [T],
    pub shape: Shape,
    /// Elements from one plane to the next.
    pub plane: usize,
    /// Elements from one row to the next, at least `shape[2]`.
    pub row: usize,
}

/// Like [`View`], for writing.
pub struct ViewMut<'a, T> {
    pub data: &'a mut [T],
    pub shape: Shape,
    pub plane: usize,
    pub row: usize,
}

fn assert_extent(len: usize, shape: Shape, plane: usize, row: usize) {
    let [z, y, x] = shape;
    if z == 0 || y == 0 || x == 0 {
        return;
    }
    assert!(row >= x && (y - 1) * row + x <= plane.max((y - 1) * row + x), "rows of {row} cannot hold {x} voxels");
    assert!(z == 1 || plane >= (y - 1) * row + x, "planes of {plane} overlap");
    assert!(len > (z - 1) * plane + (y - 1) * row + x - 1, "{len} voxels cannot hold the shape {shape:?}");
}

impl<'a, T> View<'a, T> {
    /// Densely packed voxels. Panics if `data` is too short.
    pub fn dense(data: &'a [T], shape: Shape) -> Self {
        Self::strided(data, shape, shape[1] * shape[2], shape[2])
    }

    /// Panics if the extent does not fit in `data`.
    pub fn strided(data: &'a [T], shape: Shape, plane: usize, row: usize) -> Self {
        assert_extent(data.len(), shape, plane, row);
        View { data, shape, plane, row }
    }

    /// The voxels of row `y` of plane `z`.
    #[inline]
    pub fn row_at(&self, z: usize, y: usize) -> &'a [T] {
        let start = z * self.plane + y * self.row;
        &self.data[start..start + self.shape[2]]
    }

    #[inline]
    pub fn at(&self, [z, y, x]: [usize; 3]) -> T
    where
        T: Copy,
    {
        self.data[z * self.plane + y * self.row + x]
    }

    /// The part of `shape` voxels that starts at `lo`. Panics if it sticks out.
    pub fn part(&self, lo: [usize; 3], shape: Shape) -> View<'a, T> {
        assert!((0..3).all(|a| lo[a] + shape[a] <= self.shape[a]), "{lo:?} + {shape:?} sticks out of {:?}", self.shape);
        let start = (lo[0] * self.plane + lo[1] * self.row + lo[2]).min(self.data.len());
        View { data: &self.data[start..], shape, plane: self.plane, row: self.row }
    }
}

impl<'a, T> ViewMut<'a, T> {
    /// Densely packed voxels. Panics if `data` is too short.
    pub fn dense(data: &'a mut [T], shape: Shape) -> Self {
        Self::strided(data, shape, shape[1] * shape[2], shape[2])
    }

    /// Panics if the extent does not fit in `data`.
    pub fn strided(data: &'a mut [T], shape: Shape, plane: usize, row: usize) -> Self {
        assert_extent(data.len(), shape, plane, row);
        ViewMut { data, shape, plane, row }
    }

    #[inline]
    pub fn row_at(&mut self, z: usize, y: usize) -> &mut [T] {
        let start = z * self.plane + y * self.row;
        &mut self.data[start..start + self.shape[2]]
    }

    #[inline]
    pub fn set(&mut self, [z, y, x]: [usize; 3], value: T) {
        self.data[z * self.plane + y * self.row + x] = value;
    }

    /// The part of `shape` voxels that starts at `lo`. Panics if it sticks out.
    pub fn part(self, lo: [usize; 3], shape: Shape) -> ViewMut<'a, T> {
        assert!((0..3).all(|a| lo[a] + shape[a] <= self.shape[a]), "{lo:?} + {shape:?} sticks out of {:?}", self.shape);
        let start = (lo[0] * self.plane + lo[1] * self.row + lo[2]).min(self.data.len());
        ViewMut { data: &mut self.data[start..], shape, plane: self.plane, row: self.row }
    }

    pub fn as_view(&self) -> View<'_, T> {
        View { data: self.data, shape: self.shape, plane: self.plane, row: self.row }
    }

    /// A shorter borrow of the same voxels.
    pub fn reborrow(&mut self) -> ViewMut<'_, T> {
        ViewMut { data: self.data, shape: self.shape, plane: self.plane, row: self.row }
    }
}

/// A [`View`] of any element type.
#[derive(Clone, Copy)]
pub enum AnyView<'a> {
    U8(View<'a, u8>),
    I8(View<'a, i8>),
    U16(View<'a, u16>),
    I16(View<'a, i16>),
    U32(View<'a, u32>),
    I32(View<'a, i32>),
    F32(View<'a, f32>),
    F64(View<'a, f64>),
}

/// A [`ViewMut`] of any element type.
pub enum AnyViewMut<'a> {
    U8(ViewMut<'a, u8>),
    I8(ViewMut<'a, i8>),
    U16(ViewMut<'a, u16>),
    I16(ViewMut<'a, i16>),
    U32(ViewMut<'a, u32>),
    I32(ViewMut<'a, i32>),
    F32(ViewMut<'a, f32>),
    F64(ViewMut<'a, f64>),
}

/// Runs `$body` with `$v` bound to the typed view inside an `AnyView` or `AnyViewMut` (`$enum` names which).
#[macro_export]
macro_rules! with_view {
    ($enum:ident, $any:expr, $v:ident => $body:expr) => {
        match $any {
            $crate::grid::$enum::U8($v) => $body,
            $crate::grid::$enum::I8($v) => $body,
            $crate::grid::$enum::U16($v) => $body,
            $crate::grid::$enum::I16($v) => $body,
            $crate::grid::$enum::U32($v) => $body,
            $crate::grid::$enum::I32($v) => $body,
            $crate::grid::$enum::F32($v) => $body,
            $crate::grid::$enum::F64($v) => $body,
        }
    };
}

fn dtype_of<T: Voxel>(_: &[T]) -> DType {
    T::DTYPE
}

impl AnyView<'_> {
    pub fn dtype(&self) -> DType {
        with_view!(AnyView, self, v => dtype_of(v.data))
    }

    pub fn shape(&self) -> Shape {
        with_view!(AnyView, self, v => v.shape)
    }
}

impl AnyViewMut<'_> {
    pub fn dtype(&self) -> DType {
        with_view!(AnyViewMut, self, v => dtype_of(v.data))
    }

    pub fn shape(&self) -> Shape {
        with_view!(AnyViewMut, self, v => v.shape)
    }
}
