//! Gradients. Floats: the comparison allows `tolerance::GRADIENT` and no more.

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::facts::{self, tolerance};
use occlude::gpu::slopes::Fit;
use occlude::gpu::{Gpu, GpuError};
use occlude::grid::{Affine, DType, Region, Shape};
use occlude::kernel::gradient::{GradientOut, gradient};
use occlude::kernel::simd::Level;
use occlude::kernel::{Context, window};
use occlude::stage::{GradientWeight, WindowChannel, WindowParams};

use super::common::hash;
use super::{adapter, fills};

const DTYPES: [DType; 5] = [DType::U8, DType::I8, DType::U16, DType::I16, DType::F32];

/// What is computed: the regression, the slope, the output box; which channels.
#[derive(Debug, Clone, Copy)]
struct Case {
    fit: Fit,
    slope: f64,
    at: [usize; 3],
    dst: Shape,
    wanted: [bool; 2],
}

fn fit(size: usize, weight: GradientWeight, spacing: [f64; 3]) -> Fit {
    Fit { size, weight, spacing, missing: None }
}

/// Every voxel whose window of `size` lies in the volume.
fn whole(fit: Fit, shape: Shape) -> Case {
    let half = fit.size / 2;
    Case { fit, slope: 1.0, at: [half; 3], dst: shape.map(|n| n - 2 * half), wanted: [true, true] }
}

/// Magnitude, then components; what is not asked for stays what it was.
fn run(gpu: Option<&Gpu>, volume: &Voxels, shape: Shape, case: &Case) -> Result<[Vec<f64>; 4], GpuError> {
    let mut made: [Voxels; 4] = std::array::from_fn(|_| Voxels::zeroed(DType::F32, case.dst.iter().product()));
    let [m, z, y, x] = &mut made;
    let [magnitude, vector] = case.wanted;
    let out = GradientOut {
        magnitude: magnitude.then(|| m.view_mut(case.dst)),
        vector: vector.then(|| [z.view_mut(case.dst), y.view_mut(case.dst), x.view_mut(case.dst)]),
    };
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let (src, Fit { size, weight, spacing, missing }) = (volume.view(shape), case.fit);
    let affine = Affine { slope: case.slope, intercept: 7.0 };
    match gpu {
        Some(gpu) => drop(gpu.gradient(src, &case.fit, affine, case.at, out, &mut cx)?),
        None => gradient(src, size, weight, spacing, affine, missing, case.at, out, &mut cx),
    }
    Ok(made.map(|v| (0..v.len()).map(|i| v.at(i)).collect()))
}

/// Greatest difference of two voxels in every window; NaN where there is an infinity, and where all are missing.
fn ranges(volume: &Voxels, shape: Shape, case: &Case) -> Vec<f64> {
    let half = case.fit.size / 2;
    let p = WindowParams { radius: [half; 3], affine: Affine::IDENTITY, missing: case.fit.missing, solid_low: false };
    let mut made = [0, 1].map(|_| Voxels::zeroed(volume.dtype(), case.dst.iter().product()));
    let [lo, hi] = &mut made;
    let mut outs = [(WindowChannel::Min, lo), (WindowChannel::Max, hi)]
        .map(|(channel, v)| window::WindowOut { channel, dst: v.view_mut(case.dst) });
    let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
    window::window(volume.view(shape), &p, window::Place::whole(case.at), &mut outs, &mut cx);
    (0..made[0].len()).map(|i| made[1].at(i) - made[0].at(i)).collect()
}

/// The first voxel where two lanes differ by more than the tolerance.
fn differs(cpu: &[Vec<f64>; 4], gpu: &[Vec<f64>; 4], ranges: &[f64], case: &Case) -> Option<String> {
    let least = case.fit.spacing.into_iter().fold(f64::INFINITY, f64::min);
    let apart = |a: f64, b: f64, range: f64| {
        let bound = tolerance::GRADIENT * range * case.slope.abs() / least + 1e-44;
        let same = a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
        // f32 rounds each once more.
        let close = (a - b).abs() <= bound + 2f64.powi(-24) * a.abs();
        !same && !close
    };
    (0..4).find_map(|c| {
        let i = (0..ranges.len()).find(|&i| apart(cpu[c][i], gpu[c][i], ranges[i]))?;
        let (a, b) = (cpu[c][i], gpu[c][i]);
        Some(format!("channel {c}, voxel {i}: {a:?} on the CPU, {b:?} on the GPU, range {:?}", ranges[i]))
    })
}

fn check(gpu: &Gpu, name: &str, volume: &Voxels, shape: Shape, case: &Case) {
    let [cpu, got] = [None, Some(gpu)].map(|g| run(g, volume, shape, case).unwrap_or_else(|e| panic!("{e}")));
    if let Some(text) = differs(&cpu, &got, &ranges(volume, shape, case), case) {
        panic!("{name} of {} {shape:?}, {case:?}: {text}", volume.dtype());
    }
}

fn floats(shape: Shape, value: impl Fn(usize) -> f64) -> Voxels {
    let mut v = Voxels::zeroed(DType::F32, shape.iter().product());
    let occlude::brick::Voxels::F32(data) = &mut v else { unreachable!() };
    data.iter_mut().enumerate().for_each(|(i, d)| *d = value(i) as f32);
    v
}

#[test]
fn every_type_fill_and_channel_holds_the_tolerance() {
    let Some(gpu) = adapter() else { return };
    let shape = [9, 8, 37];
    for dtype in DTYPES {
        for (name, volume) in fills(dtype, shape) {
            for (size, weight) in
                [(3, GradientWeight::Distance), (5, GradientWeight::Distance), (5, GradientWeight::Inverse)]
            {
                for wanted in [[true, true], [true, false], [false, true]] {
                    let case = Case { wanted, slope: -2.5, ..whole(fit(size, weight, [2.0, 1.0, 0.7]), shape) };
                    check(&gpu, name, &volume, shape, &case);
                }
            }
        }
    }
}

#[test]
fn threads_go_on_where_there_are_more_voxels_than_threads() {
    let Some(gpu) = adapter() else { return };
    let (shape, fit) = ([104; 3], fit(3, GradientWeight::Distance, [1.0; 3]));
    let case = Case { wanted: [true, false], ..whole(fit, shape) };
    assert!(case.dst.iter().product::<usize>() > 1 << 20, "workgroups of 64, at most 2^14 of them");
    let volume = floats(shape, |i| hash(5, i as u64) as f64 / u64::MAX as f64);
    check(&gpu, "noise", &volume, shape, &case);
}

#[test]
fn floats_far_from_one_and_small_changes_of_large_values() {
    let Some(gpu) = adapter() else { return };
    let shape = [7, 9, 33];
    let noise = |i: usize| hash(11, i as u64) as f64 / u64::MAX as f64;
    let volumes = [
        ("huge", floats(shape, |i| noise(i) * 3e37)),
        ("tiny", floats(shape, |i| noise(i) * 1e-41)),
        ("small", floats(shape, |i| noise(i) * 1e-11)),
        ("offset", floats(shape, |i| 1e6 + noise(i))),
        ("bump", floats(shape, |i| if i % 97 == 5 { 1.0 + 1e-6 } else { 1.0 })),
        ("one huge", floats(shape, |i| if i == 777 { 1e30 } else { noise(i) })),
    ];
    for (name, volume) in &volumes {
        for (size, weight) in [(3, GradientWeight::Inverse), (5, GradientWeight::Distance)] {
            for wanted in [[true, false], [true, true]] {
                for spacing in [[1.0; 3], [1e-20, 2e-20, 1e-20], [1e12, 1.0, 1.0]] {
                    check(&gpu, name, volume, shape, &Case { wanted, ..whole(fit(size, weight, spacing), shape) });
                }
            }
        }
    }
}

#[test]
fn missing_voxels_are_left_to_the_cpu() {
    let Some(gpu) = adapter() else { return };
    let shape = [8, 9, 40];
    for dtype in [DType::U8, DType::I8, DType::U16, DType::I16] {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for missing in [volume.at(700) as i64, volume.at(3) as i64, -77_000] {
            let fit = Fit { missing: Some(missing), ..fit(5, GradientWeight::Distance, [1.0; 3]) };
            check(&gpu, name, &volume, shape, &whole(fit, shape));
            check(&gpu, name, &volume, shape, &Case { wanted: [true, false], ..whole(fit, shape) });
        }
    }
}

#[test]
fn a_constant_has_no_gradient() {
    let Some(gpu) = adapter() else { return };
    let shape = [6, 7, 21];
    for volume in [floats(shape, |_| 1234.567), floats(shape, |_| 1e37), floats(shape, |_| -1e-39)] {
        let case = Case { slope: -3.0, ..whole(fit(5, GradientWeight::Distance, [0.3, 1.0, 2.0]), shape) };
        let got = run(Some(&gpu), &volume, shape, &case).unwrap();
        assert!(got.iter().flatten().all(|g| g.to_bits() == 0), "zero, and positive");
    }
}

#[test]
fn boxes_inside_odd_shapes_and_bricks_that_are_cut_change_nothing() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [13, 14, 31];
    for dtype in DTYPES {
        let (_, volume) = fills(dtype, shape).swap_remove(0);
        let case = whole(fit(5, GradientWeight::Distance, [1.0; 3]), shape);
        gpu.set_cap(1 << 30);
        let all = run(Some(&gpu), &volume, shape, &case).unwrap();
        for cap in [1 << 30, 9000, 1500, 100] {
            gpu.set_cap(cap);
            for (at, dst) in [([2, 2, 2], [9, 10, 27]), ([4, 5, 6], [3, 7, 13]), ([10, 2, 28], [1, 1, 1])] {
                let part = Case { at, dst, ..case };
                if cap == 100 {
                    check(&gpu, "left to the CPU", &volume, shape, &part);
                    continue;
                }
                let got = run(Some(&gpu), &volume, shape, &part).unwrap();
                for (c, i) in (0..4).flat_map(|c| Region::whole(dst).iter().map(move |v| (c, v))) {
                    let [a, b] =
                        [(case, i.map(|v| v as usize), at), (part, i.map(|v| v as usize), at)].map(|(k, v, at)| {
                            let v: [usize; 3] = std::array::from_fn(|a| v[a] + at[a] - k.at[a]);
                            (v[0] * k.dst[1] + v[1]) * k.dst[2] + v[2]
                        });
                    assert_eq!(all[c][a].to_bits(), got[c][b].to_bits(), "{dtype}, cap {cap}, {part:?}, {i:?}");
                }
            }
        }
    }
}

#[test]
fn a_lost_device_is_opened_anew() {
    let Some(gpu) = adapter() else { return };
    let shape = [8, 9, 12];
    let (name, volume) = fills(DType::U16, shape).swap_remove(0);
    let case = whole(fit(3, GradientWeight::Inverse, [1.0; 3]), shape);
    check(&gpu, name, &volume, shape, &case);
    gpu.lose(false);
    check(&gpu, name, &volume, shape, &case);
}

#[test]
fn the_comparison_can_fail() {
    let shape = [6, 7, 8];
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let case = whole(fit(5, GradientWeight::Distance, [1.0; 3]), shape);
    let (cpu, ranges) = (run(None, &volume, shape, &case).unwrap(), ranges(&volume, shape, &case));
    assert_eq!(differs(&cpu, &cpu, &ranges, &case), None);
    for c in 0..4 {
        let off = |by: f64| {
            let mut other = cpu.clone();
            other[c][5] += by * tolerance::GRADIENT * ranges[5];
            differs(&cpu, &other, &ranges, &case)
        };
        assert_eq!(off(0.5), None);
        assert!(off(1.5 + 2f64.powi(-24) / tolerance::GRADIENT).unwrap().contains(&format!("channel {c}, voxel 5")));
        let mut gone = cpu.clone();
        gone[c][3] = f64::NAN;
        assert!(differs(&cpu, &gone, &ranges, &case).is_some());
    }
    let other = run(None, &volume, shape, &Case { fit: fit(5, GradientWeight::Inverse, [1.0; 3]), ..case }).unwrap();
    assert!(differs(&cpu, &other, &ranges, &case).is_some());
}

#[test]
fn inputs_without_a_kernel_are_named() {
    for dtype in DTYPES {
        assert_eq!(facts::gradient(dtype, false), Ok(()));
        assert!(facts::gradient(dtype, true).unwrap_err().contains("normals"));
    }
    for dtype in [DType::U32, DType::I32, DType::F64] {
        assert!(facts::gradient(dtype, false).unwrap_err().contains("runs on the CPU"));
    }
}
