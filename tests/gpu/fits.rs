//! Steps that do not fit the device together, or not at all: the plan says so with the numbers, and no voxel changes.

use std::fmt::Write;

use occlude::gpu::GpuFacts;

use super::adapter;
use super::common::{assert_same, decode};
use super::setup::{CPU, flows, folder, found, lane, place, plan, plan_with, run_on};

/// So many cuts of one channel, of which nothing is read before the last is made.
fn many(count: usize) -> String {
    let mut text =
        "[run]\nthreads = 2\nbrick = [16, 16, 32]\n[input.vol]\npath = \"vol.npy\"\n[stage.stats]\nop = \"box\"\n\
                    input = \"vol\"\nradius = 2\n"
            .to_string();
    for k in 0..count {
        let _ =
            write!(text, "[stage.cut{k}]\nop = \"window\"\ninput = \"stats.mean\"\nlow = {}\nhigh = 60000\n", 7 * k);
    }
    let mut name = "cut0".to_string();
    for k in (1..count).step_by(2) {
        let _ = write!(
            text,
            "[stage.sum{k}]\nop = \"combine\"\nop_kind = \"add\"\ninputs = [\"{name}\", \"cut{k}\", \"cut{}\"]\n",
            (k + 1) % count
        );
        name = format!("sum{k}");
    }
    text + &format!("[output.all]\npath = \"out/all.zarr\"\nfrom = \"{name}\"\nchunk = 8\nshard = 16\n")
}

#[test]
fn too_many_buffers_take_a_flow_apart_and_the_plan_says_how_many() {
    let shape = [18, 20, 40];
    let dir = folder(shape);
    assert_eq!(flows(&plan(dir.path(), &many(9), &[])).len(), 1, "a few are one flow");
    let text = many(41);
    let apart = plan(dir.path(), &text, &[]);
    assert!(apart.flows.is_empty());
    let (device, why) = place(&apart, "stats");
    assert!(device == "gpu" && why.starts_with("Test 9000; by itself, its levels on the CPU: in one go stats, cut0"));
    assert!(why.contains("buffers at once, of which there are 32"), "{why}");
    let (device, why) = place(&apart, "cut3");
    assert!(device == "cpu" && why.contains("looks at one voxel") && why.contains("of which there are 32"), "{why}");
    let Some(_) = adapter() else { return };
    run_on(dir.path(), &text, &[CPU]);
    let cpu = decode(&dir.path().join("out/all.zarr"));
    let report = run_on(dir.path(), &text, &[lane()]);
    assert_same("step by step", &cpu, &decode(&dir.path().join("out/all.zarr")));
    let stage = |name: &str| report.stages.iter().find(|s| s.name == name).unwrap();
    assert_eq!((&stage("stats").device[..], &stage("cut3").device[..]), ("gpu", "cpu"));
    assert!(stage("stats").reason.contains("buffers at once"));
}

/// Levels of windows so wide that what one cell of the last level sees is larger than what one voxel sees by much.
const WIDE: &str = r#"
[run]
threads = 2
[input.vol]
path = "vol.npy"
[stage.stats]
op = "box"
input = "vol"
radius = 50
[stage.cut]
op = "window"
input = "stats.mean"
low = 100
high = 30000
[output.cut]
path = "out/cut.zarr"
from = "cut"
chunk = [8, 8, 32]
shard = [8, 8, 64]
"#;
const LITTLE: &str = "run.memory='40MiB'";

#[test]
fn a_buffer_too_large_takes_a_flow_apart_and_a_resumed_run_is_not_held_to_that() {
    let shape = [40, 110, 560];
    let dir = folder(shape);
    let (ample, little) = (plan(dir.path(), WIDE, &[]), plan(dir.path(), WIDE, &[LITTLE]));
    assert_eq!(flows(&ample), ["stats cut"]);
    assert!(little.flows.is_empty());
    let (device, why) = place(&little, "cut");
    assert_eq!(device, "cpu");
    assert!(why.contains("KiB for its least part, of at most 853.3"), "{why}");
    assert_eq!(place(&little, "stats").0, "gpu");
    assert_eq!(ample.held, little.held, "what a resumed run is held to does not depend on the budget");
}

#[test]
fn a_sweep_that_would_read_too_much_runs_on_the_cpu_and_the_plan_says_how_much() {
    let text = "[run]\nbrick = [64, 64, 64]\n[input.vol]\npath = \"vol.npy\"\n[stage.swept]\nop = \"obscurance\"\n\
                input = \"vol\"\ndirections = 12\nmax_distance = 40\n[output.swept]\npath = \"out/swept.zarr\"\n\
                from = \"swept\"\n";
    let dir = folder([100, 100, 100]);
    assert_eq!(place(&plan(dir.path(), text, &[]), "swept"), ("gpu", "Test 9000"));
    let small = GpuFacts { most_bytes: 1_300_000, ..found() };
    let (plan, _) = plan_with(dir.path(), text, &[lane()], Ok(small)).unwrap();
    let (device, why) = place(&plan, "swept");
    assert_eq!(device, "cpu");
    assert!(why.contains("voxels for each of a brick, of at most 4") && why.ends_with("runs on the CPU"), "{why}");
}

/// Floats are the bits of the device that makes them: a budget may be refused, never move them.
#[test]
fn a_budget_does_not_move_floats_to_the_cpu() {
    let text = "[input.vol]\nsynthetic = \"noise\"\nshape = [96, 96, 96]\ndtype = \"f32\"\n[stage.stats]\nop = \"box\"\n\
                input = \"vol\"\nradius = 40\n[output.o]\npath = \"out/o.zarr\"\nfrom = \"stats.variance\"\n";
    let dir = folder([2, 2, 2]);
    assert_eq!(place(&plan(dir.path(), text, &["run.memory='2GiB'"]), "stats").0, "gpu");
    let little = plan_with(dir.path(), text, &[lane(), LITTLE], Ok(found()));
    let error = little.expect_err("too little for a window").to_string();
    assert!(error.contains("run.memory") && error.contains("give at least memory = "), "{error}");
    let enough = error.split("memory = \"").nth(1).and_then(|rest| rest.split('"').next()).unwrap();
    assert_eq!(place(&plan(dir.path(), text, &[&format!("run.memory='{enough}'")]), "stats").0, "gpu");
}

#[test]
fn ample_memory_and_workers_give_the_lane_more_slots() {
    let text = "[run]\nbrick = [64, 64, 64]\n[input.vol]\nsynthetic = \"noise\"\nshape = [256, 256, 256]\ndtype = \"u16\"\n\
                [stage.stats]\nop = \"box\"\ninput = \"vol\"\nradius = 5\n[output.o]\npath = \"out/o.zarr\"\n\
                from = \"stats.mean\"\n";
    let dir = folder([2, 2, 2]);
    let slots = |threads: &str, memory: &str| {
        let plan = plan(dir.path(), text, &[&format!("run.threads={threads}"), &format!("run.memory='{memory}'")]);
        for group in &plan.groups {
            assert!(group.brick.peak(plan.workers) <= plan.memory, "{threads} threads, {memory}");
        }
        plan.slots()
    };
    assert_eq!(slots("8", "2GiB"), 6);
    assert_eq!(slots("4", "2GiB"), 4, "no more than workers");
    assert_eq!(slots("2", "2GiB"), 3, "no fewer than keep the device busy");
    let tight = ["96MiB", "128MiB", "160MiB", "256MiB", "512MiB"].map(|m| slots("8", m));
    assert!(tight.is_sorted() && tight[0] == 3, "{tight:?}");
}
