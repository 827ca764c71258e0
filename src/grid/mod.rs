//! Boxes, shapes, element types and borrowed views: the vocabulary that every other folder shares.
//!
//! Axes are `[z, y, x]` everywhere, x contiguous. Boxes are half-open. Voxel centres lie at integer indices.

pub mod affine;
pub mod any;
pub mod border;
pub mod dtype;
pub mod hash;
pub mod order;
pub mod region;
pub mod view;

pub use affine::Affine;
pub use border::Border;
pub use dtype::{DType, Voxel};
pub use region::{Region, Shape};
pub use view::{AnyView, AnyViewMut, View, ViewMut};
