//! What the kernel must compute, one voxel at a time, short enough to check by reading. Not fast.

use crate::grid::{Affine, View, Voxel};
use crate::stage::{Method, Ties, WindowChannel, WindowParams};

/// One channel of the window around voxel `c` of `src`, in scaled units; NaN where the centre is missing.
///
/// Integers up to 32 bits go through i128 and are exact until the last division; floats are summed twice in f64, the
/// second time about the first value, which keeps an offset from cancelling.
pub fn voxel<T: Voxel>(src: View<T>, c: [usize; 3], params: &WindowParams, channel: WindowChannel) -> f64 {
    let missing = |v: T| {
        if T::DTYPE.is_float() { v.to_f64().is_nan() } else { params.missing.is_some_and(|m| m as f64 == v.to_f64()) }
    };
    let centre = src.at(c);
    if missing(centre) {
        return f64::NAN;
    }
    let (lo, hi): ([usize; 3], [usize; 3]) = (
        std::array::from_fn(|a| c[a].saturating_sub(params.radius[a])),
        std::array::from_fn(|a| (c[a] + params.radius[a] + 1).min(src.shape[a])),
    );
    // Everything about the centre: exact for integers, nearly so for floats.
    let v0 = centre.to_f64();
    let (mut n, mut min, mut max) = (0u64, f64::INFINITY, f64::NEG_INFINITY);
    let (mut deltas, mut values) = (Vec::new(), Vec::new());
    for z in lo[0]..hi[0] {
        for y in lo[1]..hi[1] {
            for v in &src.row_at(z, y)[lo[2]..hi[2]] {
                if !missing(*v) {
                    let v = v.to_f64();
                    n += 1;
                    (min, max) = (min.min(v), max.max(v));
                    deltas.push(v - v0);
                    values.push(v);
                }
            }
        }
    }
    let nf = n as f64;
    // Mean and variance of v - v0.
    let (mean, variance) = if T::DTYPE.is_float() {
        let mean = sum(deltas.iter().copied()) / nf;
        (mean, sum(deltas.iter().map(|d| (d - mean) * (d - mean))) / nf)
    } else {
        let (s1, s2) = deltas.iter().fold((0i128, 0i128), |s, d| (s.0 + *d as i128, s.1 + (*d as i128).pow(2)));
        (s1 as f64 / nf, (n as i128 * s2 - s1 * s1) as f64 / (nf * nf))
    };
    let average = if T::DTYPE.is_float() {
        sum(values.iter().copied())
    } else {
        values.iter().map(|v| *v as i128).sum::<i128>() as f64
    } / nf;
    let Affine { slope, intercept } = params.affine;
    let scaled = |v: f64| slope * v + intercept;
    match channel {
        WindowChannel::Mean => scaled(average),
        WindowChannel::Min => scaled(min).min(scaled(max)),
        WindowChannel::Max => scaled(min).max(scaled(max)),
        WindowChannel::Variance => slope * slope * variance,
        WindowChannel::Std => slope.abs() * variance.sqrt(),
        WindowChannel::Moment2 => slope * slope * variance + scaled(average).powi(2),
        WindowChannel::Openness(_, ties) if min == max => {
            if ties == Ties::Le {
                1.0
            } else {
                0.5
            }
        }
        WindowChannel::Openness(method, _) => {
            // Relative to the centre, turned around where the solid is low: below = v - min, above = max - v.
            let (below, above, mean) =
                if params.flipped() { (max - v0, v0 - min, -mean) } else { (v0 - min, max - v0, mean) };
            let range = max - min;
            match method {
                Method::CdfPower if below == 0.0 => 0.0,
                Method::CdfPower if above == 0.0 => 1.0,
                Method::CdfPower => {
                    let beta = ((mean + below) / (above - mean)).clamp(1e-6, 1e6);
                    let log = if 2.0 * above < range { (-above / range).ln_1p() } else { below.ln() - range.ln() };
                    (beta * log).exp()
                }
                Method::GaussianCdf => normal(-mean / variance.sqrt()),
                Method::Chebyshev if mean >= 0.0 => 0.0,
                Method::Chebyshev => 1.0 - variance / (variance + mean * mean),
                Method::ChebyshevLiteral if mean >= 0.0 => 1.0,
                Method::ChebyshevLiteral => variance / (variance + mean * mean),
                Method::Beta if below == 0.0 => 0.0,
                Method::Beta if above == 0.0 => 1.0,
                Method::Beta => {
                    let share = (mean + below) / range;
                    let k = (share * (above - mean) * range / variance - 1.0).clamp(1e-9, 1e8);
                    beta(below / range, share * k, (above - mean) / range * k)
                }
                Method::Exact | Method::Levels | Method::Moments4 => panic!("has a kernel of its own"),
            }
        }
    }
}

/// Sum with Neumaier's compensation.
fn sum(values: impl Iterator<Item = f64>) -> f64 {
    let (mut s, mut c) = (0.0, 0.0);
    for v in values {
        let t: f64 = s + v;
        c += if f64::abs(s) >= v.abs() { (s - t) + v } else { (v - t) + s };
        s = t;
    }
    s + c
}

/// `I_x(a, b)` from its integral by Gauss's hypergeometric series, `x^a y^b / (a B(a, b)) sum of (a + b)_i / (a + 1)_i
/// x^i`, all of whose terms are positive; from the side on which it converges faster.
pub fn beta(x: f64, a: f64, b: f64) -> f64 {
    if x * (a + b) > a {
        return 1.0 - beta_series(1.0 - x, b, a);
    }
    beta_series(x, a, b)
}

fn beta_series(x: f64, a: f64, b: f64) -> f64 {
    let (mut term, mut total, mut i) = (1.0, 1.0, 0.0);
    while term > 1e-17 * total && i < 1e7 {
        term *= (a + b + i) / (a + 1.0 + i) * x;
        total += term;
        i += 1.0;
    }
    let log = a * x.ln() + b * (-x).ln_1p() + ln_gamma(a + b) - ln_gamma(a + 1.0) - ln_gamma(b);
    log.exp() * total
}

/// Logarithm of the gamma function: Stirling's series from 20 up.
fn ln_gamma(z: f64) -> f64 {
    if z < 20.0 {
        return ln_gamma(z + 1.0) - z.ln();
    }
    let w = 1.0 / (z * z);
    let series = (1.0 / 12.0 - w * (1.0 / 360.0 - w * (1.0 / 1260.0 - w / 1680.0))) / z;
    (z - 0.5) * z.ln() - z + 0.5 * (2.0 * std::f64::consts::PI).ln() + series
}

/// Standard normal distribution function: Taylor series of the integral near 0, continued fraction (Lentz) beyond.
pub fn normal(z: f64) -> f64 {
    let density = (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt();
    if z.abs() < 3.0 {
        let (mut term, mut total) = (z, z);
        for k in 1..100 {
            term *= z * z / (2 * k + 1) as f64;
            total += term;
        }
        return 0.5 + density * total;
    }
    let x = z.abs();
    let tail = density / (1..200).rev().fold(x, |f, k| x + k as f64 / f);
    if z > 0.0 { 1.0 - tail } else { tail }
}
