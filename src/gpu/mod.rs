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
pub use facts::{GpuFacts, GpuKind};

use crate::config::Device;

/// Opens the GPU that a config's `run.device` means, keeps it in `opened`, and says what it is.
///
/// # Errors
/// What was looked for and what was found.
pub fn find(device: Device, opened: &mut Option<Gpu>) -> Result<GpuFacts, String> {
    let kind = match device {
        Device::GpuSoftware => GpuKind::Software,
        _ => GpuKind::Hardware,
    };
    let gpu = Gpu::open(kind)?;
    Ok(opened.insert(gpu).facts().clone())
}
