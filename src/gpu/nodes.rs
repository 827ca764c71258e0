//! Whether this machine can have a GPU at all. To open Vulkan takes 25 to 30 ms where only a software driver is installed
//! (2-core Zen 4 VM, lavapipe, 2026-11-26), a fifth of a small run, and drivers print what they please; a glance at the
//! device nodes takes microseconds.

/// Beginnings of the names of the kernel's device nodes of GPUs, in /dev: DRM (Intel, AMD, nouveau, Asahi, Panfrost, MSM),
/// NVIDIA, AMD compute, WSL 2, Tegra, Mali, Adreno.
const NODES: [&str; 8] = ["dri/renderD", "nvidia", "kfd", "dxg", "nvgpu", "nvhost-", "mali", "kgsl"];

/// What was looked for in vain, if there is no node of a GPU. Other systems than Linux always may have one.
pub fn none() -> Option<String> {
    if !cfg!(target_os = "linux") || any(std::path::Path::new("/dev")) {
        return None;
    }
    Some("found no device node of a GPU (/dev/dri/renderD*, /dev/nvidia* or the like)".to_string())
}

fn any(dev: &std::path::Path) -> bool {
    NODES.iter().any(|node| {
        let (folder, start) = node.rsplit_once('/').unwrap_or(("", node));
        let entries = std::fs::read_dir(dev.join(folder)).into_iter().flatten().flatten();
        entries.into_iter().any(|e| e.file_name().to_string_lossy().starts_with(start))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_found_by_how_its_name_starts() {
        let dev = tempfile::tempdir().unwrap();
        assert!(!any(dev.path()), "an empty folder");
        std::fs::create_dir(dev.path().join("dri")).unwrap();
        std::fs::write(dev.path().join("dri/card0"), "").unwrap();
        std::fs::write(dev.path().join("null"), "").unwrap();
        assert!(!any(dev.path()), "a display without a renderer is no GPU");
        std::fs::write(dev.path().join("dri/renderD128"), "").unwrap();
        assert!(any(dev.path()));
        std::fs::remove_file(dev.path().join("dri/renderD128")).unwrap();
        std::fs::write(dev.path().join("nvidia0"), "").unwrap();
        assert!(any(dev.path()));
        assert!(!any(&dev.path().join("missing")));
    }
}
