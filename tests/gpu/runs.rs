//! Whole runs and plans.

use std::path::Path;
use std::process::Command;

use occlude::gpu::{GpuFacts, facts};
use occlude::plan::Plan;
use occlude::run::{RunOptions, Session, Silent};

use super::common::{Decoded, assert_same, decode, metadata, parse, program, run_with};
use super::setup::{CPU, lane, place, run_on};
use super::{adapter, setup};

/// Steps that have a GPU kernel, steps that have none, borders, a mask, levels, bricks that are cut.
const CONFIG: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
slope = 0.5
intercept = -3
[stage.stats]
op = "box"
input = "vol"
radius = [2, 3, 5]
[stage.mirrored]
op = "ambient_occlusion"
input = "vol"
method = "cdf_power"
radius = 6
border = "reflect"
where = { input = "vol", min = 9000 }
[stage.again]
op = "ambient_occlusion"
input = "stats.mean"
method = "gaussian_cdf"
radius = 3
[stage.exact]
op = "ambient_occlusion"
input = "vol"
method = "exact"
radius = 2
[stage.swept]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 7
[stage.floats]
op = "obscurance"
input = "stats.mean"
max_distance = 4
where = { input = "vol", max = 20000 }
[stage.bell]
op = "gaussian"
input = "vol"
sigma = 1.5
border = "nearest"
[stage.bells]
op = "gaussian"
input = "vol"
sigma = 0.8
[output.bell]
path = "out/bell.zarr"
from = "bell.mean"
chunk = 16
shard = 32
[output.bells]
path = "out/bells.zarr"
from = ["bells.mean", "bells.variance"]
chunk = 16
[stage.slope]
op = "gradient"
input = "vol"
[stage.steps]
op = "gradient"
input = "stats.mean"
size = 3
weight = "inverse"
[output.slope]
path = "out/slope.zarr"
from = ["slope.magnitude", "steps.vector"]
chunk = 16
shard = 32
[stage.bleeding]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 3
weight_by_normal = true
[output.swept]
path = "out/swept.zarr"
from = ["swept", "floats"]
chunk = 16
shard = 32
[output.bleeding]
path = "out/bleeding.zarr"
from = "bleeding"
chunk = 16
shard = 32
[output.stats]
path = "out/stats.zarr"
from = ["stats.mean", "stats.min", "stats.max", "stats.variance", "stats.std", "stats.moment2"]
chunk = 16
shard = 32
[output.mirrored]
path = "out/mirrored.zarr"
from = "mirrored"
dtype = "f32"
chunk = 16
shard = 32
[output.again]
path = "out/again.zarr"
from = "again"
chunk = 16
shard = 32
[output.open]
path = "out/open.zarr"
from = "again"
dtype = "f32"
chunk = 16
[stage.deviation]
op = "box"
input = "bell.mean"
radius = 4
border = { constant = 40.5 }
[output.deviation]
path = "out/deviation.zarr"
from = ["deviation.std", "deviation.mean", "deviation.min"]
chunk = 16
[output.exact]
path = "out/exact.zarr"
from = "exact"
chunk = 16
shard = 32
"#;
const OUTPUTS: [&str; 4] = ["stats.zarr", "exact.zarr", "swept.zarr", "bleeding.zarr"];

/// Outputs whose floats are within a tolerance only, with the bound that their values' range gives.
const CLOSE: [(&str, f64); 6] = [
    ("mirrored.zarr", facts::tolerance::OPENNESS),
    // Of the greatest variance of values of half of u16.
    ("bells.zarr", facts::tolerance::VARIANCE * 2.7e8),
    ("slope.zarr", facts::tolerance::GRADIENT * 0.5 * 65535.0),
    // Codes of u8, of which one may round to its neighbour.
    ("again.zarr", 1.0),
    ("open.zarr", facts::tolerance::OPENNESS),
    ("deviation.zarr", facts::tolerance::VARIANCE * 32768.0),
];

/// The first number that lies further from its twin than `bound`; NaN and infinities must be alike.
fn far_apart(a: &Decoded, b: &Decoded, bound: f64) -> Option<String> {
    if a.keys().ne(b.keys()) {
        return Some("other arrays".into());
    }
    a.iter().zip(b.values()).find_map(|((name, (shape, a)), (other, b))| {
        let close = |a: f64, b: f64| (a - b).abs() <= bound || a.is_nan() && b.is_nan() || a == b;
        let values = a.iter().zip(b).map(|(a, b)| (f64::from_bits(*a), f64::from_bits(*b)));
        let far = values.enumerate().find(|(_, (a, b))| !close(*a, *b));
        (shape != other || far.is_some()).then(|| format!("{name}: {far:?}, {bound} is allowed"))
    })
}

fn assert_close_outputs(what: &str, a: &Path, b: &Path) {
    for (name, bound) in CLOSE {
        let [a, b] = [a, b].map(|d| decode(&d.join("out").join(name)));
        assert_eq!(far_apart(&a, &b, bound), None, "{what}: {name}");
    }
}

#[test]
fn the_comparison_of_floats_can_fail() {
    let of = |v: f64| Decoded::from([("level 0".to_string(), (vec![1, 1, 2], vec![1.0f64.to_bits(), v.to_bits()]))]);
    assert_eq!(far_apart(&of(2.0), &of(2.5), 0.5), None);
    assert!(far_apart(&of(2.0), &of(2.6), 0.5).unwrap().contains("level 0"));
    assert!(far_apart(&of(2.0), &of(f64::NAN), 0.5).is_some());
    assert!(far_apart(&of(2.0), &Decoded::new(), 0.5).is_some());
}

#[test]
fn floats_of_the_gpu_do_not_show_bricks() {
    let Some(_) = adapter() else { return };
    let (one, two) = (folder(), folder());
    run_on(one.path(), CONFIG, &[lane()]);
    run_with(&parse(two.path(), CONFIG, &[lane(), "run.brick=[32, 16, 64]"]), &RunOptions::default());
    for (name, _) in CLOSE {
        let [a, b] = [&one, &two].map(|d| decode(&d.path().join("out").join(name)));
        assert_same(name, &a, &b);
    }
}

fn folder() -> tempfile::TempDir {
    let dir = setup::folder([40, 50, 60]);
    std::fs::write(dir.path().join("config.toml"), CONFIG).unwrap();
    dir
}

fn assert_same_outputs(what: &str, a: &Path, b: &Path) {
    for name in OUTPUTS {
        let [a, b] = [a, b].map(|d| d.join("out").join(name));
        assert_same(&format!("{what}: {name}"), &decode(&a), &decode(&b));
        assert_eq!(metadata(&a), metadata(&b), "{what}: metadata of {name}");
    }
}

#[test]
fn a_whole_run_on_the_gpu_equals_the_cpu_run() {
    let Some(_) = adapter() else { return };
    let (cpu, gpu) = (folder(), folder());
    run_on(cpu.path(), CONFIG, &[CPU]);
    let report = run_on(gpu.path(), CONFIG, &[lane()]);
    assert_same_outputs("gpu:software", cpu.path(), gpu.path());
    assert_close_outputs("gpu:software", cpu.path(), gpu.path());
    let device = |name: &str| report.stages.iter().find(|s| s.name == name).map(|s| s.device.clone());
    assert_eq!(device("stats").as_deref(), Some("gpu"));
    assert_eq!(device("mirrored").as_deref(), Some("gpu"));
    assert_eq!(device("swept").as_deref(), Some("gpu"));
    assert_eq!(device("floats").as_deref(), Some("gpu"));
    assert_eq!(device("bell").as_deref(), Some("gpu"));
    assert_eq!(device("slope").as_deref(), Some("gpu"));
    assert_eq!(device("steps").as_deref(), Some("gpu"));
    assert_eq!(device("bells").as_deref(), Some("gpu"));
    assert_eq!(device("bleeding").as_deref(), Some("cpu"));
    assert_eq!(device("again").as_deref(), Some("gpu"));
    assert_eq!(device("deviation").as_deref(), Some("gpu"));
    assert_eq!(device("exact").as_deref(), Some("cpu"));
    assert_eq!(report.placement["stats"], "gpu");
    let why = |name: &str| report.stages.iter().find(|s| s.name == name).map(|s| s.reason.clone());
    assert_eq!(why("exact").as_deref(), Some(facts::EXACT), "the report says why");
}

#[test]
fn a_little_memory_cuts_bricks_on_the_device_and_changes_nothing() {
    let Some(_) = adapter() else { return };
    let (cpu, gpu) = (folder(), folder());
    run_on(cpu.path(), CONFIG, &[CPU]);
    run_on(gpu.path(), CONFIG, &[lane(), "run.memory='40MiB'", "run.brick='auto'"]);
    assert_same_outputs("40 MiB", cpu.path(), gpu.path());
    assert_close_outputs("40 MiB", cpu.path(), gpu.path());
}

#[test]
fn a_run_resumes_on_the_device_that_it_was_begun_on() {
    let Some(_) = adapter() else { return };
    let (cpu, gpu) = (folder(), folder());
    run_on(cpu.path(), CONFIG, &[CPU]);
    let config = parse(gpu.path(), CONFIG, &[lane()]);
    let options = RunOptions { resume: true, ..Default::default() };
    let session = Session::open(&config, &options, &Silent).unwrap();
    session.run_task(0).unwrap();
    drop(session);
    let other = parse(gpu.path(), CONFIG, &["run.device='cpu'"]);
    let error = Session::open(&other, &options, &Silent).err().expect("another placement").to_string();
    assert!(error.contains("placement"), "{error}");
    let report = run_with(&config, &options);
    assert!(report.bricks.resumed > 0);
    assert_same_outputs("resumed", cpu.path(), gpu.path());
}

fn plan_with(device: &str, found: Result<GpuFacts, String>) -> occlude::Result<(Plan, usize)> {
    setup::plan_with(folder().path(), CONFIG, &[device], found)
}

#[test]
fn placement_follows_the_device_and_says_why() {
    let found = |software| GpuFacts { software, exact_floats: software, ..setup::found() };
    let none = || Err("looked for a driver; found no Vulkan adapter".to_string());
    let (plan, calls) = plan_with("run.device='cpu'", Ok(found(false))).unwrap();
    assert_eq!((calls, plan.gpu.is_none()), (0, true));
    let parked = plan.groups[0].brick.parked;
    let (plan, _) = plan_with("run.device='auto'", Ok(found(false))).unwrap();
    assert_eq!(place(&plan, "stats"), ("gpu", "Test 9000"));
    assert_eq!(place(&plan, "swept"), ("gpu", "Test 9000"));
    assert_eq!(place(&plan, "bell"), ("cpu", facts::INEXACT));
    assert_eq!(place(&plan, "bells"), ("cpu", facts::INEXACT));
    assert_eq!(place(&plan, "bleeding"), ("cpu", facts::NORMALS));
    assert_eq!(place(&plan, "again"), ("cpu", facts::INEXACT));
    assert!(place(&plan, "exact").1.contains("exact"));
    let staging = plan.groups[0].brick.parked - parked;
    let rough = GpuFacts { close_floats: false, ..setup::found() };
    let (plan, _) = plan_with("run.device='auto'", Ok(rough)).unwrap();
    assert_eq!(["mirrored", "again", "slope", "steps"].map(|s| place(&plan, s)), [("cpu", facts::ROUGH); 4]);
    assert_eq!(["stats", "swept", "bell", "deviation"].map(|s| place(&plan, s).0), ["gpu"; 4]);
    let (plan, _) = plan_with("run.device='gpu:software'", Ok(found(true))).unwrap();
    assert_eq!(place(&plan, "bell"), ("gpu", "Test 9000"));
    assert_eq!(place(&plan, "again"), ("gpu", "Test 9000"));
    assert!(staging > 0 && plan.groups[0].brick.parked - parked > staging, "device memory of software counts");
    let (plan, _) = plan_with("run.device='auto'", none()).unwrap();
    assert!(plan.placement.iter().all(|p| p.lane == occlude::plan::Lane::Cpu));
    assert!(place(&plan, "stats").1.contains("no Vulkan adapter"));
    for device in ["gpu", "gpu:software"] {
        let error = plan_with(&format!("run.device='{device}'"), none()).unwrap_err();
        assert_eq!(error.exit_code(), 1);
        assert!(error.to_string().contains("looked for a driver") && error.to_string().contains(device), "{error}");
        assert!(error.to_string().contains("config.toml") && error.to_string().contains("accepted here"), "{error}");
    }
}

#[test]
fn without_a_driver_gpu_fails_and_auto_runs_on_the_cpu_and_says_so() {
    let dir = folder();
    let command = |device: &str| {
        let mut c = Command::new(program());
        // The Vulkan loader finds no driver under these names.
        c.env("VK_DRIVER_FILES", "/nowhere.json").env("VK_ICD_FILENAMES", "/nowhere.json");
        let out = c.arg("run").arg(dir.path().join("config.toml")).args(["--device", device]).output().unwrap();
        (out.status.code(), String::from_utf8_lossy(&out.stderr).into_owned())
    };
    let named = CONFIG.replacen("threads = 2", "threads = 2\ndevice = \"gpu\"", 1);
    std::fs::write(dir.path().join("named.toml"), named).unwrap();
    let mut c = Command::new(program());
    c.env("VK_DRIVER_FILES", "/nowhere.json").env("VK_ICD_FILENAMES", "/nowhere.json");
    let out = c.arg("plan").arg(dir.path().join("named.toml")).output().unwrap();
    let text = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(1), "{text}");
    assert!(text.contains("named.toml:4: run.device: \"gpu\" was asked for"), "the key's file and line: {text}");
    for device in ["gpu", "gpu:software"] {
        let (code, text) = command(device);
        assert_eq!(code, Some(1), "{text}");
        assert!(text.contains("looked for") && text.contains("no Vulkan adapter"), "{text}");
    }
    let (code, text) = command("auto");
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("running on the CPU"), "{text}");
}

#[test]
fn many_workers_share_bricks_between_the_lanes() {
    let Some(_) = adapter() else { return };
    let (cpu, pure, mixed) = (folder(), folder(), folder());
    let bricks = "run.brick=[8, 16, 32]";
    run_on(cpu.path(), CONFIG, &[CPU]);
    let run = |dir: &Path, sets: &[&str]| {
        let report = run_on(dir, CONFIG, &[&[lane(), bricks, "run.threads=8"], sets].concat());
        let on_cpu = |name: &str| report.stages.iter().find(|s| s.name == name).map_or(0, |s| s.bricks_on_cpu);
        (report.byte_identity_waived, ["swept", "floats", "stats", "mirrored", "bell"].map(on_cpu))
    };
    let (waived, shared) = run(pure.path(), &[]);
    assert!(!waived && shared.iter().sum::<u64>() > 0, "8 workers and 3 slots: {shared:?}");
    assert_eq!(shared[4], 0, "floats stay on one lane");
    assert_same_outputs("shared", cpu.path(), pure.path());
    let (waived, _) = run(mixed.path(), &["run.lanes='mixed'"]);
    assert!(waived);
    // Waived for floats alone.
    for name in OUTPUTS {
        let [a, b] = [&cpu, &mixed].map(|d| decode(&d.path().join("out").join(name)));
        assert_same(&format!("mixed: {name}"), &a, &b);
    }
    assert_close_outputs("mixed", cpu.path(), mixed.path());
}

#[test]
fn workers_fill_the_ring_and_its_staging_is_counted() {
    let (plan, _) = plan_with("run.device='auto'", Ok(setup::found())).unwrap();
    assert!(facts::SLOTS >= 3 && plan.threads == 2 && plan.workers == facts::SLOTS as usize);
    assert!(plan.groups[0].brick.in_flight as u64 > facts::SLOTS);
    assert!(plan.groups[0].brick.parked as usize > 3 * 40 * 50 * 60 / 8, "three bricks' voxels and sums");
    let (plan, _) = plan_with("run.device='cpu'", Err("none".into())).unwrap();
    assert_eq!(plan.workers, 2);
}

/// A volume long enough for three tasks.
const LONG: &str = r#"
[run]
threads = 2
brick = [8, 8, 128]
[input.vol]
path = "vol.npy"
[stage.stats]
op = "box"
input = "vol"
radius = 3
[stage.swept]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 5
[stage.bell]
op = "gaussian"
input = "vol"
sigma = 1.1
[output.stats]
path = "out/stats.zarr"
from = "stats.variance"
chunk = [8, 8, 32]
shard = [8, 8, 64]
[output.swept]
path = "out/swept.zarr"
from = "swept"
chunk = [8, 8, 32]
shard = [8, 8, 64]
[output.bell]
path = "out/bell.zarr"
from = "bell.mean"
chunk = [8, 8, 32]
shard = [8, 8, 64]
"#;

#[test]
fn a_device_lost_in_a_run_is_opened_anew_or_ends_it_resumable() {
    let Some(_) = adapter() else { return };
    let long = || setup::folder([7, 8, 1100]);
    let same = |what: &str, a: &Path, b: &Path| {
        for name in ["stats.zarr", "swept.zarr", "bell.zarr"] {
            let [a, b] = [a, b].map(|d| decode(&d.join("out").join(name)));
            assert_same(&format!("{what}: {name}"), &a, &b);
        }
    };
    let (cpu, once, twice) = (long(), long(), long());
    run_on(cpu.path(), LONG, &[CPU]);
    let options = RunOptions { resume: true, ..Default::default() };
    let config = parse(once.path(), LONG, &[lane()]);
    let session = Session::open(&config, &options, &Silent).unwrap();
    let tasks = session.task_count();
    assert!(tasks > 2, "{tasks} tasks");
    for task in 0..tasks {
        session.lose_gpu(false);
        session.run_task(task).unwrap();
    }
    session.finish().unwrap();
    same("lost and opened anew", cpu.path(), once.path());
    let config = parse(twice.path(), LONG, &[lane()]);
    let session = Session::open(&config, &options, &Silent).unwrap();
    session.run_task(0).unwrap();
    session.lose_gpu(true);
    let error = session.run_task(1).expect_err("no device is left");
    assert_eq!(error.exit_code(), 1);
    let text = error.to_string();
    assert!(text.contains("on the GPU") && text.contains("--resume continues"), "{text}");
    drop(session);
    let report = run_with(&config, &options);
    assert!(report.bricks.resumed > 0, "what was finished is kept");
    same("resumed after a loss", cpu.path(), twice.path());
}
