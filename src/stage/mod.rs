//! What each stage is: its parameters as kernels and planner take them, and the directions of sweeps. Touches no voxel.

pub mod directions;
pub mod params;

pub use params::*;
