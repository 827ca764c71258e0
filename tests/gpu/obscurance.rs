//! Obscurance: openness with weights per direction.

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::{Gpu, facts};
use occlude::grid::{AnyViewMut, DType, Region, Shape, ViewMut};
use occlude::kernel::Context;
use occlude::kernel::obscurance::{ObscuranceIo, ObscuranceParams, Prepared, Ranks};
use occlude::kernel::simd::Level;
use occlude::stage::{DirectionSet, DirectionWeights, Rho};

use super::{adapter, fills};

const DTYPES: [DType; 7] = [DType::U8, DType::I8, DType::U16, DType::I16, DType::U32, DType::I32, DType::F32];

fn params(directions: usize, max_distance: f64) -> ObscuranceParams {
    ObscuranceParams {
        directions,
        set: match directions {
            12 | 42 | 162 => DirectionSet::Icosahedron,
            _ => DirectionSet::Fibonacci,
        },
        weights: DirectionWeights::Uniform,
        rho: Rho::Sqrt,
        max_distance,
        spacing: [1.0; 3],
        flipped: false,
        missing: None,
        ambient: [1.0; 3],
        ranks: None,
    }
}

/// A volume whose corner has the global index `lo`.
struct Placed<'a> {
    voxels: &'a Voxels,
    shape: Shape,
    lo: [i64; 3],
}

impl Placed<'_> {
    fn region(&self) -> Region {
        Region::whole(self.shape).shift(self.lo)
    }
}

/// Openness of a box by one lane; `None` for the CPU.
fn openness(gpu: Option<&Gpu>, p: &ObscuranceParams, v: &Placed, out: Region) -> Vec<f32> {
    let sweep = Prepared::new(p);
    let region = v.region();
    let mut made = vec![if gpu.is_some() { 7.0f32 } else { 3.0 }; out.voxels()];
    let mut view = ViewMut::dense(&mut made, out.shape());
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let src = v.voxels.view(v.shape);
    match gpu {
        Some(gpu) => {
            gpu.obscurance(&sweep, src, region, out, &mut view, &mut cx).unwrap_or_else(|e| panic!("{e}"));
        }
        None => {
            let openness = Some(AnyViewMut::F32(view));
            sweep.sweep(
                src,
                region,
                out,
                ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None },
                &mut cx,
            );
        }
    }
    made
}

/// The first voxel where two lanes differ.
fn differs(cpu: &[f32], gpu: &[f32]) -> Option<String> {
    let i = cpu.iter().zip(gpu).position(|(a, b)| a.to_bits() != b.to_bits())?;
    Some(format!("voxel {i}: {:?} on the CPU, {:?} on the GPU", cpu[i], gpu[i]))
}

fn check(gpu: &Gpu, name: &str, p: &ObscuranceParams, v: &Placed, out: Region) {
    let (cpu, got) = (openness(None, p, v, out), openness(Some(gpu), p, v, out));
    if let Some(text) = differs(&cpu, &got) {
        panic!("{name} of {} {:?} at {:?}, {out:?}, {p:?}: {text}", v.voxels.dtype(), v.shape, v.lo);
    }
}

#[test]
fn every_type_and_fill_equals_the_cpu() {
    let Some(gpu) = adapter() else { return };
    let shape = [11, 13, 21];
    for dtype in DTYPES {
        for (name, voxels) in fills(dtype, shape) {
            let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
            check(&gpu, name, &params(42, 6.0), &v, v.region());
        }
    }
}

#[test]
fn every_parameter_equals_the_cpu() {
    let Some(gpu) = adapter() else { return };
    let shape = [9, 12, 15];
    let voxels = fills(DType::I16, shape).swap_remove(0).1;
    let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
    let with = |change: &dyn Fn(&mut ObscuranceParams)| {
        let mut p = params(42, 5.0);
        change(&mut p);
        check(&gpu, "noise", &p, &v, v.region());
    };
    for rho in [Rho::Step, Rho::Linear, Rho::Exponential, Rho::Sqrt] {
        with(&|p| p.rho = rho);
    }
    with(&|p| p.weights = DirectionWeights::Voronoi);
    with(&|p| p.flipped = true);
    with(&|p| p.missing = Some(voxels.at(7) as i64));
    with(&|p| {
        p.missing = Some(voxels.at(7) as i64);
        p.ranks = Ranks::new(&(0..1 << 16).map(|i| (i / 7 % 5000) as f32).collect::<Vec<f32>>());
    });
    for spacing in [[2.0, 1.0, 1.0], [0.3, 1.7, 0.9], [1.0, 1.0, 40.0]] {
        with(&|p| p.spacing = spacing);
    }
    for (directions, distance) in [(12, 0.0), (12, 1.0), (162, 4.0), (1, 9.0), (7, 300.0), (10, 12.0)] {
        check(&gpu, "noise", &params(directions, distance), &v, v.region());
    }
}

#[test]
fn odd_shapes_and_reach_beyond_the_volume() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [1, 33, 1], [5, 6, 71], [3, 300, 2], [40, 3, 5]] {
        for dtype in [DType::U8, DType::U16, DType::F32] {
            let (name, voxels) = fills(dtype, shape).swap_remove(1);
            let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
            check(&gpu, name, &params(42, 400.0), &v, v.region());
        }
    }
}

#[test]
fn boxes_inside_follow_global_lines() {
    let Some(gpu) = adapter() else { return };
    let shape = [17, 19, 23];
    for dtype in [DType::U8, DType::F32] {
        let (name, voxels) = fills(dtype, shape).swap_remove(0);
        for lo in [[0, 0, 0], [1001, 7, 123_457]] {
            let v = Placed { voxels: &voxels, shape, lo };
            for (from, to) in [([4, 5, 6], [9, 13, 17]), ([0, 18, 0], [17, 19, 23]), ([16, 0, 22], [17, 1, 23])] {
                let out = Region::new(from, to).shift(lo);
                check(&gpu, name, &params(42, 3.0), &v, out);
                check(&gpu, name, &params(7, 30.0), &v, out);
            }
        }
    }
}

#[test]
fn a_brick_beyond_the_limits_is_cut_or_goes_to_the_cpu() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [22, 25, 31];
    for dtype in [DType::U8, DType::F32] {
        let (name, voxels) = fills(dtype, shape).swap_remove(0);
        let v = Placed { voxels: &voxels, shape, lo: [3, 0, 5] };
        for cap in [100_000, 40_000, 3000] {
            gpu.set_cap(cap);
            check(&gpu, name, &params(12, 2.0), &v, v.region());
        }
    }
}

#[test]
fn sums_fill_32_bits() {
    let Some(gpu) = adapter() else { return };
    let shape = [4, 5, 6];
    let (name, voxels) = fills(DType::U8, shape).swap_remove(0);
    let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
    // 22 bits after the point of 1000 contributions: the sums come near to 2^32.
    check(&gpu, name, &params(1000, 3.0), &v, v.region());
}

#[test]
fn a_lost_device_is_opened_anew() {
    let Some(gpu) = adapter() else { return };
    let shape = [8, 9, 10];
    let (name, voxels) = fills(DType::U16, shape).swap_remove(0);
    let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
    check(&gpu, name, &params(12, 4.0), &v, v.region());
    gpu.lose(false);
    check(&gpu, name, &params(12, 4.0), &v, v.region());
}

#[test]
fn the_comparison_can_fail() {
    let shape = [4, 5, 6];
    let voxels = fills(DType::U8, shape).swap_remove(0).1;
    let v = Placed { voxels: &voxels, shape, lo: [0; 3] };
    let cpu = openness(None, &params(12, 3.0), &v, v.region());
    assert_eq!(differs(&cpu, &cpu), None);
    let mut other = cpu.clone();
    other[50] = f32::from_bits(other[50].to_bits() ^ 1);
    assert!(differs(&cpu, &other).expect("one bit is a difference").contains("voxel 50"));
    assert!(differs(&cpu, &openness(None, &params(12, 2.0), &v, v.region())).is_some());
}

#[test]
fn inputs_without_a_kernel_are_named() {
    for dtype in DTYPES {
        assert_eq!(facts::obscurance(dtype, true), Ok(()));
        assert!(facts::obscurance(dtype, false).unwrap_err().contains("weight_by_normal"));
    }
    assert!(facts::obscurance(DType::F64, true).unwrap_err().contains("f64"));
}
