//! Masked steps on the GPU: fills, and levels into which excluded voxels enter only where there are no others, are the CPU's
//! bit for bit.

use std::path::Path;

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::Needed;
use occlude::gpu::flow::{FlowStep, Input, Kernel, Sink};
use occlude::gpu::points::Op;
use occlude::grid::{Affine, DType, Region, Shape, View};
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::run::RunOptions;
use occlude::stage::{CombineKind, Reduce, WindowChannel, WindowParams};

use super::common::{Decoded, assert_same, decode, hash, parse, run_with};
use super::levels::{cx, differs, flow_of, hostile, made, on_cpu, point, pointwise_on_cpu, pyramids, results_of, step};
use super::setup::{CPU, flows, folder, lane, place, plan, run_on};
use super::{adapter, fills};

/// Masks that break careless levels: noise, whole cells in and out, single voxels, halves, nothing but the ends.
fn masks([nz, ny, nx]: Shape) -> Vec<(&'static str, Vec<u8>)> {
    let of = |f: &dyn Fn(usize, usize, usize) -> bool| {
        let at = |i: usize| f(i / (ny * nx), i / nx % ny, i % nx) as u8;
        (0..nz * ny * nx).map(at).collect::<Vec<u8>>()
    };
    vec![
        ("noise", of(&|z, y, x| hash(11, ((z * ny + y) * nx + x) as u64).is_multiple_of(2))),
        ("few", of(&|z, y, x| hash(12, ((z * ny + y) * nx + x) as u64).is_multiple_of(29))),
        ("cells", of(&|z, y, x| (z / 2 + y / 2 + x / 4) % 2 == 0)),
        ("rows", of(&|_, y, _| y % 3 != 0)),
        ("first half", of(&|_, _, x| x < nx.div_ceil(2))),
        ("one", of(&|z, y, x| [z, y, x] == [nz / 2, ny / 2, nx / 2])),
        ("ends", of(&|_, _, x| x == 0 || x + 1 == nx)),
        ("none", of(&|_, _, _| false)),
        ("all", of(&|_, _, _| true)),
    ]
}

fn filled(values: &Voxels, needed: &[u8], fill: f32) -> Voxels {
    let Voxels::F32(values) = values else { unreachable!("channels are f32") };
    Voxels::F32(values.iter().zip(needed).map(|(v, n)| if *n == 0 { fill } else { *v }).collect())
}

fn masked(mut step: FlowStep, fills: &[f32]) -> FlowStep {
    step.fills = Some(fills.to_vec());
    step
}

#[test]
fn levels_of_masked_channels_equal_the_cpus() {
    let Some(mut gpu) = adapter() else { return };
    for (shape, seed) in [([9, 10, 37], 1), ([8, 16, 24], 2), ([1, 1, 70], 3), ([5, 1, 3], 4), ([1, 1, 1], 5)] {
        let (source, whole) = (hostile(shape, seed), Region::whole(shape));
        let doubled = match &source {
            Voxels::F32(v) => Voxels::F32(v.iter().map(|v| (*v as f64 * 2.0 + 0.0) as f32).collect()),
            _ => unreachable!("hostile voxels are floats"),
        };
        for (name, needed) in masks(shape) {
            for fill in [1.0f32, -0.0, f32::NAN] {
                for range in [Some([-3.25, 1000.5]), None] {
                    for pyramid in pyramids(range) {
                        let steps = vec![
                            masked(point(Op::Scale, &[Input::Source]), &[fill]),
                            masked(point(Op::Times { by: 2.0 }, &[Input::Source]), &[fill]),
                        ];
                        let mean = (pyramid.reduce == Reduce::Moments).then_some(made(1, 0));
                        let sink = Sink { value: made(0, 0), mean, region: whole, pyramid: Some(pyramid.clone()) };
                        let flow = flow_of(DType::F32, Affine::IDENTITY, shape, steps, vec![sink]);
                        let [value, twice] = [&source, &doubled].map(|v| filled(v, &needed, fill));
                        let cpu = on_cpu(&pyramid, &value, mean.map(|_| &twice), Some(&needed), shape, whole);
                        let caps: &[u64] = if name == "noise" { &[1 << 30, 20_000] } else { &[1 << 30] };
                        for &cap in caps {
                            gpu.set_cap(cap);
                            let view = View::dense(&needed[..], shape);
                            let given = [0, 1].map(|step| Needed { step, view, region: whole });
                            let got = results_of(&gpu, &flow, &source, &given).expect("it fits").swap_remove(0);
                            assert_eq!(
                                differs(&cpu, &got),
                                None,
                                "{name}, {fill}: {pyramid:?} of {shape:?}, cap {cap}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn masks_change_levels_so_that_the_comparison_can_fail() {
    let (shape, whole) = ([9, 10, 37], Region::whole([9, 10, 37]));
    let source = hostile(shape, 2);
    for (name, needed) in masks(shape).into_iter().filter(|m| !["none", "all"].contains(&m.0)) {
        let value = filled(&source, &needed, 1.0);
        for pyramid in pyramids(None) {
            let mean = Some(&value).filter(|_| pyramid.reduce == Reduce::Moments);
            let [with, without] = [Some(&needed[..]), None].map(|m| on_cpu(&pyramid, &value, mean, m, shape, whole));
            assert!(differs(&with, &without).is_some(), "{name}: {pyramid:?}");
        }
    }
}

#[test]
fn later_steps_read_fills() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [6, 9, 40];
    let whole = Region::whole(shape);
    let channels = [WindowChannel::Mean, WindowChannel::Max];
    let params = WindowParams { radius: [1, 2, 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    let stats = step(Kernel::Windows { params, channels: channels.to_vec() }, &[Input::Source]);
    for dtype in [DType::U8, DType::I16] {
        let source = fills(dtype, shape).swap_remove(0).1;
        let mut scratch = Scratch::new();
        let mut outs = [DType::F32, dtype].map(|d| Voxels::zeroed(d, whole.voxels()));
        let mut to: Vec<WindowOut> =
            outs.iter_mut().zip(channels).map(|(v, channel)| WindowOut { channel, dst: v.view_mut(shape) }).collect();
        window(source.view(shape), &params, Place::whole([0; 3]), &mut to, &mut cx(&mut scratch));
        drop(to);
        let floats = |v: &Voxels| Voxels::F32((0..v.len()).map(|i| v.at(i) as f32).collect());
        for (name, needed) in masks(shape) {
            let [mean, most] = [&outs[0], &outs[1]].map(|v| filled(&floats(v), &needed, 7.0));
            let op = Op::Combine(CombineKind::Mean);
            let reads = [(mean.view(shape), Affine::IDENTITY), (most.view(shape), Affine::IDENTITY)];
            // The second step has another mask.
            let other: Vec<u8> = needed.iter().rev().copied().collect();
            let both = filled(&Voxels::F32(pointwise_on_cpu(&op, &reads, shape)), &other, -2.5);
            let steps = vec![masked(stats.clone(), &[7.0, 7.0]), masked(point(op, &[made(0, 0), made(0, 1)]), &[-2.5])];
            let sink = |s: usize, c: usize| Sink { value: made(s, c), mean: None, region: whole, pyramid: None };
            let flow = flow_of(dtype, Affine::IDENTITY, shape, steps, vec![sink(0, 1), sink(1, 0)]);
            for cap in [1 << 30, 10_000] {
                gpu.set_cap(cap);
                let given = [(0, &needed), (1, &other)].map(|(step, m)| Needed {
                    step,
                    view: View::dense(&m[..], shape),
                    region: whole,
                });
                let got = results_of(&gpu, &flow, &source, &given).expect("it fits");
                for (expect, got) in [&most, &both].iter().zip(&got) {
                    assert_eq!(expect.as_bytes(), &got[0][..], "{name} of {dtype}, cap {cap}");
                }
            }
        }
    }
}

/// Stages of one mask, of another, of none; one that hangs on a stage; every way of reducing but by moments.
const CONFIG: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
[stage.stats]
op = "box"
input = "vol"
radius = [2, 3, 5]
where = { input = "vol", min = 3000 }
fill = 12
[stage.band]
op = "box"
input = "vol"
radius = 1
where = { input = "vol", iso = [20000, 41000], band = 2.0 }
[stage.all]
op = "box"
input = "vol"
radius = 1
[stage.both]
op = "combine"
op_kind = "add"
inputs = ["stats.mean", "all.mean"]
where = { input = "vol", max = 50000 }
fill = -3
[stage.hung]
op = "box"
input = "vol"
radius = 1
where = { input = "all.mean", min = 30000 }
[output.var]
path = "out/var.zarr"
from = "stats.variance"
chunk = 4
shard = 8
[output.least]
path = "out/least.zarr"
from = "stats.min"
reduce = "min"
chunk = 8
[output.most]
path = "out/most.zarr"
from = "band.max"
reduce = "max"
chunk = 8
[output.mean]
path = "out/mean.zarr"
from = "band.mean"
dtype = "u8"
range = [0, 65535]
chunk = 8
[output.both]
path = "out/both.zarr"
from = "both"
reduce = "stride"
chunk = 8
[output.hung]
path = "out/hung.zarr"
from = "hung.std"
chunk = 8
"#;
const OUTPUTS: [&str; 6] = ["var", "least", "most", "mean", "both", "hung"];

fn decoded(dir: &Path) -> Vec<Decoded> {
    OUTPUTS.iter().map(|name| decode(&dir.join(format!("out/{name}.zarr")))).collect()
}

#[test]
fn masked_stages_run_in_one_go_and_equal_the_cpus() {
    let shape = [30, 40, 50];
    let [cpu, gpu] = [0, 1].map(|_| folder(shape));
    let planned = plan(gpu.path(), CONFIG, &[]);
    assert_eq!(flows(&planned), ["stats band all both"], "one mask hangs on what is made there");
    assert_eq!((place(&planned, "hung").0, place(&planned, "both").0), ("gpu", "gpu"));
    let Some(_) = adapter() else { return };
    run_on(cpu.path(), CONFIG, &[CPU]);
    let all = decoded(cpu.path());
    assert!(all.iter().all(|o| o.len() > 2), "a few levels");
    let same = |what: &str| {
        for ((name, a), b) in OUTPUTS.iter().zip(&all).zip(decoded(gpu.path())) {
            assert_same(&format!("{what}: {name}"), a, &b);
        }
    };
    let report = run_on(gpu.path(), CONFIG, &[lane()]);
    same("bricks as given");
    let stage = |name: &str| report.stages.iter().find(|s| s.name == name).unwrap();
    let together = stage("stats, band, all, both in one go");
    let counts = together.together.as_ref().unwrap();
    assert_eq!((counts.bricks, counts.bricks_left), (2 * 2 * 2, 0));
    assert!(together.seconds > 0.0 && stage("stats").seconds == 0.0, "no stage has the time of all");
    assert_eq!(stage("both").part_of.as_ref(), Some(&together.name));
    assert_eq!((stage("all").voxels, together.voxels), (60_000, 60_000));
    assert!(stage("hung").part_of.is_none() && stage("hung").seconds > 0.0);
    run_on(gpu.path(), CONFIG, &[lane(), "run.memory='48MiB'", "run.brick='auto'", "run.threads=4"]);
    same("a little memory");
    let options = RunOptions { overwrite: true, no_skip: true, ..Default::default() };
    run_with(&parse(gpu.path(), CONFIG, &[lane()]), &options);
    same("no skipping");
    // Nothing of a brick is needed by some, or by all.
    let high = ["stage.stats.where.min=70000", "stage.band.where.iso=[70000]", "stage.both.where.max=-1"];
    run_on(cpu.path(), CONFIG, &[&[CPU], &high[..]].concat());
    let report = run_on(gpu.path(), CONFIG, &[&[lane()], &high[..]].concat());
    let row = report.stages.iter().find_map(|s| s.together.clone()).unwrap();
    assert_eq!(row.bricks, 2 * 2 * 2, "the others still run in one go");
    for ((name, a), b) in OUTPUTS.iter().zip(decoded(cpu.path())).zip(decoded(gpu.path())) {
        assert_same(&format!("nothing is needed: {name}"), &a, &b);
    }
}
