//! Gaussian means, bit for bit, and variances within their tolerance.

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::facts::tolerance;
use occlude::gpu::{Gpu, facts};
use occlude::grid::{Affine, AnyViewMut, DType, Shape, ViewMut};
use occlude::kernel::simd::Level;
use occlude::kernel::{Context, gaussian};

use super::{adapter, fills};

const DTYPES: [DType; 4] = [DType::U8, DType::I8, DType::U16, DType::I16];

/// What is computed: sigma, scale, and the output box.
#[derive(Debug, Clone, Copy)]
struct Case {
    sigma: [f64; 3],
    affine: Affine,
    at: [usize; 3],
    dst: Shape,
}

/// The mean of a box by one lane; `None` for the CPU.
fn mean(gpu: Option<&Gpu>, volume: &Voxels, shape: Shape, case: &Case) -> Vec<f32> {
    let mut made = vec![if gpu.is_some() { 7.0f32 } else { 3.0 }; case.dst.iter().product()];
    let out = AnyViewMut::F32(ViewMut::dense(&mut made, case.dst));
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let (src, Case { sigma, affine, at, .. }) = (volume.view(shape), *case);
    match gpu {
        Some(gpu) => {
            gpu.gaussian(src, sigma, affine, at, Some(out), None, &mut cx).unwrap_or_else(|e| panic!("{e}"));
        }
        None => gaussian::gaussian(src, sigma, affine, None, at, Some(out), None, &mut cx),
    }
    made
}

/// Mean and variance of a box by one lane, made together.
fn moments(gpu: Option<&Gpu>, volume: &Voxels, shape: Shape, case: &Case) -> [Vec<f32>; 2] {
    let mut made = [0, 1].map(|_| vec![if gpu.is_some() { 7.0f32 } else { 3.0 }; case.dst.iter().product()]);
    let [mean, variance] = &mut made;
    let [mean, variance] = [mean, variance].map(|v| Some(AnyViewMut::F32(ViewMut::dense(v, case.dst))));
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let (src, Case { sigma, affine, at, .. }) = (volume.view(shape), *case);
    match gpu {
        Some(gpu) => {
            gpu.gaussian(src, sigma, affine, at, mean, variance, &mut cx).unwrap_or_else(|e| panic!("{e}"));
        }
        None => gaussian::gaussian(src, sigma, affine, None, at, mean, variance, &mut cx),
    }
    made
}

/// The first voxel whose variances differ by more than the tolerance, or are of a constant and not both 0.
fn spreads_differ(cpu: &[f32], gpu: &[f32]) -> Option<String> {
    let close = |a: f32, b: f32| {
        let bound = (tolerance::VARIANCE + 2f64.powi(-23)) * a as f64 + 1e-37;
        (a as f64 - b as f64).abs() <= bound && (a > 0.0 || b == 0.0)
    };
    let i = cpu.iter().zip(gpu).position(|(a, b)| !close(*a, *b))?;
    Some(format!("variance of voxel {i}: {:?} on the CPU, {:?} on the GPU", cpu[i], gpu[i]))
}

fn check_moments(gpu: &Gpu, name: &str, volume: &Voxels, shape: Shape, case: &Case) {
    let [cpu, got] = [None, Some(gpu)].map(|g| moments(g, volume, shape, case));
    if let Some(text) = differs(&cpu[0], &got[0]).or(spreads_differ(&cpu[1], &got[1])) {
        panic!("{name} of {} {shape:?}, {case:?}: {text}", volume.dtype());
    }
}

#[test]
fn variances_hold_their_tolerance_on_every_type_and_fill() {
    let Some(gpu) = adapter() else { return };
    let shape = [9, 10, 37];
    for dtype in DTYPES {
        for (name, volume) in fills(dtype, shape) {
            for sigma in [[0.1, 0.3, 0.5], [1.0; 3], [2.3, 0.7, 5.0], [50.0, 3.0, 11.0]] {
                check_moments(&gpu, name, &volume, shape, &whole(sigma, shape));
            }
        }
        for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [3, 60, 2]] {
            let (name, volume) = fills(dtype, shape).swap_remove(0);
            check_moments(&gpu, name, &volume, shape, &whole([1.5; 3], shape));
        }
    }
    let (name, volume) = fills(DType::I16, shape).swap_remove(0);
    for (at, dst) in [([2, 3, 4], [5, 6, 13]), ([8, 0, 36], [1, 1, 1])] {
        let affine = Affine { slope: -0.37, intercept: 1e4 };
        check_moments(&gpu, name, &volume, shape, &Case { sigma: [1.4, 2.0, 0.9], affine, at, dst });
    }
}

#[test]
fn variances_do_not_show_cuts_or_what_else_is_made() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [14, 15, 33];
    for dtype in [DType::U8, DType::I16] {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        let case = whole([1.0, 1.6, 1.3], shape);
        gpu.set_cap(1 << 30);
        let all = moments(Some(&gpu), &volume, shape, &case);
        for cap in [60_000, 20_000] {
            gpu.set_cap(cap);
            let cut = moments(Some(&gpu), &volume, shape, &case);
            assert_eq!([differs(&all[0], &cut[0]), differs(&all[1], &cut[1])], [None, None], "{name}, cap {cap}");
        }
        gpu.set_cap(700);
        check_moments(&gpu, "left to the CPU", &volume, shape, &case);
        gpu.set_cap(1 << 30);
        let mut alone = vec![5.0f32; case.dst.iter().product()];
        let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
        let variance = Some(AnyViewMut::F32(ViewMut::dense(&mut alone, case.dst)));
        gpu.gaussian(volume.view(shape), case.sigma, case.affine, case.at, None, variance, &mut cx).unwrap();
        assert_eq!(differs(&all[1], &alone), None);
    }
}

/// The first voxel where two lanes differ.
fn differs(cpu: &[f32], gpu: &[f32]) -> Option<String> {
    let i = cpu.iter().zip(gpu).position(|(a, b)| a.to_bits() != b.to_bits())?;
    Some(format!("voxel {i}: {:?} on the CPU, {:?} on the GPU", cpu[i], gpu[i]))
}

fn check(gpu: &Gpu, name: &str, volume: &Voxels, shape: Shape, case: &Case) {
    if let Some(text) = differs(&mean(None, volume, shape, case), &mean(Some(gpu), volume, shape, case)) {
        panic!("{name} of {} {shape:?}, {case:?}: {text}", volume.dtype());
    }
}

fn whole(sigma: [f64; 3], shape: Shape) -> Case {
    Case { sigma, affine: Affine::IDENTITY, at: [0; 3], dst: shape }
}

#[test]
fn every_type_and_fill_equals_the_cpu() {
    let Some(gpu) = adapter() else { return };
    assert!(gpu.facts().exact_floats, "this adapter's floats have been the CPU's so far");
    let shape = [11, 13, 37];
    for dtype in DTYPES {
        for (name, volume) in fills(dtype, shape) {
            for sigma in [[0.1, 0.3, 0.5], [1.0; 3], [2.3, 0.7, 5.0]] {
                check(&gpu, name, &volume, shape, &whole(sigma, shape));
            }
        }
    }
}

#[test]
fn odd_shapes_boxes_inside_and_kernels_beyond_the_volume() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [1, 33, 1], [3, 90, 2], [24, 3, 5]] {
        for dtype in DTYPES {
            let (name, volume) = fills(dtype, shape).swap_remove(0);
            for sigma in [[1.0; 3], [50.0, 3.0, 11.0]] {
                check(&gpu, name, &volume, shape, &whole(sigma, shape));
            }
        }
    }
    let shape = [15, 16, 31];
    let (name, volume) = fills(DType::I16, shape).swap_remove(0);
    for (at, dst) in [([4, 5, 6], [7, 9, 13]), ([0, 15, 0], [15, 1, 31]), ([14, 0, 30], [1, 1, 1])] {
        for affine in [Affine::IDENTITY, Affine { slope: -0.37, intercept: 1e4 }] {
            check(&gpu, name, &volume, shape, &Case { sigma: [1.4, 2.0, 0.9], affine, at, dst });
        }
    }
}

/// Longer than what a workgroup holds of a row, by kernels up to and beyond what it can hold.
#[test]
fn long_rows_and_wide_kernels() {
    let Some(gpu) = adapter() else { return };
    let shape = [2, 3, 1100];
    for dtype in DTYPES {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for sigma in [2.0, 25.0, 42.5, 43.0, 120.0] {
            check(&gpu, name, &volume, shape, &whole([0.5, 1.0, sigma], shape));
        }
        let inside = Case { at: [1, 1, 77], dst: [1, 2, 600], ..whole([0.5, 1.0, 20.0], shape) };
        check(&gpu, name, &volume, shape, &inside);
    }
}

#[test]
fn a_brick_beyond_the_limits_is_cut_or_goes_to_the_cpu() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [20, 25, 33];
    for dtype in [DType::U8, DType::I16] {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for cap in [40_000, 9_000, 700] {
            gpu.set_cap(cap);
            check(&gpu, name, &volume, shape, &whole([1.0, 1.6, 1.3], shape));
        }
    }
}

#[test]
fn the_comparison_can_fail() {
    let shape = [4, 5, 6];
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let cpu = mean(None, &volume, shape, &whole([1.0; 3], shape));
    assert_eq!(differs(&cpu, &cpu), None);
    let mut other = cpu.clone();
    other[50] = f32::from_bits(other[50].to_bits() ^ 1);
    assert!(differs(&cpu, &other).expect("one bit is a difference").contains("voxel 50"));
    assert_eq!(spreads_differ(&[0.0, 2.0], &[0.0, 2.0 + 1e-5]), None);
    assert!(spreads_differ(&[0.0, 2.0], &[0.0, 2.0 + 3e-5]).unwrap().contains("voxel 1"));
    assert!(spreads_differ(&[0.0], &[1e-40]).is_some(), "a constant has no variance");
    assert!(differs(&cpu, &mean(None, &volume, shape, &whole([1.1; 3], shape))).is_some());
}

#[test]
fn inputs_without_a_kernel_are_named() {
    for dtype in DTYPES {
        assert_eq!(facts::gaussian(dtype, false), Ok(()));
        assert!(facts::gaussian(dtype, true).unwrap_err().contains("missing"));
    }
    for dtype in [DType::F32, DType::F64, DType::U32, DType::I32] {
        assert!(facts::gaussian(dtype, false).unwrap_err().contains("runs on the CPU"));
    }
}
