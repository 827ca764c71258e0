//! The GPU lane: exact integer window sums and extremes through wgpu, finished by the CPU kernel's own row functions, so
//! that a GPU's results equal the CPU's bit for bit.
//!
//! [`facts`] and [`passes`] know no wgpu: the planner uses them. [`device`] finds an adapter and opens it, [`slot`] holds
//! the buffers of one brick at a time, [`engine`] runs windows and survives a lost device once.

pub mod device;
pub mod engine;
pub mod facts;
pub mod passes;
mod slot;

pub use engine::{Gpu, GpuError, Times};
pub use facts::{GpuFacts, GpuKind, supports};
