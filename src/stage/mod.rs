//! What each stage is: parameters with units and ranges, channels, reach, tolerance, the paper it follows. Touches no voxel.

pub mod directions;
pub mod params;

pub use params::*;
