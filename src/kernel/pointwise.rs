//! Stages that look at one voxel: transfer tables, openness windows, modulation, ambient light, combination.
//!
//! All of them work in f64 on runs of voxels along x and round once to the type of `dst`. Extents must agree; a function
//! panics where they do not.

use super::values::{BLOCK, blocks, load_any, store_any};
use crate::grid::{Affine, AnyView, AnyViewMut};
use crate::stage::{CombineKind, TransferPoint, WindowMode};

/// What a stage reads: stored voxels, what scales them, and the stored value of missing ones.
pub type Operand<'a> = (AnyView<'a>, Affine, Option<i64>);

/// Piecewise-linear table (B, A): scaled value to `opacity` and linear `rgb`, clamped at the ends. `points` ascend in their
/// first entry; where two share it (a step) the later one holds at that value. NaN and `missing` give NaN. Panics if
/// `points` is empty.
pub fn transfer(src: Operand, points: &[TransferPoint], opacity: Option<AnyViewMut>, rgb: Option<[AnyViewMut; 3]>) {
    assert!(!points.is_empty(), "a transfer table needs a point");
    let shape = src.0.shape();
    let [r, g, b] = rgb.map_or([None, None, None], |c| c.map(Some));
    let mut outs = [opacity, r, g, b];
    outs.iter().flatten().for_each(|o| assert_eq!(o.shape(), shape, "extents differ"));
    let (mut values, mut results) = ([0.0; BLOCK], [0.0; BLOCK]);
    for (at, n) in blocks(shape) {
        load_scaled(&src, at, &mut values[..n]);
        for (component, out) in outs.iter_mut().enumerate() {
            let Some(out) = out else { continue };
            for (result, v) in results[..n].iter_mut().zip(&values) {
                *result = table(points, component + 1, *v);
            }
            store_any(out, at, &results[..n]);
        }
    }
}

/// Entry `component` of a transfer table at `v`.
fn table(points: &[TransferPoint], component: usize, v: f64) -> f64 {
    if v.is_nan() {
        return f64::NAN;
    }
    let above = points.partition_point(|p| p[0] <= v);
    if above == 0 {
        return points[0][component];
    }
    let low = &points[above - 1];
    let Some(high) = points.get(above) else { return low[component] };
    let t = (v - low[0]) / (high[0] - low[0]);
    low[component] + t * (high[component] - low[component])
}

/// B 5.1: below `low` 0, above `high` 1, between kept or stretched to [0, 1]. Stretching an empty interval gives 1 at it.
/// NaN stays.
pub fn openness_window(src: Operand, low: f64, high: f64, mode: WindowMode, dst: AnyViewMut) {
    map(src, dst, |v| match mode {
        _ if v < low => 0.0,
        _ if v > high => 1.0,
        WindowMode::Keep => v,
        WindowMode::Stretch if v.is_nan() => v,
        WindowMode::Stretch if high > low => (v - low) / (high - low),
        WindowMode::Stretch => 1.0,
    });
}

/// A 4.2: `opacity * min(by / sigma_max2, 1)`. A variance of 0 gives 0 whatever the bound; NaN in either gives NaN.
pub fn modulate_by_variance(opacity: Operand, by: Operand, sigma_max2: f64, dst: AnyViewMut) {
    map2(opacity, by, dst, |o, variance| {
        let share = if variance.is_nan() {
            variance
        } else if variance >= sigma_max2 && variance > 0.0 {
            1.0
        } else if variance <= 0.0 {
            0.0
        } else {
            variance / sigma_max2
        };
        o * share
    });
}

/// B 5.2: `clamp(opacity * s * gain, 0, 1)`, 0 where the saliency s is below `threshold`. NaN in either gives NaN.
pub fn modulate_by_saliency(opacity: Operand, by: Operand, threshold: f64, gain: f64, dst: AnyViewMut) {
    map2(opacity, by, dst, |o, s| {
        if o.is_nan() || s.is_nan() {
            f64::NAN
        } else if s < threshold {
            0.0
        } else {
            (o * s * gain).clamp(0.0, 1.0)
        }
    });
}

/// A eq. 5, one component: `k * openness * colour`.
pub fn ambient_light(openness: Operand, colour: Operand, k: f64, dst: AnyViewMut) {
    map2(openness, colour, dst, |o, c| k * o * c);
}

/// Joins inputs of one shape, voxel by voxel, in the order given; arithmetic in f64, scaled by each input's affine. A voxel
/// that is NaN or `missing` in one input is NaN. Panics without inputs.
pub fn combine(inputs: &[Operand], kind: CombineKind, mut dst: AnyViewMut) {
    let shape = dst.shape();
    assert!(!inputs.is_empty(), "nothing to combine");
    inputs.iter().for_each(|(v, ..)| assert_eq!(v.shape(), shape, "extents differ"));
    let (mut joined, mut next) = ([0.0; BLOCK], [0.0; BLOCK]);
    for (at, n) in blocks(shape) {
        for (i, input) in inputs.iter().enumerate() {
            load_scaled(input, at, &mut next[..n]);
            if i == 0 {
                joined = next;
            } else {
                joined[..n].iter_mut().zip(&next).for_each(|(a, b)| *a = join(kind, *a, *b));
            }
        }
        if kind == CombineKind::Mean {
            joined[..n].iter_mut().for_each(|v| *v /= inputs.len() as f64);
        }
        store_any(&mut dst, at, &joined[..n]);
    }
}

#[inline(always)]
fn join(kind: CombineKind, a: f64, b: f64) -> f64 {
    match kind {
        CombineKind::Add | CombineKind::Mean => a + b,
        CombineKind::Multiply => a * b,
        CombineKind::Min => {
            if b < a || b.is_nan() {
                b
            } else {
                a
            }
        }
        CombineKind::Max => {
            if b > a || b.is_nan() {
                b
            } else {
                a
            }
        }
    }
}

/// Scaled values: `slope * stored + intercept`; NaN and `missing` give NaN.
pub fn scale(src: AnyView, affine: Affine, missing: Option<i64>, dst: AnyViewMut) {
    map((src, affine, missing), dst, |v| v);
}

#[inline(always)]
fn load_scaled((view, affine, missing): &Operand, at: [usize; 3], values: &mut [f64]) {
    load_any(view, at, *missing, values);
    if !affine.is_identity() {
        values.iter_mut().for_each(|v| *v = affine.apply(*v));
    }
}

#[inline(always)]
fn map(src: Operand, mut dst: AnyViewMut, f: impl Fn(f64) -> f64) {
    assert_eq!(src.0.shape(), dst.shape(), "extents differ");
    let mut values = [0.0; BLOCK];
    for (at, n) in blocks(dst.shape()) {
        load_scaled(&src, at, &mut values[..n]);
        values[..n].iter_mut().for_each(|v| *v = f(*v));
        store_any(&mut dst, at, &values[..n]);
    }
}

#[inline(always)]
fn map2(a: Operand, b: Operand, mut dst: AnyViewMut, f: impl Fn(f64, f64) -> f64) {
    assert!(a.0.shape() == dst.shape() && b.0.shape() == dst.shape(), "extents differ");
    let (mut left, mut right) = ([0.0; BLOCK], [0.0; BLOCK]);
    for (at, n) in blocks(dst.shape()) {
        load_scaled(&a, at, &mut left[..n]);
        load_scaled(&b, at, &mut right[..n]);
        left[..n].iter_mut().zip(&right).for_each(|(l, r)| *l = f(*l, *r));
        store_any(&mut dst, at, &left[..n]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;
    use crate::grid::DType;
    use crate::kernel::hostile::volume;

    const NAN: f32 = f32::NAN;

    fn view(v: &Voxels) -> AnyView<'_> {
        v.view([1, 1, v.len()])
    }

    /// Values as they are stored.
    fn plain(v: &Voxels) -> Operand<'_> {
        (view(v), Affine::IDENTITY, None)
    }

    /// Runs `f` on a destination of `n` voxels.
    fn run(dtype: DType, n: usize, f: impl FnOnce(AnyViewMut)) -> Vec<f64> {
        let mut out = Voxels::zeroed(dtype, n);
        out.fill(7.0);
        f(out.view_mut([1, 1, n]));
        (0..n).map(|i| out.at(i)).collect()
    }

    fn same(a: &[f64], b: &[f64]) {
        assert_eq!(a.len(), b.len());
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            assert!(a == b || a.is_nan() && b.is_nan(), "voxel {i}: {a} against {b}");
        }
    }

    #[test]
    fn transfer_interpolates_clamps_and_takes_the_later_of_two_points() {
        let points = [[0.0, 0.0, 1.0, 0.5, 0.0], [10.0, 1.0, 0.0, 0.5, 0.25], [10.0, 0.5, 0.0, 0.0, 0.0]];
        let v = Voxels::I16(vec![-5, 0, 1, 5, 9, 10, 11, 77]);
        let mut red = Voxels::zeroed(DType::F32, 8);
        let (mut green, mut blue) = (red.clone(), red.clone());
        let opacity = run(DType::F32, 8, |d| {
            let rgb = [&mut red, &mut green, &mut blue].map(|c| c.view_mut([1, 1, 8]));
            transfer((view(&v), Affine::IDENTITY, Some(77)), &points, Some(d), Some(rgb));
        });
        same(&opacity, &[0.0, 0.0, 0.1f32 as f64, 0.5, 0.9f32 as f64, 0.5, 0.5, f64::NAN]);
        let component = |c: &Voxels| (0..7).map(|i| c.at(i)).collect::<Vec<_>>();
        same(&component(&red), &[1.0, 1.0, 0.9f32 as f64, 0.5, 0.1f32 as f64, 0.0, 0.0]);
        same(&component(&green), &[0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.0]);
        assert!(blue.at(7).is_nan());
    }

    #[test]
    fn transfer_clamps_infinities_and_scales_first() {
        let points = [[1.0, 0.25, 0.0, 0.0, 0.0], [3.0, 0.75, 0.0, 0.0, 0.0]];
        let v = Voxels::F32(vec![f32::NEG_INFINITY, f32::INFINITY, NAN, 1.0]);
        let affine = Affine::new(-2.0, 4.0);
        let got = run(DType::F64, 4, |d| transfer((view(&v), affine, None), &points, Some(d), None));
        same(&got, &[0.75, 0.25, f64::NAN, 0.5]);
    }

    #[test]
    fn windows_keep_and_stretch() {
        let v = Voxels::F32(vec![0.1, 0.25, 0.5, 0.75, 0.9, NAN]);
        let got = |low, high, mode| run(DType::F32, 6, |d| openness_window(plain(&v), low, high, mode, d));
        same(&got(0.25, 0.75, WindowMode::Keep), &[0.0, 0.25, 0.5, 0.75, 1.0, f64::NAN]);
        same(&got(0.25, 0.75, WindowMode::Stretch), &[0.0, 0.0, 0.5, 1.0, 1.0, f64::NAN]);
        same(&got(0.5, 0.5, WindowMode::Stretch), &[0.0, 0.0, 1.0, 1.0, 1.0, f64::NAN]);
    }

    #[test]
    fn modulation_is_bounded_and_spreads_nan() {
        let opacity = Voxels::F32(vec![0.5, 0.5, 0.5, 0.5, NAN]);
        let by = Voxels::F32(vec![0.0, 2.0, 9.0, NAN, 1.0]);
        let variance = |s2| run(DType::F32, 5, |d| modulate_by_variance(plain(&opacity), plain(&by), s2, d));
        same(&variance(4.0), &[0.0, 0.25, 0.5, f64::NAN, f64::NAN]);
        same(&variance(0.0), &[0.0, 0.5, 0.5, f64::NAN, f64::NAN]);
        let saliency = run(DType::F32, 5, |d| modulate_by_saliency(plain(&opacity), plain(&by), 1.0, 0.5, d));
        same(&saliency, &[0.0, 0.5, 1.0, f64::NAN, f64::NAN]);
        let light = run(DType::F32, 5, |d| ambient_light(plain(&opacity), plain(&by), 2.0, d));
        same(&light, &[0.0, 2.0, 9.0, f64::NAN, f64::NAN]);
    }

    #[test]
    fn stored_inputs_are_scaled_and_their_missing_voxels_stay_missing() {
        let v = Voxels::U8(vec![0, 51, 204, 255, 77]);
        let stored = || (view(&v), Affine::new(-1.0 / 255.0, 1.0), Some(77));
        let got = run(DType::F64, 5, |d| openness_window(stored(), 0.1, 0.9, WindowMode::Keep, d));
        same(&got, &[1.0, 1.0 - 51.0 / 255.0, 1.0 - 204.0 / 255.0, 0.0, f64::NAN]);
        let two = Voxels::F64(vec![2.0; 5]);
        let half = [1.0, 0.8, 0.2, 0.0, f64::NAN];
        let close = |got: Vec<f64>, factor: f64| {
            for (a, b) in got.iter().zip(half) {
                assert!((a - factor * b).abs() < 1e-15 || a.is_nan() && b.is_nan(), "{got:?}");
            }
        };
        close(run(DType::F64, 5, |d| modulate_by_variance(plain(&two), stored(), 1.0, d)), 2.0);
        close(run(DType::F64, 5, |d| modulate_by_variance(stored(), plain(&two), 1.0, d)), 1.0);
        close(run(DType::F64, 5, |d| modulate_by_saliency(stored(), plain(&two), 0.0, 0.5, d)), 1.0);
        close(run(DType::F64, 5, |d| ambient_light(stored(), plain(&two), 0.5, d)), 1.0);
    }

    #[test]
    fn combine_scales_each_input_and_any_missing_voxel_wins() {
        let a = Voxels::U8(vec![1, 2, 3, 255]);
        let b = Voxels::F64(vec![10.0, -20.0, f64::NAN, 0.0]);
        let inputs = [(view(&a), Affine::new(2.0, 1.0), Some(255)), plain(&b)];
        let got = |kind| run(DType::F64, 4, |d| combine(&inputs, kind, d));
        let nan = f64::NAN;
        same(&got(CombineKind::Add), &[13.0, -15.0, nan, nan]);
        same(&got(CombineKind::Multiply), &[30.0, -100.0, nan, nan]);
        same(&got(CombineKind::Min), &[3.0, -20.0, nan, nan]);
        same(&got(CombineKind::Max), &[10.0, 5.0, nan, nan]);
        same(&got(CombineKind::Mean), &[6.5, -7.5, nan, nan]);
    }

    #[test]
    fn scaling_reads_every_type_over_block_ends() {
        for dtype in DType::ALL {
            let shape = [2, 3, BLOCK + 9];
            let v = volume(dtype, shape, 3);
            let missing = Some(v.at(5) as i64);
            let mut out = Voxels::zeroed(DType::F64, v.len());
            scale(v.view(shape), Affine::new(-0.5, 3.0), missing, out.view_mut(shape));
            for i in 0..v.len() {
                let gone = v.at(i).is_nan() || !dtype.is_float() && v.at(i) == v.at(5);
                let expect = if gone { f64::NAN } else { -0.5 * v.at(i) + 3.0 };
                assert!(out.at(i) == expect || out.at(i).is_nan() && expect.is_nan(), "{dtype} {i}");
            }
        }
    }
}
