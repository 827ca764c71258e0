//! Results that stay on the GPU: gradients and windows of a Gaussian, whose means never come back, equal the two one by one.

use std::path::Path;

use occlude::brick::{Scratch, Voxels, gather};
use occlude::gpu::Gpu;
use occlude::gpu::chain::Extents;
use occlude::gpu::facts::tolerance;
use occlude::gpu::slopes::Fit;
use occlude::grid::{Affine, AnyView, AnyViewMut, Border, DType, Region, Shape, View, ViewMut};
use occlude::kernel::Context;
use occlude::kernel::gradient::GradientOut;
use occlude::kernel::simd::Level;
use occlude::kernel::window::WindowOut;
use occlude::plan::Plan;
use occlude::run::RunOptions;
use occlude::stage::{GradientWeight, Method, Ties, WindowChannel, WindowParams};

use super::common::{Decoded, assert_same, decode, mixed_u16, parse, run_with, u16_bytes, write_npy};
use super::{adapter, fills};

const SIGMA: [f64; 3] = [1.0, 0.7, 1.6];

fn fit(size: usize) -> Fit {
    Fit { size, weight: GradientWeight::Distance, spacing: [1.0, 2.0, 0.5], missing: None }
}

/// Magnitude, then components, or as many of them as are asked for.
type Results = [Vec<f32>; 4];

fn out(made: &mut Results, shape: Shape, [magnitude, vector]: [bool; 2]) -> GradientOut<'_> {
    let [m, z, y, x] = made.each_mut().map(|v| AnyViewMut::F32(ViewMut::dense(v, shape)));
    GradientOut { magnitude: magnitude.then_some(m), vector: vector.then_some([z, y, x]) }
}

/// One by one, over the whole volume.
fn apart(gpu: &Gpu, volume: &Voxels, shape: Shape, fit: &Fit, wanted: [bool; 2]) -> Results {
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let mut means = vec![0.0f32; shape.iter().product()];
    let mean = AnyViewMut::F32(ViewMut::dense(&mut means, shape));
    gpu.gaussian(volume.view(shape), SIGMA, Affine::IDENTITY, [0; 3], Some(mean), None, &mut cx).unwrap();
    let (whole, half) = (Region::whole(shape), [fit.size / 2; 3]);
    let grown = whole.grow(half);
    let mut padded = vec![0.0f32; grown.voxels()];
    let to = ViewMut::dense(&mut padded, grown.shape());
    gather::extend(View::dense(&means, shape), whole, to, grown, whole, Border::Nearest, 0.0);
    let mut made: Results = std::array::from_fn(|_| vec![3.0; whole.voxels()]);
    let src = AnyView::F32(View::dense(&padded, grown.shape()));
    gpu.gradient(src, fit, Affine::IDENTITY, half, out(&mut made, shape, wanted), &mut cx).unwrap();
    made
}

/// A box of the volume in one go, from what it needs; `None` where the device left it.
fn together(gpu: &Gpu, volume: &Voxels, shape: Shape, fit: &Fit, wanted: [bool; 2], part: Region) -> Option<Results> {
    let whole = Region::whole(shape);
    let middle = part.grow([fit.size / 2; 3]).clip(&whole);
    let src = middle.grow(SIGMA.map(|s| (3.0 * s).ceil() as usize)).clip(&whole);
    let mut brick = Voxels::zeroed(volume.dtype(), src.voxels());
    gather::copy_common(volume.view(shape), whole, brick.view_mut(src.shape()), src);
    let extents = Extents {
        src: src.shape(),
        middle: middle.shape(),
        at: src.offset_of(&middle),
        dst: part.shape(),
        inner: middle.offset_of(&part),
    };
    let mut made: Results = std::array::from_fn(|_| vec![3.0; part.voxels()]);
    let done =
        gpu.smoothed_gradient(brick.view(src.shape()), &extents, SIGMA, fit, out(&mut made, part.shape(), wanted));
    done.unwrap_or_else(|e| panic!("{e}")).map(|_| made)
}

/// The first voxel of a box that differs from the whole volume's.
fn differs(all: &Results, shape: Shape, got: &Results, part: Region) -> Option<String> {
    let at = |v: [i64; 3]| (v[0] as usize * shape[1] + v[1] as usize) * shape[2] + v[2] as usize;
    let mut voxels = (0..4).flat_map(|c| part.iter().enumerate().map(move |(j, v)| (c, j, v)));
    let (c, j, v) = voxels.find(|&(c, j, v)| all[c][at(v)].to_bits() != got[c][j].to_bits())?;
    Some(format!("channel {c}, voxel {v:?}: {} one by one, {} in one go", all[c][at(v)], got[c][j]))
}

#[test]
fn in_one_go_is_the_same_as_one_by_one_wherever_the_box_lies() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [12, 15, 33];
    for dtype in [DType::U8, DType::I8, DType::U16, DType::I16] {
        for (name, volume) in fills(dtype, shape) {
            for (size, wanted) in [(5, [true, false]), (3, [true, true]), (5, [false, true])] {
                gpu.set_cap(1 << 30);
                let all = apart(&gpu, &volume, shape, &fit(size), wanted);
                for (lo, hi, cap) in [
                    ([0, 0, 0], [12, 15, 33], 1 << 30),
                    ([0, 0, 0], [12, 15, 33], 30_000),
                    ([3, 4, 5], [8, 9, 20], 1 << 30),
                    ([11, 0, 32], [12, 15, 33], 9_000),
                ] {
                    gpu.set_cap(cap);
                    let part = Region::new(lo, hi);
                    let got = together(&gpu, &volume, shape, &fit(size), wanted, part).expect("nothing is left");
                    if let Some(text) = differs(&all, shape, &got, part) {
                        panic!("{name} of {dtype}, size {size}, {part:?}, cap {cap}: {text}");
                    }
                }
            }
        }
    }
}

const CHANNELS: [WindowChannel; 5] = [
    WindowChannel::Mean,
    WindowChannel::Min,
    WindowChannel::Std,
    WindowChannel::Openness(Method::CdfPower, Ties::Le),
    WindowChannel::Openness(Method::GaussianCdf, Ties::Mid),
];
const RADIUS: [usize; 3] = [2, 1, 4];

fn windows(made: &mut [Vec<f32>], shape: Shape) -> Vec<WindowOut<'_>> {
    let outs = made.iter_mut().zip(CHANNELS);
    outs.map(|(v, channel)| WindowOut { channel, dst: AnyViewMut::F32(ViewMut::dense(v, shape)) }).collect()
}

/// Every channel of the windows of the means of a box: in one go from what it needs, or one by one.
fn window_results(gpu: &Gpu, volume: &Voxels, shape: Shape, part: Region, in_one_go: bool) -> Option<Vec<Vec<f32>>> {
    let params = WindowParams { radius: RADIUS, affine: Affine::IDENTITY, missing: None, solid_low: true };
    let whole = Region::whole(shape);
    let middle = part.grow(RADIUS).clip(&whole);
    let src = middle.grow(SIGMA.map(|s| (3.0 * s).ceil() as usize)).clip(&whole);
    let mut brick = Voxels::zeroed(volume.dtype(), src.voxels());
    gather::copy_common(volume.view(shape), whole, brick.view_mut(src.shape()), src);
    let (dst, at, inner) = (part.shape(), src.offset_of(&middle), middle.offset_of(&part));
    let mut made: Vec<Vec<f32>> = CHANNELS.iter().map(|_| vec![3.0; part.voxels()]).collect();
    let mut outs = windows(&mut made, dst);
    let view = brick.view(src.shape());
    if in_one_go {
        let extents = Extents { src: src.shape(), middle: middle.shape(), at, dst, inner };
        let done = gpu.smoothed_window(view, &extents, SIGMA, &params, part.lo, &mut outs);
        return done.unwrap_or_else(|e| panic!("{e}")).map(|_| made);
    }
    let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
    let mut means = vec![0.0f32; middle.voxels()];
    let mean = AnyViewMut::F32(ViewMut::dense(&mut means, middle.shape()));
    gpu.gaussian(view, SIGMA, Affine::IDENTITY, at, Some(mean), None, &mut cx).unwrap();
    let means = AnyView::F32(View::dense(&means, middle.shape()));
    gpu.window(means, &params, inner, part.lo, &mut outs, &mut cx).unwrap();
    Some(made)
}

#[test]
fn windows_in_one_go_are_the_same_as_one_by_one() {
    let Some(mut gpu) = adapter() else { return };
    for shape in [[12, 15, 33], [1, 1, 40], [3, 20, 2]] {
        for dtype in [DType::U8, DType::I16] {
            for (name, volume) in fills(dtype, shape) {
                let whole = Region::whole(shape);
                let inside = Region::new([0; 3], shape.map(|n| n as i64 * 3 / 4 + 1)).clip(&whole);
                for (part, cap) in [(whole, 1 << 30), (inside, 1 << 30), (whole, 60_000)] {
                    gpu.set_cap(1 << 30);
                    let apart = window_results(&gpu, &volume, shape, part, false);
                    gpu.set_cap(cap);
                    let got = window_results(&gpu, &volume, shape, part, true);
                    let bits = |r: Option<Vec<Vec<f32>>>| {
                        let r = r.expect("nothing is left");
                        r.into_iter().map(|v| v.into_iter().map(f32::to_bits).collect()).collect::<Vec<Vec<u32>>>()
                    };
                    assert_eq!(bits(apart), bits(got), "{name} of {dtype} {shape:?}, {part:?}, cap {cap}");
                }
            }
        }
    }
}

#[test]
fn odd_shapes_equal_one_by_one() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 40], [7, 1, 9], [2, 33, 1], [3, 40, 2]] {
        let volume = fills(DType::U16, shape).swap_remove(0).1;
        let all = apart(&gpu, &volume, shape, &fit(5), [true, true]);
        let got = together(&gpu, &volume, shape, &fit(5), [true, true], Region::whole(shape)).expect("nothing is left");
        assert_eq!(differs(&all, shape, &got, Region::whole(shape)), None, "{shape:?}");
    }
}

#[test]
fn a_lost_device_is_opened_anew_and_what_does_not_fit_is_left() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [8, 9, 20];
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let whole = Region::whole(shape);
    let all = apart(&gpu, &volume, shape, &fit(5), [true, true]);
    gpu.lose(false);
    let got = together(&gpu, &volume, shape, &fit(5), [true, true], whole).expect("opened anew");
    assert_eq!(differs(&all, shape, &got, whole), None);
    gpu.set_cap(600);
    assert!(together(&gpu, &volume, shape, &fit(5), [true, true], whole).is_none());
}

#[test]
fn the_comparison_can_fail() {
    let shape = [2, 3, 4];
    let all: Results = std::array::from_fn(|c| (0..24).map(|i| (i + c) as f32).collect());
    assert_eq!(differs(&all, shape, &all, Region::whole(shape)), None);
    let mut other = all.clone();
    other[2][13] += 1.0;
    assert!(differs(&all, shape, &other, Region::whole(shape)).unwrap().contains("channel 2, voxel [1, 0, 1]"));
    let part = Region::new([1, 0, 0], [2, 3, 4]);
    assert!(differs(&all, shape, &all, part).is_some(), "another box");
}

const CONFIG: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
[stage.bell]
op = "gaussian"
input = "vol"
sigma = 1.5
[stage.slope]
op = "gradient"
input = "bell.mean"
[output.slope]
path = "out/slope.zarr"
from = ["slope.magnitude", "slope.vector"]
chunk = 16
shard = 32
"#;

/// The same with windows in the place of the gradient.
fn with_windows() -> String {
    let stage = "op = \"box\"\nradius = [2, 3, 4]\ninput = \"bell.mean\"";
    let text = CONFIG.replacen("op = \"gradient\"\ninput = \"bell.mean\"", stage, 1);
    text.replacen("[\"slope.magnitude\", \"slope.vector\"]", "[\"slope.std\", \"slope.max\"]", 1)
}

fn folder(voxels: &[u16], shape: Shape) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(voxels));
    dir
}

fn run(dir: &Path, text: &str, sets: &[&str]) -> Decoded {
    let sets: Vec<&str> = [&["run.device='gpu:software'"], sets].concat();
    run_with(&parse(dir, text, &sets), &RunOptions { overwrite: true, ..Default::default() });
    decode(&dir.join("out/slope.zarr"))
}

/// By step, whether its results stay on the GPU.
fn chained(dir: &Path, text: &str) -> Vec<bool> {
    let config = parse(dir, text, &["run.device='gpu:software'"]);
    let infos: Vec<_> = occlude::store::open_inputs(&config).unwrap().iter().map(|s| s.info().clone()).collect();
    let facts = occlude::gpu::GpuFacts { name: "Test".into(), software: true, most_bytes: 1 << 30, exact_floats: true };
    let plan = Plan::new(&config, &infos, &mut || Ok(facts.clone())).unwrap();
    plan.chains.iter().map(|c| c.is_some()).collect()
}

#[test]
fn a_run_keeps_the_means_on_the_gpu_and_shows_no_brick() {
    let Some(_) = adapter() else { return };
    let shape = [30, 40, 50];
    let dir = folder(&mixed_u16(shape), shape);
    assert_eq!(chained(dir.path(), CONFIG), [true, false]);
    let all = run(dir.path(), CONFIG, &[]);
    assert_same("other bricks", &all, &run(dir.path(), CONFIG, &["run.brick=[32, 16, 64]"]));
    assert_same("a little memory", &all, &run(dir.path(), CONFIG, &["run.memory='40MiB'", "run.brick='auto'"]));
    // Somebody reads the means: they come back, and the gradients are the same.
    let read = format!("{CONFIG}[output.bell]\npath = \"out/bell.zarr\"\nfrom = \"bell.mean\"\nchunk = 16\n");
    assert_eq!(chained(dir.path(), &read), [false, false]);
    let one_by_one = run(dir.path(), &read, &[]);
    assert_same("one by one", &all, &one_by_one);
    let cpu = folder(&mixed_u16(shape), shape);
    run_with(&parse(cpu.path(), CONFIG, &["run.device='cpu'"]), &RunOptions::default());
    let bound = tolerance::GRADIENT * 65535.0;
    for ((name, (_, a)), (_, b)) in all.iter().zip(decode(&cpu.path().join("out/slope.zarr")).values()) {
        let far = a.iter().zip(b).find(|(a, b)| (f64::from_bits(**a) - f64::from_bits(**b)).abs() > bound);
        assert!(far.is_none() && a.len() == b.len(), "{name}: {far:?}");
    }
}

#[test]
fn a_run_keeps_the_means_of_windows_on_the_gpu() {
    let Some(_) = adapter() else { return };
    let shape = [30, 40, 50];
    let dir = folder(&mixed_u16(shape), shape);
    let text = with_windows();
    assert_eq!(chained(dir.path(), &text), [true, false]);
    let all = run(dir.path(), &text, &[]);
    assert_same("other bricks", &all, &run(dir.path(), &text, &["run.brick=[32, 16, 64]"]));
    let read = format!("{text}[output.bell]\npath = \"out/bell.zarr\"\nfrom = \"bell.mean\"\nchunk = 16\n");
    assert_eq!(chained(dir.path(), &read), [false, false]);
    assert_same("one by one", &all, &run(dir.path(), &read, &[]));
    // Beyond the edge of the volume a window sees means that the border's rule makes of means: those come back.
    let mirrored = text.replacen("radius =", "border = \"reflect\"\nradius =", 1);
    assert_eq!(chained(dir.path(), &mirrored), [false, false]);
}

#[test]
fn bricks_that_the_device_leaves_and_constant_ones_run_one_by_one() {
    let Some(_) = adapter() else { return };
    let shape = [20, 20, 70];
    // One voxel in a void: far from it means are as small as f32 goes.
    let mut voxels = vec![0u16; shape.iter().product()];
    voxels[10 * 20 * 70 + 10 * 70 + 9] = 1;
    let dir = folder(&voxels, shape);
    let gpu = adapter().expect("there was one");
    let extents = Extents { src: shape, middle: shape, at: [0; 3], dst: shape, inner: [0; 3] };
    let mut made: Results = std::array::from_fn(|_| vec![3.0; voxels.len()]);
    let volume = AnyView::U16(View::dense(&voxels, shape));
    let out = out(&mut made, shape, [true, false]);
    assert!(gpu.smoothed_gradient(volume, &extents, [0.2; 3], &fit(5), out).unwrap().is_none(), "too small for f32");
    let narrow = ["stage.bell.sigma=[0.2, 0.2, 0.2]", "run.brick=[16, 16, 16]"];
    let all = run(dir.path(), CONFIG, &narrow);
    assert_same("no skipping", &all, &{
        let sets = [&["run.device='gpu:software'"], &narrow[..]].concat();
        let options = RunOptions { overwrite: true, no_skip: true, ..Default::default() };
        run_with(&parse(dir.path(), CONFIG, &sets), &options);
        decode(&dir.path().join("out/slope.zarr"))
    });
    assert_same("one brick", &all, &run(dir.path(), CONFIG, &["stage.bell.sigma=[0.2, 0.2, 0.2]"]));
    assert!(all.values().any(|(_, v)| v.iter().any(|b| f64::from_bits(*b) > 1e-3)));
}

#[test]
fn masks_scales_and_missing_voxels_keep_steps_apart() {
    let shape = [6, 7, 8];
    let dir = folder(&mixed_u16(shape), shape);
    for (from, to) in [
        ("path = \"vol.npy\"", "path = \"vol.npy\"\nslope = 0.5"),
        ("path = \"vol.npy\"", "path = \"vol.npy\"\nnodata = 7"),
        ("sigma = 1.5", "sigma = 1.5\nwhere = { input = \"vol\", min = 9 }"),
        ("input = \"bell.mean\"", "input = \"bell.mean\"\nwhere = { input = \"vol\", min = 9 }"),
    ] {
        let text = CONFIG.replacen(from, to, 1);
        assert_ne!(text, CONFIG);
        assert!(chained(dir.path(), &text).iter().all(|c| !c), "{to}");
    }
}
