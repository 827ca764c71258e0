//! Adversarial fields, exact references and what naive single precision gives: shared by `tests/stress.rs`, which
//! asserts, and `benches/stress.rs`, which prints the table of worst cases.
#![allow(dead_code)] // each of the two uses its own part

pub mod counted;
pub mod exact;
pub mod fields;
pub mod functions;
pub mod naive;

use exact::Window;
use fields::Field;
use occlude::brick::{Scratch, Voxels};
use occlude::grid::{Affine, DType};
use occlude::kernel::simd::Level;
use occlude::kernel::{Context, gaussian, window};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};

/// Statistics that are compared in units in the last place.
pub const STATISTICS: [WindowChannel; 4] =
    [WindowChannel::Mean, WindowChannel::Variance, WindowChannel::Std, WindowChannel::Moment2];
/// Estimators of openness, compared in absolute difference.
pub const METHODS: [Method; 4] = [Method::CdfPower, Method::GaussianCdf, Method::Chebyshev, Method::Beta];

/// Worst errors over the sampled voxels of a field.
#[derive(Debug, Clone, Default)]
pub struct Worst {
    /// Units in the last place of the result's type, by [`STATISTICS`].
    pub ulps: [f64; 4],
    /// Relative, by [`STATISTICS`]; results below the normal numbers of the type apart.
    pub relative: [f64; 4],
    /// Relative error of the variance where |mean|/std <= 1e6.
    pub promised: f64,
    /// Mean, as a share of the largest magnitude in the window.
    pub mean_share: f64,
    /// Minima and maxima that differ.
    pub extremes: usize,
    /// Absolute, by [`METHODS`].
    pub openness: [f64; 4],
    /// Relative errors of running f32 sums: mean and variance by E[v^2] - E[v]^2. Infinite where one is lost for good.
    pub naive: [f64; 2],
    /// Voxels that are NaN but should not be, or the reverse.
    pub misplaced: usize,
    /// Voxels whose mean or variance the naive way turns into NaN or an infinity for nothing.
    pub naive_lost: usize,
    pub samples: usize,
}

/// Every statistic and estimator of `field` on the best level of this CPU, at its samples.
pub fn measure(field: &Field) -> Worst {
    let volume = field.voxels();
    let channels: Vec<WindowChannel> = STATISTICS
        .into_iter()
        .chain([WindowChannel::Min, WindowChannel::Max])
        .chain(METHODS.map(|m| WindowChannel::Openness(m, Ties::Le)))
        .collect();
    let got = windows(field, &volume, &channels);
    let naive = naive::running(&volume, field.shape, field.radius);
    let mut worst = Worst::default();
    let double = volume.dtype().result() == DType::F64;
    for i in field.samples() {
        worst.samples += 1;
        let Some(w) = Window::of(&volume, field.shape, field.radius, i) else {
            worst.misplaced += STATISTICS.iter().enumerate().filter(|(k, _)| !got[*k].at(i).is_nan()).count();
            continue;
        };
        statistics(&mut worst, &w, &got, i, double);
        worst.extremes += usize::from(got[4].at(i) != w.min) + usize::from(got[5].at(i) != w.max);
        for (k, method) in METHODS.into_iter().enumerate() {
            let (exact, value) = (w.openness(method), got[6 + k].at(i));
            match (exact.is_nan(), value.is_nan()) {
                (false, false) => worst.openness[k] = worst.openness[k].max((exact - value).abs()),
                (a, b) => worst.misplaced += usize::from(a != b),
            }
        }
        if w.infinite {
            continue;
        }
        let mut lost = false;
        for (k, (exact, value)) in [(w.mean(), naive[0][i]), (w.variance(), naive[1][i])].into_iter().enumerate() {
            let value = value as f64;
            if !value.is_finite() && (exact as f32).is_finite() {
                lost = true;
            } else if value != exact as f32 as f64 && (exact as f32).abs() >= f32::MIN_POSITIVE {
                worst.naive[k] = worst.naive[k].max(((value - exact) / exact).abs());
            } else if exact == 0.0 && value.abs() > f32::MIN_POSITIVE as f64 {
                worst.naive[k] = f64::INFINITY;
            }
        }
        worst.naive_lost += usize::from(lost);
    }
    worst
}

fn statistics(worst: &mut Worst, w: &Window, got: &[Voxels], i: usize, double: bool) {
    let exact = [w.mean(), w.variance(), w.std(), w.moment2()];
    for k in 0..4 {
        let value = got[k].at(i);
        if exact[k].is_nan() || value.is_nan() {
            worst.misplaced += usize::from(exact[k].is_nan() != value.is_nan());
            continue;
        }
        let rounded = if double { exact[k] } else { exact[k] as f32 as f64 };
        if value == rounded {
            continue;
        }
        if rounded.is_infinite() || value.is_infinite() {
            worst.misplaced += 1;
            continue;
        }
        let error = (value - exact[k]).abs();
        worst.ulps[k] = worst.ulps[k].max(error / exact::ulp(exact[k], double));
        let normal = if double { f64::MIN_POSITIVE } else { f32::MIN_POSITIVE as f64 };
        if exact[k].abs() >= normal {
            let relative = error / exact[k].abs();
            worst.relative[k] = worst.relative[k].max(relative);
            if k == 1 && w.mean().abs() <= 1e6 * w.std() {
                worst.promised = worst.promised.max(relative);
            }
        }
        if k == 0 {
            worst.mean_share = worst.mean_share.max(error / w.min.abs().max(w.max.abs()));
        }
    }
}

/// The kernel's results for a whole volume.
pub fn windows(field: &Field, volume: &Voxels, channels: &[WindowChannel]) -> Vec<Voxels> {
    let params = WindowParams { radius: field.radius, affine: Affine::IDENTITY, missing: None, solid_low: false };
    let extreme = |c: &WindowChannel| matches!(c, WindowChannel::Min | WindowChannel::Max);
    let dtype = |c: &WindowChannel| if extreme(c) { volume.dtype() } else { volume.dtype().result() };
    let mut results: Vec<Voxels> = channels.iter().map(|c| Voxels::zeroed(dtype(c), volume.len())).collect();
    let mut outs: Vec<window::WindowOut> = results
        .iter_mut()
        .zip(channels)
        .map(|(r, c)| window::WindowOut { channel: *c, dst: r.view_mut(field.shape) })
        .collect();
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    window::window(volume.view(field.shape), &params, window::Place::whole([0; 3]), &mut outs, &mut cx);
    results
}

/// Worst errors of the truncated Gaussian: mean as a share of the window's range beyond three units of the result
/// (each of the three passes rounds), and
/// relative variance where |mean|/std <= 1e6.
pub fn measure_gaussian(field: &Field, sigma: f64) -> [f64; 2] {
    let volume = field.voxels();
    let result = volume.dtype().result();
    let [mut mean, mut variance] = [0, 1].map(|_| Voxels::zeroed(result, volume.len()));
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    gaussian::gaussian(
        volume.view(field.shape),
        [sigma; 3],
        Affine::IDENTITY,
        None,
        [0; 3],
        Some(mean.view_mut(field.shape)),
        Some(variance.view_mut(field.shape)),
        &mut cx,
    );
    let mut worst = [0f64; 2];
    for i in field.samples() {
        let Some(w) = exact::weighted(&volume, field.shape, sigma, i) else { continue };
        let rounding = 3.0 * exact::ulp(w.mean, result == DType::F64);
        let error = ((mean.at(i) - w.mean).abs() - rounding).max(0.0);
        if w.range > 0.0 {
            worst[0] = worst[0].max(error / w.range);
        }
        let normal = w.variance >= f32::MIN_POSITIVE as f64 && (w.variance as f32).is_finite();
        if normal && w.mean.abs() <= 1e6 * w.variance.sqrt() {
            worst[1] = worst[1].max((variance.at(i) / w.variance - 1.0).abs());
        }
    }
    worst
}
