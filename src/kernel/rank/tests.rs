use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, Region};
use crate::kernel::hostile::{SHAPES, constant, volume};
use crate::kernel::simd::Level;

fn params(radius: [usize; 3], missing: Option<i64>, solid_low: bool) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing, solid_low }
}

/// Section 4 word by word, on values turned by `solid`.
fn reference(v: &Voxels, shape: Shape, p: &WindowParams, window: WindowShape, ties: Ties) -> Vec<f64> {
    let whole = Region::whole(shape);
    let at = |q: [i64; 3]| {
        let value = v.at((q[0] as usize * shape[1] + q[1] as usize) * shape[2] + q[2] as usize);
        let lost = !v.dtype().is_float() && p.missing.is_some_and(|m| m as f64 == value);
        if lost {
            f64::NAN
        } else if p.flipped() {
            -value
        } else {
            value
        }
    };
    let inside = |c: [i64; 3], q: [i64; 3]| {
        let mut sum = 0.0;
        for a in 0..3 {
            let (d, r) = ((q[a] - c[a]) as f64, p.radius[a] as f64);
            if d != 0.0 {
                sum += if r == 0.0 { 2.0 } else { d * d / (r * r) };
            }
        }
        window == WindowShape::Box || sum <= 1.0 + 1e-12
    };
    let openness = |c: [i64; 3]| {
        let centre = at(c);
        if centre.is_nan() {
            return f64::NAN;
        }
        if centre.is_infinite() {
            return if centre > 0.0 { 1.0 } else { 0.0 };
        }
        let (mut n, mut below, mut equal) = (0.0, 0.0, 0.0);
        let cut = Region::new(c, c.map(|i| i + 1)).grow(p.radius).clip(&whole);
        for q in cut.iter().filter(|q| inside(c, *q)).map(at).filter(|q| !q.is_nan()) {
            n += 1.0;
            below += f64::from(q < centre);
            equal += f64::from(q == centre);
        }
        if ties == Ties::Le { (below + equal) / n } else { (2.0 * below + equal) / (2.0 * n) }
    };
    let single = v.dtype().result() == DType::F32;
    whole.iter().map(openness).map(|o| if single { o as f32 as f64 } else { o }).collect()
}

/// The kernel over bricks of one edge, each with its halo cut at the volume.
fn bricks(
    v: &Voxels,
    shape: Shape,
    p: &WindowParams,
    window: WindowShape,
    ties: Ties,
    edge: usize,
    level: Level,
) -> Vec<f64> {
    let whole = Region::whole(shape);
    let mut got = Voxels::zeroed(v.dtype().result(), v.len());
    let mut scratch = Scratch::new();
    for cell in whole.cells([0; 3], [edge; 3]).iter() {
        let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
        let grown = part.grow(p.radius).clip(&whole);
        let mut brick = Voxels::zeroed(v.dtype(), grown.voxels());
        crate::brick::gather::copy_common(v.view(shape), whole, brick.view_mut(grown.shape()), grown);
        let mut out = Voxels::zeroed(v.dtype().result(), part.voxels());
        let (src, at) = (brick.view(grown.shape()), grown.offset_of(&part));
        rank(src, p, window, ties, at, out.view_mut(part.shape()), &mut Context { level, scratch: &mut scratch });
        crate::brick::gather::copy_common(out.view(part.shape()), part, got.view_mut(shape), whole);
    }
    (0..got.len()).map(|i| got.at(i)).collect()
}

fn same(got: &[f64], expect: &[f64], what: &str) {
    for (i, (g, e)) in got.iter().zip(expect).enumerate() {
        assert!(g == e || g.is_nan() && e.is_nan(), "{what}, voxel {i}: {g}, expected {e}");
    }
}

#[test]
fn equals_the_definition_for_every_type_window_tie_and_brick() {
    let radii = [[1, 1, 1], [2, 3, 1], [0, 2, 4], [3, 0, 0], [0, 0, 0], [3, 5, 200]];
    for (case, dtype) in DType::ALL.into_iter().enumerate() {
        for (s, shape) in SHAPES.into_iter().enumerate() {
            let v = volume(dtype, shape, (case * 7 + s) as u64);
            for (r, radius) in radii.into_iter().enumerate() {
                let p = params(radius, [Some(5), None, Some(12)][(r + s) % 3], (r + s + case) % 2 == 1);
                for (window, ties) in [WindowShape::Box, WindowShape::Ball]
                    .into_iter()
                    .flat_map(|w| [Ties::Le, Ties::Mid].map(|t| (w, t)))
                {
                    let expect = reference(&v, shape, &p, window, ties);
                    for level in Level::available() {
                        for edge in [5, 128] {
                            let got = bricks(&v, shape, &p, window, ties, edge, level);
                            same(
                                &got,
                                &expect,
                                &format!("{dtype} {shape:?} {p:?} {window:?} {ties:?} {level:?} {edge}"),
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn larger_windows_count_past_narrow_counters() {
    let shape = [3, 9, 420];
    for dtype in [DType::U8, DType::I8, DType::I16, DType::F32] {
        let v = volume(dtype, shape, 4);
        for (radius, ties) in [([4, 9, 60], Ties::Mid), ([1, 2, 140], Ties::Le), ([2, 8, 400], Ties::Le)] {
            let p = params(radius, if ties == Ties::Mid { None } else { Some(5) }, dtype == DType::I8);
            let expect = reference(&v, shape, &p, WindowShape::Box, ties);
            for level in Level::available() {
                same(
                    &bricks(&v, shape, &p, WindowShape::Box, ties, 1000, level),
                    &expect,
                    &format!("{dtype} {level:?}"),
                );
            }
        }
    }
}

#[test]
fn constants_and_infinities() {
    let p = params([2, 2, 2], None, false);
    for dtype in DType::ALL {
        for value in [0.0, 127.0, dtype.range().0, dtype.range().1] {
            let v = constant(dtype, [3, 4, 5], value);
            for (ties, expect) in [(Ties::Le, 1.0), (Ties::Mid, 0.5)] {
                for window in [WindowShape::Box, WindowShape::Ball] {
                    let got = bricks(&v, [3, 4, 5], &p, window, ties, 100, Level::detect());
                    assert!(got.iter().all(|o| *o == expect), "{dtype} {value} {ties:?}");
                }
            }
        }
    }
    let (inf, shape) = (f32::INFINITY, [1, 1, 4]);
    let v = Voxels::F32(vec![1.0, inf, -inf, 2.0]);
    let run = |p: &WindowParams| bricks(&v, shape, p, WindowShape::Box, Ties::Le, 9, Level::detect());
    assert_eq!(run(&params([0, 0, 1], None, false)), [0.5, 1.0, 0.0, 1.0]);
    assert_eq!(run(&params([0, 0, 1], None, true)), [1.0, 0.0, 1.0, 0.5]);
}

#[test]
fn a_ball_is_decided_in_integers() {
    // 3-4-5: a voxel exactly on the sphere belongs to it
    let reach = ball([5, 5, 5], [5, 5, 5]);
    assert_eq!(reach[(3 + 5) * 11 + 4 + 5], Some(0));
    assert_eq!(reach[(4 + 5) * 11 + 4 + 5], None);
    assert_eq!(reach[5 * 11 + 5], Some(5));
    assert_eq!(ball([0, 1, 2], [0, 1, 2]), [Some(0), Some(2), Some(0)]);
    assert_eq!(ball([usize::MAX, 0, 0], [1, 0, 0]), [Some(0), Some(0), Some(0)]);
}

/// The coded kernel itself, whatever the size of the window.
fn coded_openness<T: ToKey<K>, K: coded::Index>(v: View<T>, p: &WindowParams, ties: Ties, level: Level) -> Vec<f64> {
    let plan = Plan::new(v.shape, v.shape, [0; 3], p.radius, WindowShape::Box, ties);
    let mut scratch = Scratch::new();
    let bytes = scratch.take(coded::scratch_bytes::<K>(&plan));
    bytes.fill(0xa5);
    let mut out = vec![7f32; v.data.len()];
    let source = coded::Source { view: v, missing: missing_as(p.missing), flipped: p.flipped() };
    let dst = &mut crate::grid::ViewMut::dense(&mut out, v.shape);
    coded::count_all::<T, K>(level, &source, &plan, bytes, dst);
    out.into_iter().map(f64::from).collect()
}

#[test]
fn thresholds_and_buckets_count_as_the_definition_says() {
    let radii = [[1, 1, 1], [2, 3, 1], [0, 2, 4], [3, 0, 0], [0, 0, 0], [3, 5, 200]];
    for (s, shape) in [[1, 1, 1], [7, 1, 9], [9, 11, 37], [70, 3, 5], [2, 70, 67], [5, 6, 140]].into_iter().enumerate()
    {
        let few = volume(DType::U8, shape, s as u64);
        let mut noise = crate::kernel::hostile::Noise(s as u64);
        // More values than thresholds, a few of them often.
        let n = shape.iter().product();
        let many: Vec<u16> = (0..n).map(|_| if noise.below(4) == 0 { 5 } else { noise.next() as u16 }).collect();
        for (r, radius) in radii.into_iter().enumerate() {
            let p = params(radius, [Some(5), None, Some(12)][(r + s) % 3], (r + s) % 2 == 1);
            for (ties, level) in
                [Ties::Le, Ties::Mid].into_iter().flat_map(|t| Level::available().into_iter().map(move |l| (t, l)))
            {
                let expect = reference(&few, shape, &p, WindowShape::Box, ties);
                let Voxels::U8(v) = &few else { unreachable!() };
                let got = coded_openness::<u8, i8>(View::dense(v, shape), &p, ties, level);
                same(&got, &expect, &format!("u8 {shape:?} {p:?} {ties:?} {level:?}"));
                let expect = reference(&Voxels::U16(many.clone()), shape, &p, WindowShape::Box, ties);
                let got = coded_openness::<u16, i16>(View::dense(&many, shape), &p, ties, level);
                same(&got, &expect, &format!("u16 {shape:?} {p:?} {ties:?} {level:?}"));
            }
        }
    }
}

#[test]
fn all_256_values_of_a_byte_are_thresholds() {
    let shape = [8, 16, 40];
    let v: Vec<u8> = (0..8 * 16 * 40).map(|i: usize| (i * 37 % 256) as u8).collect();
    for (missing, low) in [(None, false), (Some(0), false), (Some(255), true), (Some(100), false)] {
        let p = params([2, 3, 9], missing, low);
        for ties in [Ties::Le, Ties::Mid] {
            let expect = reference(&Voxels::U8(v.clone()), shape, &p, WindowShape::Box, ties);
            for level in Level::available() {
                let got = coded_openness::<u8, i8>(View::dense(&v, shape), &p, ties, level);
                same(&got, &expect, &format!("{missing:?} {low} {ties:?} {level:?}"));
            }
        }
    }
}

#[test]
fn groups_of_thresholds_that_a_part_of_a_plane_asks_for() {
    // A slope through all groups, which come and go from plane to plane.
    let shape = [6, 70, 90];
    let mut noise = crate::kernel::hostile::Noise(3);
    let shift = [0, 90, 0, 150, 10, 200];
    let whole = Region::whole(shape);
    let at = |q: [i64; 3]| (q[1] * 2 + q[2] / 2 + shift[q[0] as usize]) as usize;
    let v: Vec<u8> = whole.iter().map(|q| ((at(q) + noise.below(9)) % 256) as u8).collect();
    for (missing, low) in [(None, false), (None, true), (Some(77), false)] {
        let p = params([1, 3, 4], missing, low);
        for ties in [Ties::Le, Ties::Mid] {
            let expect = reference(&Voxels::U8(v.clone()), shape, &p, WindowShape::Box, ties);
            for level in Level::available() {
                let got = coded_openness::<u8, i8>(View::dense(&v, shape), &p, ties, level);
                same(&got, &expect, &format!("{missing:?} {low} {ties:?} {level:?}"));
            }
        }
    }
}
