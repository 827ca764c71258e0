//! f64 volumes with values whose squares f64 cannot hold. Windows of such values are computed once more from voxels that a
//! power of two brings near 1, which is exact: what a window needs is told by its own extremes, so bricks never show. Volumes
//! without such values, all but a few, are only looked through.

use super::float;
use super::plan::{self, Job, Needs, cut};
use super::{Place, WindowOut};
use crate::brick::scratch::padded;
use crate::grid::{Affine, AnyViewMut, DType, Region, Shape, View, ViewMut};
use crate::kernel::Context;
use crate::kernel::simd::Level;
use crate::stage::{WindowChannel, WindowParams};

/// Windows that span more, or less, than these have sums of squares that overflow, or lose digits at the lower end.
const WIDE: f64 = power(450);
const NARROW: f64 = power(-400);
/// From here on sums may overflow, even of equal values.
const LARGE: f64 = power(900);
/// What brings them back. Of a wide window's voxels those that vanish are nothing beside its span; a narrow one's largest are
/// 2^53 times its span at most.
const DOWN: i64 = -600;
const UP: i64 = 600;
/// Output boxes that are computed once more at a time.
const BLOCK: Shape = [8, 32, 64];

const fn power(k: i64) -> f64 {
    f64::from_bits(((1023 + k) as u64) << 52)
}

/// [`float::run`], right for every finite number.
pub fn run(src: View<f64>, params: &WindowParams, place: Place, dst: Shape, outs: &mut [WindowOut], cx: &mut Context) {
    let bytes = cx.scratch.take(bytes(src.shape, dst, params, outs.iter().map(|o| o.channel)));
    float::run(src, params, place, dst, outs, cx.level, bytes);
    let rows = (0..src.shape[0]).flat_map(|z| (0..src.shape[1]).map(move |y| (z, y)));
    if outs.iter().all(|o| plain(o.channel)) || !rows.into_iter().any(|(z, y)| any_far(cx.level, src.row_at(z, y))) {
        return;
    }
    let whole = Region::whole(dst);
    for cell in whole.cells([0; 3], BLOCK).iter() {
        let part = Region::of_cell(cell, [0; 3], BLOCK).clip(&whole);
        let lo = part.lo.map(|v| v as usize);
        block(src, params, place, lo, part.shape(), outs, cx.level, bytes);
    }
}

/// Bytes of scratch.
pub fn bytes(
    src: Shape,
    dst: Shape,
    params: &WindowParams,
    channels: impl Iterator<Item = WindowChannel> + Clone,
) -> usize {
    let of = |src: Shape, dst: Shape, needs: Needs| {
        let moments = plan::batch_bytes(DType::F64, needs);
        float::bytes::<f64>(&Job::new(src, dst, Place::whole([0; 3]), params, needs, moments))
    };
    let once = of(src, dst, Needs::of(channels.clone(), true));
    if channels.clone().all(plain) {
        return once;
    }
    let small: Shape = std::array::from_fn(|a| BLOCK[a].min(dst[a]));
    let seen: Shape = std::array::from_fn(|a| small[a].saturating_add(params.radius[a].saturating_mul(2)).min(src[a]));
    let again = |channels: [WindowChannel; 2]| of(seen, small, Needs::of(channels.into_iter(), true));
    let statistics = again(EXTREMES).max(again(MOMENTS));
    let most = channels.map(|c| again([c; 2])).fold(statistics, usize::max);
    let own = padded::<f64>(seen.iter().product()) + 4 * padded::<f64>(small.iter().product());
    once.max(own + most)
}

const EXTREMES: [WindowChannel; 2] = [WindowChannel::Min, WindowChannel::Max];
const MOMENTS: [WindowChannel; 2] = [WindowChannel::Mean, WindowChannel::Variance];

/// Channels that no square enters and no sum.
fn plain(channel: WindowChannel) -> bool {
    matches!(channel, WindowChannel::Min | WindowChannel::Max)
}

crate::multiversion! {
    /// Whether a row has a number so large or so small that a window with it may be wide or narrow.
    fn any_far[](row: &[f64]) -> bool = any_far_inner;
}

#[inline(always)]
fn any_far_inner(row: &[f64]) -> bool {
    // Patterns of bits are ordered as magnitudes are; zero wraps to the largest. Half of a span may be all of a value; a
    // value may be 2^53 times a span.
    let (large, least) = (power(448).to_bits(), power(-346).to_bits());
    let infinite = f64::INFINITY.to_bits();
    row.iter().fold(false, |any, v| {
        let bits = v.abs().to_bits();
        any | (bits >= large && bits < infinite) | (bits.wrapping_sub(1) < least)
    })
}

/// Computes the windows of one block once more that ask for it.
#[allow(clippy::too_many_arguments)]
fn block(
    src: View<f64>,
    params: &WindowParams,
    place: Place,
    lo: [usize; 3],
    dst: Shape,
    outs: &mut [WindowOut],
    level: Level,
    mut bytes: &mut [u8],
) {
    let at: [usize; 3] = std::array::from_fn(|a| place.at[a] + lo[a]);
    let first: [usize; 3] = std::array::from_fn(|a| at[a].saturating_sub(params.radius[a]));
    let end = |a: usize| at[a].saturating_add(dst[a]).saturating_add(params.radius[a]).min(src.shape[a]);
    let shape: Shape = std::array::from_fn(|a| end(a) - first[a]);
    let place = Place {
        at: std::array::from_fn(|a| at[a] - first[a]),
        phase: std::array::from_fn(|a| (place.phase[a] + lo[a]) % super::parts::BLOCK),
    };
    let voxels = dst.iter().product();
    let bytes = &mut bytes;
    let scaled = cut::<f64>(bytes, shape.iter().product());
    let [least, most, one, two] = [(); 4].map(|()| cut::<f64>(bytes, voxels));
    // Results of stored values; the affine follows once they are brought back.
    let stored = WindowParams { affine: Affine::IDENTITY, solid_low: params.flipped(), ..*params };
    let part = src.part(first, shape);
    let mut rerun = |src: View<f64>, channels: [WindowChannel; 2], to: [&mut [f64]; 2]| {
        let mut outs = channels.into_iter().zip(to).map(|(channel, to)| {
            let dst = AnyViewMut::F64(ViewMut::dense(to, dst));
            WindowOut { channel, dst }
        });
        let mut outs: [WindowOut; 2] = std::array::from_fn(|_| outs.next().expect("two channels"));
        float::run(src, &stored, place, dst, &mut outs, level, bytes);
    };
    rerun(part, EXTREMES, [&mut *least, &mut *most]);
    // Halves, since a difference may overflow.
    let span = |i: usize| (0.5 * most[i] - 0.5 * least[i]).abs() * 2.0;
    let size = |i: usize| most[i].abs().max(least[i].abs());
    for exponent in [DOWN, UP] {
        // What decides of a mean are the values themselves, of the rest how far they lie apart.
        let asks = |i: usize, channel: WindowChannel| {
            let v = if matches!(channel, WindowChannel::Mean | WindowChannel::Moment2) { size(i) } else { span(i) };
            let asks = if exponent == DOWN { v >= WIDE || size(i) >= LARGE } else { v > 0.0 && v <= NARROW };
            asks && size(i) < f64::INFINITY
        };
        let any = |channel| (0..voxels).any(|i| asks(i, channel));
        if !any(WindowChannel::Mean) && !any(WindowChannel::Variance) {
            continue;
        }
        let rows = (0..shape[0]).flat_map(|z| (0..shape[1]).map(move |y| (z, y)));
        for (to, (z, y)) in scaled.chunks_exact_mut(shape[2]).zip(rows) {
            to.iter_mut().zip(part.row_at(z, y)).for_each(|(t, v)| *t = v * power(exponent));
        }
        let scaled = View::dense(scaled, shape);
        for out in outs.iter_mut().filter(|o| !plain(o.channel)) {
            let channel = out.channel;
            let openness = matches!(channel, WindowChannel::Openness(..));
            let channels = if openness { [channel; 2] } else { MOMENTS };
            rerun(scaled, channels, [&mut *one, &mut *two]);
            let AnyViewMut::F64(d) = &mut out.dst else { panic!("{channel:?} of f64 is written as f64") };
            for (i, c) in Region::whole(dst).iter().enumerate().filter(|(i, _)| asks(*i, channel)) {
                let c: [usize; 3] = std::array::from_fn(|a| lo[a] + c[a] as usize);
                let variance = if span(i) == 0.0 { 0.0 } else { two[i] };
                d.set(c, if openness { one[i] } else { back(channel, one[i], variance, exponent, params.affine) });
            }
        }
    }
}

/// A statistic from mean and variance of values times 2^exponent.
fn back(channel: WindowChannel, mean: f64, variance: f64, exponent: i64, affine: Affine) -> f64 {
    // Half of the way at a time: no step overflows before the result does.
    let (half, slope) = (power(-exponent / 2), affine.slope);
    let scale = |v: f64, times: i64| (0..2 * times).fold(v, |v, _| v * half);
    let m = scale(mean * slope, 1);
    match channel {
        WindowChannel::Mean => m + affine.intercept,
        WindowChannel::Std => scale(variance.sqrt() * slope.abs(), 1),
        WindowChannel::Variance => scale(variance * slope * slope, 2),
        _ => {
            let m = m + affine.intercept;
            scale(variance * slope * slope, 2) + m * m
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::{Scratch, Voxels};
    use crate::kernel::hostile::Noise;
    use crate::kernel::window::window;
    use crate::stage::{Method, Ties};

    const SHAPE: Shape = [7, 9, 75];
    const CHANNELS: [WindowChannel; 10] = [
        WindowChannel::Mean,
        WindowChannel::Std,
        WindowChannel::Variance,
        WindowChannel::Moment2,
        WindowChannel::Min,
        WindowChannel::Max,
        WindowChannel::Openness(Method::CdfPower, Ties::Le),
        WindowChannel::Openness(Method::GaussianCdf, Ties::Le),
        WindowChannel::Openness(Method::Chebyshev, Ties::Mid),
        WindowChannel::Openness(Method::Beta, Ties::Le),
    ];

    fn params(radius: [usize; 3], affine: Affine, solid_low: bool) -> WindowParams {
        WindowParams { radius, affine, missing: None, solid_low }
    }

    /// All channels over bricks of one edge.
    fn bricks(v: &[f64], p: &WindowParams, edge: usize, level: Level) -> Vec<Vec<f64>> {
        channels(v, p, edge, level, &CHANNELS)
    }

    fn channels(v: &[f64], p: &WindowParams, edge: usize, level: Level, channels: &[WindowChannel]) -> Vec<Vec<f64>> {
        let (whole, all) = (Region::whole(SHAPE), Voxels::F64(v.to_vec()));
        let mut got = vec![Voxels::zeroed(DType::F64, v.len()); channels.len()];
        let mut scratch = Scratch::new();
        for cell in whole.cells([0; 3], [edge; 3]).iter() {
            let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
            let grown = part.grow(p.radius).clip(&whole);
            let mut brick = Voxels::zeroed(DType::F64, grown.voxels());
            crate::brick::gather::copy_common(all.view(SHAPE), whole, brick.view_mut(grown.shape()), grown);
            let mut made = vec![Voxels::zeroed(DType::F64, part.voxels()); channels.len()];
            let mut outs: Vec<WindowOut> = (made.iter_mut().zip(channels))
                .map(|(m, &channel)| WindowOut { channel, dst: m.view_mut(part.shape()) })
                .collect();
            let mut cx = Context { level, scratch: &mut scratch };
            let place = Place::new(grown.offset_of(&part), part.lo);
            window(brick.view(grown.shape()), p, place, &mut outs, &mut cx);
            drop(outs);
            for (made, got) in made.iter().zip(&mut got) {
                crate::brick::gather::copy_common(made.view(part.shape()), part, got.view_mut(SHAPE), whole);
            }
        }
        got.iter().map(|g| (0..g.len()).map(|i| g.at(i)).collect()).collect()
    }

    fn noise() -> Vec<f64> {
        let mut noise = Noise(8);
        (0..SHAPE.iter().product()).map(|i| if i % 50 < 9 { 3.0 } else { noise.unit() - 0.3 }).collect()
    }

    fn same(a: f64, b: f64) -> bool {
        a == b || a.is_nan() && b.is_nan()
    }

    #[test]
    fn a_power_of_two_changes_nothing_but_the_exponent() {
        let (near, p) = (noise(), params([2, 1, 3], Affine::IDENTITY, false));
        let expect = bricks(&near, &p, 100, Level::detect());
        for exponent in [1020, 800, 520, 449, 400, -390, -420, -560, -900] {
            let half = 2f64.powi(exponent / 2);
            let scale = |v: f64, times: i32| (0..2 * times).fold(v, |v, _| v * half);
            let far: Vec<f64> = near.iter().map(|v| scale(*v, 1)).collect();
            let got = bricks(&far, &p, 100, Level::detect());
            for (k, channel) in CHANNELS.into_iter().enumerate() {
                let times = match channel {
                    WindowChannel::Openness(..) => 0,
                    WindowChannel::Variance | WindowChannel::Moment2 => 2,
                    _ => 1,
                };
                for (g, e) in got[k].iter().zip(&expect[k]) {
                    let e = scale(*e, times);
                    // Denormal results have fewer digits.
                    let close = (g - e).abs() <= 1e-12 * e.abs() + f64::MIN_POSITIVE * 1e-12;
                    assert!(same(*g, e) || close, "2^{exponent}, {channel:?}: {g:e}, expected {e:e}");
                }
            }
        }
    }

    /// Large, ordinary and small values side by side, with gaps.
    fn mixed() -> Vec<f64> {
        let mut noise = Noise(2);
        let scales = [1.7e308, 1e-320, 1.0, 1e200, 1e-200, 1e308, 1e-160, 1e160];
        let at = |i: usize| match noise.below(90) {
            0 => f64::NAN,
            1 if i % 75 < 10 => f64::INFINITY,
            _ if i % 75 > 70 => 1.5e308,
            _ => scales[i % 75 / 10] * (noise.unit() - 0.5),
        };
        (0..SHAPE.iter().product()).map(at).collect()
    }

    #[test]
    fn mixtures_are_right_and_bricks_never_show() {
        let v = mixed();
        for (radius, slope, solid_low) in [([1, 2, 2], 1.0, false), ([0, 1, 4], -0.5, true), ([3, 3, 80], 1.0, false)] {
            let affine = Affine { slope, intercept: 0.0 };
            let p = params(radius, affine, solid_low);
            let got = bricks(&v, &p, 100, Level::detect());
            for level in Level::available() {
                assert!(
                    got.iter().flatten().zip(bricks(&v, &p, 100, level).iter().flatten()).all(|(a, b)| same(*a, *b))
                );
            }
            for (channel, joint) in CHANNELS.into_iter().zip(&got) {
                let alone = channels(&v, &p, 20, Level::detect(), &[channel]);
                assert!(alone[0].iter().zip(joint).all(|(a, b)| same(*a, *b)), "{channel:?} alone");
            }
            for edge in [5, 8, 33] {
                let other = bricks(&v, &p, edge, Level::detect());
                assert!(
                    got.iter().flatten().zip(other.iter().flatten()).all(|(a, b)| same(*a, *b)),
                    "bricks of {edge} show"
                );
            }
            for (i, c) in Region::whole(SHAPE).iter().enumerate() {
                let range = |a: usize| {
                    let (c, r) = (c[a] as usize, radius[a]);
                    c.saturating_sub(r)..(c + r + 1).min(SHAPE[a])
                };
                let view = View::dense(&v, SHAPE);
                let rows = range(0).flat_map(|z| range(1).map(move |y| (z, y)));
                let w: Vec<f64> =
                    rows.flat_map(|(z, y)| &view.row_at(z, y)[range(2)]).copied().filter(|v| !v.is_nan()).collect();
                let size = w.iter().fold(0.0f64, |m, v| m.max(v.abs()));
                if v[i].is_nan() || size.is_infinite() || size == 0.0 {
                    continue;
                }
                // In units of the largest; of several lots of digits one is enough here.
                let unit = size * 0.5;
                let near: Vec<f64> = w.iter().map(|v| v / unit).collect();
                let n = w.len() as f64;
                let mean = near.iter().sum::<f64>() / n;
                let variance = near.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
                let std = variance.sqrt() * unit * slope.abs();
                let close = |k: usize, e: f64, size: f64| {
                    let g = got[k][i];
                    assert!((g - e).abs() <= 1e-9 * size + 1e-322, "{:?} at {c:?}: {g:e}, expected {e:e}", CHANNELS[k]);
                };
                close(0, mean * unit * slope, size);
                close(1, std, std);
                if variance > 0.0 && v[i] / unit != mean {
                    let side = if p.flipped() { -1.0 } else { 1.0 };
                    let z = side * (v[i] / unit - mean) / variance.sqrt();
                    let open = if z <= 0.0 { 0.0 } else { 1.0 - 1.0 / (1.0 + z * z) };
                    assert!((got[8][i] - open).abs() < 1e-5, "chebyshev at {c:?}: {}, expected {open}", got[8][i]);
                }
            }
        }
    }

    #[test]
    fn ordinary_volumes_are_not_far() {
        for v in [0.0, -0.0, 1.0, -1e130, 1e-100, f64::INFINITY, f64::NAN, f64::NEG_INFINITY] {
            assert!(!any_far(Level::detect(), &[v]), "{v}");
        }
        for v in [1e140, -1e308, 1e-110, -5e-324] {
            assert!(any_far(Level::detect(), &[0.0, v]), "{v}");
        }
    }
}
