//! Chunks that the cache cannot hold often enough are unpacked once, others are not; plans say so, and what they say of
//! memory is what a run can take.

mod common;
mod common_sources;

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

/// Only planes of the region and what its windows see are unpacked, however the volume is packed: what lies behind them may be broken.
#[test]
fn a_region_unpacks_its_own_planes() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [40, 30, 20];
    let bytes: Vec<u8> = (0..40 * 30 * 20).map(|i| hash(3, i) as u8).collect();
    write_npy(&dir.path().join("v.npy"), "|u1", shape, &bytes);
    let stages = "[stage.s]\nop = 'box'\ninput = 'v'\nradius = 2\n[output.o]\npath = 'o.npy'\nfrom = 's.max'\n";
    let made = |input: &str, region: &str| {
        let text = format!("[run]\nmemory = '64MiB'\n[input.v]\n{input}\n{stages}");
        let config = parse(dir.path(), &text, &[&format!("run.region={region}")]);
        let scratch = plan::explain(&config).unwrap().1["scratch_bytes"].as_u64().unwrap();
        let options = occlude::run::RunOptions { overwrite: true, ..Default::default() };
        let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent)?;
        session.run_tasks(&session.open_tasks())?;
        session.finish()?;
        Ok::<_, occlude::Error>((decode(&dir.path().join("o.npy")), scratch))
    };
    let region = "[[5, 9], [0, 30], [0, 20]]";
    let (expected, none) = made("path = 'v.npy'", region).unwrap();
    assert_eq!(none, 0);
    // gzip, whose end is cut off.
    let packed = common_sources::gzip(&bytes);
    std::fs::write(dir.path().join("v.raw.gz"), &packed[..packed.len() - 100]).unwrap();
    // Pages of one deflated strip each, of which that of plane 20 is broken.
    let tiff = dir.path().join("v.tif");
    common_sources::deflated_tiff(&tiff, shape, &bytes, Some(20));
    let gz = "path = 'v.raw.gz'\nformat = 'raw'\nshape = [40, 30, 20]\ndtype = 'u8'";
    for input in [gz, "path = 'v.tif'"] {
        let (got, scratch) = made(input, region).unwrap();
        assert_same(input, &got, &expected);
        assert!((8 * 600..=11 * 600).contains(&scratch), "{input}: {scratch} bytes of scratch");
        let error = made(input, "all").unwrap_err().to_string();
        assert!(error.contains("v.raw.gz") || error.contains("v.tif"), "{error}");
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
