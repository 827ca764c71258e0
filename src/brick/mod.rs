//! Voxels in memory: typed buffers that are recycled, and scratch that belongs to a worker.

pub mod gather;
pub mod pool;
pub mod scratch;
pub mod voxels;

pub use pool::Pool;
pub use scratch::Scratch;
pub use voxels::Voxels;
