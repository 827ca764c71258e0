//! Unneeded work is not done (SPEC 5.5), and it is counted why; nothing is decoded twice.

mod common;

use std::path::Path;

use common::*;
use occlude::run::Report;

fn skipped(report: &Report, cause: &str) -> u64 {
    report.bricks.skipped.get(cause).copied().unwrap_or(0)
}

/// A cube of noise in the middle of zeros.
fn island(dir: &Path) {
    let shape = [96, 96, 96];
    let inside = |i: usize| (40..56).contains(&i);
    let v = fill(shape, |z, y, x| {
        if inside(z) && inside(y) && inside(x) {
            (hash(1, ((z * 96 + y) * 96 + x) as u64) % 60000) as u16 + 1
        } else {
            0
        }
    });
    write_npy(&dir.join("vol.npy"), "<u2", shape, &u16_bytes(&v));
}

const STAGE: &str = "[stage.s]\nop = 'box'\ninput = 'a'\nradius = 2\n[output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 16\nshard = 32\n";

#[test]
fn constant_bricks_are_skipped_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = format!("[run]\nbrick = 16\n[input.a]\npath = 'vol.npy'\n{STAGE}");
    let report = run(dir.path(), &text, &[]);
    // 6^3 bricks; those whose window touches the island (38..58) are bricks 2 and 3 of each axis.
    assert_eq!(report.bricks.total, 216);
    assert_eq!(report.bricks.computed, 8);
    assert_eq!(skipped(&report, "constant"), 208);
}

#[test]
fn missing_chunks_are_not_decoded_and_present_ones_once() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let store =
        "[input.a]\npath = 'vol.npy'\n[output.o]\npath = 'in.zarr'\nfrom = 'a'\nchunk = 16\nshard = 32\nlevels = 1\n";
    run(dir.path(), store, &[]);
    let text = format!("[run]\nbrick = 16\nthreads = 2\n[input.a]\npath = 'in.zarr'\n{STAGE}");
    let report = run(dir.path(), &text, &[]);
    assert_eq!(report.bricks.computed, 8);
    // Bricks 1 and 4 of an axis see zeros of chunks that are stored: constant, not missing.
    assert_eq!(skipped(&report, "missing_chunk"), 216 - 64);
    assert_eq!(skipped(&report, "constant"), 64 - 8);
    let stored: u64 = shards(&dir.path().join("in.zarr/0/c"));
    assert!(report.bytes_read <= stored, "{} bytes read of {stored} stored", report.bytes_read);
    let full = run(dir.path(), &text.replace("radius = 2", "radius = 20"), &[]);
    assert!(full.bytes_read <= stored, "halos decode nothing twice: {} of {stored}", full.bytes_read);
    assert!(full.read_amplification > 5.0, "{}", full.read_amplification);
}

fn shards(dir: &Path) -> u64 {
    let entries = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap());
    entries.map(|e| if e.path().is_dir() { shards(&e.path()) } else { e.metadata().unwrap().len() }).sum()
}

#[test]
fn what_no_mask_needs_is_not_read() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    // A second volume, as large, that only the masked stage reads.
    let other = fill([96, 96, 96], |z, y, x| hash(2, ((z * 96 + y) * 96 + x) as u64) as u8);
    write_npy(&dir.path().join("other.npy"), "|u1", [96, 96, 96], &other);
    let text = "[run]\nbrick = 16\n[input.a]\npath = 'vol.npy'\n[input.b]\npath = 'other.npy'\n[stage.s]\nop = 'box'\ninput = 'b'\n\
                radius = 1\nwhere = { input = 'a', min = 1 }\n[output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 16\n";
    let report = run(dir.path(), text, &[]);
    assert_eq!(skipped(&report, "where"), 216 - 8);
    assert_eq!(report.bricks.computed, 8);
    // The mask's input whole (2 bytes a voxel), of the other only eight bricks with their halos.
    assert!(report.bytes_read <= 96 * 96 * 96 * 2 + 8 * 18 * 18 * 18, "{}", report.bytes_read);
}

#[test]
fn bricks_outside_the_region_are_not_visited() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text =
        format!("[run]\nbrick = 16\nregion = [[32, 64], [32, 64], [0, 16]]\n[input.a]\npath = 'vol.npy'\n{STAGE}");
    assert_eq!(run(dir.path(), &text, &[]).bricks.total, 4);
}

#[test]
fn channels_that_nobody_reads_are_not_planned() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = format!(
        "[input.a]\npath = 'vol.npy'\n[stage.unused]\nop = 'obscurance'\ninput = 'a'\n[stage.again]\nop = 'ambient_occlusion'\n\
         input = 'a'\nmethod = 'cdf_power'\nradius = 2\n{STAGE}[output.p]\npath = 'p.zarr'\nfrom = 'again'\n"
    );
    let (text, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
    let steps = plan["steps"].as_array().unwrap();
    assert_eq!(steps.len(), 1, "one pass serves both stages: {text}");
    assert_eq!(steps[0]["makes"], "again.openness, s.mean".to_string().as_str(), "{text}");
}
