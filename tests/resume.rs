//! Nothing is lost (SPEC 5.4): killed at any moment, `--resume` finishes, and the result is that of an undisturbed run.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::*;
use occlude::run::{Cancel, Progress, RunOptions, Session, Silent};
use occlude::store::Sink;

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
    let (mut all_kills, mut resumed) = (0, 0);
    for round in 0..4u64 {
        let dir = folder();
        let mut kills = 0;
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
        all_kills += kills;
        println!("round {round}: {kills} kills, {resumed} bricks found done by the last starts");
        for (name, (a, b)) in OUTPUTS.iter().zip(expected.iter().zip(decoded(dir.path()))) {
            assert_same(&format!("{name} after {kills} kills"), a, &b);
        }
        for name in ["ao.zarr/zarr.json", "ao.zarr/0/zarr.json", "ao.zarr/5/zarr.json", "mean.zarr/zarr.json"] {
            let [a, b] = [&reference, &dir].map(|d| fs::read_to_string(d.path().join("out").join(name)).unwrap());
            assert_eq!(a, b, "{name} after {kills} kills");
        }
        assert!(!dir.path().join("out/ao.zarr.occlude").exists(), "the work folder of a finished output is gone");
    }
    assert!(all_kills > 0 && resumed > 0, "{all_kills} kills, after which {resumed} bricks were found done");
}

/// Arrays of the second phase lie in `run.scratch`; a run that goes on finds them there whatever its config says by then.
#[test]
fn what_waits_for_the_second_phase_lies_in_scratch() {
    let reference = folder();
    run(reference.path(), CONFIG, &[]);
    let dir = folder();
    let config = parse(dir.path(), CONFIG, &["run.scratch=\"elsewhere\""]);
    let options = RunOptions::default();
    let session =
        Session::open(&config, &options, &Silent).map_err(|e| e.to_string()).unwrap_or_else(|e| panic!("{e}"));
    let first = session.open_tasks()[0];
    session.run_task(first).unwrap();
    drop(session);
    let scratch = dir.path().join("elsewhere");
    let names = |folder: &Path| -> Vec<String> {
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    };
    let arrays =
        |folder: &Path| names(folder).iter().filter(|n| n.starts_with("cells.") || n.starts_with("level.")).count();
    assert!(names(&scratch).iter().map(|own| arrays(&scratch.join(own))).sum::<usize>() > 0);
    assert_eq!(arrays(&dir.path().join("out/ao.zarr.occlude")), 0);
    let report = run_with(&parse(dir.path(), CONFIG, &[]), &RunOptions { resume: true, ..Default::default() });
    assert!(report.bricks.resumed > 0 && report.read_amplification > 1.0, "{report:?}");
    assert_eq!(names(&scratch), [""; 0]);
    for (name, (a, b)) in OUTPUTS.iter().zip(decoded(reference.path()).iter().zip(&decoded(dir.path()))) {
        assert_same(name, a, b);
    }
}

/// The trace of a run that was stopped tells what it did until then.
#[test]
fn a_stopped_run_leaves_its_trace() {
    let dir = folder();
    let cancel = Cancel::new();
    let trace = dir.path().join("trace.json");
    let options = RunOptions { trace: Some(trace.clone()), cancel: cancel.clone(), ..Default::default() };
    let stopped = occlude::run::run(&parse(dir.path(), CONFIG, &[]), &options, &StopSoon(cancel));
    assert!(matches!(stopped, Err(occlude::Error::Interrupted)), "{stopped:?}");
    let spans: serde_json::Value = serde_json::from_slice(&fs::read(trace).unwrap()).unwrap();
    assert!(!spans["traceEvents"].as_array().unwrap().is_empty());
}

#[test]
fn a_kill_before_the_tidying_leaves_no_work_folder_behind() {
    let dir = folder();
    run(dir.path(), CONFIG, &[]);
    for name in ["ao.zarr", "mean.zarr"] {
        let work = dir.path().join(format!("out/{name}.occlude"));
        fs::create_dir_all(work.join("tmp")).unwrap();
        fs::write(work.join("meta.json"), "{ \"format\": \"zarr\", \"complete\": false }").unwrap();
        assert!(start(dir.path()).spawn().unwrap().wait().unwrap().success());
        assert!(!work.exists(), "{name}");
    }
}

/// Of a volume below the usual size of a task something is kept as well, where files and halos allow it.
#[test]
fn small_volumes_are_cut_into_tasks() {
    let text = |stage: &str, output: &str| {
        format!(
            "[input.v]\nsynthetic = 'noise'\nshape = [300, 300, 300]\ndtype = 'u8'\n[stage.s]\ninput = 'v'\n{stage}\n\
             [output.o]\nfrom = 's'\n{output}\n"
        )
    };
    let near = "op = 'box'\nradius = 8";
    let far = "op = 'obscurance'\nmax_distance = 64";
    for (stage, output, tasks) in [
        (near, "path = 'o.zarr'\nchunk = 32\nshard = 64\nlevels = 1", 27),
        (near, "path = 'o.raw'", 5),
        // Shards of 256 voxels, of which those of the coarser levels are shared.
        (near, "path = 'o.zarr'", 8),
        (far, "path = 'o.raw'", 1),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let (config, options) = (parse(dir.path(), &text(stage, output), &[]), RunOptions::default());
        let session = Session::open(&config, &options, &Silent).map_err(|e| e.to_string());
        assert_eq!(session.unwrap().open_tasks().len(), tasks, "{stage} {output}");
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
    let change = || {
        let mut bytes = fs::read(dir.path().join("vol.npy")).unwrap();
        let middle = bytes.len() - 1;
        bytes[middle] ^= 1;
        bytes[200] ^= 1;
        fs::write(dir.path().join("vol.npy"), bytes).unwrap();
    };
    change();
    let error = occlude::run::run(&config, &resume, &occlude::run::Silent).unwrap_err();
    assert!(error.to_string().contains("input"), "{error}");
    // Nor is a finished output of another input taken for this one's.
    let afresh = RunOptions { overwrite: true, ..Default::default() };
    occlude::run::run(&config, &afresh, &occlude::run::Silent).unwrap();
    occlude::run::run(&config, &resume, &occlude::run::Silent).unwrap();
    change();
    let error = occlude::run::run(&config, &resume, &occlude::run::Silent).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains("input"), "{error}");
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

/// A small file system of its own, gone with the value. `None` where this user may not mount.
struct Disk(std::path::PathBuf);

impl Disk {
    fn mount(at: &Path, options: &str) -> Option<Disk> {
        fs::create_dir_all(at).unwrap();
        let done = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(at).output();
        done.is_ok_and(|o| o.status.success()).then(|| Disk(at.to_path_buf()))
    }

    fn grow(&self, size: &str) {
        let done = Command::new("mount").args(["-o", &format!("remount,size={size}")]).arg(&self.0).status();
        assert!(done.unwrap().success(), "remount");
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_full_disk_keeps_what_was_finished_and_resumes_when_there_is_room() {
    let reference = folder();
    run(reference.path(), CONFIG, &[]);
    let expected = decoded(reference.path());
    let dir = folder();
    let out = dir.path().join("out");
    // Room for some of the five tasks (their files take about 17 MiB), and for nothing but the first files.
    for size in ["12m", "6m"] {
        let Some(disk) = Disk::mount(&out, &format!("size={size}")) else {
            eprintln!("SKIPPED: no file system can be mounted here (root is needed), so no disk can run full");
            return;
        };
        let failed = start(dir.path()).output().unwrap();
        let message = String::from_utf8_lossy(&failed.stderr);
        assert_eq!(failed.status.code(), Some(1), "{size}: {message}");
        assert!(message.contains("out/") && message.contains("No space left"), "{size}: {message}");
        assert!(!message.contains("panicked") && !message.contains("internal error"), "{message}");
        // Whatever lies under a final name decodes, and is either not there yet (0; 255 of openness) or final.
        for (name, want) in OUTPUTS.iter().zip(&expected).filter(|(name, _)| name.ends_with("zarr")) {
            let have = decode(&out.join(name));
            let (level, (_, voxels)) = have.iter().next().unwrap();
            let fault = voxels
                .iter()
                .zip(&want[level].1)
                .position(|(a, b)| a != b && ![0.0, 255.0].contains(&f64::from_bits(*a)));
            assert_eq!(fault, None, "{size}: {name} {level}");
        }
        assert!(!out.join("flat.npy").exists(), "an unfinished file has no final name");
        let done = fs::read(out.join("flat.npy.occlude/tasks.log")).unwrap_or_default().len();
        disk.grow("200m");
        let resumed = start(dir.path()).output().unwrap();
        assert!(resumed.status.success(), "{size}: {}", String::from_utf8_lossy(&resumed.stderr));
        let report: serde_json::Value =
            serde_json::from_slice(&fs::read(dir.path().join("report.json")).unwrap()).unwrap();
        let again = report["bricks"]["resumed"].as_u64().unwrap();
        assert_eq!(done > 0, again > 0, "{size}: {done} bytes of marks, {again} bricks found done");
        for (name, (a, b)) in OUTPUTS.iter().zip(expected.iter().zip(decoded(dir.path()))) {
            assert_same(&format!("{name} after a full disk of {size}"), a, &b);
        }
        println!("{size}: {again} bricks were kept; {}", message.trim());
    }
}

#[test]
fn a_vanished_chunk_is_not_taken_for_one_that_was_never_stored() {
    for shard in ["16", "'none'"] {
        let dir = tempfile::tempdir().unwrap();
        let shape = [16, 32, 64];
        write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(&mixed_u16(shape)));
        let make = format!(
            "[input.a]\npath = 'vol.npy'\n[output.z]\npath = 'in.zarr'\nfrom = 'a'\nchunk = 8\nshard = {shard}\nlevels = 1\n"
        );
        let text = "[run]\nbrick = 8\n[input.a]\npath = 'in.zarr'\n[stage.s]\nop = 'box'\ninput = 'a'\nradius = 1\n\
                    [output.o]\npath = 'o.npy'\nfrom = 's'\n";
        let array = dir.path().join("in.zarr");
        let chunk = array.join("0/c/0/0/0");
        let vanish: [&dyn Fn(); 3] = [
            &|| fs::rename(&array, dir.path().join("elsewhere.zarr")).unwrap(),
            &|| fs::remove_file(&chunk).unwrap(),
            &|| fs::remove_dir_all(array.join("0/c")).unwrap(),
        ];
        for (i, vanish) in vanish.iter().enumerate() {
            run(dir.path(), &make, &[]);
            let config = parse(dir.path(), text, &[]);
            let options = RunOptions { overwrite: true, ..Default::default() };
            let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent).unwrap();
            // Clocks of file systems tick every few milliseconds.
            std::thread::sleep(Duration::from_millis(30));
            vanish();
            let error = session.run_tasks(&session.open_tasks()).unwrap_err();
            assert_eq!(error.exit_code(), 1, "{error}");
            assert!(error.to_string().contains("in.zarr/0/c/0"), "{shard} {i}: {error}");
            drop(session);
            let _ = fs::remove_dir_all(&array);
            let _ = fs::remove_dir_all(dir.path().join("elsewhere.zarr"));
        }
    }
}

/// A second run into outputs that a first is writing would delete or mix what that wrote.
#[test]
fn one_run_at_a_time_writes_an_output() {
    let dir = folder();
    let config = parse(dir.path(), CONFIG, &[]);
    let plain = RunOptions::default();
    let first = Session::open(&config, &plain, &Silent).map_err(|e| e.to_string());
    let first = first.unwrap_or_else(|e| panic!("{e}"));
    let tasks = first.open_tasks();
    first.run_task(tasks[0]).unwrap();
    let other = parse(dir.path(), CONFIG, &["stage.ao.radius=5"]);
    for (resume, overwrite) in [(false, false), (true, false), (false, true)] {
        let options = RunOptions { resume, overwrite, ..Default::default() };
        let error = Session::open(&other, &options, &Silent).map(|_| ()).unwrap_err();
        assert_eq!(error.exit_code(), 2);
        assert!(error.to_string().contains("ao.zarr is being written by another run"), "{error}");
    }
    first.run_tasks(&tasks[1..]).unwrap();
    first.finish().unwrap();
    let alone = decoded(dir.path());
    // Ended, however it ended, it keeps nobody out.
    let again = RunOptions { overwrite: true, ..Default::default() };
    drop(Session::open(&config, &again, &Silent).map_err(|e| e.to_string()).unwrap_or_else(|e| panic!("{e}")));
    run(dir.path(), CONFIG, &[]);
    for (name, (a, b)) in OUTPUTS.iter().zip(alone.iter().zip(&decoded(dir.path()))) {
        assert_same(name, a, b);
    }
}

/// What was finished and then deleted by hand is nothing: a run starts afresh. What is unfinished lies elsewhere and stays.
#[test]
fn a_finished_file_that_was_deleted_is_made_again() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("v.npy"), "|u1", [2, 3, 4], &(0..24).collect::<Vec<u8>>());
    for ending in ["npy", "raw", "nrrd", "nii"] {
        let path = dir.path().join(format!("o.{ending}"));
        let text = format!("[input.v]\npath = 'v.npy'\n[output.o]\npath = 'o.{ending}'\nfrom = 'v'\n");
        let config = parse(dir.path(), &text, &[]);
        let first = run_with(&config, &RunOptions::default());
        let made = std::fs::read(&path).unwrap();
        for resume in [false, true] {
            std::fs::remove_file(&path).unwrap();
            let again = run_with(&config, &RunOptions { resume, ..Default::default() });
            assert_eq!(std::fs::read(&path).unwrap(), made, "{ending}, resume {resume}");
            assert_eq!(again.bricks.computed, first.bricks.computed, "{ending}, resume {resume}");
        }
        // Killed between the last word and the name: whole, but not there yet.
        let part = Sink::work_dir(&path).join("data.part");
        std::fs::rename(&path, &part).unwrap();
        let refused = occlude::run::run(&config, &RunOptions::default(), &Silent).unwrap_err();
        assert!(refused.to_string().contains("exists; --resume continues it"), "{refused}");
        assert!(part.exists());
    }
}

/// An output that was deleted is made again, whole, beside those that are complete or begun.
#[test]
fn deleted_outputs_are_made_again_beside_the_others() {
    let dir = folder();
    run(dir.path(), CONFIG, &[]);
    let expected = decoded(dir.path());
    let config = parse(dir.path(), CONFIG, &[]);
    let resume = RunOptions { resume: true, ..Default::default() };
    let same = |what: &str| {
        for (name, (a, b)) in OUTPUTS.iter().zip(expected.iter().zip(&decoded(dir.path()))) {
            assert_same(&format!("{name}, {what}"), a, b);
        }
    };
    let delete = |name: &str| {
        let path = dir.path().join("out").join(name);
        if path.is_dir() { fs::remove_dir_all(&path).unwrap() } else { fs::remove_file(&path).unwrap() }
    };
    for name in OUTPUTS {
        delete(name);
        assert!(run_with(&config, &resume).bricks.computed > 0, "{name}");
        same(&format!("after {name} was deleted"));
        assert_eq!(run_with(&config, &resume).bricks.computed, 0, "{name}");
    }
    // Begun: what done tasks left in it is gone.
    let again = RunOptions { overwrite: true, ..Default::default() };
    let session = Session::open(&config, &again, &Silent).map_err(|e| e.to_string()).unwrap_or_else(|e| panic!("{e}"));
    session.run_task(session.open_tasks()[0]).unwrap();
    drop(session);
    delete(OUTPUTS[0]);
    run_with(&config, &resume);
    same("begun and deleted");
    fs::remove_dir_all(dir.path().join("out").join(OUTPUTS[0]).join("0")).unwrap();
    let error = occlude::run::run(&config, &resume, &Silent).unwrap_err().to_string();
    assert!(error.contains(OUTPUTS[0]) && error.contains("level 0, which is gone"), "{error}");
}

/// Killed while `--overwrite` deletes: some chunks are gone, the rest of an interrupted run stands.
#[test]
fn an_overwrite_that_was_killed_leaves_no_task_done() {
    let text = "[run]\nthreads = 1\n[input.a]\npath = 'vol.npy'\n[stage.s]\nop = 'box'\ninput = 'a'\nradius = 1\n\
                [output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 8\nshard = 'none'\n";
    let dir = folder();
    let config = parse(dir.path(), text, &[]);
    let options = RunOptions::default();
    let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent).unwrap();
    let open = session.open_tasks();
    session.run_tasks(&open[..open.len() / 2]).unwrap();
    let error = session.finish().unwrap_err().to_string();
    assert!(error.contains("tasks are not done"), "{error}");
    let work = dir.path().join("o.zarr.occlude");
    assert!(work.join("tasks.log").exists());
    let overwrite = RunOptions { overwrite: true, ..Default::default() };
    // Killed before its first task: of the first run nothing is left, neither chunks nor marks.
    drop(occlude::run::Session::open(&config, &overwrite, &occlude::run::Silent).unwrap());
    let resume = RunOptions { resume: true, ..Default::default() };
    let session = occlude::run::Session::open(&config, &resume, &occlude::run::Silent).unwrap();
    assert_eq!(session.open_tasks().len(), open.len(), "no task of the first run counts");
    session.run_tasks(&session.open_tasks()).unwrap();
    assert!(session.run_task(open.len()).is_err(), "there is no such task");
    session.finish().unwrap();
    let other = folder();
    run(other.path(), text, &[]);
    assert_same("after all", &decode(&other.path().join("o.zarr")), &decode(&dir.path().join("o.zarr")));
}

#[test]
fn scratch_that_vanished_is_an_error_and_not_zeros() {
    let dir = folder();
    let text = format!("{}\n", CONFIG.replace("chunk = 16", "chunk = 16\nlevels = 5"));
    let config = parse(dir.path(), &text, &[]);
    let options = RunOptions::default();
    let session = occlude::run::Session::open(&config, &options, &occlude::run::Silent).unwrap();
    let open = session.open_tasks();
    assert!(open.len() > 1, "one task leaves nothing to resume");
    session.run_tasks(&open[..1]).unwrap();
    drop(session);
    let work = dir.path().join("out/ao.zarr.occlude");
    let spills: Vec<_> = fs::read_dir(&work).unwrap().map(|e| e.unwrap().path()).collect();
    let name = |p: &Path| p.file_name().unwrap().to_string_lossy().into_owned();
    let spill = spills.iter().find(|p| name(p).starts_with("cells.") || name(p).starts_with("level."));
    fs::remove_file(spill.expect("levels beyond bricks leave scratch")).unwrap();
    let resume = RunOptions { resume: true, ..Default::default() };
    let error = occlude::run::Session::open(&config, &resume, &occlude::run::Silent).err().unwrap().to_string();
    assert!(error.contains("gone or was changed") && error.contains("--overwrite"), "{error}");
}

/// Every state between the first and the last deletion of an output is still known as this program's.
#[test]
fn half_made_and_half_removed_groups_are_ours() {
    use occlude::store::sink::{Existing, existing};
    let dir = tempfile::tempdir().unwrap();
    let group = dir.path().join("o.zarr");
    let work = dir.path().join("o.zarr.occlude");
    fs::create_dir_all(&group).unwrap();
    assert_eq!(existing(&group), Existing::Foreign, "an empty folder is anybody's");
    fs::create_dir_all(&work).unwrap();
    fs::write(work.join("meta.json"), "{\"complete\":false}").unwrap();
    let ours = Existing::Ours { complete: false, occlude: None };
    assert_eq!(existing(&group), ours);
    fs::write(group.join(".zgroup"), "{\"zarr_format\":2}").unwrap();
    assert_eq!(existing(&group), ours, "killed before the attributes");
    fs::write(group.join("notes.txt"), "mine").unwrap();
    assert_eq!(existing(&group), Existing::Foreign);
}

/// `nohup` and jobs in the background of a script ignore signals: a run that they start goes on; others drain.
#[cfg(unix)]
#[test]
fn signals_that_were_ignored_at_the_start_stay_so() {
    let text = "[run]\nthreads = 1\nbrick = 32\n[input.a]\nsynthetic = 'noise'\nshape = [160, 160, 160]\ndtype = 'u16'\n\
                [stage.s]\nop = 'ambient_occlusion'\nmethod = 'exact'\ninput = 'a'\nradius = 9\n[output.o]\npath = 'o.zarr'\nfrom = 's'\n";
    for (trap, signal, code) in
        [("trap '' HUP", libc::SIGHUP, 0), ("trap '' INT", libc::SIGINT, 0), ("trap - HUP", libc::SIGHUP, 130)]
    {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("c.toml"), text).unwrap();
        let mut command = Command::new("sh");
        command.args(["-c", &format!("{trap}; exec \"$0\" run c.toml -q")]).arg(program());
        let as_usual = || {
            // SAFETY: valid dispositions of signals that exist; whoever runs the tests may ignore them.
            unsafe {
                libc::signal(libc::SIGHUP, libc::SIG_DFL);
                libc::signal(libc::SIGINT, libc::SIG_DFL);
            }
            Ok(())
        };
        // SAFETY: `signal` may be called between fork and exec.
        unsafe { std::os::unix::process::CommandExt::pre_exec(&mut command, as_usual) };
        let mut child = command.current_dir(dir.path()).stderr(Stdio::null()).spawn().unwrap();
        // Until the run has begun, and with it the handler stands.
        while !dir.path().join("o.zarr.occlude").exists() {
            std::thread::sleep(Duration::from_millis(5));
            assert!(child.try_wait().unwrap().is_none(), "it ended before it began");
        }
        // SAFETY: a signal to a child of ours that was not waited for.
        assert_eq!(unsafe { libc::kill(child.id() as i32, signal) }, 0);
        assert_eq!(child.wait().unwrap().code(), Some(code), "{trap}");
    }
}
