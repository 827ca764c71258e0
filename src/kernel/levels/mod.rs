//! Window counts at many thresholds at once.

pub(crate) mod sums;
mod vector;
