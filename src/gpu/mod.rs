//! The GPU lane through wgpu. Window sums and extremes of small integers and obscurance are exact integers, finished by the
//! CPU kernels' own row functions, so that a GPU's results equal the CPU's bit for bit; floats hold the tolerances that
//! [`facts::tolerance`] states.
//!
//! | file | holds |
//! |---|---|
//! | `facts` | what the planner knows of an adapter; which stages have kernels |
//! | `record` | the device's work as data: buffers, dispatches, what comes back |
//! | `shaders` | their texts, put together of what they share |
//! | `passes`, `sweep`, `taps`, `slopes` | windows, obscurance, Gaussians and gradients recorded, cut into parts that fit |
//! | `pairs`, `probe` | f32 arithmetic as the shaders ask for it, and whether a device does it so |
//! | `maps`, `occlusion` | occlusion maps recorded, and called |
//! | `finish` | results of f32 windows made of moments there |
//! | `chain`, `smoothed` | a Gaussian and what reads it, recorded together and called |
//! | `nodes` | whether a machine can have a GPU at all |
//! | `device`, `slot` | an open adapter, the buffers of one brick on its way |
//! | `engine` | runs recordings, survives a lost device once |
//! | `windows`, `float_windows`, `obscurance`, `gaussian`, `gradient` | calls like the CPU kernels' |
//!
//! Everything above `device` knows no wgpu.

pub mod chain;
pub mod device;
pub mod engine;
pub mod facts;
pub mod finish;
mod float_windows;
mod gaussian;
mod gradient;
pub mod maps;
mod nodes;
mod obscurance;
mod occlusion;
pub mod pairs;
pub mod passes;
mod probe;
pub mod record;
pub mod shaders;
pub mod slopes;
mod slot;
mod smoothed;
pub mod sweep;
pub mod taps;
mod windows;

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
    // Only where a GPU is not asked for: a device node that this list lacks must not keep anybody from theirs.
    if device == Device::Auto
        && let Some(missing) = nodes::none()
    {
        return Err(missing);
    }
    let gpu = Gpu::open(kind)?;
    Ok(opened.insert(gpu).facts().clone())
}
