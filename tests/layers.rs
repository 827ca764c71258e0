//! The map of the source cannot go stale: which folder may name which, and where external crates live.

use std::fs;
use std::path::{Path, PathBuf};

/// Folder and the folders of this crate that it must never name.
const NEVER: [(&str, &[&str]); 9] = [
    ("grid", &["brick", "stage", "kernel", "store", "config", "plan", "run", "cli", "gpu"]),
    ("brick", &["stage", "kernel", "store", "config", "plan", "run", "cli", "gpu"]),
    ("stage", &["brick", "kernel", "store", "config", "plan", "run", "cli", "gpu"]),
    ("kernel", &["store", "config", "plan", "run", "cli", "gpu"]),
    ("store", &["kernel", "plan", "run", "cli", "gpu"]),
    ("config", &["brick", "kernel", "store", "plan", "run", "cli", "gpu"]),
    // The plan reads the GPU lane's facts and its arithmetic of bytes; wgpu itself stays in `gpu` (below).
    ("plan", &["run", "cli"]),
    ("gpu", &["store", "plan", "run", "cli"]),
    ("run", &["cli"]),
];

/// External crate and the folders that may name it.
const HOMES: [(&str, &[&str]); 5] = [
    ("zarrs", &["store"]),
    ("memmap2", &["store"]),
    // Commands decode a row of chunks in parallel when they look at a volume without a run.
    ("rayon", &["run", "cli"]),
    ("crossbeam_channel", &["run"]),
    ("wgpu", &["gpu"]),
];

fn sources(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found
}

/// Lines of code, without comments and without what stands below `#[cfg(test)] mod`.
fn code(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap();
    let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default().to_string();
    text.lines().map(|l| l.split("//").next().unwrap_or_default().to_string()).collect()
}

#[test]
fn folders_name_only_what_lies_below() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut faults = Vec::new();
    for (folder, never) in NEVER {
        for path in sources(&src.join(folder)) {
            if path.file_name().is_some_and(|n| n.to_string_lossy().contains("test")) {
                continue;
            }
            // Instruction levels are chosen in one place; copies that swap bytes choose theirs there too.
            for line in code(&path).into_iter().filter(|l| !l.contains("crate::kernel::simd::")) {
                for other in never.iter().filter(|o| line.contains(&format!("crate::{o}::"))) {
                    faults.push(format!("{}: {folder} names {other}: {}", path.display(), line.trim()));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn external_crates_have_one_home() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut faults = Vec::new();
    for path in sources(&src) {
        let folder =
            path.strip_prefix(&src).unwrap().components().next().unwrap().as_os_str().to_string_lossy().to_string();
        for line in code(&path) {
            for (name, homes) in HOMES {
                if line.contains(&format!("{name}::")) && !homes.contains(&folder.as_str()) {
                    faults.push(format!("{}: {name}: {}", path.display(), line.trim()));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
