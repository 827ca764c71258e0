//! What can be done with a view of any element type without knowing the type.

use super::{AnyView, AnyViewMut, Shape};

macro_rules! map_any {
    ($enum:ident, $any:expr, $v:ident => $body:expr) => {
        match $any {
            $enum::U8($v) => $enum::U8($body),
            $enum::I8($v) => $enum::I8($body),
            $enum::U16($v) => $enum::U16($body),
            $enum::I16($v) => $enum::I16($body),
            $enum::U32($v) => $enum::U32($body),
            $enum::I32($v) => $enum::I32($body),
            $enum::F32($v) => $enum::F32($body),
            $enum::F64($v) => $enum::F64($body),
        }
    };
}

impl<'a> AnyView<'a> {
    /// The part of `shape` voxels that starts at `lo`. Panics if it sticks out.
    pub fn part(self, lo: [usize; 3], shape: Shape) -> AnyView<'a> {
        map_any!(AnyView, self, v => v.part(lo, shape))
    }

    /// One voxel as f64 (exact but for nothing: every type fits).
    pub fn at_f64(&self, index: [usize; 3]) -> f64 {
        use super::Voxel;
        crate::with_view!(AnyView, self, v => v.at(index).to_f64())
    }
}

impl<'a> AnyViewMut<'a> {
    pub fn as_view(&self) -> AnyView<'_> {
        macro_rules! arms {
            ($($t:ident),*) => { match self { $(AnyViewMut::$t(v) => AnyView::$t(v.as_view()),)* } };
        }
        arms!(U8, I8, U16, I16, U32, I32, F32, F64)
    }

    /// The part of `shape` voxels that starts at `lo`. Panics if it sticks out.
    pub fn part(self, lo: [usize; 3], shape: Shape) -> AnyViewMut<'a> {
        map_any!(AnyViewMut, self, v => v.part(lo, shape))
    }

    /// A shorter borrow of the same voxels.
    pub fn reborrow(&mut self) -> AnyViewMut<'_> {
        map_any!(AnyViewMut, self, v => v.reborrow())
    }
}
