use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::Region;
use crate::kernel::hostile::{Noise, SHAPES, calm, constant, volume};
use crate::kernel::simd::Level;

/// The 3-D sum over voxels that exist: mean, variance and sum of weights, in f64, in two passes.
fn reference(v: &Voxels, shape: Shape, sigma: [f64; 3], missing: Option<i64>) -> Vec<[f64; 2]> {
    let (whole, reach) = (Region::whole(shape), reach(sigma));
    let at = |q: [i64; 3]| {
        let value = v.at((q[0] as usize * shape[1] + q[1] as usize) * shape[2] + q[2] as usize);
        if !v.dtype().is_float() && missing.is_some_and(|m| m as f64 == value) { f64::NAN } else { value }
    };
    let one = |c: [i64; 3]| {
        if at(c).is_nan() {
            return [f64::NAN; 2];
        }
        let window = Region::new(c, c.map(|i| i + 1)).grow(reach).clip(&whole);
        let taps: Vec<(f64, f64)> = window
            .iter()
            .filter(|q| !at(*q).is_nan())
            .map(|q| {
                let w = (0..3).map(|a| {
                    let d = (q[a] - c[a]) as f64;
                    if d == 0.0 { 1.0 } else { (-d * d / (2.0 * sigma[a] * sigma[a])).exp() }
                });
                (w.product(), at(q))
            })
            .collect();
        let total: f64 = taps.iter().map(|t| t.0).sum();
        let mean = taps.iter().map(|t| t.0 / total * (t.1 - at(c))).sum::<f64>() + at(c);
        let mean = if mean.is_finite() { mean } else { taps.iter().map(|t| t.0 / total * t.1).sum() };
        [mean, taps.iter().map(|t| t.0 / total * (t.1 - mean).powi(2)).sum()]
    };
    whole.iter().map(one).collect()
}

/// The kernel over bricks of one edge, each with its halo cut at the volume: means, variances.
fn bricks(
    v: &Voxels,
    shape: Shape,
    sigma: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    edge: usize,
    level: Level,
) -> [Vec<f64>; 2] {
    let (whole, result) = (Region::whole(shape), v.dtype().result());
    let mut got = [Voxels::zeroed(result, v.len()), Voxels::zeroed(result, v.len())];
    let mut scratch = Scratch::new();
    for cell in whole.cells([0; 3], [edge; 3]).iter() {
        let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
        let grown = part.grow(reach(sigma)).clip(&whole);
        let mut brick = Voxels::zeroed(v.dtype(), grown.voxels());
        crate::brick::gather::copy_common(v.view(shape), whole, brick.view_mut(grown.shape()), grown);
        let mut out = [Voxels::zeroed(result, part.voxels()), Voxels::zeroed(result, part.voxels())];
        let [m, s] = &mut out;
        let (n, at) = (part.shape(), grown.offset_of(&part));
        let mut cx = Context { level, scratch: &mut scratch };
        gaussian(
            brick.view(grown.shape()),
            sigma,
            affine,
            missing,
            at,
            Some(m.view_mut(n)),
            Some(s.view_mut(n)),
            &mut cx,
        );
        for (out, got) in out.iter().zip(&mut got) {
            crate::brick::gather::copy_common(out.view(n), part, got.view_mut(shape), whole);
        }
    }
    got.map(|g| (0..g.len()).map(|i| g.at(i)).collect())
}

fn near(got: f64, expect: f64, relative: f64, absolute: f64) -> bool {
    got == expect || (got - expect).abs() <= relative * expect.abs() + absolute || got.is_nan() && expect.is_nan()
}

#[test]
fn equals_the_definition_for_every_type_and_never_shows_bricks_or_levels() {
    let sigmas = [[1.0, 0.7, 1.3], [0.0, 2.0, 0.4], [3.0, 3.0, 3.0], [0.0; 3]];
    for (case, dtype) in DType::ALL.into_iter().enumerate() {
        for (s, shape) in SHAPES.into_iter().enumerate() {
            for (k, sigma) in sigmas.into_iter().enumerate() {
                let hostile = (case + s + k) % 2 == 0;
                let seed = (10 * case + s) as u64;
                let v = if hostile { volume(dtype, shape, seed) } else { calm(dtype, shape, seed) };
                let missing = [Some(5), None, Some(12)][(s + k) % 3];
                let affine = if k == 1 { Affine::new(-2.0, 10.0) } else { Affine::IDENTITY };
                let expect = reference(&v, shape, sigma, missing);
                let got = bricks(&v, shape, sigma, affine, missing, 1000, Level::Baseline);
                let (lo, hi) = (0..v.len())
                    .map(|i| v.at(i))
                    .filter(|v| v.is_finite())
                    .fold((0.0f64, 0.0f64), |a, v| (a.0.min(v), a.1.max(v)));
                let relative = if dtype.result() == DType::F32 { 5e-7 } else { 1e-12 };
                for (i, e) in expect.iter().enumerate() {
                    let what = format!("{dtype} {shape:?} {sigma:?} {missing:?} voxel {i}");
                    let mean = affine.slope * e[0] + affine.intercept;
                    assert!(
                        near(got[0][i], mean, relative, relative * 2.0 * (hi - lo)),
                        "{what}: mean {} {mean}",
                        got[0][i]
                    );
                    // a variance beyond f32 is an infinity there
                    let mut variance = affine.slope * affine.slope * e[1];
                    if dtype.result() == DType::F32 && !hostile {
                        variance = variance as f32 as f64;
                    } else if dtype == DType::F32 && variance > 1e38 {
                        variance = f64::INFINITY;
                    }
                    assert!(near(got[1][i], variance, 1e-6, 1e-20), "{what}: variance {} {variance}", got[1][i]);
                }
                for (level, edge) in Level::available().into_iter().map(|l| (l, 1000)).chain([(Level::detect(), 4)]) {
                    let other = bricks(&v, shape, sigma, affine, missing, edge, level);
                    for (a, b) in got.iter().flatten().zip(other.iter().flatten()) {
                        assert!(
                            a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(),
                            "{dtype} {shape:?} {sigma:?} {level:?} {edge}"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn constants_are_exact_also_beside_missing_voxels() {
    let shape = [3, 9, 40];
    for dtype in DType::ALL {
        for value in [0.0, 77.0, dtype.range().0, dtype.range().1, 0.1] {
            let mut v = constant(dtype, shape, value);
            let first = v.at(0);
            if dtype.is_float() {
                crate::with_voxels!(&mut v, v => v[500] = crate::grid::Voxel::from_f64(f64::NAN));
            }
            for level in Level::available() {
                let got = bricks(&v, shape, [1.5, 2.0, 3.0], Affine::IDENTITY, None, 16, level);
                for i in (0..v.len()).filter(|i| !dtype.is_float() || *i != 500) {
                    assert_eq!((got[0][i], got[1][i]), (first, 0.0), "{dtype} {value} voxel {i}");
                }
                assert!(!dtype.is_float() || got[0][500].is_nan() && got[1][500].is_nan());
            }
        }
    }
}

#[test]
fn rows_far_apart_are_mended_alone_and_means_are_the_same_without_variances() {
    let (shape, sigma) = ([37, 20, 150], [0.6, 1.0, 1.2]);
    let mut v = calm(DType::F32, shape, 4);
    let at = |[z, y, x]: [usize; 3]| (z * shape[1] + y) * shape[2] + x;
    crate::with_voxels!(&mut v, v => {
        for (place, value) in [
            ([2, 3, 5], f64::NAN), ([3, 18, 140], f64::NAN), ([20, 9, 70], f64::NAN), ([21, 9, 70], f64::NAN),
            ([30, 2, 63], f64::INFINITY), ([30, 3, 64], f64::NAN), ([36, 19, 149], f64::NAN), ([10, 10, 10], 3e38),
        ] {
            v[at(place)] = crate::grid::Voxel::from_f64(value);
        }
    });
    let expect = reference(&v, shape, sigma, None);
    let got = bricks(&v, shape, sigma, Affine::IDENTITY, None, 1000, Level::detect());
    for (i, e) in expect.iter().enumerate() {
        let variance = if e[1] > 1e38 { f64::INFINITY } else { e[1] };
        assert!(near(got[0][i], e[0], 5e-7, 1e-4) && near(got[1][i], variance, 1e-6, 1e-20), "voxel {i}: {e:?}");
    }
    let mut mean = Voxels::zeroed(DType::F32, v.len());
    let mut scratch = Scratch::new();
    for (level, edge) in Level::available().into_iter().map(|l| (l, 1000)).chain([(Level::detect(), 11)]) {
        let other = bricks(&v, shape, sigma, Affine::IDENTITY, None, edge, level);
        let mut cx = Context { level, scratch: &mut scratch };
        let alone = Some(mean.view_mut(shape));
        gaussian(v.view(shape), sigma, Affine::IDENTITY, None, [0; 3], alone, None, &mut cx);
        for i in 0..v.len() {
            let same = |a: f64, b: f64| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
            assert!(same(got[0][i], other[0][i]) && same(got[1][i], other[1][i]), "{level:?} {edge} voxel {i}");
            assert!(same(got[0][i], mean.at(i)), "{level:?} voxel {i}: the mean alone is {}", mean.at(i));
        }
    }
}

#[test]
fn variance_holds_where_the_mean_is_a_million_times_larger() {
    let shape = [7, 8, 64];
    let mut noise = Noise(8);
    let n = shape.iter().product::<usize>();
    // 16 steps of f32 at 2^20 per standard deviation, and a step of a million beside it
    let v =
        Voxels::F32((0..n).map(|i| (1e6 + noise.unit() * 3.5 + if i % 64 > 50 { 1e6 } else { 0.0 }) as f32).collect());
    let (sigma, missing) = ([2.0; 3], None);
    let expect = reference(&v, shape, sigma, missing);
    let got = bricks(&v, shape, sigma, Affine::IDENTITY, missing, 20, Level::detect());
    for (i, e) in expect.iter().enumerate() {
        assert!(near(got[1][i], e[1], 1e-6, 0.0), "voxel {i}: {} {}", got[1][i], e[1]);
        assert!(near(got[0][i], e[0], 4e-7, 0.0), "voxel {i}: {} {}", got[0][i], e[0]);
    }
}
