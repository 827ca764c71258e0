use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::Region;
use crate::kernel::hostile::{Noise, calm};
use crate::kernel::simd::Level;

const WEIGHTS: [GradientWeight; 2] = [GradientWeight::Distance, GradientWeight::Inverse];

/// Magnitude, z, y, x of every voxel whose window lies in `v`, on one level, in one box of outputs.
fn run(
    v: &Voxels,
    shape: Shape,
    part: Region,
    level: Level,
    job: (usize, GradientWeight, [f64; 3], Affine),
) -> [Vec<f64>; 4] {
    let (size, weight, spacing, affine) = job;
    let grown = part.grow([size / 2; 3]);
    let mut brick = Voxels::zeroed(v.dtype(), grown.voxels());
    crate::brick::gather::copy_common(v.view(shape), Region::whole(shape), brick.view_mut(grown.shape()), grown);
    let result = v.dtype().result();
    let mut outs: [Voxels; 4] = std::array::from_fn(|_| Voxels::zeroed(result, part.voxels()));
    let [m, z, y, x] = &mut outs;
    let n = part.shape();
    let out =
        GradientOut { magnitude: Some(m.view_mut(n)), vector: Some([z.view_mut(n), y.view_mut(n), x.view_mut(n)]) };
    let (mut scratch, at) = (Scratch::new(), [size / 2; 3]);
    let mut cx = Context { level, scratch: &mut scratch };
    gradient(brick.view(grown.shape()), size, weight, spacing, affine, Some(90), at, out, &mut cx);
    outs.map(|o| (0..o.len()).map(|i| o.at(i)).collect())
}

/// Weighted least squares by the 4x4 normal equations, as section 4 of the specification states it.
fn reference(v: &dyn Fn([i64; 3]) -> f64, half: i64, weight: GradientWeight, spacing: [f64; 3]) -> [f64; 3] {
    if v([0; 3]).is_nan() {
        return [f64::NAN; 3];
    }
    let mut m = [[0.0f64; 5]; 4];
    for d in Region::new([-half; 3], [half + 1; 3]).iter() {
        let offset: [f64; 3] = std::array::from_fn(|a| d[a] as f64 * spacing[a]);
        let distance = offset.iter().map(|o| o * o).sum::<f64>().sqrt();
        let f = v(d);
        if d == [0; 3] || f.is_nan() {
            continue;
        }
        let w = if weight == GradientWeight::Distance { distance } else { 1.0 / distance };
        let row = [offset[0], offset[1], offset[2], 1.0, f];
        for i in 0..4 {
            for j in 0..5 {
                m[i][j] += w * row[i] * row[j];
            }
        }
    }
    let scale = m[0][0].max(m[1][1]).max(m[2][2]).max(m[3][3]);
    for p in 0..4 {
        let best = (p..4).max_by(|&i, &j| m[i][p].abs().total_cmp(&m[j][p].abs())).unwrap();
        m.swap(p, best);
        if m[p][p].abs() <= 1e-10 * scale {
            return [0.0; 3];
        }
        for i in 0..4 {
            if i != p {
                let factor = m[i][p] / m[p][p];
                let pivot = m[p];
                m[i].iter_mut().zip(pivot).for_each(|(a, b)| *a -= factor * b);
            }
        }
    }
    std::array::from_fn(|i| m[i][4] / m[i][i])
}

fn close(got: f64, expect: f64, scale: f64) -> bool {
    (got - expect).abs() <= 2e-7 * scale.max(expect.abs()) || got.is_nan() && expect.is_nan()
}

#[test]
fn equals_the_regression_for_every_type_level_and_brick() {
    let shape = [8, 7, 45];
    for (case, dtype) in DType::ALL.into_iter().enumerate() {
        for gaps in [false, true] {
            let mut v = calm(dtype, shape, case as u64);
            if !gaps {
                crate::with_voxels!(&mut v, v => v.iter_mut().filter(|v| v.to_f64() == 90.0).for_each(|v| *v = Voxel::from_f64(3.0)));
            } else if dtype.is_float() {
                let mut noise = Noise(5);
                let n = v.len();
                for i in 0..n {
                    // few, many, and windows that hold hardly anything
                    if noise.below(100) < [2, 40, 93][3 * i / n] {
                        crate::with_voxels!(&mut v, v => v[i] = Voxel::from_f64(f64::NAN));
                    }
                }
            }
            for (size, weight) in [3, 5].into_iter().flat_map(|s| WEIGHTS.map(|w| (s, w))) {
                let half = size as i64 / 2;
                let (spacing, affine) = ([2.0, 1.0, 0.7], Affine::new(-0.5, 4.0));
                let inner = Region::new([half; 3], shape.map(|n| n as i64 - half));
                let job = (size, weight, spacing, affine);
                let got = run(&v, shape, inner, Level::Baseline, job);
                for (i, p) in inner.iter().enumerate() {
                    let at = |d: [i64; 3]| {
                        let q: [usize; 3] = std::array::from_fn(|a| (p[a] + d[a]) as usize);
                        let value = v.at((q[0] * shape[1] + q[1]) * shape[2] + q[2]);
                        if !dtype.is_float() && value == 90.0 { f64::NAN } else { value }
                    };
                    let expect = reference(&at, half, weight, spacing).map(|g| g * -0.5);
                    let magnitude = expect.iter().map(|g| g * g).sum::<f64>().sqrt();
                    assert!(close(got[0][i], magnitude, 50.0), "{dtype} {size} {p:?}: {} {magnitude}", got[0][i]);
                    for a in 0..3 {
                        assert!(close(got[a + 1][i], expect[a], 50.0), "{dtype} {size} {weight:?} {p:?} axis {a}");
                    }
                }
                for level in Level::available() {
                    for edge in [3, 64] {
                        for cell in inner.cells([1; 3], [edge; 3]).iter() {
                            let part = Region::of_cell(cell, [1; 3], [edge; 3]).clip(&inner);
                            let brick = run(&v, shape, part, level, job);
                            for (j, p) in part.iter().enumerate() {
                                let o = inner.offset_of(&Region::new(p, p));
                                let n = inner.shape();
                                let i = (o[0] * n[1] + o[1]) * n[2] + o[2];
                                for c in 0..4 {
                                    assert_eq!(brick[c][j].to_bits(), got[c][i].to_bits(), "{dtype} {level:?} {p:?}");
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn constants_give_zero_and_planes_their_slope() {
    let shape = [5, 5, 40];
    let inner = Region::new([2, 2, 2], [3, 3, 38]);
    for level in Level::available() {
        for weight in WEIGHTS {
            let job = (5, weight, [1.0, 1.0, 2.0], Affine::new(-3.0, 0.0));
            for (dtype, value) in [(DType::U8, 255.0), (DType::F32, 0.1), (DType::F64, 1e300), (DType::I32, -7.0)] {
                let got = run(&crate::kernel::hostile::constant(dtype, shape, value), shape, inner, level, job);
                assert!(got.iter().flatten().all(|g| g.to_bits() == 0), "{dtype}: {got:?}");
            }
            let ramp = Voxels::I16((0..1000).map(|i| (i % 40) - 30 * ((i / 40) % 5)).collect());
            let got = run(&ramp, shape, inner, level, job);
            let [_, z, y, x] = &got;
            assert!(z.iter().all(|g| *g == 0.0) && x.iter().all(|g| *g == -1.5), "{z:?} {x:?}");
            assert!(y.iter().all(|g| (g - 90.0).abs() < 1e-5), "{y:?}");
        }
    }
}

/// f = 3 z - 2 y + x / 2 where `there` says so, else missing; the slopes of windows of 5 that a row of centres sees.
fn slopes_of(there: &dyn Fn([i64; 3]) -> bool, weight: GradientWeight, spacing: [f64; 3]) -> [Vec<f64>; 4] {
    let shape = [5, 5, 40];
    let f = |[z, y, x]: [i64; 3]| (3 * z - 2 * y) as f64 + x as f64 / 2.0;
    let voxels = Region::whole(shape).iter().map(|p| if there(p) { f(p) } else { f64::NAN });
    let v = Voxels::F64(voxels.collect());
    let inner = Region::new([2, 2, 2], [3, 3, 38]);
    let job = (5, weight, spacing, Affine::IDENTITY);
    let first = run(&v, shape, inner, Level::Baseline, job);
    for level in Level::available() {
        let other = run(&v, shape, inner, level, job);
        let bits = |o: &[Vec<f64>; 4]| o.iter().flatten().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&first), bits(&other), "{level:?}");
    }
    first
}

#[test]
fn voxels_of_one_plane_determine_no_slope_and_one_beside_it_does() {
    let planes: [&dyn Fn([i64; 3]) -> bool; 5] = [
        &|[z, ..]| z == 2,
        &|[z, y, _]| z == y,
        &|[z, y, _]| z == 2 && y == 2,
        &|[z, y, x]| z == 2 && y == 2 && x % 3 == 0,
        &|[z, y, x]| z == x - 18 && y < 4,
    ];
    for (k, plane) in planes.into_iter().enumerate() {
        for (weight, spacing) in WEIGHTS.into_iter().flat_map(|w| [(w, [1.0; 3]), (w, [1e4, 1.0, 1e-2])]) {
            let got = slopes_of(plane, weight, spacing);
            for (i, g) in got[0].iter().enumerate() {
                let there = plane([2, 2, i as i64 + 2]);
                assert!(if there { g.to_bits() == 0 } else { g.is_nan() }, "plane {k} {weight:?} {spacing:?} {i}: {g}");
            }
        }
    }
    for (weight, spacing) in WEIGHTS.into_iter().flat_map(|w| [(w, [1.0; 3]), (w, [1e3, 1.0, 1e-2])]) {
        let got = slopes_of(&|p| p[0] == p[1] || p == [4, 0, 20], weight, spacing);
        for (x, i) in (2..38).zip(0..) {
            for (a, slope) in [3.0, -2.0, 0.5].into_iter().enumerate() {
                let expect = if (18..=22).contains(&x) { slope / spacing[a] } else { 0.0 };
                assert!((got[a + 1][i] - expect).abs() <= 1e-7 * expect.abs(), "{weight:?} {x} {}", got[a + 1][i]);
            }
        }
    }
}

#[test]
fn beside_an_infinity_and_a_gap_there_is_no_number() {
    let shape = [5, 5, 60];
    let inner = Region::new([2, 2, 2], [3, 3, 58]);
    for (weight, infinite) in WEIGHTS.into_iter().flat_map(|w| [(w, f64::INFINITY), (w, f64::NEG_INFINITY)]) {
        let mut calm = calm(DType::F32, shape, 9);
        crate::with_voxels!(&mut calm, v => v[4 * 300..].fill(Voxel::from_f64(f64::NAN)));
        let mut hostile = calm.clone();
        crate::with_voxels!(&mut hostile, v => v[2 * 300 + 2 * 60 + 20] = Voxel::from_f64(infinite));
        let job = (5, weight, [1.0; 3], Affine::IDENTITY);
        for level in Level::available() {
            let (a, b) = (run(&calm, shape, inner, level, job), run(&hostile, shape, inner, level, job));
            for (x, i) in (2..58).zip(0..) {
                let reached = (18..=22).contains(&x);
                assert!(
                    !a[0][i].is_nan() && (reached && b[0][i].is_nan() || !reached && a[0][i] == b[0][i]),
                    "voxel {x}"
                );
            }
        }
    }
}

#[test]
fn constants_beside_gaps_give_exactly_zero() {
    let shape = [9, 9, 60];
    let inner = Region::new([2; 3], [7, 7, 58]);
    for (dtype, value) in [(DType::F32, 0.1), (DType::F64, 1e300), (DType::F64, -1.0 / 3.0)] {
        let mut v = crate::kernel::hostile::constant(dtype, shape, value);
        let mut noise = Noise(3);
        for i in 0..v.len() {
            if noise.below(10) < 3 {
                crate::with_voxels!(&mut v, v => v[i] = Voxel::from_f64(f64::NAN));
            }
        }
        for weight in WEIGHTS {
            let got = run(&v, shape, inner, Level::detect(), (5, weight, [1.0, 3.0, 0.3], Affine::IDENTITY));
            assert!(got.iter().flatten().all(|g| g.is_nan() || g.to_bits() == 0), "{dtype} {value}");
        }
    }
}

#[test]
fn an_infinity_changes_only_windows_that_hold_it() {
    let shape = [5, 5, 60];
    let calm = calm(DType::F32, shape, 9);
    let mut hostile = calm.clone();
    crate::with_voxels!(&mut hostile, v => v[2 * 300 + 2 * 60 + 20] = Voxel::from_f64(f64::INFINITY));
    let inner = Region::new([2, 2, 2], [3, 3, 58]);
    let job = (5, GradientWeight::Distance, [1.0; 3], Affine::IDENTITY);
    let (a, b) = (run(&calm, shape, inner, Level::detect(), job), run(&hostile, shape, inner, Level::detect(), job));
    for i in 0..56 {
        assert_eq!(a[0][i].to_bits() == b[0][i].to_bits(), i + 2 < 18 || i + 2 > 22 || i + 2 == 20, "voxel {i}");
    }
}

/// Voxels that cancel in exact arithmetic leave nothing, so that nobody takes a rounding for a direction.
#[test]
fn slopes_that_vanish_are_zero_for_every_type() {
    let shape = [5, 5, 23];
    let even: [fn([i64; 3]) -> i64; 4] = [
        |[z, y, x]| x * x + 2 * y * y + 3 * z * z,
        |[z, y, x]| (x * y * z).rem_euclid(7),
        |[z, y, x]| 40 + x * y - y * z + 5 * z * x,
        |[z, y, x]| x.abs() + z.abs() * y.abs(),
    ];
    for (dtype, value) in DType::ALL.into_iter().flat_map(|d| even.map(|f| (d, f))) {
        let factor = if dtype.is_float() { 0.1 } else { 1.0 };
        // Every fourth plane along x is the middle of windows that are their own mirror image.
        let voxel = |i: usize| {
            let p = [i / (5 * 23), i / 23 % 5, i % 23].map(|v| v as i64);
            value([p[0] - 2, p[1] - 2, (p[2] + 1) % 4 - 2]) as f64 * factor
        };
        let mut v = Voxels::zeroed(dtype, shape.iter().product());
        crate::with_voxels!(&mut v, v => v.iter_mut().enumerate().for_each(|(i, v)| *v = Voxel::from_f64(voxel(i))));
        for (weight, spacing) in WEIGHTS.into_iter().flat_map(|w| [[1.0; 3], [0.7, 1.1, 0.3]].map(|s| (w, s))) {
            let inner = Region::new([2, 2, 1], [3, 3, 22]);
            for level in Level::available() {
                let got = run(&v, shape, inner, level, (3, weight, spacing, Affine::IDENTITY));
                for x in (0..inner.shape()[2]).step_by(4) {
                    let slope = [got[1][x], got[2][x], got[3][x]];
                    assert_eq!(slope, [0.0; 3], "{dtype} {weight:?} {spacing:?} at {x}");
                }
            }
        }
    }
}

/// The same field with and without a large offset, which every type here holds exactly.
#[test]
fn an_offset_of_all_values_cancels_along_every_axis() {
    let shape = [5, 6, 11];
    let mut noise = Noise(3);
    let small: Vec<f64> = (0..shape.iter().product()).map(|_| noise.below(8) as f64).collect();
    let cases = [
        (DType::U8, 200.0),
        (DType::I16, 32_000.0),
        (DType::F32, 16_000_000.0),
        (DType::U32, 4e9),
        (DType::I32, 2_147_483_000.0),
        (DType::F64, 1e12),
        (DType::F64, 2f64.powi(52)),
    ];
    for (dtype, offset) in cases {
        for (size, weight) in [3, 5].into_iter().flat_map(|s| WEIGHTS.map(|w| (s, w))) {
            let of = |offset: f64| {
                let mut v = Voxels::zeroed(dtype, small.len());
                crate::with_voxels!(&mut v, v => v.iter_mut().zip(&small).for_each(|(v, s)| *v = Voxel::from_f64(s + offset)));
                vector_of(&v, shape, size, weight)
            };
            let result = if dtype.result() == DType::F32 { 3e-7 } else { 1e-14 };
            for (raised, plain) in of(offset).into_iter().zip(of(0.0)) {
                // weighed sums of f32 and short integers lose 24 bits of 53 at most
                let lost = if dtype == DType::F32 { 1e-6 } else { 1e-10 };
                let lost = if dtype.result() == DType::F64 { 0.0 } else { lost };
                assert!((raised - plain).abs() <= result * 8.0 + lost, "{dtype} {offset} {size}: {raised} {plain}");
            }
        }
    }
}

#[test]
fn lengths_do_not_leave_the_range_of_f64() {
    let shape = [3, 5, 9];
    for scale in [1e-300, 1e-170, 1e-150, 1.0, 1e145, 1e160, 1e300] {
        let v = Voxels::F64((0..135).map(|i| f64::from(i) * scale).collect());
        let (mut got, mut scratch) = (Voxels::zeroed(DType::F64, 5), Scratch::default());
        let out = GradientOut { magnitude: Some(got.view_mut([1, 1, 5])), vector: None };
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        gradient(v.view(shape), 3, WEIGHTS[0], [1.0; 3], Affine::IDENTITY, None, [1, 1, 2], out, &mut cx);
        let expect = (45f64 * 45.0 + 81.0 + 1.0).sqrt() * scale;
        assert!((got.at(2) / expect - 1.0).abs() < 1e-14, "{scale}: {} {expect}", got.at(2));
    }
}

/// Components z, y, x of all inner voxels.
fn vector_of(v: &Voxels, shape: [usize; 3], size: usize, weight: GradientWeight) -> Vec<f64> {
    let half = size / 2;
    let inner = shape.map(|n| n - 2 * half);
    let (n, dtype) = (inner.iter().product(), v.dtype().result());
    let mut got = [0; 3].map(|_| Voxels::zeroed(dtype, n));
    let vector = Some(got.each_mut().map(|g| g.view_mut(inner)));
    let mut scratch = Scratch::default();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let out = GradientOut { magnitude: None, vector };
    gradient(v.view(shape), size, weight, [2.0, 1.0, 0.7], Affine::IDENTITY, None, [half; 3], out, &mut cx);
    got.iter().flat_map(|g| (0..n).map(|i| g.at(i))).collect()
}
