//! The kernel against its reference and the exact count, and itself in other bricks and on other levels.

use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, Region, Voxel};
use crate::kernel::hostile::{Noise, SHAPES, constant, volume};
use crate::stage::WindowShape;

fn params(radius: [usize; 3], missing: Option<i64>, solid_low: bool) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing, solid_low }
}

/// Levels of a volume's finite voxels.
fn levels_of(v: &Voxels, p: &WindowParams, count: usize) -> Levels {
    let lost = |v: f64| !v.is_finite() || p.missing.is_some_and(|m| m as f64 == v);
    let mut all: Vec<f64> = (0..v.len()).map(|i| v.at(i)).filter(|v| v.is_nan() || !lost(*v)).collect();
    all.retain(|v| !v.is_nan());
    all.iter_mut().filter(|_| p.flipped()).for_each(|v| *v = -*v);
    all.sort_by(f64::total_cmp);
    let mut values: Vec<(f64, u64)> = Vec::new();
    for v in all {
        match values.last_mut() {
            Some((last, n)) if *last == v => *n += 1,
            _ => values.push((v, 1)),
        }
    }
    Levels::choose(&values, count)
}

/// The kernel over bricks of one edge, each with its halo cut at the volume.
fn bricks(v: &Voxels, shape: Shape, l: &Levels, p: &WindowParams, ties: Ties, edge: usize, level: Level) -> Vec<f64> {
    let whole = Region::whole(shape);
    let mut got = Voxels::zeroed(v.dtype().result(), v.len());
    let mut scratch = Scratch::new();
    for cell in whole.cells([0; 3], [edge; 3]).iter() {
        let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
        let grown = part.grow(p.radius).clip(&whole);
        let mut brick = Voxels::zeroed(v.dtype(), grown.voxels());
        crate::brick::gather::copy_common(v.view(shape), whole, brick.view_mut(grown.shape()), grown);
        let mut out = Voxels::zeroed(v.dtype().result(), part.voxels());
        scratch.take(1000).fill(0xa5);
        let mut cx = Context { level, scratch: &mut scratch };
        levels(brick.view(grown.shape()), l, p, ties, grown.offset_of(&part), out.view_mut(part.shape()), &mut cx);
        crate::brick::gather::copy_common(out.view(part.shape()), part, got.view_mut(shape), whole);
    }
    (0..got.len()).map(|i| got.at(i)).collect()
}

fn reference(v: &Voxels, shape: Shape, l: &Levels, p: &WindowParams, ties: Ties) -> Vec<f64> {
    let single = v.dtype().result() == DType::F32;
    let round = |o: f64| if single { o as f32 as f64 } else { o };
    let at =
        |c: [i64; 3]| with_view!(AnyView, v.view(shape), v => reference::voxel(v, c.map(|i| i as usize), l, p, ties));
    Region::whole(shape).iter().map(at).map(round).collect()
}

/// Distance from the reference: a few roundings to f32, or to f64 for f64.
fn tolerance(dtype: DType) -> f64 {
    if dtype.result() == DType::F64 { 1e-14 } else { 4e-7 }
}

#[test]
fn equals_the_reference_for_every_type_tie_and_brick() {
    let radii = [[1, 1, 1], [2, 3, 1], [0, 2, 4], [3, 0, 0], [0, 0, 0], [3, 5, 200]];
    for (case, dtype) in DType::ALL.into_iter().enumerate() {
        for (s, shape) in SHAPES.into_iter().enumerate() {
            let v = volume(dtype, shape, (case * 7 + s) as u64);
            for (r, radius) in radii.into_iter().enumerate() {
                let p = params(radius, [Some(5), None, Some(12)][(r + s) % 3], (r + s + case) % 2 == 1);
                let l = levels_of(&v, &p, [8, 32, 64][(r + case) % 3]);
                for ties in [Ties::Le, Ties::Mid] {
                    let expect = reference(&v, shape, &l, &p, ties);
                    for level in Level::available() {
                        let got = bricks(&v, shape, &l, &p, ties, 100, level);
                        for (i, (g, e)) in got.iter().zip(&expect).enumerate() {
                            let close = (g - e).abs() <= tolerance(dtype) || g.is_nan() && e.is_nan();
                            assert!(close, "{dtype} {shape:?} {p:?} {ties:?} {level:?}, voxel {i}: {g}, expected {e}");
                        }
                        let other = bricks(&v, shape, &l, &p, ties, 5, level);
                        let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                        assert_eq!(bits(&got), bits(&other), "{dtype} {shape:?} {p:?}: bricks show");
                    }
                }
            }
        }
    }
}

#[test]
fn larger_windows_count_past_bytes_and_16_bits() {
    for (shape, radius) in [([3, 9, 420], [4, 9, 60]), ([260, 4, 70], [130, 4, 40]), ([40, 41, 60], [40, 41, 60])] {
        let v = volume(DType::U16, shape, 4);
        let p = params(radius, Some(5), false);
        let l = levels_of(&v, &p, 32);
        let mut places = Noise(3);
        for level in Level::available() {
            let got = bricks(&v, shape, &l, &p, Ties::Le, 1000, level);
            for _ in 0..200 {
                let c = shape.map(|n| places.below(n));
                let e = with_view!(AnyView, v.view(shape), v => reference::voxel(v, c, &l, &p, Ties::Le));
                let g = got[(c[0] * shape[1] + c[1]) * shape[2] + c[2]];
                assert!(
                    (g - e).abs() <= tolerance(v.dtype()) || g.is_nan() && e.is_nan(),
                    "{shape:?} {c:?} {level:?}: {g}, not {e}"
                );
            }
        }
    }
}

/// Values 0 to `values - 1`, mapped by `map`.
fn coarse(dtype: DType, shape: Shape, values: usize, map: impl Fn(f64) -> f64) -> Voxels {
    let mut noise = Noise(9);
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    crate::with_voxels!(&mut v, d => d.iter_mut().for_each(|d| *d = Voxel::from_f64(map(noise.below(values) as f64))));
    v
}

#[test]
fn is_exact_where_there_are_no_more_values_than_levels() {
    let shape = [9, 12, 30];
    for (dtype, low) in [(DType::U8, false), (DType::I16, true), (DType::F32, false), (DType::U32, true)] {
        let v = coarse(dtype, shape, 20, |i| i * i);
        for ties in [Ties::Le, Ties::Mid] {
            let p = params([2, 3, 4], None, low);
            let got = bricks(&v, shape, &levels_of(&v, &p, 20), &p, ties, 7, Level::detect());
            let mut exact = Voxels::zeroed(dtype.result(), v.len());
            let mut scratch = Scratch::new();
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            crate::kernel::rank::rank(
                v.view(shape),
                &p,
                WindowShape::Box,
                ties,
                [0; 3],
                exact.view_mut(shape),
                &mut cx,
            );
            assert!(got.iter().enumerate().all(|(i, g)| *g == exact.at(i)), "{dtype} {ties:?}");
        }
    }
}

#[test]
fn an_increasing_map_of_values_that_are_levels_changes_nothing() {
    let shape = [8, 9, 40];
    let maps: [fn(f64) -> f64; 3] = [|i| i, |i| i * i * i, |i| (i / 40.0).exp()];
    let p = params([2, 2, 3], None, false);
    let results = maps.map(|map| {
        let v = coarse(DType::F64, shape, 60, map);
        bricks(&v, shape, &levels_of(&v, &p, 64), &p, Ties::Mid, 100, Level::detect())
    });
    assert_eq!(results[0], results[1]);
    assert_eq!(results[0], results[2]);
}

#[test]
fn constants_are_decided_exactly() {
    let p = params([2, 2, 2], None, false);
    // Levels that no voxel of the window has.
    let l = Levels::even(vec![-1000.0, -1.0, 60.0, 1000.0], vec![true, false, false, false]);
    for dtype in DType::ALL {
        let v = constant(dtype, [3, 4, 70], 7.0);
        for (ties, expect) in [(Ties::Le, 1.0), (Ties::Mid, 0.5)] {
            assert!(bricks(&v, [3, 4, 70], &l, &p, ties, 100, Level::detect()).iter().all(|o| *o == expect), "{dtype}");
        }
    }
    let one_off: Vec<f32> = (0..9).map(|i| if i == 8 { 8.0 } else { 7.0 }).collect();
    let got =
        bricks(&Voxels::F32(one_off), [1, 1, 9], &l, &params([0, 0, 1], None, false), Ties::Le, 9, Level::detect());
    assert!(got[..7].iter().all(|o| *o == 1.0) && got[7] < 0.2, "{got:?}");
}

#[test]
fn uniform_noise_gives_its_own_value() {
    let shape = [21, 21, 21];
    let mut noise = Noise(5);
    let v = Voxels::F32((0..9261).map(|_| noise.unit() as f32).collect());
    let p = params([10; 3], None, false);
    let got = bricks(&v, shape, &levels_of(&v, &p, 32), &p, Ties::Le, 100, Level::detect());
    let centre = 9261 / 2;
    assert!((got[centre] - v.at(centre)).abs() < 0.02, "{} at {}", got[centre], v.at(centre));
}

#[test]
fn a_volume_without_a_finite_voxel_has_no_levels() {
    let (nan, inf) = (f32::NAN, f32::INFINITY);
    let v = Voxels::F32(vec![nan, inf, -inf, nan]);
    let p = params([0, 0, 1], None, false);
    let got = bricks(&v, [1, 1, 4], &Levels::default(), &p, Ties::Le, 9, Level::detect());
    assert!(got[0].is_nan() && got[3].is_nan());
    assert_eq!((got[1], got[2]), (1.0, 0.0));
}
