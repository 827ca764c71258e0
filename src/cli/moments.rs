//! Statistics of streamed values, with merges that lose nothing.

/// Count, mean and spread of values seen; NaN is counted apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moments {
    pub n: u64,
    pub missing: u64,
    pub infinite: u64,
    pub mean: f64,
    /// Sum of squared deviations from the mean.
    pub m2: f64,
    pub min: f64,
    pub max: f64,
    /// Least and largest finite value: the ends of a histogram.
    pub finite: [f64; 2],
}

impl Default for Moments {
    fn default() -> Moments {
        let (min, max) = (f64::INFINITY, f64::NEG_INFINITY);
        Moments { n: 0, missing: 0, infinite: 0, mean: 0.0, m2: 0.0, min, max, finite: [min, max] }
    }
}

impl Moments {
    /// Largest minus least finite value, for SSIM; 1 of a constant, so that equal constants are alike.
    pub fn dynamic_range(&self) -> f64 {
        let range = self.finite[1] - self.finite[0];
        if range > 0.0 && range.is_finite() { range } else { 1.0 }
    }

    /// Of one block, in two passes over it. Infinite values enter min and max only.
    pub fn of(values: &[f64]) -> Moments {
        let mut m = Moments::default();
        let mut sum = 0.0;
        for &v in values {
            if v.is_nan() {
                m.missing += 1;
                continue;
            }
            m.min = m.min.min(v);
            m.max = m.max.max(v);
            if v.is_infinite() {
                m.infinite += 1;
            } else {
                m.n += 1;
                sum += v;
                m.finite = [m.finite[0].min(v), m.finite[1].max(v)];
            }
        }
        if m.n == 0 {
            return m;
        }
        m.mean = sum / m.n as f64;
        m.m2 = values.iter().filter(|v| v.is_finite()).map(|v| (v - m.mean) * (v - m.mean)).sum();
        m
    }

    /// Both together (Chan, Golub, LeVeque).
    pub fn merge(self, other: Moments) -> Moments {
        let n = self.n + other.n;
        let (missing, infinite) = (self.missing + other.missing, self.infinite + other.infinite);
        let (min, max) = (self.min.min(other.min), self.max.max(other.max));
        let finite = [self.finite[0].min(other.finite[0]), self.finite[1].max(other.finite[1])];
        if n == 0 {
            return Moments { missing, infinite, min, max, ..Moments::default() };
        }
        let share = other.n as f64 / n as f64;
        let delta = other.mean - self.mean;
        let mean = if self.n == 0 { other.mean } else { self.mean + delta * share };
        let m2 = self.m2 + other.m2 + if self.n == 0 { 0.0 } else { delta * delta * share * self.n as f64 };
        Moments { n, missing, infinite, mean, m2, min, max, finite }
    }

    /// Population variance; NaN of nothing.
    pub fn variance(&self) -> f64 {
        if self.n == 0 { f64::NAN } else { self.m2 / self.n as f64 }
    }
}

/// Counts of values in equal bins from `lo` to `hi`.
#[derive(Debug, Clone, PartialEq)]
pub struct Histogram {
    pub lo: f64,
    pub hi: f64,
    pub counts: Vec<u64>,
}

impl Histogram {
    pub fn new(lo: f64, hi: f64, bins: usize) -> Histogram {
        Histogram { lo, hi, counts: vec![0; bins.max(1)] }
    }

    /// Values outside the range and NaN are not counted; `hi` falls into the last bin.
    pub fn add(&mut self, values: &[f64]) {
        values.iter().for_each(|&v| self.add_times(v, 1));
    }

    /// One value so many times.
    #[inline]
    pub fn add_times(&mut self, v: f64, times: u64) {
        let bins = self.counts.len();
        if v >= self.lo && v <= self.hi {
            let scale = if self.hi > self.lo { bins as f64 / (self.hi - self.lo) } else { 0.0 };
            let bin = ((v - self.lo) * scale) as usize;
            self.counts[bin.min(bins - 1)] += times;
        }
    }
}

/// Counts of absolute values by magnitude: 4096 bins per power of two, each remembering its largest value. A quantile is
/// exact where a bin holds one distinct value (differences of 8-bit volumes), else right to 1 part in 4096.
pub struct Magnitudes {
    counts: Vec<u64>,
    largest: Vec<f32>,
    n: u64,
}

/// Low bits of an `f32` that do not choose the bin.
const DROPPED: u32 = 11;

impl Default for Magnitudes {
    fn default() -> Magnitudes {
        // Positive f32 bit patterns ascend with their values.
        let bins = (f32::INFINITY.to_bits() >> DROPPED) as usize + 1;
        Magnitudes { counts: vec![0; bins], largest: vec![0.0; bins], n: 0 }
    }
}

impl Magnitudes {
    pub fn add(&mut self, magnitude: f64) {
        let v = magnitude as f32;
        let bin = (v.to_bits() >> DROPPED) as usize;
        self.counts[bin] += 1;
        self.largest[bin] = self.largest[bin].max(v);
        self.n += 1;
    }

    /// The least value that is not below a share `q` of all; NaN of nothing.
    pub fn quantile(&self, q: f64) -> f64 {
        let rank = ((q * self.n as f64).ceil() as u64).max(1);
        let mut seen = 0;
        for (count, largest) in self.counts.iter().zip(&self.largest) {
            seen += count;
            if *count > 0 && seen >= rank {
                return f64::from(*largest);
            }
        }
        f64::NAN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_moments_are_those_of_the_whole() {
        let values: Vec<f64> = (0..1000).map(|i| 1e6 + f64::from((i * 7919) % 1000) * 1e-3).collect();
        let whole = Moments::of(&values);
        let parts = values.chunks(37).map(Moments::of).fold(Moments::default(), Moments::merge);
        assert_eq!((parts.n, parts.min, parts.max), (whole.n, whole.min, whole.max));
        assert!((parts.mean - 1_000_000.499_5).abs() < 1e-8);
        let variance = (1e6 - 1.0) / 12.0 * 1e-6;
        assert!((parts.variance() / variance - 1.0).abs() < 1e-5, "{}", parts.variance());
    }

    #[test]
    fn nothing_and_odd_values() {
        let m = Moments::of(&[f64::NAN, f64::INFINITY, 2.0, 4.0]).merge(Moments::default());
        assert_eq!((m.n, m.missing, m.infinite, m.mean, m.variance()), (2, 1, 1, 3.0, 1.0));
        assert_eq!((m.min, m.max), (2.0, f64::INFINITY));
        assert!(Moments::default().merge(Moments::of(&[])).variance().is_nan());
        let mut h = Histogram::new(0.0, 4.0, 4);
        h.add(&[0.0, 0.5, 1.0, 4.0, 5.0, f64::NAN, -1.0]);
        assert_eq!(h.counts, [2, 1, 0, 1]);
        let mut constant = Histogram::new(3.0, 3.0, 4);
        constant.add(&[3.0, 3.0]);
        assert_eq!(constant.counts, [2, 0, 0, 0]);
    }

    #[test]
    fn quantiles_of_few_values_are_exact() {
        let mut m = Magnitudes::default();
        assert!(m.quantile(0.99).is_nan());
        (0..1000).for_each(|i| m.add(f64::from(i) / 255.0));
        assert_eq!(m.quantile(0.99) as f32, (989.0f64 / 255.0) as f32);
        assert_eq!(m.quantile(0.0), 0.0);
        let mut tail = Magnitudes::default();
        (0..99).for_each(|_| tail.add(0.0));
        tail.add(f64::INFINITY);
        assert_eq!(tail.quantile(0.99), 0.0);
        assert_eq!(tail.quantile(1.0), f64::INFINITY);
    }
}
