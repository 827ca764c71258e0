//! What the planner knows about a GPU, and which windows have kernels there. No wgpu here.

use crate::grid::DType;
use crate::stage::{Method, WindowChannel};

/// Which adapters may be opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GpuKind {
    /// Anything but software.
    Hardware,
    /// A software adapter (lavapipe, SwiftShader): slow, right, for tests.
    Software,
}

/// An adapter as the planner sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuFacts {
    pub name: String,
    /// Device memory is this process's memory.
    pub software: bool,
    /// Most bytes of one buffer that a shader can see.
    pub most_bytes: u64,
    /// f32 arithmetic is the CPU's, bit for bit, where shaders ask for it.
    pub exact_floats: bool,
    /// Openness and gradients, of which f32 may differ in their last bits, lie within [`tolerance`].
    pub close_floats: bool,
}

/// Why exact openness stays on the CPU.
pub const EXACT: &str = "no GPU kernel for exact openness: runs on the CPU";

/// Why the beta distribution stays on the CPU.
pub const BETA: &str = "no GPU kernel for method \"beta\": runs on the CPU";

/// Why quantile levels stay on the CPU.
pub const LEVELS: &str = "no GPU kernel for method \"levels\": runs on the CPU";

/// Why four moments stay on the CPU: sums of fourth powers take 96 bits, and bounds of their rounding f64.
pub const MOMENTS4: &str = "no GPU kernel for method \"moments4\", whose guarantee takes f64: runs on the CPU";

/// Why moments for `reduce = "moments"` stay on the CPU, but for bytes.
pub const UNROUNDED: &str = "no GPU kernel for means in f64, which `reduce = \"moments\"` pools: runs on the CPU";

/// Bricks that are on the GPU's way at once at least: one is packed, one computes, one is read back and finished.
pub const SLOTS: u64 = 3;

/// And at most, where memory and workers allow it: results of f32 take a core longer to copy than the device to make. Streams of
/// u8 bricks of 256^3 (H200 beside 16 cores, 2026-11-27): gradients of a Gaussian 104, 123, 144, 157 bricks/s with 3, 4, 5, 6 slots,
/// `cdf_power` 122, 147, 175, 202.
pub const MOST_SLOTS: u64 = 6;

impl GpuFacts {
    /// Bytes to which each buffer is held, so that all of them together stay a part of `memory` (up to nine buffers' worth
    /// per slot) and a dispatch stays short. Larger boxes are cut.
    pub fn buffer_cap(&self, memory: u64) -> u64 {
        self.most_bytes.min((memory / 48).clamp(256 << 10, 256 << 20))
    }
}

/// Whether windows of this type have a GPU kernel, or why not. Of f32 they also ask for [`GpuFacts::exact_floats`].
pub fn window(dtype: DType, missing: bool, channels: &[WindowChannel]) -> Result<(), &'static str> {
    if channels.iter().any(|c| matches!(c, WindowChannel::Openness(Method::Exact, _))) {
        return Err(EXACT);
    }
    if channels.iter().any(|c| matches!(c, WindowChannel::Openness(Method::Levels, _))) {
        return Err(LEVELS);
    }
    if channels.iter().any(|c| matches!(c, WindowChannel::Openness(Method::Moments4, _))) {
        return Err(MOMENTS4);
    }
    if channels.iter().any(|c| matches!(c, WindowChannel::Openness(Method::Beta, _))) {
        return Err(BETA);
    }
    match dtype {
        DType::U8 | DType::I8 | DType::U16 | DType::I16 if missing => {
            Err("no GPU kernel for voxels that may be missing (nodata): runs on the CPU")
        }
        DType::U8 | DType::I8 | DType::U16 | DType::I16 => Ok(()),
        DType::U32 | DType::I32 => Err("no GPU kernel that sums 32-bit integers exactly: runs on the CPU"),
        DType::F32 => Ok(()),
        DType::F64 => Err("no GPU kernel that holds SPEC 5.6 for f64: runs on the CPU"),
    }
}

/// Why float stages stay on the CPU where an adapter rounds otherwise.
pub const INEXACT: &str = "the adapter rounds or fuses f32 operations unlike the CPU: runs on the CPU";

/// Why openness and gradients stay on the CPU where an adapter is less exact than its kind.
pub const ROUGH: &str = "openness or gradients of the adapter miss the tolerances: runs on the CPU";

/// Whether a Gaussian of this type has a GPU kernel, or why not. It also asks for [`GpuFacts::exact_floats`].
pub fn gaussian(dtype: DType, missing: bool) -> Result<(), &'static str> {
    match dtype {
        DType::U8 | DType::I8 | DType::U16 | DType::I16 if missing => {
            Err("no GPU kernel for voxels that may be missing (nodata): runs on the CPU")
        }
        DType::U8 | DType::I8 | DType::U16 | DType::I16 => Ok(()),
        // NaN, infinities and subnormals, which drivers treat as they like.
        DType::F32 => {
            Err("no GPU kernel for a Gaussian of f32, whose NaN and subnormals drivers treat freely: runs on the CPU")
        }
        DType::U32 | DType::I32 | DType::F64 => Err("no GPU kernel for a Gaussian in f64: runs on the CPU"),
    }
}

/// Why the normals of a sweep stay on the CPU.
pub const NORMALS: &str =
    "normals of a sweep come from gradients in f64, since a gradient that vanishes decides there: runs on the CPU";

/// Whether gradients of this type have a GPU kernel, or why not. `normals`: a sweep weighs its directions by them.
pub fn gradient(dtype: DType, normals: bool) -> Result<(), &'static str> {
    match dtype {
        _ if normals => Err(NORMALS),
        DType::U8 | DType::I8 | DType::U16 | DType::I16 | DType::F32 => Ok(()),
        DType::U32 | DType::I32 | DType::F64 => Err("no GPU kernel for a gradient in f64: runs on the CPU"),
    }
}

/// Whether the chain of an occlusion map over voxels of this type has a GPU kernel, or why not. It also asks for
/// [`GpuFacts::exact_floats`].
pub fn occlusion_map(dtype: DType, missing: bool) -> Result<(), &'static str> {
    match dtype {
        DType::U8 | DType::I8 | DType::U16 | DType::I16 if missing => {
            Err("no GPU kernel for voxels that may be missing (nodata): runs on the CPU")
        }
        DType::U8 | DType::I8 | DType::U16 | DType::I16 => Ok(()),
        _ => Err("no GPU kernel for an occlusion map of 32-bit integers or floats: runs on the CPU"),
    }
}

/// Why an occlusion map stays on the CPU where a cell of its last level sees too many voxels.
pub const MAP_TOO_LARGE: &str = "a cell of the occlusion map does not fit the GPU's buffers: runs on the CPU";

/// The same for windows.
pub const WINDOW_TOO_LARGE: &str = "a window does not fit the GPU's buffers: runs on the CPU";

/// How far floats of the GPU may be from the CPU's. What is not here is the same bit for bit.
pub mod tolerance {
    /// Components and magnitudes of gradients, times the range of the window's values over the (least) spacing. The sums of
    /// up to 27 products in f32: 27 * 2^-24 at worst, of weights that together are less than the inverse of the spacing.
    pub const GRADIENT: f64 = 2e-6;

    /// Means of windows of f32, and of cells of occlusion maps, times the range of the window's values: merges of pairs round a step toward another mean to
    /// f32, at most half of the distance. The second moment E\[v^2\] has this times its largest magnitude.
    pub const MEAN: f64 = 1e-6;
    /// Variances of windows of f32, of Gaussians and of cells of occlusion maps, relative (SPEC 5.2).
    pub const VARIANCE: f64 = 1e-5;
    /// Openness (SPEC 5.6).
    pub const OPENNESS: f64 = 1e-5;
}

/// Whether obscurance of this type has a GPU kernel, or why not. `plain`: openness alone, with weights that depend on the
/// direction only.
pub fn obscurance(dtype: DType, plain: bool) -> Result<(), &'static str> {
    match dtype {
        _ if !plain => Err("no GPU kernel for colour bleeding and weight_by_normal: runs on the CPU"),
        DType::F64 => Err("no GPU kernel that orders f64: runs on the CPU"),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stage::Ties;

    #[test]
    fn estimators_without_a_shader_stay_on_the_cpu() {
        let open = |method| [WindowChannel::Openness(method, Ties::Le)];
        assert_eq!(window(DType::U8, false, &open(Method::Beta)), Err(BETA));
        assert_eq!(window(DType::U8, false, &open(Method::Exact)), Err(EXACT));
        assert_eq!(window(DType::U8, false, &open(Method::Levels)), Err(LEVELS));
        assert_eq!(window(DType::U8, false, &open(Method::Moments4)), Err(MOMENTS4));
        assert_eq!(window(DType::U8, false, &open(Method::CdfPower)), Ok(()));
    }
}
