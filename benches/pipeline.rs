//! Whole runs beside what bounds them, in one process: `cargo bench --bench pipeline`.
//!
//! Rows are wall times of `run()` on two threads, best of three. Ratios are taken inside this run; absolute times on a
//! shared machine say little.

use std::path::Path;
use std::time::Instant;

use occlude::brick::{Scratch, Voxels};
use occlude::config;
use occlude::grid::{Affine, DType, Region};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::run::{Report, RunOptions, Silent};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};
use occlude::store::os::thread_time;

const SHAPE: [usize; 3] = [512, 256, 256];

/// A body in air with noise, u16.
fn volume() -> Vec<u16> {
    let mut state = 88172645463325252u64;
    let mut v = Vec::with_capacity(SHAPE.iter().product());
    for i in Region::whole(SHAPE).iter() {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let d: [f64; 3] = std::array::from_fn(|a| (i[a] as f64 + 0.5) / SHAPE[a] as f64 - 0.5);
        let r = d.iter().map(|x| x * x).sum::<f64>().sqrt();
        let tissue = if r > 0.45 { 0.0 } else { 1000.0 + 200.0 * (40.0 * d[0]).sin() * (30.0 * d[2]).cos() };
        v.push((tissue + if r > 0.45 { 0.0 } else { (state >> 58) as f64 }) as u16);
    }
    v
}

fn run(dir: &Path, text: &str, sets: &[&str]) -> (f64, Report) {
    let sets: Vec<String> = sets.iter().map(|s| s.to_string()).collect();
    let config = config::parse(text, &dir.join("config.toml"), &sets).expect("a valid config");
    let once = || {
        let start = Instant::now();
        let options = RunOptions { overwrite: true, ..Default::default() };
        let report = occlude::run::run(&config, &options, &Silent).expect("the run succeeds");
        (start.elapsed().as_secs_f64(), report)
    };
    (0..3).map(|_| once()).min_by(|a, b| a.0.total_cmp(&b.0)).expect("three runs")
}

fn row(name: &str, seconds: f64, note: &str) {
    let rate = SHAPE.iter().product::<usize>() as f64 / seconds / 1e6;
    println!("| {name} | {:.0} ms | {rate:.0} | {note} |", seconds * 1e3);
}

/// The kernel alone on the whole volume, two halves on two threads, as the pipeline would at best: seconds, and those that both
/// had a core, together.
fn kernel(v: &Voxels) -> [f64; 2] {
    let channel = WindowChannel::Openness(Method::CdfPower, Ties::Le);
    let params = WindowParams { radius: [10; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    let half = [SHAPE[0] / 2, SHAPE[1], SHAPE[2]];
    let work = |z: usize| {
        let mut out = Voxels::zeroed(DType::F32, half.iter().product());
        let mut scratch = Scratch::new();
        let mut best = [f64::INFINITY; 2];
        for _ in 0..3 {
            let (start, core) = (Instant::now(), thread_time());
            let mut outs = [WindowOut { channel, dst: out.view_mut(half) }];
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            window(v.view(SHAPE), &params, Place::whole([z, 0, 0]), &mut outs, &mut cx);
            let with_core = thread_time().zip(core).map_or(0.0, |(to, from)| (to - from).as_secs_f64());
            best = [best[0].min(start.elapsed().as_secs_f64()), best[1].min(with_core)];
        }
        best
    };
    std::thread::scope(|s| {
        let other = s.spawn(|| work(half[0]));
        let (mine, other) = (work(0), other.join().expect("the kernel does not panic"));
        [mine[0].max(other[0]), mine[1] + other[1]]
    })
}

fn main() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let v = volume();
    let bytes: Vec<u8> = v.iter().flat_map(|x| x.to_le_bytes()).collect();
    std::fs::write(dir.path().join("ct.raw"), bytes).expect("room for the volume");
    let input = format!("[input.ct]\npath = 'ct.raw'\nformat = 'raw'\nshape = {SHAPE:?}\ndtype = 'u16'\n");
    let ao = "[stage.ao]\nop = 'ambient_occlusion'\ninput = 'ct'\nmethod = 'cdf_power'\nradius = 10\n";
    println!("Whole runs, {SHAPE:?} u16, cdf_power radius 10, two threads, best of three.\n");
    println!("| run | time | Mvoxel/s | |\n|---|---|---|---|");
    let [alone, cores] = kernel(&Voxels::U16(v));
    row("kernel alone, two threads", alone, "in memory");
    let flat = format!("[run]\nthreads = 2\n{input}{ao}[output.o]\npath = 'o.raw'\nfrom = 'ao'\n");
    let (raw, report) = run(dir.path(), &flat, &[]);
    row("raw to raw u8", raw, &format!("{:.2}x the kernel", raw / alone));
    let inside = report.stages[0].core_seconds.unwrap_or(f64::NAN);
    row("its stage, core seconds", inside, &format!("{:.0} % of the kernel's rate per core", 100.0 * cores / inside));
    let start = Instant::now();
    std::fs::copy(dir.path().join("ct.raw"), dir.path().join("copy.raw")).expect("room for a copy");
    row("copy of the input file", start.elapsed().as_secs_f64(), "");
    let plain = format!("[run]\nthreads = 2\n{input}[output.o]\npath = 'in.zarr'\nfrom = 'ct'\nlevels = 1\n");
    run(dir.path(), &plain, &[]);
    let from = "[input.ct]\npath = 'in.zarr'\n";
    let codec = format!(
        "[run]\nthreads = 2\n{from}[output.o]\npath = 'c.zarr'\nfrom = 'ct'\ndtype = 'u8'\nrange = [0, 1300]\nlevels = 1\n"
    );
    let (recode, _) = run(dir.path(), &codec, &[]);
    row("Zarr to Zarr, decode and encode only", recode, "");
    let filter = format!("[run]\nthreads = 2\n{from}{ao}[output.o]\npath = 'f.zarr'\nfrom = 'ao'\nlevels = 1\n");
    let (filtered, _) = run(dir.path(), &filter, &[]);
    row("Zarr to Zarr with the filter", filtered, &format!("{:.0} % of the codec's rate", 100.0 * recode / filtered));
    let (levels, _) = run(dir.path(), &filter.replace("levels = 1", "levels = 'auto'"), &[]);
    row("the same with levels", levels, &format!("{:+.0} %", 100.0 * (levels / filtered - 1.0)));
    let (tight, report) = run(dir.path(), &filter, &["run.memory=64MiB"]);
    let peak = report.peak_memory_bytes as f64 / (1 << 20) as f64;
    row(
        "the same under 64 MiB",
        tight,
        &format!("{:.0} % of the in-core rate, peak {peak:.0} MiB", 100.0 * filtered / tight),
    );
}
