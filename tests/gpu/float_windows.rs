//! Windows of f32: extremes bit for bit, moments and openness within `facts::tolerance`, and never a brick that shows.

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::Gpu;
use occlude::gpu::facts::tolerance;
use occlude::grid::{Affine, DType, Region, Shape};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};

use super::common::hash;
use super::{adapter, fills};

const CHANNELS: [WindowChannel; 11] = [
    WindowChannel::Mean,
    WindowChannel::Min,
    WindowChannel::Max,
    WindowChannel::Variance,
    WindowChannel::Std,
    WindowChannel::Moment2,
    WindowChannel::Openness(Method::CdfPower, Ties::Le),
    WindowChannel::Openness(Method::GaussianCdf, Ties::Le),
    WindowChannel::Openness(Method::Chebyshev, Ties::Le),
    WindowChannel::Openness(Method::ChebyshevLiteral, Ties::Le),
    WindowChannel::Openness(Method::CdfPower, Ties::Mid),
];

/// A volume that starts at `lo` of a greater one, and the box of outputs within it.
#[derive(Debug, Clone, Copy)]
struct Case {
    shape: Shape,
    lo: [i64; 3],
    at: [usize; 3],
    dst: Shape,
    params: WindowParams,
}

fn whole(shape: Shape, radius: [usize; 3]) -> Case {
    let params = WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false };
    Case { shape, lo: [0; 3], at: [0; 3], dst: shape, params }
}

fn results(gpu: Option<&Gpu>, volume: &Voxels, case: &Case, channels: &[WindowChannel]) -> Vec<Vec<f64>> {
    let dirty = |_| {
        let mut v = Voxels::zeroed(DType::F32, case.dst.iter().product());
        v.fill(if gpu.is_some() { 77.0 } else { 33.0 });
        v
    };
    let mut made: Vec<Voxels> = channels.iter().map(dirty).collect();
    let mut outs: Vec<WindowOut> =
        made.iter_mut().zip(channels).map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(case.dst) }).collect();
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let voxel: [i64; 3] = std::array::from_fn(|a| case.lo[a] + case.at[a] as i64);
    let (src, p) = (volume.view(case.shape), &case.params);
    match gpu {
        Some(gpu) => drop(gpu.window(src, p, case.at, voxel, &mut outs, &mut cx).unwrap_or_else(|e| panic!("{e}"))),
        None => window(src, p, Place::new(case.at, voxel), &mut outs, &mut cx),
    }
    made.iter().map(|v| (0..v.len()).map(|i| v.at(i)).collect()).collect()
}

/// How far a channel of a voxel may be from the CPU's, given all of the CPU's.
fn bound(cpu: &[Vec<f64>], c: usize, i: usize) -> f64 {
    let (mean, range, variance) = (cpu[0][i], (cpu[2][i] - cpu[1][i]).abs(), cpu[3][i]);
    let rounding = 2f64.powi(-23) * cpu[c][i].abs() + 1e-44;
    let off = tolerance::MEAN * range;
    rounding
        + match CHANNELS[c] {
            WindowChannel::Mean => off,
            WindowChannel::Min | WindowChannel::Max => return 0.0,
            WindowChannel::Variance => tolerance::VARIANCE * variance,
            WindowChannel::Std => tolerance::VARIANCE * cpu[4][i],
            WindowChannel::Moment2 => tolerance::VARIANCE * variance + off * (2.0 * mean.abs() + off),
            WindowChannel::Openness(..) => tolerance::OPENNESS,
        }
}

/// The first channel and voxel where two lanes differ by more than the tolerance.
fn differs(cpu: &[Vec<f64>], gpu: &[Vec<f64>]) -> Option<String> {
    (0..CHANNELS.len()).find_map(|c| {
        let close = |i: usize| {
            let (a, b) = (cpu[c][i], gpu[c][i]);
            a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan() || (a - b).abs() <= bound(cpu, c, i)
        };
        let i = (0..cpu[c].len()).find(|&i| !close(i))?;
        Some(format!("{:?}, voxel {i}: {:?} on the CPU, {:?} on the GPU", CHANNELS[c], cpu[c][i], gpu[c][i]))
    })
}

fn check(gpu: &Gpu, name: &str, volume: &Voxels, case: &Case) {
    let [cpu, got] = [None, Some(gpu)].map(|g| results(g, volume, case, &CHANNELS));
    if let Some(text) = differs(&cpu, &got) {
        panic!("{name} {case:?}: {text}");
    }
}

fn floats(shape: Shape, value: &dyn Fn(usize) -> f64) -> Voxels {
    let mut v = Voxels::zeroed(DType::F32, shape.iter().product());
    let Voxels::F32(data) = &mut v else { unreachable!() };
    data.iter_mut().enumerate().for_each(|(i, d)| *d = value(i) as f32);
    v
}

fn noise(i: usize) -> f64 {
    hash(19, i as u64) as f64 / u64::MAX as f64 - 0.5
}

/// Fills that break careless floats.
fn hostile(shape: Shape) -> Vec<(&'static str, Voxels)> {
    let nx = shape[2];
    let mut list = fills(DType::F32, shape);
    let more: [(&'static str, &dyn Fn(usize) -> f64); 9] = [
        ("offset", &|i| 1e6 + noise(i)),
        ("far offset", &|i| -8e6 + (noise(i) * 16.0).round()),
        ("step of 1e6", &|i| if i % nx < nx / 3 { 1e6 + noise(i) } else { noise(i) }),
        ("outlier", &|i| if i == 321 { 1e6 } else { noise(i) }),
        ("gaps", &|i| if hash(2, i as u64).is_multiple_of(3) { f64::NAN } else { 100.0 + noise(i) }),
        ("an infinity", &|i| if i == 400 { f64::INFINITY } else { noise(i) }),
        ("small", &|i| noise(i) * 1e-12),
        ("large", &|i| noise(i) * 1e25),
        ("both zeros", &|i| if i % 2 == 0 { 0.0 } else { -0.0 }),
    ];
    list.extend(more.iter().map(|(name, f)| (*name, floats(shape, f))));
    list
}

#[test]
fn every_channel_holds_its_tolerance_on_every_fill() {
    let Some(gpu) = adapter() else { return };
    assert!(gpu.facts().exact_floats, "this adapter's floats have been the CPU's so far");
    assert!(gpu.facts().close_floats && gpu.probe_close().unwrap(), "and the others near to them");
    let shape = [9, 11, 37];
    for (name, volume) in hostile(shape) {
        for radius in [[0; 3], [1, 1, 1], [2, 3, 5], [0, 4, 0], [10, 10, 10]] {
            check(&gpu, name, &volume, &whole(shape, radius));
        }
    }
}

#[test]
fn odd_shapes_radii_beyond_the_volume_scales_and_low_solids() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [1, 33, 1], [3, 90, 2], [40, 3, 5]] {
        for (name, volume) in hostile(shape).into_iter().take(11) {
            for radius in [[1, 0, 2], [3, 3, 3], [0, 1 << 40, 1]] {
                check(&gpu, name, &volume, &whole(shape, radius));
            }
        }
    }
    let shape = [8, 9, 30];
    for (name, volume) in hostile(shape) {
        for (slope, intercept, solid_low) in [(1.0, 0.0, true), (-2.5, 7.0, false), (0.5, -1024.0, true)] {
            let params = WindowParams { affine: Affine { slope, intercept }, solid_low, ..whole(shape, [2; 3]).params };
            check(&gpu, name, &volume, &Case { params, ..whole(shape, [2; 3]) });
        }
    }
}

/// Longer than what a workgroup holds of a row, by windows up to and beyond what it can hold.
#[test]
fn long_rows_and_wide_windows() {
    let Some(gpu) = adapter() else { return };
    let shape = [1, 2, 1100];
    for (name, volume) in hostile(shape).into_iter().filter(|(n, _)| ["noise", "gaps", "specials"].contains(n)) {
        for radius in [5, 127, 128, 400] {
            check(&gpu, name, &volume, &whole(shape, [0, 1, radius]));
        }
    }
}

#[test]
fn variance_of_a_large_mean_is_right() {
    let Some(gpu) = adapter() else { return };
    let shape = [20, 20, 70];
    // |mean| / std is 1e6: what f32 holds of such noise is coarse, and exact in f64.
    let volume = floats(shape, &|i| 1e6 + 3.4 * noise(i));
    check(&gpu, "mean / std = 1e6", &volume, &whole(shape, [9, 8, 30]));
}

#[test]
fn bricks_and_cuts_change_no_bit() {
    let Some(mut gpu) = adapter() else { return };
    let (shape, radius) = ([14, 15, 45], [2, 3, 4]);
    for (name, volume) in hostile(shape) {
        gpu.set_cap(1 << 30);
        let all = results(Some(&gpu), &volume, &whole(shape, radius), &CHANNELS);
        for (lo, hi, cap) in
            [([0, 0, 0], [14, 15, 45], 20_000), ([3, 4, 5], [9, 15, 40], 1 << 30), ([10, 0, 20], [14, 8, 21], 9000)]
        {
            gpu.set_cap(cap);
            let (out, all_of) = (Region::new(lo, hi), Region::whole(shape));
            let src = out.grow(radius).clip(&all_of);
            let mut brick = Voxels::zeroed(DType::F32, src.voxels());
            occlude::brick::gather::copy_common(volume.view(shape), all_of, brick.view_mut(src.shape()), src);
            let case = Case {
                shape: src.shape(),
                lo: src.lo,
                at: src.offset_of(&out),
                dst: out.shape(),
                ..whole(shape, radius)
            };
            let got = results(Some(&gpu), &brick, &case, &CHANNELS);
            for (c, (j, v)) in (0..CHANNELS.len()).flat_map(|c| out.iter().enumerate().map(move |e| (c, e))) {
                let i = (v[0] as usize * shape[1] + v[1] as usize) * shape[2] + v[2] as usize;
                let (a, b) = (all[c][i], got[c][j]);
                assert!(
                    a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(),
                    "{name} {:?} {v:?}: {a} {b}",
                    CHANNELS[c]
                );
            }
        }
        gpu.set_cap(300);
        check(&gpu, "left to the CPU", &volume, &whole(shape, radius));
    }
}

#[test]
fn each_channel_stands_alone() {
    let Some(gpu) = adapter() else { return };
    let shape = [6, 7, 33];
    let volume = hostile(shape).swap_remove(8).1;
    let all = results(Some(&gpu), &volume, &whole(shape, [2; 3]), &CHANNELS);
    for (c, channel) in CHANNELS.iter().enumerate() {
        let one = results(Some(&gpu), &volume, &whole(shape, [2; 3]), &[*channel]);
        let same = one[0].iter().zip(&all[c]).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
        assert!(same, "{channel:?}");
    }
}

#[test]
fn the_comparison_can_fail() {
    let shape = [5, 6, 20];
    let volume = floats(shape, &|i| 3.0 + noise(i));
    let cpu = results(None, &volume, &whole(shape, [2; 3]), &CHANNELS);
    assert_eq!(differs(&cpu, &cpu.clone()), None);
    for c in 0..CHANNELS.len() {
        let off = |by: f64| {
            let mut other = cpu.clone();
            other[c][7] += by;
            differs(&cpu, &other)
        };
        assert_eq!(off(0.9 * bound(&cpu, c, 7)), None);
        let text = off(1.1 * bound(&cpu, c, 7) + 1e-9).expect("beyond the bound");
        assert!(text.contains(&format!("{:?}, voxel 7", CHANNELS[c])), "{text}");
        assert!(off(f64::NAN).is_some());
    }
    let wider = results(None, &volume, &whole(shape, [3; 3]), &CHANNELS);
    assert!(differs(&cpu, &wider).is_some());
}
