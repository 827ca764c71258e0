//! The kernel against its reference, closed forms, and itself in other bricks and on other levels.

use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::Affine;
use crate::kernel::simd::Level;
use crate::stage::{Method, Ties};

const METHODS: [Method; 5] =
    [Method::CdfPower, Method::GaussianCdf, Method::Chebyshev, Method::ChebyshevLiteral, Method::Beta];

fn params(radius: [usize; 3]) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false }
}

fn all_channels() -> Vec<WindowChannel> {
    use WindowChannel::*;
    let open = METHODS.iter().flat_map(|m| [Openness(*m, Ties::Le), Openness(*m, Ties::Mid)]);
    [Mean, Min, Max, Variance, Std, Moment2].into_iter().chain(open).collect()
}

fn out_dtype(input: DType, p: &WindowParams, channel: WindowChannel) -> DType {
    let extreme = matches!(channel, WindowChannel::Min | WindowChannel::Max);
    if extreme && p.affine.is_identity() { input } else { input.result() }
}

/// Every channel for the box `lo..hi` of a volume, given its clipped halo box, as a run would.
fn brick(
    volume: &Voxels,
    shape: Shape,
    p: &WindowParams,
    lo: [usize; 3],
    hi: [usize; 3],
    channels: &[WindowChannel],
    level: Level,
) -> Vec<Voxels> {
    let from: [usize; 3] = std::array::from_fn(|a| lo[a].saturating_sub(p.radius[a]));
    let to: [usize; 3] = std::array::from_fn(|a| (hi[a] + p.radius[a]).min(shape[a]));
    let size: Shape = std::array::from_fn(|a| to[a] - from[a]);
    let dst: Shape = std::array::from_fn(|a| hi[a] - lo[a]);
    let at = std::array::from_fn(|a| lo[a] - from[a]);
    // Dirty outputs: every voxel must be written.
    let mut results: Vec<Voxels> = channels
        .iter()
        .map(|c| {
            let mut v = Voxels::zeroed(out_dtype(volume.dtype(), p, *c), dst.iter().product());
            v.fill(77.0);
            v
        })
        .collect();
    let mut outs: Vec<WindowOut> =
        results.iter_mut().zip(channels).map(|(r, c)| WindowOut { channel: *c, dst: r.view_mut(dst) }).collect();
    let mut scratch = Scratch::new();
    scratch.take(100).fill(0xa5);
    let mut cx = Context { level, scratch: &mut scratch };
    let any = volume.view(shape);
    macro_rules! part {
        ($($v:ident),*) => { match any { $(AnyView::$v(v) => AnyView::$v(v.part(from, size)),)* } };
    }
    window(part!(U8, I8, U16, I16, U32, I32, F32, F64), p, Place::new(at, lo.map(|v| v as i64)), &mut outs, &mut cx);
    let promised = scratch_bytes(volume.dtype(), size, dst, p, channels);
    assert!(scratch.bytes() <= promised.max(128), "{} bytes taken, {promised} promised", scratch.bytes());
    results
}

fn reference_at(volume: &Voxels, shape: Shape, c: [usize; 3], p: &WindowParams, channel: WindowChannel) -> f64 {
    crate::with_view!(AnyView, volume.view(shape), v => reference::voxel(v, c, p, channel))
}

/// Error allowed for a channel, given the exact value: half a unit of the result type and a little, and what the
/// contract says about openness and the variance of floats.
fn tolerance(input: DType, channel: WindowChannel, exact: f64, mean: f64) -> f64 {
    let unit = if input.result() == DType::F64 { 4.5e-16 } else { 6.1e-8 };
    let least = if input.result() == DType::F64 { 5e-324 } else { 1e-45 };
    match channel {
        WindowChannel::Openness(..) => 3e-6,
        WindowChannel::Variance | WindowChannel::Std if input.is_float() => 1e-6 * exact.abs() + least,
        WindowChannel::Moment2 => unit * exact.abs().max(mean * mean) * 4.0 + least,
        WindowChannel::Mean => unit * mean + least,
        _ => unit * exact.abs() + least,
    }
}

/// The whole volume on every level against the reference at every `every`-th voxel; bits equal between levels.
fn check(name: &str, volume: &Voxels, shape: Shape, p: &WindowParams, every: usize) {
    let channels = all_channels();
    let mut first: Option<Vec<Voxels>> = None;
    for level in Level::available() {
        let got = brick(volume, shape, p, [0; 3], shape, &channels, level);
        if let Some(first) = &first {
            for (i, (a, b)) in first.iter().zip(&got).enumerate() {
                assert!(a.as_bytes() == b.as_bytes(), "{name}: {:?} differs on {level:?}", channels[i]);
            }
            continue;
        }
        for i in (0..volume.len()).step_by(every) {
            let c = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]];
            // The terms of `a mean + b`, which may cancel.
            let mean = reference_at(volume, shape, c, p, WindowChannel::Mean);
            let mean = (mean - p.affine.intercept).abs() + p.affine.intercept.abs();
            for (k, channel) in channels.iter().enumerate() {
                let (exact, value) = (reference_at(volume, shape, c, p, *channel), got[k].at(i));
                if exact.is_nan() {
                    assert!(
                        value.is_nan() || !got[k].dtype().is_float() && value == 0.0,
                        "{name}: {channel:?} at {c:?}: {value} for a missing voxel"
                    );
                    continue;
                }
                if value == exact || got[k].dtype() == DType::F32 && value == exact as f32 as f64 {
                    continue;
                }
                let error = (value - exact).abs();
                let allowed = tolerance(volume.dtype(), *channel, exact, mean);
                assert!(
                    error <= allowed,
                    "{name} {p:?}: {channel:?} at {c:?}: {value} for {exact}, off by {error:e} (allowed {allowed:e})"
                );
            }
        }
        first = Some(got);
    }
}

fn random(seed: u64) -> impl FnMut() -> u64 {
    let mut s = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        s ^= s << 13;
        s ^= s >> 7;
        s ^= s << 17;
        s.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }
}

/// About N(0, 1).
fn noise(next: &mut impl FnMut() -> u64) -> f64 {
    (0..12).map(|_| (next() >> 11) as f64 / (1u64 << 53) as f64).sum::<f64>() - 6.0
}

fn make(dtype: DType, shape: Shape, mut f: impl FnMut(usize) -> f64) -> Voxels {
    fn set<T: Voxel>(v: &mut [T], f: &mut impl FnMut(usize) -> f64) {
        for (i, v) in v.iter_mut().enumerate() {
            *v = T::from_f64(f(i));
        }
    }
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    crate::with_voxels!(&mut v, d => set(d, &mut f));
    v
}

fn noisy(dtype: DType, shape: Shape, seed: u64) -> Voxels {
    let mut next = random(seed);
    let (lo, hi) = dtype.range();
    make(dtype, shape, |_| {
        if dtype.is_float() {
            100.0 * noise(&mut next)
        } else {
            lo + (next() >> 11) as f64 / (1u64 << 53) as f64 * (hi - lo)
        }
    })
}

const SHAPE: Shape = [9, 13, 37];

#[test]
fn every_type_and_channel_equals_the_reference() {
    for dtype in DType::ALL {
        let volume = noisy(dtype, SHAPE, 3);
        for radius in [[0, 0, 0], [1, 1, 1], [2, 3, 4], [0, 5, 0], [4, 0, 9], [30, 50, 100]] {
            let every = if radius[0] > 9 { 97 } else { 7 };
            check("noise", &volume, SHAPE, &params(radius), every);
        }
    }
}

#[test]
fn thin_volumes_and_single_voxels() {
    for dtype in [DType::I8, DType::U16, DType::F32, DType::F64] {
        for shape in [[1, 1, 1], [1, 1, 70], [1, 40, 1], [33, 1, 1], [2, 65, 3], [3, 2, 129]] {
            let volume = noisy(dtype, shape, 5);
            for radius in [[1, 1, 1], [3, 3, 3], [70, 70, 70]] {
                check("thin", &volume, shape, &params(radius), 3);
            }
        }
    }
}

#[test]
fn scaled_values_low_solid_and_missing_voxels() {
    for dtype in DType::ALL {
        let mut next = random(11);
        let (lo, _) = dtype.range();
        let mut volume = noisy(dtype, SHAPE, 7);
        // A fifth of the voxels missing, and a slab of nothing else.
        let gone = if dtype.is_float() { f64::NAN } else { lo + 3.0 };
        let plane = SHAPE[1] * SHAPE[2];
        fn set<T: Voxel>(v: &mut [T], i: usize, x: f64) {
            v[i] = T::from_f64(x);
        }
        for i in 0..volume.len() {
            if next().is_multiple_of(5) || (4 * plane..6 * plane).contains(&i) {
                crate::with_voxels!(&mut volume, v => set(v, i, gone));
            }
        }
        for (slope, intercept) in [(1.0, 0.0), (-0.5, 12.25), (2.0, -3.0)] {
            for solid_low in [false, true] {
                for radius in [[1, 1, 1], [2, 3, 4]] {
                    let mut p = params(radius);
                    p.affine = Affine::new(slope, intercept);
                    p.solid_low = solid_low;
                    p.missing = (!dtype.is_float()).then_some(gone as i64);
                    check("missing", &volume, SHAPE, &p, 11);
                }
            }
        }
    }
}

#[test]
fn hostile_integers() {
    let shape = [7, 9, 40];
    let p = params([2, 3, 5]);
    let mut next = random(17);
    check("all 65535", &make(DType::U16, shape, |_| 65535.0), shape, &p, 5);
    check("65535 less a little", &make(DType::U16, shape, |_| 65535.0 - (next() % 3) as f64), shape, &p, 5);
    check("one low", &make(DType::U16, shape, |i| if i == 1200 { 65534.0 } else { 65535.0 }), shape, &p, 1);
    check("extremes", &make(DType::I16, shape, |i| if i % 3 == 0 { -32768.0 } else { 32767.0 }), shape, &p, 5);
    check("least", &make(DType::I8, shape, |_| -128.0), shape, &p, 5);
    check("one high", &make(DType::I8, shape, |i| if i == 1201 { 127.0 } else { -128.0 }), shape, &p, 1);
    for dtype in [DType::U32, DType::I32] {
        let top = dtype.range().1;
        check("top", &make(dtype, shape, |_| top), shape, &p, 5);
        check("top less one", &make(dtype, shape, |i| top - (i % 2) as f64), shape, &p, 5);
    }
}

#[test]
fn hostile_floats() {
    let shape = [7, 9, 40];
    let p = params([2, 3, 5]);
    let mut next = random(19);
    let mut n = || noise(&mut next);
    for dtype in [DType::F32, DType::F64] {
        check("0.1", &make(dtype, shape, |_| 0.1f32 as f64), shape, &p, 5);
        check("offset 1e6", &make(dtype, shape, |_| 1e6 + n()), shape, &p, 5);
        check("0 beside 1e6", &make(dtype, shape, |i| if i % 40 < 20 { 0.0 } else { 1e6 + n() }), shape, &p, 3);
        check("step of 1e6", &make(dtype, shape, |i| if i % 40 < 20 { n() } else { 1e6 + n() }), shape, &p, 3);
        check(
            "two bands",
            &make(dtype, shape, |i| if i % 40 < 20 { 1e-3 * n() } else { 1e3 + 1e-3 * n() }),
            shape,
            &p,
            3,
        );
        check("denormals", &make(dtype, shape, |i| (i % 7) as f64 * 1e-45), shape, &p, 5);
        check("wide range", &make(dtype, shape, |i| [1e30, 1e-40, 3e-30, -1e20, 0.0][i % 5]), shape, &p, 3);
        check(
            "nearly all low",
            &make(dtype, shape, |i| if i % 300 == 7 { 1e30 } else { 1e-30 * (i % 9) as f64 }),
            shape,
            &p,
            3,
        );
        check("one ulp", &make(dtype, shape, |i| if i == 1203 { 0.999_999_94 } else { 1.0 }), shape, &p, 1);
        let gaps = |i: usize| match i {
            1203 => 0.999_999_94,
            i if i % 7 == 3 => f64::NAN,
            _ => 1.0,
        };
        check("one ulp beside gaps", &make(dtype, shape, gaps), shape, &p, 1);
        check("huge", &make(dtype, shape, |_| 1e36 * n()), shape, &p, 5);
    }
    check("offset 1e15", &make(DType::F64, shape, |_| 1e15 + (10.0 * n()).round()), shape, &p, 3);
    check("offset 1e30", &make(DType::F64, shape, |_| 1e30 + 1e18 * n()), shape, &p, 3);
}

#[test]
fn wide_sums_of_long_windows() {
    // Sections and windows beyond the narrow sums: a 6 x 120 x 340 volume in one window (n = 244800).
    let shape = [6, 120, 340];
    for (dtype, v) in [(DType::U8, 255.0), (DType::U16, 65535.0), (DType::U32, 4294967295.0)] {
        let volume = make(dtype, shape, |i| v - (i % 7 / 6) as f64);
        check("long", &volume, shape, &params([3, 130, 170]), 61_001);
    }
}

#[test]
fn long_windows_in_many_batches_and_tiles() {
    // Groups of lines are kept from batch to batch along z (of 32 planes) and made anew per tile (of 68 rows) along y.
    let shape = [75, 80, 90];
    for (dtype, missing) in [(DType::U8, None), (DType::I16, Some(77)), (DType::U32, None), (DType::F32, None)] {
        let mut next = random(47);
        let volume = make(dtype, shape, |i| ((next() >> 40) % 120 + (i / 9000) as u64) as f64);
        for radius in [[16, 17, 40], [37, 16, 3], [2, 31, 70]] {
            let mut p = params(radius);
            p.missing = missing;
            check("long", &volume, shape, &p, 53_003);
            check_bricks(&volume, shape, &p, [43, 71, 61]);
        }
    }
}

#[test]
fn long_float_windows_in_short_last_tiles() {
    let shape = [3, 9, 771]; // two tiles along x, the last of 379 voxels
    for dtype in [DType::F32, DType::F64] {
        check("short tile", &noisy(dtype, shape, 43), shape, &params([1, 2, 64]), 401);
    }
}

/// Bits of every channel must not depend on the brick.
fn check_bricks(volume: &Voxels, shape: Shape, p: &WindowParams, cuts: [usize; 3]) {
    let channels = all_channels();
    let level = Level::detect();
    let whole = brick(volume, shape, p, [0; 3], shape, &channels, level);
    for z in (0..shape[0]).step_by(cuts[0]) {
        for y in (0..shape[1]).step_by(cuts[1]) {
            for x in (0..shape[2]).step_by(cuts[2]) {
                let lo = [z, y, x];
                let hi = std::array::from_fn(|a| (lo[a] + cuts[a]).min(shape[a]));
                let part = brick(volume, shape, p, lo, hi, &channels, level);
                let size: Shape = std::array::from_fn(|a| hi[a] - lo[a]);
                for (k, (w, q)) in whole.iter().zip(&part).enumerate() {
                    let bytes = w.dtype().size();
                    for r in 0..size[0] * size[1] {
                        let start = ((z + r / size[1]) * shape[1] + y + r % size[1]) * shape[2] + x;
                        let a = &w.as_bytes()[start * bytes..(start + size[2]) * bytes];
                        let b = &q.as_bytes()[r * size[2] * bytes..(r + 1) * size[2] * bytes];
                        assert!(a == b, "{:?} of {} at {lo:?}, row {r}", channels[k], volume.dtype());
                    }
                }
            }
        }
    }
}

#[test]
fn bricks_never_show() {
    let shape = [19, 23, 75];
    for dtype in [DType::U8, DType::I16, DType::U32, DType::F32, DType::F64] {
        let volume = noisy(dtype, shape, 23);
        for radius in [[2, 2, 2], [4, 5, 6], [10, 11, 12], [40, 40, 80]] {
            check_bricks(&volume, shape, &params(radius), [5, 7, 31]);
            check_bricks(&volume, shape, &params(radius), [19, 1, 70]);
        }
    }
}

#[test]
fn equal_values_beside_missing_ones_have_no_variance() {
    let shape = [9, 11, 40];
    for dtype in [DType::F32, DType::F64] {
        for (value, share) in [(0.1, 0.05), (-7.3e9, 0.4), (1.0 / 3.0, 0.9)] {
            let mut next = random(31);
            let mut gap = || (next() >> 11) as f64 / (1u64 << 53) as f64 <= share;
            let volume = make(dtype, shape, |_| if gap() { f64::NAN } else { value });
            let p = params([2, 3, 4]);
            let channels = [WindowChannel::Variance, WindowChannel::Std];
            for made in brick(&volume, shape, &p, [0; 3], shape, &channels, Level::detect()) {
                for i in 0..made.len() {
                    let expected = if volume.at(i).is_nan() { f64::NAN } else { 0.0 };
                    assert_eq!(
                        made.at(i).to_bits(),
                        expected.to_bits(),
                        "{value} of {dtype}, {share} missing, voxel {i}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_missing_voxel_far_away_changes_no_bit() {
    let shape = [12, 14, 90];
    for dtype in [DType::F32, DType::F64, DType::U16, DType::I8] {
        let mut volume = noisy(dtype, shape, 29);
        let mut p = params([2, 3, 4]);
        let marker = dtype.range().0 + 1.0;
        fn set<T: Voxel>(v: &mut [T], i: usize, x: f64) {
            v[i] = T::from_f64(x);
        }
        for i in 0..volume.len() {
            if volume.at(i) == marker {
                crate::with_voxels!(&mut volume, v => set(v, i, marker + 1.0));
            }
        }
        let channels = all_channels();
        let clean = brick(&volume, shape, &p, [0; 3], shape, &channels, Level::detect());
        p.missing = (!dtype.is_float()).then_some(marker as i64);
        let i = (5 * shape[1] + 6) * shape[2] + 40;
        crate::with_voxels!(&mut volume, v => set(v, i, if dtype.is_float() { f64::NAN } else { marker }));
        let dirty = brick(&volume, shape, &p, [0; 3], shape, &channels, Level::detect());
        let mut near = 0;
        for (k, (a, b)) in clean.iter().zip(&dirty).enumerate() {
            for i in 0..a.len() {
                let c = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]];
                if c[0].abs_diff(5) > 2 || c[1].abs_diff(6) > 3 || c[2].abs_diff(40) > 4 {
                    assert_eq!(a.at(i).to_bits(), b.at(i).to_bits(), "{:?} of {dtype} at {c:?}", channels[k]);
                } else {
                    near += (a.at(i).to_bits() != b.at(i).to_bits()) as usize;
                }
            }
        }
        assert!(near > 1000, "the missing voxel must change the windows that hold it");
        check("one missing", &volume, shape, &p, 29);
    }
}

/// Mean squares that lie halfway between two f32 go to the even one, which takes the sum itself.
#[test]
fn mean_squares_of_integers_are_rounded_once() {
    let shape = [6, 8, 70];
    let p = params([0, 0, 1]);
    for (dtype, spread, least) in
        [(DType::U16, 60000, 2000), (DType::I16, 60000, -30000), (DType::U8, 255, 0), (DType::I8, 255, -128)]
    {
        let volume = make(dtype, shape, |i| ((i * 7919 + i * i * 31) % (spread + 1)) as f64 + least as f64);
        let channels = [WindowChannel::Moment2];
        let v = |i: usize| volume.at(i) as i64;
        for level in Level::available() {
            let got = brick(&volume, shape, &p, [0; 3], shape, &channels, level);
            for i in (0..volume.len()).filter(|i| ![0, shape[2] - 1].contains(&(i % shape[2]))) {
                let squares = [i - 1, i, i + 1].map(|i| v(i) * v(i)).iter().sum::<i64>();
                assert_eq!(got[0].at(i) as f32, third(squares), "{dtype} {level:?} voxel {i}: a third of {squares}");
            }
        }
    }
}

/// A third, as the f32 that is nearest, the even one of two: by whole numbers alone.
fn third(squares: i64) -> f32 {
    let near = (squares as f64 / 3.0) as f32;
    // Six times the distance to a candidate and its neighbours is an integer below 2^53: they are multiples of 2^-20.
    let scaled = |f: f32| 3 * (f as f64 * (1u64 << 20) as f64) as i128;
    let off = |f: f32| (scaled(f) - ((squares as i128) << 20)).abs();
    let around = [near, f32::from_bits(near.to_bits() + 1), f32::from_bits(near.to_bits().saturating_sub(1))];
    let best = around.into_iter().map(off).min().unwrap();
    let mut ties = around.into_iter().filter(|f| off(*f) == best);
    let first = ties.next().unwrap();
    ties.next().map_or(first, |other| if first.to_bits() % 2 == 0 { first } else { other })
}

#[test]
fn infinities_change_only_their_windows() {
    use WindowChannel::*;
    let shape = [5, 6, 60];
    let at = |x: usize| (2 * shape[1] + 3) * shape[2] + x;
    for dtype in [DType::F32, DType::F64] {
        let base = noisy(dtype, shape, 31);
        let volume = make(dtype, shape, |i| match i {
            i if i == at(10) => f64::INFINITY,
            i if i == at(25) => f64::NEG_INFINITY,
            i if i == at(40) || i == at(43) => {
                if i == at(40) {
                    f64::INFINITY
                } else {
                    f64::NEG_INFINITY
                }
            }
            i => base.at(i),
        });
        let channels = all_channels();
        let p = params([1, 1, 2]);
        let clean = brick(&base, shape, &p, [0; 3], shape, &channels, Level::detect());
        let got = brick(&volume, shape, &p, [0; 3], shape, &channels, Level::detect());
        let of = |c: WindowChannel, x: usize| got[channels.iter().position(|k| *k == c).unwrap()].at(at(x));
        let touched = |x: usize| [10usize, 25, 40, 43].iter().any(|i| x.abs_diff(*i) <= 2);
        for (k, c) in channels.iter().enumerate() {
            for i in 0..base.len() {
                let (z, y, x) = (i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]);
                if z.abs_diff(2) > 1 || y.abs_diff(3) > 1 || !touched(x) {
                    assert_eq!(got[k].at(i).to_bits(), clean[k].at(i).to_bits(), "{c:?}");
                }
            }
        }
        let inf = f64::INFINITY;
        assert_eq!((of(Max, 9), of(Min, 26), of(Mean, 9), of(Mean, 26)), (inf, -inf, inf, -inf));
        assert!(of(Mean, 42).is_nan() && of(Variance, 9).is_nan() && of(Std, 26).is_nan());
        assert_eq!((of(Moment2, 9), of(Moment2, 26), of(Moment2, 42)), (inf, inf, inf));
        for m in METHODS {
            let o = |x| of(Openness(m, Ties::Le), x);
            // beside +inf, beside -inf
            let beside = match m {
                Method::GaussianCdf => [f64::NAN; 2],
                Method::Chebyshev => [0.0, f64::NAN],
                Method::ChebyshevLiteral => [1.0, f64::NAN],
                _ => [0.0, 1.0],
            };
            assert_eq!((o(10), o(25)), (1.0, 0.0), "{m:?}");
            for (got, expect) in [o(9), o(26)].into_iter().zip(beside) {
                assert!(got == expect || got.is_nan() && expect.is_nan(), "{m:?}: {got} {expect}");
            }
            assert!(o(42).is_nan());
        }
        let mut low = p;
        low.solid_low = true;
        let got = brick(&volume, shape, &low, [0; 3], shape, &channels, Level::detect());
        let k = channels.iter().position(|c| *c == Openness(Method::CdfPower, Ties::Le)).unwrap();
        assert_eq!([10, 25, 9, 26].map(|x| got[k].at(at(x))), [0.0, 1.0, 1.0, 0.0]);
    }
}

#[test]
fn closed_forms_of_a_ramp() {
    // v = x: mean x, variance (w^2 - 1) / 12, cdf_power 1/2 inside.
    let shape = [8, 8, 64];
    let volume = make(DType::U8, shape, |i| (i % 64) as f64);
    let (channels, p) = (all_channels(), params([2, 2, 5]));
    let got = brick(&volume, shape, &p, [0; 3], shape, &channels, Level::detect());
    for i in (0..volume.len()).filter(|i| (5..59).contains(&(i % 64))) {
        assert_eq!((got[0].at(i), got[3].at(i), got[4].at(i)), ((i % 64) as f64, 10.0, 10f32.sqrt() as f64));
        assert!((got[6].at(i) - 0.5).abs() < 1e-6);
        assert!((got[8].at(i) - 0.5).abs() < 1e-6);
        assert_eq!((got[10].at(i), got[12].at(i)), (0.0, 1.0)); // chebyshev at the mean
    }
}

#[test]
fn codes_of_openness_are_within_half_a_code() {
    for dtype in [DType::U8, DType::I16, DType::F32] {
        let volume = noisy(dtype, SHAPE, 37);
        for method in METHODS {
            let channel = WindowChannel::Openness(method, Ties::Le);
            let p = params([2, 2, 3]);
            let mut codes = vec![0u8; SHAPE.iter().product()];
            let dst = AnyViewMut::U8(crate::grid::ViewMut::dense(&mut codes, SHAPE));
            let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
            window(volume.view(SHAPE), &p, Place::whole([0; 3]), &mut [WindowOut { channel, dst }], &mut cx);
            for (i, code) in codes.iter().enumerate() {
                let c = [i / (SHAPE[1] * SHAPE[2]), i / SHAPE[2] % SHAPE[1], i % SHAPE[2]];
                let exact = 255.0 * reference_at(&volume, SHAPE, c, &p, channel);
                assert!((*code as f64 - exact).abs() <= 0.5 + 2e-4 * 255.0, "{method:?} of {dtype} at {c:?}");
            }
        }
    }
}

#[test]
fn one_channel_alone_equals_the_same_among_others() {
    for dtype in [DType::U8, DType::U16, DType::F32, DType::F64] {
        let volume = noisy(dtype, SHAPE, 41);
        let (channels, p) = (all_channels(), params([2, 3, 4]));
        let all = brick(&volume, SHAPE, &p, [0; 3], SHAPE, &channels, Level::detect());
        for (k, c) in channels.iter().enumerate() {
            let one = brick(&volume, SHAPE, &p, [0; 3], SHAPE, &[*c], Level::detect());
            assert!(one[0].as_bytes() == all[k].as_bytes(), "{c:?} of {dtype}");
        }
    }
}
