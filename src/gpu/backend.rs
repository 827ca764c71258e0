//! The one way to GPUs that is used on each system, and what its drivers are called. The features of wgpu in Cargo.toml are the
//! same three.

/// What the instance looks for.
pub const BACKENDS: wgpu::Backends = if cfg!(windows) {
    wgpu::Backends::DX12
} else if cfg!(target_vendor = "apple") {
    wgpu::Backends::METAL
} else {
    wgpu::Backends::VULKAN
};

/// Its name in messages.
pub const NAME: &str = if cfg!(windows) {
    "Direct3D 12"
} else if cfg!(target_vendor = "apple") {
    "Metal"
} else {
    "Vulkan"
};

/// A driver in software that it may find.
pub const SOFTWARE: &str = if cfg!(windows) {
    "such as WARP"
} else if cfg!(target_vendor = "apple") {
    "of which Metal has none"
} else {
    "such as lavapipe"
};

/// Whether the language that shaders are translated to bounds the errors of f32 operations: SPIR-V does (quotients to 2.5 units
/// in the last place, sums and products rounded, no re-ordering but by decorations that naga does not write); Metal compiles with
/// fast mathematics and Direct3D leaves quotients and roots to the driver, so that a probe looks at what comes out. It takes
/// 0.4 s where every shader is compiled for it (lavapipe, 2-core Zen 4 VM, AVX-512, 2026-11-26), against 0.1 s for all else of opening.
pub const BOUNDS_ERRORS: bool = !cfg!(any(windows, target_vendor = "apple"));
