//! What another device needs to make the results of integer windows from exact sums with the bits of this kernel: the
//! formulas are those of [`super::estimate`] and [`super::emit`], in f64, of which the widths choose one.

pub use super::estimate::Width;
