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
