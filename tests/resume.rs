//! Nothing is lost (SPEC 5.4): killed at any moment, `--resume` finishes, and the result is that of an undisturbed run.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::*;
use occlude::run::{Cancel, Progress, RunOptions};

const SHAPE: [usize; 3] = [24, 40, 2300];

/// Five tasks, shards that tasks share on the coarse levels, a second phase, a flat file and a pre-pass.
const CONFIG: &str = r#"
[run]
threads = 2
brick = [8, 8, 64]
[input.vol]
path = "vol.npy"
[stage.ao]
op = "ambient_occlusion"
input = "vol"
method = "exact"
radius = 4
[stage.stats]
op = "box"
input = "vol"
radius = 3
[output.ao]
path = "out/ao.zarr"
from = "ao"
chunk = [8, 8, 16]
shard = [16, 16, 32]
levels = 6
[output.mean]
path = "out/mean.zarr"
from = "stats.mean"
dtype = "u16"
range = "auto"
chunk = 16
shard = "none"
[output.flat]
path = "out/flat.npy"
from = "stats.max"
"#;
const OUTPUTS: [&str; 3] = ["ao.zarr", "mean.zarr", "flat.npy"];

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", SHAPE, &u16_bytes(&mixed_u16(SHAPE)));
    fs::write(dir.path().join("config.toml"), CONFIG).unwrap();
    dir
}

fn decoded(dir: &Path) -> Vec<Decoded> {
    OUTPUTS.iter().map(|o| decode(&dir.join("out").join(o))).collect()
}

fn start(dir: &Path) -> Command {
    let mut command = Command::new(program());
    command.arg("run").arg(dir.join("config.toml")).arg("--resume").arg("-q");
    command.args(["--report".as_ref(), dir.join("report.json").as_os_str()]);
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

#[test]
fn killed_at_random_moments_it_resumes_to_the_same_bytes() {
    let reference = folder();
    run(reference.path(), CONFIG, &[]);
    let expected = decoded(reference.path());
    for round in 0..4u64 {
        let dir = folder();
        let (mut kills, mut resumed) = (0, 0);
        loop {
            let mut child = start(dir.path()).spawn().unwrap();
            // From the first milliseconds to beyond the end; later tries get longer, so that the loop ends.
            let wait = 10 + hash(round, kills) % (150 + 150 * kills);
            std::thread::sleep(Duration::from_millis(wait));
            if let Ok(Some(status)) = child.try_wait() {
                let error = child.wait_with_output().unwrap().stderr;
                assert!(status.success(), "{}", String::from_utf8_lossy(&error));
                break;
            }
            child.kill().unwrap();
            child.wait().unwrap();
            kills += 1;
            assert!(kills < 60, "no end after {kills} kills");
        }
        let report: serde_json::Value =
            serde_json::from_slice(&fs::read(dir.path().join("report.json")).unwrap()).unwrap();
        resumed += report["bricks"]["resumed"].as_u64().unwrap();
        println!("round {round}: {kills} kills, {resumed} bricks found done by the last start");
        for (name, (a, b)) in OUTPUTS.iter().zip(expected.iter().zip(decoded(dir.path()))) {
            assert_same(&format!("{name} after {kills} kills"), a, &b);
        }
        assert!(!dir.path().join("out/ao.zarr.occlude").exists(), "the work folder of a finished output is gone");
    }
}

/// Raises a cancel at the first word of progress.
struct StopSoon(Cancel);

impl Progress for StopSoon {
    fn update(&self, _: u64, _: u64, _: u64, _: u64, phase: &str) {
        if phase == "compute" {
            self.0.cancel();
        }
    }
    fn note(&self, _: &str) {}
}

#[test]
fn done_tasks_are_never_computed_again_and_resuming_may_change_bricks_and_threads() {
    let reference = folder();
    run(reference.path(), CONFIG, &[]);
    let dir = folder();
    let config = parse(dir.path(), CONFIG, &[]);
    let cancel = Cancel::new();
    let options = RunOptions { cancel: cancel.clone(), ..Default::default() };
    let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent).unwrap();
    let tasks = session.open_tasks();
    assert_eq!(tasks.len(), 5);
    session.run_task(tasks[3]).unwrap();
    session.run_task(tasks[0]).unwrap();
    drop(session);
    let stopped = occlude::run::run(
        &config,
        &RunOptions { resume: true, cancel: cancel.clone(), ..Default::default() },
        &StopSoon(cancel),
    );
    assert!(matches!(stopped, Err(occlude::Error::Interrupted)), "{stopped:?}");
    let other = parse(dir.path(), CONFIG, &["run.brick=[24, 24, 32]", "run.threads=3"]);
    let report = run_with(&other, &RunOptions { resume: true, ..Default::default() });
    assert!(report.bricks.resumed >= 2, "{:?}", report.bricks);
    assert!(report.bricks.computed < report.bricks.total);
    for (a, b) in decoded(reference.path()).iter().zip(decoded(dir.path())) {
        assert_same("resumed with other bricks", a, &b);
    }
    let again = run_with(&config, &RunOptions { resume: true, ..Default::default() });
    assert_eq!(again.bricks.computed, 0);
}

#[test]
fn a_changed_config_or_input_is_not_resumed() {
    let dir = folder();
    let config = parse(dir.path(), CONFIG, &[]);
    let options = RunOptions::default();
    let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent).unwrap();
    session.run_task(0).unwrap();
    drop(session);
    let resume = RunOptions { resume: true, ..Default::default() };
    let changed = parse(dir.path(), CONFIG, &["stage.stats.radius=2"]);
    let error = occlude::run::run(&changed, &resume, &occlude::run::Silent).unwrap_err();
    assert_eq!(error.exit_code(), 2);
    assert!(error.to_string().contains("configuration"), "{error}");
    let error = occlude::run::run(&config, &RunOptions::default(), &occlude::run::Silent).unwrap_err();
    assert!(error.to_string().contains("--resume"), "{error}");
    let mut bytes = fs::read(dir.path().join("vol.npy")).unwrap();
    let middle = bytes.len() - 1;
    bytes[middle] ^= 1;
    bytes[200] ^= 1;
    fs::write(dir.path().join("vol.npy"), bytes).unwrap();
    let error = occlude::run::run(&config, &resume, &occlude::run::Silent).unwrap_err();
    assert!(error.to_string().contains("input"), "{error}");
}

#[test]
fn a_corrupt_chunk_ends_the_run_with_its_name_and_keeps_what_was_finished() {
    let dir = folder();
    let text = CONFIG.replace("from = \"stats.mean\"\ndtype = \"u16\"\nrange = \"auto\"", "from = \"vol\"");
    run(dir.path(), &text, &[]);
    let store = dir.path().join("out/mean.zarr");
    let chunk = store.join("0/c/0/1/70");
    let mut bytes = fs::read(&chunk).unwrap();
    bytes.truncate(bytes.len() / 2);
    fs::write(&chunk, bytes).unwrap();
    let second = "[run]\nbrick = 16\n[input.a]\npath = 'out/mean.zarr'\n[stage.s]\nop = 'box'\ninput = 'a'\nradius = 1\n\
                  [output.o]\npath = 'out/second.zarr'\nfrom = 's.mean'\nchunk = 16\n";
    fs::write(dir.path().join("second.toml"), second).unwrap();
    let output = Command::new(program()).arg("run").arg(dir.path().join("second.toml")).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("70") && message.contains("mean.zarr"), "{message}");
    assert!(!message.contains("panicked"), "{message}");
    assert!(dir.path().join("out/second.zarr.occlude").exists(), "an unfinished output keeps its work folder");
    let root = fs::read_to_string(dir.path().join("out/second.zarr/zarr.json")).unwrap_or_default();
    assert!(!root.contains("complete"), "{root}");
}
