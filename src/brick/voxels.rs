//! A typed, densely packed buffer of voxels.

use crate::grid::{AnyView, AnyViewMut, DType, Shape, View, ViewMut, Voxel};

/// Voxels of one box and one component, of any element type, densely packed.
#[derive(Debug, Clone, PartialEq)]
pub enum Voxels {
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// Runs `$body` with `$v` bound to the typed `Vec` inside a [`Voxels`].
#[macro_export]
macro_rules! with_voxels {
    ($any:expr, $v:ident => $body:expr) => {
        match $any {
            $crate::brick::Voxels::U8($v) => $body,
            $crate::brick::Voxels::I8($v) => $body,
            $crate::brick::Voxels::U16($v) => $body,
            $crate::brick::Voxels::I16($v) => $body,
            $crate::brick::Voxels::U32($v) => $body,
            $crate::brick::Voxels::I32($v) => $body,
            $crate::brick::Voxels::F32($v) => $body,
            $crate::brick::Voxels::F64($v) => $body,
        }
    };
}

macro_rules! per_type {
    ($($variant:ident),*) => {
        impl Voxels {
            /// `len` zeros.
            pub fn zeroed(dtype: DType, len: usize) -> Voxels {
                match dtype { $(DType::$variant => Voxels::$variant(vec![Default::default(); len]),)* }
            }

            pub fn dtype(&self) -> DType {
                match self { $(Voxels::$variant(_) => DType::$variant,)* }
            }

            /// Borrowed with an extent. Panics if the buffer is too short.
            pub fn view(&self, shape: Shape) -> AnyView<'_> {
                match self { $(Voxels::$variant(v) => AnyView::$variant(View::dense(v, shape)),)* }
            }

            /// Borrowed for writing. Panics if the buffer is too short.
            pub fn view_mut(&mut self, shape: Shape) -> AnyViewMut<'_> {
                match self { $(Voxels::$variant(v) => AnyViewMut::$variant(ViewMut::dense(v, shape)),)* }
            }
        }
    };
}
per_type!(U8, I8, U16, I16, U32, I32, F32, F64);

macro_rules! from_vec {
    ($($variant:ident: $t:ty),*) => {$(
        impl From<Vec<$t>> for Voxels {
            fn from(v: Vec<$t>) -> Voxels {
                Voxels::$variant(v)
            }
        }
    )*};
}
from_vec!(U8: u8, I8: i8, U16: u16, I16: i16, U32: u32, I32: i32, F32: f32, F64: f64);

impl Voxels {
    /// One voxel, rounded and saturated to the type.
    pub fn one(dtype: DType, value: f64) -> Voxels {
        let mut voxel = Voxels::zeroed(dtype, 1);
        voxel.fill(value);
        voxel
    }

    /// Voxels held.
    pub fn len(&self) -> usize {
        with_voxels!(self, v => v.len())
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of memory reserved.
    pub fn capacity_bytes(&self) -> usize {
        with_voxels!(self, v => v.capacity()) * self.dtype().size()
    }

    /// Sets every voxel to the value nearest to `value`.
    pub fn fill(&mut self, value: f64) {
        fn set<T: Voxel>(v: &mut [T], value: f64) {
            v.fill(T::from_f64(value));
        }
        with_voxels!(self, v => set(v, value))
    }

    pub fn at(&self, index: usize) -> f64 {
        with_voxels!(self, v => v[index].to_f64())
    }

    /// Bytes in this machine's order.
    pub fn as_bytes(&self) -> &[u8] {
        with_voxels!(self, v => bytemuck::cast_slice(v))
    }

    /// Bytes in this machine's order, for writing.
    pub fn as_bytes_mut(&mut self) -> &mut [u8] {
        with_voxels!(self, v => bytemuck::cast_slice_mut(v))
    }
}
