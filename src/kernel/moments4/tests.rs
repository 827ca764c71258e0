//! The bounds against the exact count and the reference, and the kernel in other bricks and on other levels.

use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::Affine;
use crate::grid::Region;
use crate::kernel::hostile::{Noise, SHAPES, constant, volume};
use crate::kernel::levels::Levels;
use crate::kernel::rank::rank;
use crate::stage::WindowShape;
use crate::{with_view, with_voxels};

const CHANNELS: [Bound; 3] = [Bound::Openness, Bound::Lower, Bound::Upper];

fn params(radius: [usize; 3], missing: Option<i64>, solid_low: bool) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing, solid_low }
}

/// Codes of a volume's finite voxels, as a pre-pass finds them; none where the type needs none.
fn codes_of(v: &Voxels, p: &WindowParams) -> Option<Codes> {
    if !needs_codes(v.dtype()) {
        return None;
    }
    let lost = |w: f64| !w.is_finite() || !v.dtype().is_float() && p.missing.is_some_and(|m| m as f64 == w);
    let mut all: Vec<f64> = (0..v.len()).map(|i| v.at(i) + 0.0).filter(|v| !lost(*v)).collect();
    all.sort_by(f64::total_cmp);
    let mut values: Vec<(f64, u64)> = Vec::new();
    for v in all {
        match values.last_mut() {
            Some((last, n)) if *last == v => *n += 1,
            _ => values.push((v, 1)),
        }
    }
    Some(Codes::new(&Levels::choose(&values, 64)))
}

/// Openness, lower, upper by the kernel over bricks of one edge, each with its halo cut at the volume.
fn bricks(v: &Voxels, shape: Shape, p: &WindowParams, ties: Ties, edge: usize, level: Level) -> [Voxels; 3] {
    let (whole, dtype) = (Region::whole(shape), v.dtype().result());
    let codes = codes_of(v, p);
    let mut got = [(); 3].map(|()| Voxels::zeroed(dtype, v.len()));
    let mut scratch = Scratch::new();
    for cell in whole.cells([0; 3], [edge; 3]).iter() {
        let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
        let grown = part.grow(p.radius).clip(&whole);
        let mut brick = Voxels::zeroed(v.dtype(), grown.voxels());
        crate::brick::gather::copy_common(v.view(shape), whole, brick.view_mut(grown.shape()), grown);
        let mut out = [(); 3].map(|()| Voxels::zeroed(dtype, part.voxels()));
        scratch.take(1000).fill(0xa5);
        let mut cx = Context { level, scratch: &mut scratch };
        let mut outs: Vec<BoundOut> = (out.iter_mut().zip(CHANNELS))
            .map(|(o, channel)| BoundOut { channel, dst: o.view_mut(part.shape()) })
            .collect();
        moments4(brick.view(grown.shape()), codes.as_ref(), p, ties, grown.offset_of(&part), &mut outs, &mut cx);
        drop(outs);
        for (out, got) in out.iter().zip(&mut got) {
            crate::brick::gather::copy_common(out.view(part.shape()), part, got.view_mut(shape), whole);
        }
    }
    got
}

fn exact(v: &Voxels, shape: Shape, p: &WindowParams, ties: Ties) -> Voxels {
    let mut out = Voxels::zeroed(v.dtype().result(), v.len());
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    rank(v.view(shape), p, WindowShape::Box, ties, [0; 3], out.view_mut(shape), &mut cx);
    out
}

fn same(a: &[Voxels; 3], b: &[Voxels; 3]) -> bool {
    let bits = |v: &Voxels| (0..v.len()).map(|i| v.at(i).to_bits()).collect::<Vec<_>>();
    a.iter().zip(b).all(|(a, b)| bits(a) == bits(b))
}

/// Everything that holds for any volume; the mean width of the bounds.
fn check(v: &Voxels, shape: Shape, p: &WindowParams, ties: Ties, what: &str) -> f64 {
    let count = exact(v, shape, p, ties);
    let got = bricks(v, shape, p, ties, 1000, Level::detect());
    for level in Level::available() {
        assert!(
            same(&got, &bricks(v, shape, p, ties, 1000, level)),
            "{what} {shape:?} {p:?} {ties:?}: {level:?} shows"
        );
    }
    assert!(same(&got, &bricks(v, shape, p, ties, 7, Level::detect())), "{what} {shape:?} {p:?} {ties:?}: bricks show");
    let [open, lower, upper] = got;
    let (mut width, mut voxels) = (0.0, 0.0);
    for i in 0..v.len() {
        let (o, l, u, e) = (open.at(i), lower.at(i), upper.at(i), count.at(i));
        let ordered = 0.0 <= l && l <= e && e <= u && u <= 1.0 && l <= o && o <= u;
        let gone = [o, l, u, e].iter().all(|v| v.is_nan());
        assert!(ordered || gone, "{what} {} {shape:?} {p:?} {ties:?}, voxel {i}: {l} {e} {u}, middle {o}", v.dtype());
        if !gone {
            (width, voxels) = (width + (u - l), voxels + 1.0);
        }
    }
    width / f64::max(voxels, 1.0)
}

#[test]
fn the_exact_count_lies_between_the_bounds_of_every_type_tie_and_brick() {
    let radii = [[1, 1, 1], [2, 3, 1], [0, 2, 4], [3, 0, 0], [0, 0, 0], [5, 5, 5], [3, 5, 200]];
    for (case, dtype) in DType::ALL.into_iter().enumerate() {
        for (s, shape) in SHAPES.into_iter().enumerate() {
            let v = volume(dtype, shape, (case * 7 + s) as u64);
            for (r, radius) in radii.into_iter().enumerate() {
                let p = params(radius, [Some(5), None, Some(12)][(r + s) % 3], (r + s + case) % 2 == 1);
                for ties in [Ties::Le, Ties::Mid] {
                    check(&v, shape, &p, ties, "hostile");
                }
            }
        }
    }
}

/// A volume by a function of place and noise, within the type.
fn field(dtype: DType, shape: Shape, of: impl Fn([i64; 3], &mut Noise) -> f64) -> Voxels {
    let mut noise = Noise(5);
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    let values: Vec<f64> = Region::whole(shape).iter().map(|c| of(c, &mut noise)).collect();
    with_voxels!(&mut v, d => d.iter_mut().zip(values).for_each(|(d, v)| *d = Voxel::from_f64(v)));
    v
}

#[test]
fn hostile_fields() {
    let shape = [11, 13, 43];
    for dtype in [DType::U8, DType::I8, DType::U16, DType::I16, DType::I32, DType::F32, DType::F64] {
        let (lo, hi) = if dtype.is_float() { (-3e38, 3e38) } else { dtype.range() };
        let span = if dtype.is_float() { 1e4 } else { hi - lo };
        let base = if dtype.is_float() { 1e4 } else { hi - 4.0 };
        let place = |[z, y, x]: [i64; 3]| (z * 70 + y * 11 + x) as f64;
        type Of<'a> = &'a dyn Fn([i64; 3], &mut Noise) -> f64;
        // The field, and the mean width of its bounds at radius 3 that must not be passed.
        let fields: [(&str, Of, f64); 9] = [
            ("constant", &|_, _| base, 0.0),
            ("two values", &|_, n| if n.below(3) == 0 { base } else { base + 1.0 }, 1e-7),
            ("three values", &|_, n| base + n.below(3) as f64, 0.4),
            ("outlier", &|c, _| if c == [5, 6, 20] { hi } else { lo }, 1e-7),
            ("outlier in noise", &|c, n| if c == [5, 6, 20] { hi } else { base + n.below(4) as f64 }, 0.5),
            ("ramp", &|c, _| lo / 4.0 + span * place(c) / 2000.0, 0.55),
            ("noise", &|_, n| lo / 4.0 + n.unit() * span / 2.0, 0.45),
            ("extremes", &|c, _| if (c[0] + c[1] + c[2]) % 2 == 0 { lo } else { hi }, 1e-7),
            ("tail", &|_, n| lo / 4.0 + span / 2.0 * n.unit().powi(9), 0.7),
        ];
        for (name, of, widest) in fields {
            let v = field(dtype, shape, of);
            for (r, ties) in [1, 2, 3, 4, 5].into_iter().flat_map(|r| [(r, Ties::Le), (r, Ties::Mid)]) {
                let p = params([r; 3], None, r % 2 == 0);
                let width = check(&v, shape, &p, ties, name);
                assert!(r != 3 || width <= widest, "{name} {dtype} {ties:?}: bounds of width {width}");
                if name == "two values" || name == "extremes" || name == "outlier" {
                    let (count, [open, ..]) =
                        (exact(&v, shape, &p, ties), bricks(&v, shape, &p, ties, 50, Level::detect()));
                    let worst = (0..v.len()).map(|i| (open.at(i) - count.at(i)).abs()).fold(0.0, f64::max);
                    assert!(
                        worst <= 1e-7,
                        "{name} {dtype} {ties:?} {r}: {worst} off although two values are known exactly"
                    );
                }
            }
        }
    }
}

#[test]
fn floats_of_any_size() {
    let shape = [9, 10, 31];
    let tiny = f64::from_bits(1);
    for (name, offset, step) in [
        ("denormals", 0.0, tiny),
        ("small", 0.0, 1e-300),
        ("huge", 0.0, 1e303),
        ("offset", 1e30, 1e16),
        ("negative offset", -1e300, 1e290),
    ] {
        let v = field(DType::F64, shape, |_, n| offset + step * n.below(1000) as f64);
        let width = check(&v, shape, &params([2; 3], None, false), Ties::Mid, name);
        assert!(width < 0.45, "{name}: bounds of width {width}");
    }
    let v = field(DType::F32, shape, |c, n| match n.below(30) {
        0 => f64::NAN,
        1 => f64::INFINITY,
        2 => f64::NEG_INFINITY,
        3 => f64::from(f32::MAX),
        _ if c[2] < 15 => 7.0,
        _ => n.unit(),
    });
    for ties in [Ties::Le, Ties::Mid] {
        check(&v, shape, &params([2; 3], None, ties == Ties::Mid), ties, "scattered");
    }
}

#[test]
fn windows_whose_sums_pass_64_bits() {
    // 2^15 voxels and more, of differences up to 2^16.
    let shape = [40, 41, 47];
    for dtype in [DType::U16, DType::I16, DType::F32] {
        let v = volume(dtype, shape, 4);
        for (radius, low) in [([16, 15, 16], false), ([40, 41, 60], true)] {
            let p = params(radius, Some(5), low);
            let codes = codes_of(&v, &p);
            let [_, lower, upper] = bricks(&v, shape, &p, Ties::Mid, 1000, Level::detect());
            let count = exact(&v, shape, &p, Ties::Mid);
            let mut places = Noise(3);
            for _ in 0..400 {
                let c = shape.map(|n| places.below(n));
                let i = (c[0] * shape[1] + c[1]) * shape[2] + c[2];
                let (l, u, e) = (lower.at(i), upper.at(i), count.at(i));
                assert!(l <= e && e <= u || e.is_nan() && l.is_nan(), "{dtype} {radius:?} {c:?}: {l} {e} {u}");
                if e.is_nan() || v.at(i).is_infinite() {
                    continue;
                }
                let r = with_view!(AnyView, v.view(shape), v => reference::voxel(v, c, codes.as_ref(), &p));
                close(r, l * r.n - 0.5, u * r.n + 0.5, &format!("{dtype} {radius:?} {c:?}"));
            }
        }
    }
}

/// Bounds of counts, made whole, against the textbook's.
fn close(r: reference::Bounds, lower: f64, upper: f64, what: &str) {
    if r.condition < 1e-6 {
        return;
    }
    let within = |whole: f64, real: f64| (whole - real).abs() <= 1.0 + 1e-6 * r.n;
    assert!(within(lower, r.lower) && within(upper, r.upper), "{what}: {lower} {upper}, expected {r:?}");
}

#[test]
fn bounds_are_the_best_that_four_moments_allow() {
    for dtype in [DType::U8, DType::I8, DType::U16, DType::I16, DType::U32, DType::F32, DType::F64] {
        for (s, shape) in [[9, 11, 37], [5, 6, 70]].into_iter().enumerate() {
            let all = volume(dtype, shape, s as u64);
            for radius in [[1; 3], [2, 3, 4], [5; 3]] {
                let p = params(radius, Some(5), s == 1);
                let codes = codes_of(&all, &p);
                let [_, lower, upper] = bricks(&all, shape, &p, Ties::Mid, 1000, Level::detect());
                let mut seen = 0;
                for (i, c) in Region::whole(shape).iter().enumerate() {
                    if lower.at(i).is_nan() || all.at(i).is_infinite() {
                        continue;
                    }
                    let c = c.map(|c| c as usize);
                    let r = with_view!(AnyView, all.view(shape), v => reference::voxel(v, c, codes.as_ref(), &p));
                    close(r, lower.at(i) * r.n - 0.5, upper.at(i) * r.n + 0.5, &format!("{dtype} {radius:?} {c:?}"));
                    seen += (r.condition >= 1e-6) as usize;
                }
                assert!(seen > lower.len() / 4, "{dtype} {radius:?}: {seen} of {} windows judged", lower.len());
            }
        }
    }
}

#[test]
fn constants_and_infinities_are_what_the_count_is() {
    for dtype in DType::ALL {
        let v = constant(dtype, [6, 7, 8], 5.0);
        for (ties, open) in [(Ties::Le, 1.0), (Ties::Mid, 0.5)] {
            let got = bricks(&v, [6, 7, 8], &params([2; 3], None, false), ties, 4, Level::detect());
            assert!(got.iter().all(|g| (0..g.len()).all(|i| g.at(i) == open)), "{dtype} {ties:?}");
        }
    }
    // Equal codes of unequal values, and of equal ones: the ends are far away, and the middle is all one code.
    let shape = [3, 3, 60];
    let v = field(DType::F64, shape, |c, n| match c[2] {
        0 => -1e9,
        59 => 1e9,
        x if x < 30 => 1.0 + 1e-9 * n.below(1000) as f64,
        x => f64::from(x as i32 / 15),
    });
    let width = check(&v, shape, &params([1; 3], None, false), Ties::Le, "one code");
    assert!(width > 0.1 && width < 0.9, "{width}");
}
