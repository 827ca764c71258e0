//! CPU and GPU agree (SPEC 5.6). Every result of the lane must equal the CPU's **bit for bit**: sums and extremes are exact
//! integers, and the CPU's own row functions finish them. That is the one tolerance of this file: none.
//!
//! Without a Vulkan adapter these tests say so and pass, unless OCCLUDE_REQUIRE_GPU_TESTS=1.

mod common;

use std::path::Path;
use std::process::Command;

use common::{assert_same, decode, hash, metadata, mixed_u16, parse, program, run_with, u16_bytes, write_npy};
use occlude::brick::{Scratch, Voxels};
use occlude::gpu::{Gpu, GpuFacts, GpuKind, facts};
use occlude::grid::{Affine, DType, Shape, Voxel};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::plan::Plan;
use occlude::run::{RunOptions, Session, Silent};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};
use occlude::with_voxels;

/// The software adapter, or a loud note that there is none.
fn adapter() -> Option<Gpu> {
    match Gpu::open(GpuKind::Software) {
        Ok(gpu) => Some(gpu),
        Err(why) => {
            assert!(why.starts_with("looked for"), "there is an adapter, but: {why}");
            assert!(std::env::var("OCCLUDE_REQUIRE_GPU_TESTS").as_deref() != Ok("1"), "GPU tests are required: {why}");
            eprintln!("SKIPPED: no Vulkan adapter ({why})");
            None
        }
    }
}

fn params(radius: [usize; 3]) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false }
}

fn all_channels() -> Vec<WindowChannel> {
    use WindowChannel::*;
    let methods = [Method::CdfPower, Method::GaussianCdf, Method::Chebyshev, Method::ChebyshevLiteral];
    let open = methods.iter().flat_map(|m| [Openness(*m, Ties::Le), Openness(*m, Ties::Mid)]);
    [Mean, Min, Max, Variance, Std, Moment2].into_iter().chain(open).collect()
}

/// A value for each index.
type Fill = Box<dyn Fn(usize) -> f64>;

/// Fills that break careless sums: noise, extremes of the type, constants, one voxel off, and a step.
fn fills(dtype: DType, shape: Shape) -> Vec<(&'static str, Voxels)> {
    fn set<T: Voxel>(v: &mut [T], value: impl Fn(usize) -> f64) {
        v.iter_mut().enumerate().for_each(|(i, v)| *v = T::from_f64(value(i)));
    }
    let (lo, hi) = dtype.range();
    let len: usize = shape.iter().product();
    let noise = move |i: usize| lo + (hash(3, i as u64) % (hi - lo + 1.0) as u64) as f64;
    let kinds: [(&'static str, Fill); 6] = [
        ("noise", Box::new(noise)),
        ("extremes", Box::new(move |i| if hash(5, i as u64).is_multiple_of(3) { lo } else { hi })),
        ("greatest", Box::new(move |_| hi)),
        ("least", Box::new(move |_| lo)),
        ("one off", Box::new(move |i| if i == len / 2 { hi - 1.0 } else { hi })),
        ("step", Box::new(move |i| if i % shape[2] < shape[2] / 2 { lo + (i % 3) as f64 } else { hi })),
    ];
    let make = |value: &dyn Fn(usize) -> f64| {
        let mut out = Voxels::zeroed(dtype, len);
        with_voxels!(&mut out, v => set(v, value));
        out
    };
    kinds.iter().map(|(name, f)| (*name, make(f))).collect()
}

fn out_dtype(input: DType, p: &WindowParams, channel: WindowChannel) -> DType {
    let extreme = matches!(channel, WindowChannel::Min | WindowChannel::Max);
    if extreme && p.affine.is_identity() { input } else { input.result() }
}

/// Output box within a volume.
type Box3 = ([usize; 3], Shape);

/// Every channel of a box by one lane; `None` for the CPU.
fn results(
    gpu: Option<&Gpu>,
    volume: &Voxels,
    shape: Shape,
    p: &WindowParams,
    (at, dst): Box3,
    channels: &[WindowChannel],
) -> Vec<Voxels> {
    let dirty = |c: &WindowChannel| {
        let mut v = Voxels::zeroed(out_dtype(volume.dtype(), p, *c), dst.iter().product());
        v.fill(if gpu.is_some() { 77.0 } else { 33.0 });
        v
    };
    let mut made: Vec<Voxels> = channels.iter().map(dirty).collect();
    let mut outs: Vec<WindowOut> =
        made.iter_mut().zip(channels).map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(dst) }).collect();
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    match gpu {
        Some(gpu) => drop(gpu.window(volume.view(shape), p, at, &mut outs, &mut cx).unwrap_or_else(|e| panic!("{e}"))),
        None => window(volume.view(shape), p, Place::whole(at), &mut outs, &mut cx),
    }
    made
}

/// The first channel and voxel where two lanes differ.
fn differs(cpu: &[Voxels], gpu: &[Voxels], channels: &[WindowChannel]) -> Option<String> {
    let pairs = cpu.iter().zip(gpu).zip(channels).filter(|((a, b), _)| a.as_bytes() != b.as_bytes());
    let mut texts = pairs.map(|((a, b), c)| {
        let i = (0..a.len()).find(|&i| a.at(i).to_bits() != b.at(i).to_bits());
        format!("{c:?}: voxel {i:?}: {:?} on the CPU, {:?} on the GPU", i.map(|i| a.at(i)), i.map(|i| b.at(i)))
    });
    texts.next()
}

fn check(gpu: &Gpu, name: &str, volume: &Voxels, shape: Shape, p: &WindowParams, part: Box3) {
    let channels = all_channels();
    let cpu = results(None, volume, shape, p, part, &channels);
    let got = results(Some(gpu), volume, shape, p, part, &channels);
    if let Some(text) = differs(&cpu, &got, &channels) {
        panic!("{name} of {} {shape:?}, {part:?}, {p:?}: {text}", volume.dtype());
    }
}

const DTYPES: [DType; 4] = [DType::U8, DType::I8, DType::U16, DType::I16];

#[test]
fn every_channel_equals_the_cpu() {
    let Some(gpu) = adapter() else { return };
    let shape = [13, 17, 37];
    for dtype in DTYPES {
        for (name, volume) in fills(dtype, shape) {
            for radius in [[0; 3], [1, 1, 1], [2, 3, 5], [0, 4, 0], [10, 10, 10]] {
                check(&gpu, name, &volume, shape, &params(radius), ([0; 3], shape));
            }
        }
    }
}

#[test]
fn odd_shapes_and_radii_beyond_the_volume() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [1, 33, 1], [5, 6, 71], [3, 300, 2], [64, 3, 5]] {
        for dtype in DTYPES {
            let (name, volume) = fills(dtype, shape).swap_remove(0);
            for radius in [[1, 0, 2], [3, 3, 3], [100, 100, 100], [0, 1 << 40, 1]] {
                check(&gpu, name, &volume, shape, &params(radius), ([0; 3], shape));
            }
        }
    }
}

#[test]
fn boxes_inside_scaled_and_turned_around() {
    let Some(gpu) = adapter() else { return };
    let shape = [20, 24, 40];
    for dtype in DTYPES {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for (at, dst) in [([4, 5, 6], [9, 11, 13]), ([0, 23, 0], [20, 1, 40]), ([19, 0, 39], [1, 1, 1])] {
            for (slope, intercept, solid_low) in [(1.0, 0.0, true), (-2.5, 7.0, false), (0.5, -1024.0, true)] {
                let affine = Affine { slope, intercept };
                let p = WindowParams { affine, solid_low, ..params([4, 5, 6]) };
                check(&gpu, name, &volume, shape, &p, (at, dst));
            }
        }
    }
}

#[test]
fn sums_beyond_32_bits() {
    let Some(gpu) = adapter() else { return };
    // 45 * 45 * 45 voxels: S1 of u16 and S2 of u8 exceed 2^32.
    let shape = [45, 45, 45];
    for dtype in DTYPES {
        for (name, volume) in
            fills(dtype, shape).into_iter().filter(|(n, _)| ["greatest", "one off", "noise"].contains(n))
        {
            check(&gpu, name, &volume, shape, &params([60; 3]), ([20, 0, 0], [6, 45, 45]));
            check(&gpu, name, &volume, shape, &params([21; 3]), ([20, 10, 0], [6, 6, 45]));
        }
    }
}

#[test]
fn a_brick_beyond_the_limits_is_cut_and_a_window_beyond_them_goes_to_the_cpu() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [30, 25, 41];
    for dtype in [DType::U8, DType::I16] {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for cap in [120_000, 30_000, 6_000, 300] {
            gpu.set_cap(cap);
            check(&gpu, name, &volume, shape, &params([3, 4, 5]), ([0; 3], shape));
        }
    }
}

#[test]
fn threads_share_the_lane_and_each_channel_stands_alone() {
    let Some(gpu) = adapter() else { return };
    let shape = [16, 18, 40];
    let volumes: Vec<Voxels> = DTYPES.iter().map(|d| fills(*d, shape).swap_remove(0).1).collect();
    std::thread::scope(|scope| {
        for t in 0..6usize {
            let (gpu, volumes) = (&gpu, &volumes);
            scope.spawn(move || {
                for (k, channel) in all_channels().into_iter().enumerate() {
                    let (volume, p) = (&volumes[(t + k) % 4], params([t, 3, 2]));
                    let part = ([t, 0, 0], [10, 18, 40]);
                    let cpu = results(None, volume, shape, &p, part, &[channel]);
                    let got = results(Some(gpu), volume, shape, &p, part, &[channel]);
                    assert_eq!(differs(&cpu, &got, &[channel]), None, "thread {t}");
                }
            });
        }
    });
}

#[test]
fn a_lost_device_is_opened_anew() {
    let Some(gpu) = adapter() else { return };
    let shape = [12, 12, 33];
    let (name, volume) = fills(DType::U16, shape).swap_remove(0);
    for _ in 0..3 {
        check(&gpu, name, &volume, shape, &params([2; 3]), ([0; 3], shape));
        gpu.lose();
        check(&gpu, name, &volume, shape, &params([3; 3]), ([0; 3], shape));
    }
}

#[test]
fn the_comparison_can_fail() {
    let shape = [4, 5, 6];
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let channels = all_channels();
    let cpu = results(None, &volume, shape, &params([1; 3]), ([0; 3], shape), &channels);
    assert_eq!(differs(&cpu, &cpu.clone(), &channels), None);
    for k in 0..channels.len() {
        let mut other = cpu.clone();
        let bytes = other[k].as_bytes_mut();
        let last = bytes.len() - 1;
        bytes[last - 3 * usize::from(last > 400)] ^= 1;
        let text = differs(&cpu, &other, &channels).expect("one bit is a difference");
        assert!(text.contains(&format!("{:?}", channels[k])), "{text}");
    }
    let wider = results(None, &volume, shape, &params([2; 3]), ([0; 3], shape), &channels);
    assert!(differs(&cpu, &wider, &channels).is_some());
}

#[test]
fn inputs_without_a_kernel_are_named() {
    let mean = [WindowChannel::Mean];
    for dtype in DTYPES {
        assert!(facts::window(dtype, false, &all_channels()).is_ok());
        assert!(facts::window(dtype, true, &mean).unwrap_err().contains("missing"));
        let exact = WindowChannel::Openness(Method::Exact, Ties::Le);
        assert!(facts::window(dtype, false, &[exact]).unwrap_err().contains("exact"));
    }
    for dtype in [DType::U32, DType::I32, DType::F32, DType::F64] {
        assert!(facts::window(dtype, false, &mean).unwrap_err().contains("runs on the CPU"));
    }
    let Some(gpu) = adapter() else { return };
    let volume = Voxels::zeroed(DType::F32, 8);
    let mut made = Voxels::zeroed(DType::F32, 8);
    let mut outs = [WindowOut { channel: WindowChannel::Mean, dst: made.view_mut([2, 2, 2]) }];
    let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
    let error = gpu.window(volume.view([2, 2, 2]), &params([1; 3]), [0; 3], &mut outs, &mut cx).unwrap_err();
    assert!(error.to_string().contains("f32"));
}

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
[output.again]
path = "out/again.zarr"
from = "again"
chunk = 16
[output.exact]
path = "out/exact.zarr"
from = "exact"
chunk = 16
"#;
const OUTPUTS: [&str; 4] = ["stats.zarr", "mirrored.zarr", "again.zarr", "exact.zarr"];
const SOFTWARE: &str = "run.device='gpu:software'";

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let shape = [40, 50, 60];
    write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(&mixed_u16(shape)));
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
    run_with(&parse(cpu.path(), CONFIG, &["run.device='cpu'"]), &RunOptions::default());
    let report = run_with(&parse(gpu.path(), CONFIG, &[SOFTWARE]), &RunOptions::default());
    assert_same_outputs("gpu:software", cpu.path(), gpu.path());
    let device = |name: &str| report.stages.iter().find(|s| s.name == name).map(|s| s.device.clone());
    assert_eq!(device("stats").as_deref(), Some("gpu"));
    assert_eq!(device("mirrored").as_deref(), Some("gpu"));
    assert_eq!(device("again").as_deref(), Some("cpu"));
    assert_eq!(device("exact").as_deref(), Some("cpu"));
    assert_eq!(report.placement["stats"], "gpu");
}

#[test]
fn a_little_memory_cuts_bricks_on_the_device_and_changes_nothing() {
    let Some(_) = adapter() else { return };
    let (cpu, gpu) = (folder(), folder());
    run_with(&parse(cpu.path(), CONFIG, &["run.device='cpu'"]), &RunOptions::default());
    let config = parse(gpu.path(), CONFIG, &[SOFTWARE, "run.memory='40MiB'", "run.brick='auto'"]);
    run_with(&config, &RunOptions::default());
    assert_same_outputs("40 MiB", cpu.path(), gpu.path());
}

#[test]
fn a_run_resumes_on_the_device_that_it_was_begun_on() {
    let Some(_) = adapter() else { return };
    let (cpu, gpu) = (folder(), folder());
    run_with(&parse(cpu.path(), CONFIG, &["run.device='cpu'"]), &RunOptions::default());
    let config = parse(gpu.path(), CONFIG, &[SOFTWARE]);
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

/// Plans with an adapter that need not exist: the planner sees facts only.
fn plan_with(device: &str, found: Result<GpuFacts, String>) -> occlude::Result<(Plan, usize)> {
    let dir = folder();
    let config = parse(dir.path(), CONFIG, &[device]);
    let infos: Vec<_> = occlude::store::open_inputs(&config)?.iter().map(|s| s.info().clone()).collect();
    let mut calls = 0;
    let plan = Plan::new(&config, &infos, &mut || {
        calls += 1;
        found.clone()
    })?;
    assert!(calls <= 1);
    Ok((plan, calls))
}

#[test]
fn placement_follows_the_device_and_says_why() {
    let facts = |software| GpuFacts { name: "Test 9000".into(), software, most_bytes: 1 << 30 };
    let none = || Err("looked for a driver; found no Vulkan adapter".to_string());
    let on = |plan: &Plan, name: &str| {
        let place = plan.placement.iter().find(|p| p.0 == name).unwrap();
        (place.1, place.2.clone())
    };
    let (plan, calls) = plan_with("run.device='cpu'", Ok(facts(false))).unwrap();
    assert_eq!((calls, plan.gpu.is_none()), (0, true));
    let parked = plan.groups[0].brick.parked;
    let (plan, _) = plan_with("run.device='auto'", Ok(facts(false))).unwrap();
    assert_eq!(on(&plan, "stats"), ("gpu", "Test 9000".into()));
    assert!(on(&plan, "again").1.contains("f32") && on(&plan, "exact").1.contains("exact"));
    let staging = plan.groups[0].brick.parked - parked;
    let (plan, _) = plan_with("run.device='gpu:software'", Ok(facts(true))).unwrap();
    assert!(staging > 0 && plan.groups[0].brick.parked - parked > staging, "device memory of software counts");
    let (plan, _) = plan_with("run.device='auto'", none()).unwrap();
    assert!(plan.placement.iter().all(|p| p.1 == "cpu"));
    assert!(on(&plan, "stats").1.contains("no Vulkan adapter"));
    for device in ["gpu", "gpu:software"] {
        let error = plan_with(&format!("run.device='{device}'"), none()).unwrap_err();
        assert_eq!(error.exit_code(), 1);
        assert!(error.to_string().contains("looked for a driver") && error.to_string().contains(device), "{error}");
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
    for device in ["gpu", "gpu:software"] {
        let (code, text) = command(device);
        assert_eq!(code, Some(1), "{text}");
        assert!(text.contains("looked for") && text.contains("no Vulkan adapter"), "{text}");
    }
    let (code, text) = command("auto");
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("running on the CPU"), "{text}");
}
