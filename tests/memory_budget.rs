//! Memory is bounded (SPEC 5.3): private resident memory stays under the budget plus 128 MiB, whatever the volume's size;
//! a budget that is too small is refused with the least that would do.

mod common;

use std::process::{Command, Stdio};
use std::time::Duration;

use common::*;

const MIB: u64 = 1 << 20;

/// Most private resident bytes of a child, sampled from outside until it ends.
fn peak_of(mut child: std::process::Child) -> (u64, std::process::ExitStatus) {
    let path = format!("/proc/{}/status", child.id());
    let mut peak = 0;
    loop {
        let status = std::fs::read_to_string(&path).unwrap_or_default();
        let line = status.lines().find(|l| l.starts_with("RssAnon:"));
        let kib = line.and_then(|l| l.split_whitespace().nth(1)).and_then(|n| n.parse::<u64>().ok());
        peak = peak.max(kib.unwrap_or(0) * 1024);
        if let Some(status) = child.try_wait().unwrap() {
            return (peak, status);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Runs the program on a config, which must succeed, and returns its peak.
fn peak_of_run(config: &std::path::Path) -> u64 {
    let mut command = Command::new(program());
    command.arg("run").arg(config).arg("-q").stdout(Stdio::null()).stderr(Stdio::inherit());
    let (peak, status) = peak_of(command.spawn().unwrap());
    assert!(status.success());
    peak
}

#[test]
fn a_gibibyte_under_a_quarter_of_it() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config.toml");
    // Smooth and noisy by turns, 16 MiB repeated 64 times.
    let block = fill([16, 1024, 1024], |z, y, x| {
        let noise = hash(3, ((z * 1024 + y) * 1024 + x) as u64) % 16;
        ((x / 8 + y / 5 + 4 * z) % 200) as u8 + noise as u8
    });
    let mut file = std::fs::File::create(dir.path().join("big.raw")).unwrap();
    (0..64).for_each(|_| std::io::Write::write_all(&mut file, &block).unwrap());
    drop(file);
    let text = r#"
[run]
memory = "256MiB"
threads = 2
[input.big]
path = "big.raw"
format = "raw"
shape = [1024, 1024, 1024]
dtype = "u8"
[stage.ao]
op = "ambient_occlusion"
input = "big"
method = "cdf_power"
radius = 10
[output.ao]
path = "ao.zarr"
from = "ao"
"#;
    std::fs::write(&path, text).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB under a budget of 256 MiB", peak / MIB);
    assert!(peak <= (256 + 128) * MIB, "peak {} MiB", peak / MIB);
    // The same through a chunked source, whose decoded chunks count as well.
    let second = r#"
[run]
memory = "256MiB"
threads = 2
[input.big]
path = "ao.zarr"
[stage.stats]
op = "box"
input = "big"
radius = 5
[output.mean]
path = "mean.zarr"
from = "stats.mean"
dtype = "u8"
range = [0, 255]
"#;
    let path = dir.path().join("second.toml");
    std::fs::write(&path, second).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB from Zarr under a budget of 256 MiB", peak / MIB);
    assert!(peak <= (256 + 128) * MIB, "peak {} MiB", peak / MIB);
    // Sweeps that reach as far as a brick is long: what one brick sees with its halo is all that the budget holds.
    let third = r#"
[run]
memory = "256MiB"
threads = 2
device = "cpu"
region = [[400, 656], [400, 528], [300, 812]]
[input.big]
path = "big.raw"
format = "raw"
shape = [1024, 1024, 1024]
dtype = "u8"
[stage.sweep]
op = "obscurance"
input = "big"
directions = 12
max_distance = 256
[output.open]
path = "open.zarr"
from = "sweep"
"#;
    let path = dir.path().join("third.toml");
    std::fs::write(&path, third).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB of sweeps under a budget of 256 MiB", peak / MIB);
    assert!(peak <= (256 + 128) * MIB, "peak {} MiB", peak / MIB);
}

#[test]
fn a_budget_too_small_for_one_brick_is_refused_with_the_least_that_does() {
    let dir = tempfile::tempdir().unwrap();
    let text = r#"
[run]
memory = "21MiB"
threads = 1
[input.a]
synthetic = "noise"
shape = [300, 300, 300]
dtype = "f32"
[stage.s]
op = "obscurance"
input = "a"
max_distance = 100
[output.o]
path = "o.zarr"
from = "s"
"#;
    let config = parse(dir.path(), text, &[]);
    let error = occlude::run::run(&config, &Default::default(), &occlude::run::Silent).unwrap_err();
    assert_eq!(error.exit_code(), 2);
    let message = error.to_string();
    assert!(message.contains("run.memory"), "{message}");
    let least = message.split("memory = \"").nth(1).and_then(|t| t.split("MiB").next()).expect("the least is named");
    let set = format!("run.memory={least}MiB");
    let (text, plan) = occlude::plan::explain(&parse(dir.path(), text, &[&set])).unwrap();
    assert!(plan["peak_memory_bytes"].as_u64().unwrap() <= plan["memory_budget_bytes"].as_u64().unwrap(), "{text}");
}

/// A brick that was asked for larger than the volume takes what the volume does.
#[test]
fn bricks_are_no_larger_than_the_volume() {
    let dir = tempfile::tempdir().unwrap();
    let text = "[run]\nmemory = \"64MiB\"\nthreads = 1\n[input.a]\nsynthetic = \"noise\"\nshape = [20, 30, 24]\n[stage.s]\n\
                op = \"box\"\ninput = \"a\"\nradius = 2\n[output.o]\npath = \"o.npy\"\nfrom = \"s\"\n";
    run(dir.path(), text, &["run.brick=5000"]);
    let message = parse(dir.path(), text, &["run.brick=5000", "input.a.shape=[900, 900, 900]"]);
    let message = occlude::plan::explain(&message).unwrap_err().to_string();
    assert!(message.contains("run.brick") && !message.contains("smallest"), "{message}");
}

/// Chunks between bricks are decoded about once, though the budget holds a small part of the volume: the cache knows which
/// brick needs a chunk next. Kept by last use they would be read 1.4 times here.
#[test]
fn a_tight_budget_decodes_chunks_about_once() {
    let dir = tempfile::tempdir().unwrap();
    let volume = r#"
[input.v]
synthetic = "gyroid"
shape = [256, 256, 256]
dtype = "u8"
[output.o]
from = "v"
path = "vol.zarr"
levels = 1
chunk = 32
shard = "none"
"#;
    let stored = run(dir.path(), volume, &[]).bytes_written;
    let mean = r#"
[run]
memory = "40MiB"
threads = 2
[input.v]
path = "vol.zarr"
[stage.s]
op = "box"
input = "v"
radius = 4
[output.o]
from = "s.mean"
path = "mean.zarr"
levels = 1
"#;
    let read = run(dir.path(), mean, &[]).bytes_read;
    // Tasks part the planes, and the cache is too small for all that two of them share.
    assert!(read as f64 <= 1.5 * stored as f64, "{read} bytes read of {stored}");
}

/// Four stages, one on another, whose halos add up.
const CHAIN: &str = r#"
[stage.g]
op = "gaussian"
input = "a"
sigma = 2
[stage.h]
op = "gradient"
input = "g"
[stage.t]
op = "transfer"
input = "h.magnitude"
points = [[0, 0, 1, 1, 1], [300, 1, 0, 0, 0]]
[stage.s]
op = "obscurance"
input = "t.opacity"
max_distance = 16
directions = 12
[output.o]
path = "o.zarr"
from = "s"
"#;
const NOISE: &str = "synthetic = 'noise'\nshape = [200, 256, 300]\ndtype = 'u16'\n";

/// Stages of a chain use buffers of many sizes, one after another: those that wait for the next brick are part of the budget.
/// Kept beside it, they took a run of this chain to 187 to 222 MiB.
#[test]
fn a_chain_of_stages_stays_under_the_budget_itself() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config.toml");
    let run = "[run]\nmemory = '160MiB'\nthreads = 2\ndevice = 'cpu'\n";
    std::fs::write(&path, format!("{run}[input.a]\n{NOISE}{CHAIN}")).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB of a chain under a budget of 160 MiB", peak / MIB);
    assert!(peak <= 160 * MIB, "peak {} MiB", peak / MIB);
}

/// Large bricks of a chain must leave room for the chunks between two layers of them: they decoded chunks of planes eleven
/// times.
#[test]
fn a_chain_decodes_chunks_of_planes_about_once() {
    let dir = tempfile::tempdir().unwrap();
    let store = "[output.o]\nfrom = 'a'\npath = 'planes.zarr'\nlevels = 1\nchunk = [1, 256, 300]\nshard = 'none'\n";
    let stored = run(dir.path(), &format!("[input.a]\n{NOISE}{store}"), &[]).bytes_written;
    let limits = "[run]\nmemory = '160MiB'\nthreads = 2\ndevice = 'cpu'\n";
    let read = run(dir.path(), &format!("{limits}[input.a]\npath = 'planes.zarr'\n{CHAIN}"), &[]).bytes_read;
    assert!(read as f64 <= 1.2 * stored as f64, "{read} bytes read of {stored}");
}

/// The MiB that a refused config asks for; `None` where it is not refused.
fn asked_for(config: &std::path::Path, memory: &str) -> Option<u64> {
    let mut command = Command::new(program());
    command.arg("plan").arg(config).args(["-q", "--memory", memory, "--threads", "1"]);
    let out = command.output().unwrap();
    let said = String::from_utf8(out.stderr).unwrap();
    if out.status.success() {
        return None;
    }
    assert_eq!(out.status.code(), Some(2), "{said}");
    let number = said.split("at least memory = \"").nth(1).and_then(|s| s.split("MiB").next());
    Some(number.and_then(|n| n.parse().ok()).unwrap_or_else(|| panic!("no number in {said}")))
}

#[test]
fn the_least_that_is_asked_for_does() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("v.npy"), "<u2", [40, 300, 300], &u16_bytes(&mixed_u16([40, 300, 300])));
    let path = dir.path().join("config.toml");
    for (border, radius, out) in
        [("reflect", 100, "o.nrrd"), ("nearest", 30, "o.nrrd"), ("clip", 100, "o.nrrd"), ("nearest", 300, "o.zarr")]
    {
        let text = format!(
            "[input.v]\npath = 'v.npy'\n[stage.s]\nop = 'box'\ninput = 'v'\nradius = {radius}\nborder = '{border}'\n\
             [output.o]\npath = '{out}'\nfrom = 's.variance'\n"
        );
        std::fs::write(&path, text).unwrap();
        let least = asked_for(&path, "1MiB").expect("refused");
        assert_eq!(asked_for(&path, &format!("{least}MiB")), None, "{border} {radius} {out}: {least} MiB");
        assert!(
            asked_for(&path, &format!("{}MiB", least - 1)).is_some(),
            "{border} {radius} {out}: less than {least} MiB"
        );
    }
}

/// Cells of levels that only the second phase makes are read in pieces: of wide chunks one plane was read at once, on every thread.
#[test]
fn wide_chunks_of_coarse_levels_count_in_the_budget() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config.toml");
    let text = "[run]\nmemory = '96MiB'\nthreads = 2\n[input.v]\nsynthetic = 'noise'\nshape = [1, 4096, 16384]\nspacing = [1, 64, 1]\n\
                dtype = 'u8'\n[output.o]\npath = 'o.zarr'\nfrom = 'v'\nchunk = [1, 4096, 1024]\nshard = 'none'\nlevels = 6\n";
    std::fs::write(&path, text).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB of wide chunks under a budget of 96 MiB", peak / MIB);
    assert!(peak <= (96 + 40) * MIB, "peak {} MiB", peak / MIB);
}

/// A brick keeps the mask of every stage until it is written.
#[test]
fn masks_count_in_the_budget() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config.toml");
    let mut text = String::from(
        "[run]\nmemory = '96MiB'\nthreads = 2\ndevice = 'cpu'\n[input.v]\nsynthetic = 'noise'\nshape = [128, 256, 256]\ndtype = 'u8'\n",
    );
    let names: Vec<String> = (0..40).map(|i| format!("s{i}")).collect();
    for (i, name) in names.iter().enumerate() {
        text += &format!(
            "[stage.{name}]\nop = 'window'\ninput = 'v'\nlow = 50\nhigh = 200\nwhere = {{ input = 'v', min = {} }}\n",
            50 + i
        );
    }
    text += &format!(
        "[stage.c]\nop = 'combine'\nop_kind = 'max'\ninputs = {names:?}\n[output.o]\npath = 'o.zarr'\nfrom = 'c'\nlevels = 1\n"
    );
    std::fs::write(&path, text).unwrap();
    let peak = peak_of_run(&path);
    println!("peak {} MiB of 40 masks under a budget of 96 MiB", peak / MIB);
    assert!(peak <= (96 + 32) * MIB, "peak {} MiB", peak / MIB);
}

/// Bricks that are thin across wide rows of chunks leave many of them open.
#[test]
fn open_chunks_count_in_the_budget() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config.toml");
    let text = "[input.v]\nsynthetic = 'noise'\nshape = [64, 512, 2048]\ndtype = 'u16'\n[stage.s]\nop = 'box'\ninput = 'v'\nradius = 1\n\
                [output.o]\npath = 'o.zarr'\nfrom = 's.variance'\nlevels = 1\nshard = 'none'\n";
    let asked = |memory: u64| {
        let head =
            format!("run.memory = '{memory}MiB'\nrun.threads = 2\nrun.device = 'cpu'\nrun.brick = [8, 512, 64]\n");
        std::fs::write(&path, head + text).unwrap();
    };
    asked(40);
    let least = asked_for(&path, "40MiB").expect("64 chunks of a mebibyte do not fit");
    asked(least + 8);
    let peak = peak_of_run(&path);
    println!("peak {} MiB of open chunks under a budget of {} MiB", peak / MIB, least + 8);
    assert!(peak <= (least + 8 + 32) * MIB, "peak {} MiB", peak / MIB);
}

/// Chunks as large as a volume, of which only a corner exists; and volumes of one chunk.
#[test]
fn large_chunks_count_in_the_budget() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [40, 300, 300];
    write_npy(&dir.path().join("v.npy"), "<u2", shape, &u16_bytes(&mixed_u16(shape)));
    let path = dir.path().join("config.toml");
    let under = |text: &str, memory: u64| {
        std::fs::write(&path, text).unwrap();
        let least = asked_for(&path, &format!("{memory}MiB")).expect("refused");
        std::fs::write(&path, format!("run.memory = '{least}MiB'\nrun.threads = 1\n{text}")).unwrap();
        let peak = peak_of_run(&path);
        println!("peak {} MiB under a budget of {least} MiB", peak / MIB);
        assert!(peak <= (least + 128) * MIB, "peak {} MiB under {least} MiB", peak / MIB);
    };
    under("[input.v]\npath = 'v.npy'\n[output.o]\npath = 'o.zarr'\nfrom = 'v'\nchunk = 512\nshard = 'none'\n", 64);
    // Indices of shards of two million chunks, most of which do not exist.
    under(
        "[input.v]\nsynthetic = 'noise'\nshape = [12, 13, 14]\ndtype = 'u8'\n[output.o]\npath = 'i.zarr'\nfrom = 'v'\nchunk = 2\n",
        64,
    );
    // Noise, so that packed chunks are as large as they can be.
    let made = "[input.v]\nsynthetic = 'noise'\nshape = [256, 256, 256]\ndtype = 'f32'\n[output.o]\npath = 'one.zarr'\nfrom = 'v'\n\
                chunk = 256\nshard = 'none'\nlevels = 1\ndtype = 'f32'\n";
    run(dir.path(), made, &[]);
    under(
        "[input.v]\npath = 'one.zarr'\n[stage.s]\nop = 'box'\ninput = 'v'\nradius = 1\n[output.o]\npath = 'o.npy'\nfrom = 's.max'\n",
        21,
    );
}
