//! Sweeps whose bricks with halos do not fit read the columns of their lines instead: nothing of that shows in the output.

mod common;

use std::path::Path;

use common::*;
use occlude::plan::Plan;
use occlude::run::{RunOptions, Session, Silent};
use occlude::store::open_inputs;

const SHAPE: [usize; 3] = [130, 170, 560];

/// The volume comes as .npy and as Zarr with chunks that are not stored.
const CONFIG: &str = r#"
[run]
memory = "4GiB"
device = "cpu"
threads = 2
[input.vol]
path = "vol.npy"
nodata = 7
[stage.sweep]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 110
[output.o]
path = "o.zarr"
from = "sweep"
dtype = "f32"
"#;
const COPY: &str = r#"
[input.vol]
path = "vol.npy"
[output.copy]
path = "vol.zarr"
from = "vol"
chunk = 32
shard = "none"
levels = 1
"#;
/// Budgets at which a box with its halo would be far smaller than a column's.
const SMALL: [&str; 3] = ["run.memory=44MiB", "run.memory=48MiB", "run.memory=72MiB"];

/// Noise on waves with missing voxels; far to the right nothing, which chunks of the copy leave out.
fn voxels() -> Vec<u8> {
    fill(SHAPE, |z, y, x| {
        if x >= 360 {
            return 0;
        }
        let wave = (z as f64 * 0.07).sin() + (y as f64 * 0.05).cos() + (x as f64 * 0.04).sin();
        let noise = hash(3, ((z * 1024 + y) * 1024 + x) as u64);
        if noise.is_multiple_of(31) { 7 } else { (120.0 + 30.0 * wave) as u8 + (noise >> 20) as u8 % 9 }
    })
}

fn volume() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "|u1", SHAPE, &voxels());
    run(dir.path(), COPY, &[]);
    dir
}

/// Whether a run under these settings reads columns.
fn streams(dir: &Path, sets: &[&str]) -> bool {
    streams_of(dir, CONFIG, sets)
}

fn streams_of(dir: &Path, text: &str, sets: &[&str]) -> bool {
    let config = parse(dir, text, sets);
    let infos: Vec<_> = open_inputs(&config).unwrap().iter().map(|s| s.info().clone()).collect();
    // A budget for which everything is too large streams nothing.
    let plan = Plan::new(&config, &infos, &mut || Err("none".into()));
    plan.is_ok_and(|plan| plan.graph.steps.iter().any(|s| s.streamed.is_some()))
}

#[test]
fn budgets_threads_bricks_and_sources_never_show() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    assert!(!streams(dir.path(), &[]));
    run(dir.path(), CONFIG, &[]);
    let (whole, meta) = (decode(&out), metadata(&out));
    let zarr = "input.vol.path=vol.zarr";
    let variants: [&[&str]; 6] = [
        &[SMALL[0]],
        &[SMALL[1], "run.threads=1"],
        &[SMALL[2], "run.threads=3", zarr],
        &[SMALL[0], zarr],
        &["run.memory=56MiB", "run.brick=[32, 48, 40]"],
        &[SMALL[2], "run.brick=[64, 16, 96]", zarr],
    ];
    for sets in variants {
        assert!(streams(dir.path(), sets), "{sets:?}");
        let report = run(dir.path(), CONFIG, sets);
        assert_same(&format!("{sets:?}"), &whole, &decode(&out));
        if !sets.contains(&zarr) {
            assert_eq!(meta, metadata(&out), "metadata with {sets:?}");
        }
        assert!(report.read_amplification > 3.0, "{}", report.read_amplification);
        // To the right of everything nothing is in reach, or the chunks there are not even stored.
        let skipped: u64 = report.bricks.skipped.values().sum();
        assert!(skipped > 0 && report.bricks.computed + skipped == report.bricks.total, "{:?}", report.bricks);
        let cause = if sets.contains(&zarr) { "missing_chunk" } else { "constant" };
        assert!(report.bricks.skipped.contains_key(cause), "{:?}", report.bricks);
        let plain = RunOptions { overwrite: true, no_skip: true, ..Default::default() };
        let report = run_with(&parse(dir.path(), CONFIG, sets), &plain);
        assert_eq!(report.bricks.computed, report.bricks.total);
        assert_same(&format!("{sets:?} without skipping"), &whole, &decode(&out));
    }
}

#[test]
fn a_run_may_go_on_with_boxes_where_columns_began() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    run(dir.path(), CONFIG, &[]);
    let whole = decode(&out);
    for (first, second) in [(SMALL[1], "run.memory=4GiB"), ("run.memory=4GiB", SMALL[2])] {
        let config = parse(dir.path(), CONFIG, &[first]);
        let options = RunOptions { overwrite: true, ..Default::default() };
        let session = Session::open(&config, &options, &Silent).unwrap();
        assert!(session.task_count() > 1);
        session.run_task(0).unwrap();
        drop(session);
        let config = parse(dir.path(), CONFIG, &[second]);
        let report = run_with(&config, &RunOptions { resume: true, ..Default::default() });
        assert!(report.bricks.resumed > 0 && report.bricks.resumed < report.bricks.total, "{:?}", report.bricks);
        assert_same(&format!("{first}, then {second}"), &whole, &decode(&out));
    }
}

#[test]
fn a_region_is_that_part_of_the_whole() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    run(dir.path(), CONFIG, &["output.o.levels=1"]);
    let whole = decode(&out);
    let (lo, hi) = ([9, 21, 30], [120, 164, 383]);
    let region = "run.region=[[9, 120], [21, 164], [30, 383]]";
    assert!(streams(dir.path(), &[SMALL[1], region]));
    run(dir.path(), CONFIG, &["output.o.levels=1", SMALL[1], region]);
    for (name, (shape, part)) in decode(&out) {
        assert_eq!(shape, [0, 1, 2].map(|a| hi[a] - lo[a]), "{name}");
        let values = &whole[&name].1;
        let mut at = part.iter();
        for z in lo[0]..hi[0] {
            for y in lo[1]..hi[1] {
                let row = &values[(z * SHAPE[1] + y) * SHAPE[2]..][lo[2]..hi[2]];
                assert!(row.iter().zip(at.by_ref()).all(|(a, b)| a == b), "row {z} {y}");
            }
        }
    }
}

/// Sweeps of an opacity: by a table that falls and has plateaus, so that no order of stored values would do.
fn opacity_of(input: &str, rest: &str) -> String {
    let table = "[stage.tf]\nop = 'transfer'\ninput = 'vol'\n\
                 points = [[0, 0, 0, 0, 0], [90, 0.9, 0, 0, 0], [110, 0.9, 0, 0, 0], [125, 0.2, 0, 0, 0], [160, 1, 0, 0, 0]]\n\
                 [stage.floats]\nop = 'combine'\ninputs = ['tf']\nop_kind = 'max'\n";
    CONFIG
        .replace("[stage.sweep]", &format!("{table}[stage.sweep]"))
        .replace("input = \"vol\"\ndirections", &format!("input = \"{input}\"\n{rest}\ndirections"))
}

#[test]
fn opacities_read_columns_too_and_come_out_as_their_floats_do() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    let bounded = "where = { input = 'vol', min = 100 }";
    for (rest, budgets) in [("", &SMALL[..]), (bounded, &SMALL[1..2])] {
        let floats = opacity_of("floats", rest);
        assert!(!streams_of(dir.path(), &floats, &[]));
        run(dir.path(), &floats, &[]);
        let (whole, table) = (decode(&out), opacity_of("tf", rest));
        assert!(!streams_of(dir.path(), &table, &[]));
        run(dir.path(), &table, &[]);
        assert_same("ranks in boxes", &whole, &decode(&out));
        for budget in budgets {
            assert!(streams_of(dir.path(), &table, &[budget]), "{budget}");
            run(dir.path(), &table, &[budget]);
            assert_same(&format!("{rest} {budget}"), &whole, &decode(&out));
        }
    }
}

#[test]
fn floats_read_columns_through_their_table() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    let bytes = opacity_of("tf", "");
    run(dir.path(), &bytes, &[]);
    let whole = decode(&out);
    let values: Vec<f32> = voxels().iter().map(|&v| if v == 7 { f32::NAN } else { v as f32 }).collect();
    write_npy(&dir.path().join("floats.npy"), "<f4", SHAPE, &f32_bytes(&values));
    let floats = bytes.replace("vol.npy", "floats.npy").replace("nodata = 7\n", "");
    assert!(!streams_of(dir.path(), &floats, &[]));
    run(dir.path(), &floats, &[]);
    assert_same("boxes of floats", &whole, &decode(&out));
    let budgets = [56, 64, 80, 96, 112, 128, 160].map(|mib| format!("run.memory={mib}MiB"));
    let small: Vec<&String> = budgets.iter().filter(|b| streams_of(dir.path(), &floats, &[b.as_str()])).collect();
    assert!(!small.is_empty(), "no budget takes columns");
    for budget in [small[0], small[small.len() - 1]] {
        let report = run(dir.path(), &floats, &[budget.as_str()]);
        assert_same(budget, &whole, &decode(&out));
        assert!(report.read_amplification > 3.0, "{}", report.read_amplification);
    }
}

#[test]
fn sweeps_weighed_by_normals_read_columns_too() {
    let dir = volume();
    let out = dir.path().join("o.zarr");
    let plain = CONFIG.replace("directions", "weight_by_normal = true\ndirections");
    for text in [plain, opacity_of("tf", "weight_by_normal = true")] {
        assert!(!streams_of(dir.path(), &text, &[]));
        run(dir.path(), &text, &[]);
        let whole = decode(&out);
        for sets in [&[SMALL[2]][..], &["run.memory=60MiB", "run.threads=1"]] {
            assert!(streams_of(dir.path(), &text, sets), "{sets:?}");
            run(dir.path(), &text, sets);
            assert_same(&format!("{sets:?}"), &whole, &decode(&out));
        }
    }
}
