//! Exact windows: integers in i128, floats in two passes of double-double arithmetic (about 32 digits).

use occlude::brick::Voxels;
use occlude::grid::Shape;
use occlude::kernel::window::reference;
use occlude::stage::Method;

/// A sum of two f64, the second below half a unit of the first.
#[derive(Debug, Clone, Copy, Default)]
pub struct Twice(pub f64, pub f64);

impl Twice {
    pub fn plus(self, o: Twice) -> Twice {
        let s = self.0 + o.0;
        let t = s - self.0;
        let e = (self.0 - (s - t)) + (o.0 - t) + self.1 + o.1;
        let high = s + e;
        Twice(high, e - (high - s))
    }

    pub fn times(self, o: Twice) -> Twice {
        let p = self.0 * o.0;
        let e = self.0.mul_add(o.0, -p) + (self.0 * o.1 + self.1 * o.0);
        let high = p + e;
        Twice(high, e - (high - p))
    }

    pub fn over(self, n: f64) -> Twice {
        let q = self.0 / n;
        let rest = (-q).mul_add(n, self.0) + self.1;
        let e = rest / n;
        let high = q + e;
        Twice(high, e - (high - q))
    }

    pub fn value(self) -> f64 {
        self.0 + self.1
    }
}

/// What a window holds.
#[derive(Debug, Clone)]
pub struct Window {
    pub centre: f64,
    pub min: f64,
    pub max: f64,
    pub infinite: bool,
    /// A power of two that brings the window's values near 1 where squares would leave the range of f64. What follows is in
    /// these units.
    scale: f64,
    mean: Twice,
    /// Mean less the centre.
    shift: f64,
    variance: f64,
    moment2: f64,
}

/// Position of a linear index.
pub fn place(shape: Shape, i: usize) -> [usize; 3] {
    [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]]
}

/// Values of the voxels that exist in a window, NaN apart, with their offsets from the centre.
fn members(volume: &Voxels, shape: Shape, radius: [usize; 3], i: usize) -> Vec<([isize; 3], f64)> {
    let c = place(shape, i);
    let span = |a: usize| c[a].saturating_sub(radius[a])..(c[a] + radius[a] + 1).min(shape[a]);
    let mut values = Vec::new();
    for z in span(0) {
        for y in span(1) {
            for x in span(2) {
                let v = volume.at((z * shape[1] + y) * shape[2] + x);
                let d = [z as isize - c[0] as isize, y as isize - c[1] as isize, x as isize - c[2] as isize];
                if !v.is_nan() {
                    values.push((d, v));
                }
            }
        }
    }
    values
}

impl Window {
    /// The window around voxel `i`; `None` where the centre is NaN.
    pub fn of(volume: &Voxels, shape: Shape, radius: [usize; 3], i: usize) -> Option<Window> {
        let centre = volume.at(i);
        if centre.is_nan() {
            return None;
        }
        let values: Vec<f64> = members(volume, shape, radius, i).into_iter().map(|(_, v)| v).collect();
        let n = values.len() as f64;
        let (min, max) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |m, v| (m.0.min(*v), m.1.max(*v)));
        if min.is_infinite() || max.is_infinite() {
            let mean = values.iter().sum::<f64>();
            let (mean, shift, scale) = (Twice(mean, 0.0), f64::NAN, 1.0);
            let (variance, moment2) = (f64::NAN, f64::INFINITY);
            return Some(Window { centre, min, max, infinite: true, scale, mean, shift, variance, moment2 });
        }
        let scale = match max.abs().max(min.abs()) {
            size if size > 1e120 => 2f64.powi(-600),
            size if size < 1e-120 => 2f64.powi(600),
            _ => 1.0,
        };
        let values: Vec<f64> = values.iter().map(|v| v * scale).collect();
        let sum = |f: &dyn Fn(f64) -> Twice| values.iter().fold(Twice::default(), |s, v| s.plus(f(*v)));
        let mean = sum(&|v| Twice(v, 0.0)).over(n);
        let minus = Twice(-mean.0, -mean.1);
        let variance = if volume.dtype().is_float() {
            let square = |v: f64| {
                let d = Twice(v, 0.0).plus(minus);
                d.times(d)
            };
            sum(&square).over(n).value()
        } else {
            let (s1, s2) = values.iter().fold((0i128, 0i128), |s, v| (s.0 + *v as i128, s.1 + (*v as i128).pow(2)));
            (values.len() as i128 * s2 - s1 * s1) as f64 / (n * n)
        };
        let moment2 = sum(&|v| Twice(v, 0.0).times(Twice(v, 0.0))).over(n).value();
        let shift = mean.plus(Twice(-centre * scale, 0.0)).value();
        Some(Window { centre, min, max, infinite: false, scale, mean, shift, variance, moment2 })
    }

    pub fn mean(&self) -> f64 {
        self.mean.value() / self.scale
    }

    pub fn variance(&self) -> f64 {
        self.variance / self.scale / self.scale
    }

    pub fn std(&self) -> f64 {
        self.variance.sqrt() / self.scale
    }

    pub fn moment2(&self) -> f64 {
        self.moment2 / self.scale / self.scale
    }

    /// The formula in f64 from exact moments.
    pub fn openness(&self, method: Method) -> f64 {
        let (v, min, max) = (self.centre, self.min, self.max);
        if min == max {
            return 1.0;
        }
        if self.infinite {
            return match (v, min.is_infinite(), max.is_infinite()) {
                (f64::INFINITY, ..) => 1.0,
                (f64::NEG_INFINITY, ..) => 0.0,
                (_, true, true) => f64::NAN,
                // By how many spreads an infinite mean is away hangs on how many infinities there are.
                _ if method == Method::GaussianCdf => f64::NAN,
                (_, true, _) if matches!(method, Method::Chebyshev | Method::ChebyshevLiteral) => f64::NAN,
                (_, _, true) => f64::from(u8::from(method == Method::ChebyshevLiteral)),
                _ => 1.0,
            };
        }
        let [v, min, max] = [v, min, max].map(|v| v * self.scale);
        let (below, above, range) = (v - min, max - v, max - min);
        // Mean less min and max less mean, from the mean's distance to the centre.
        let (over, under) = (self.shift + below, above - self.shift);
        match method {
            Method::CdfPower | Method::Beta if below == 0.0 => 0.0,
            Method::CdfPower | Method::Beta if above == 0.0 => 1.0,
            Method::CdfPower => {
                let log = if 2.0 * above < range { (-above / range).ln_1p() } else { (below / range).ln() };
                ((over / under).clamp(1e-6, 1e6) * log).exp()
            }
            Method::Beta => {
                let k = ((over / range) * (under / range) / (self.variance / range / range) - 1.0).clamp(1e-9, 1e8);
                reference::beta(below / range, over / range * k, under / range * k)
            }
            Method::GaussianCdf => reference::normal(-self.shift / self.variance.sqrt()),
            _ if self.shift >= 0.0 => 0.0,
            _ => {
                let z = self.shift / self.variance.sqrt();
                1.0 - 1.0 / (1.0 + z * z)
            }
        }
    }
}

/// Moments of a truncated Gaussian window.
pub struct Weighted {
    pub mean: f64,
    pub variance: f64,
    pub range: f64,
}

/// The truncated Gaussian around voxel `i`; `None` where the centre is NaN or an infinity is near.
pub fn weighted(volume: &Voxels, shape: Shape, sigma: f64, i: usize) -> Option<Weighted> {
    let reach = (3.0 * sigma).ceil() as usize;
    let members = members(volume, shape, [reach; 3], i);
    if volume.at(i).is_nan() || members.iter().any(|(_, v)| v.is_infinite()) {
        return None;
    }
    let weight = |d: [isize; 3]| (-(d.iter().map(|d| (d * d) as f64).sum::<f64>()) / (2.0 * sigma * sigma)).exp();
    let total: f64 = members.iter().map(|(d, _)| weight(*d)).sum();
    let sum = |f: &dyn Fn(f64) -> Twice| {
        members.iter().fold(Twice::default(), |s, (d, v)| s.plus(f(*v).times(Twice(weight(*d), 0.0)))).over(total)
    };
    // From the centre: the rounding of the total then touches deviations only.
    let centre = volume.at(i);
    let shift = sum(&|v| Twice(v, 0.0).plus(Twice(-centre, 0.0)));
    let mean = Twice(centre, 0.0).plus(shift);
    let square = |v: f64| {
        let d = Twice(v, 0.0).plus(Twice(-mean.0, -mean.1));
        d.times(d)
    };
    let variance = sum(&square).value();
    let (min, max) = members.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |m, (_, v)| (m.0.min(*v), m.1.max(*v)));
    Some(Weighted { mean: mean.value(), variance, range: max - min })
}

/// Distance of neighbouring numbers of the result type at `v`.
pub fn ulp(v: f64, double: bool) -> f64 {
    if double {
        let v = v.abs().max(f64::MIN_POSITIVE);
        f64::from_bits(v.to_bits() + 1) - v
    } else {
        let v = (v.abs() as f32).clamp(f32::MIN_POSITIVE, f32::MAX / 2.0);
        // At a power of two the numbers below lie closer; the wider spacing is the unit of rounding above it.
        (f32::from_bits(v.to_bits() + 1) - v) as f64
    }
}
