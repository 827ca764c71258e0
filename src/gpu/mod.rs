//! The GPU lane through wgpu. Window sums and extremes of small integers and obscurance are exact integers; statistics, steps
//! that look at one voxel, levels and conversions are made in f64 that shaders build of integers. All of these equal the CPU's
//! bit for bit; floats hold the tolerances that [`facts::tolerance`] states.
//!
//! | file | holds |
//! |---|---|
//! | `facts` | what the planner knows of an adapter; which stages have kernels |
//! | `record`, `recorder` | the device's work as data: buffers, dispatches, what comes back; put together |
//! | `shaders` | their texts, put together of what they share |
//! | `passes`, `sweep`, `taps`, `slopes` | windows, obscurance, Gaussians and gradients recorded, cut into parts that fit |
//! | `pairs`, `probe` | f32 arithmetic as the shaders ask for it, and whether a device does it so |
//! | `maps`, `occlusion` | occlusion maps recorded, and called |
//! | `masks`, `extend` | voxels that nobody needs, what lies beyond the volume |
//! | `finish`, `points`, `levels` | results of windows, steps that look at one voxel, pyramids, recorded |
//! | `flow`, `flow_steps`, `flow_call` | several steps and their levels recorded together, and called |
//! | `unfit` | why work is not the device's |
//! | `nodes` | whether a machine can have a GPU at all |
//! | `backend` | Vulkan, Metal or Direct3D 12 |
//! | `device`, `slot` | an open adapter, the buffers of one brick on its way |
//! | `engine` | runs recordings, survives a lost device once |
//! | `rate` | how fast a device moves memory |
//! | `windows`, `float_windows`, `obscurance`, `gaussian`, `gradient` | calls like the CPU kernels' |
//!
//! What records work knows no wgpu: `backend`, `device`, `slot`, `engine`, `probe` and the calls do.

mod backend;
pub mod device;
pub mod engine;
pub mod extend;
pub mod facts;
pub mod finish;
mod float_windows;
pub mod flow;
mod flow_call;
mod flow_steps;
mod gaussian;
mod gradient;
pub mod levels;
pub mod maps;
mod masks;
mod nodes;
mod obscurance;
mod occlusion;
pub mod pairs;
pub mod passes;
pub mod points;
mod probe;
mod rate;
pub mod record;
pub mod recorder;
pub mod shaders;
pub mod slopes;
mod slot;
pub mod stored;
pub mod sweep;
pub mod taps;
mod unfit;
mod windows;

pub use engine::{Gpu, GpuError, Times};
pub use facts::{GpuFacts, GpuKind};
pub use flow_call::{Needed, SinkOut};
pub use occlusion::MapLevels;
pub use unfit::Unfit;

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
