//! Chunks that the cache cannot hold often enough are unpacked once, others are not; plans say so, and what they say of
//! memory is what a run can take.

mod common;

use std::path::Path;

use common::*;
use occlude::plan;

/// Voxels that pack badly, so that bytes read count what was decoded.
const NOISE: &str = "synthetic = 'noise'\nshape = [160, 160, 160]\ndtype = 'f32'\n";
const SWEEP: &str = "op = 'obscurance'\ninput = 'v'\ndirections = 12\nmax_distance = 64\n";
const WINDOW: &str = "op = 'box'\ninput = 'v'\nradius = 12\n";

/// Stores the noise in chunks of this shape; the bytes that they take.
fn store(dir: &Path, chunk: [usize; 3]) -> u64 {
    let output = "[output.o]\nfrom = 'v'\npath = 'v.zarr'\nlevels = 1\nshard = 'none'\n";
    run(dir, &format!("[input.v]\n{NOISE}{output}chunk = {chunk:?}\n"), &[]).bytes_written
}

/// A run of a stage over what is stored, its report, and the scratch that its plan says.
fn of_stored(dir: &Path, stage: &str, memory: &str) -> (occlude::run::Report, u64) {
    let text = format!(
        "[run]\nmemory = '{memory}'\nthreads = 1\ndevice = 'cpu'\n[input.v]\npath = 'v.zarr'\n[stage.s]\n{stage}\
         [output.o]\npath = 'o.zarr'\nfrom = 's'\n"
    );
    let (_, json) = plan::explain(&parse(dir, &text, &[])).unwrap();
    assert!(json["peak_memory_bytes"].as_u64() <= json["memory_budget_bytes"].as_u64(), "{json}");
    (run(dir, &text, &[]), json["scratch_bytes"].as_u64().unwrap())
}

#[test]
fn chunks_beyond_the_cache_are_unpacked_once_and_others_are_not() {
    let dir = tempfile::tempdir().unwrap();
    let volume = 160 * 160 * 160 * 4;
    for (chunk, stage, memory, unpacked) in [
        // One chunk of 16 MiB, of which every brick wants a part.
        ([160, 160, 160], WINDOW, "40MiB", true),
        ([160, 160, 160], SWEEP, "40MiB", true),
        ([160, 160, 160], WINDOW, "256MiB", false),
        // Eight chunks of 2 MiB, all of them beneath each brick and its lines.
        ([80, 80, 80], SWEEP, "40MiB", true),
        ([80, 80, 80], WINDOW, "256MiB", false),
        ([32, 32, 32], WINDOW, "256MiB", false),
        ([32, 32, 32], SWEEP, "256MiB", false),
    ] {
        let stored = store(dir.path(), chunk);
        let (report, scratch) = of_stored(dir.path(), stage, memory);
        let what = format!("{chunk:?}, {memory}, {stage}: {} bytes read of {stored}", report.bytes_read);
        assert_eq!(scratch >= volume, unpacked, "{what}, scratch {scratch}");
        assert!(report.bytes_read >= stored && report.bytes_read as f64 <= 1.3 * stored as f64, "{what}");
    }
}

#[test]
fn unpacking_changes_no_voxel() {
    let dir = tempfile::tempdir().unwrap();
    let mut seen: Option<Decoded> = None;
    for (chunk, memory) in [([160, 160, 160], "40MiB"), ([160, 160, 160], "256MiB"), ([32, 32, 32], "256MiB")] {
        store(dir.path(), chunk);
        of_stored(dir.path(), WINDOW, memory);
        let decoded = decode(&dir.path().join("o.zarr"));
        assert!(seen.replace(decoded.clone()).is_none_or(|s| s == decoded), "{chunk:?}, {memory}");
    }
}

#[test]
fn a_tiny_volume_is_not_said_to_take_the_whole_budget() {
    let dir = tempfile::tempdir().unwrap();
    let peak = |path: &str| {
        let text = format!(
            "[run]\nmemory = '2GiB'\nthreads = 2\ndevice = 'cpu'\n[input.v]\npath = '{path}'\n[stage.s]\nop = 'box'\n\
             input = 'v'\nradius = 3\n[output.o]\npath = 'o.zarr'\nfrom = 's.mean'\n"
        );
        let (said, json) = plan::explain(&parse(dir.path(), &text, &[])).unwrap();
        (json["peak_memory_bytes"].as_u64().unwrap(), said)
    };
    write_npy(&dir.path().join("v.npy"), "|u1", [16, 16, 16], &[7; 4096]);
    run(dir.path(), "[input.v]\npath = 'v.npy'\n[output.o]\npath = 'v.zarr'\nfrom = 'v'\n", &[]);
    for path in ["v.npy", "v.zarr"] {
        let (bytes, said) = peak(path);
        assert!((16 << 20..64 << 20).contains(&bytes), "{bytes} bytes: {said}");
    }
}
