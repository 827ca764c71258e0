//! The configuration: text to typed values.

pub mod model;

pub use model::*;
