//! What `shaders/window_moments.wgsl` computes, operation by operation: f32 rounds here as the shader asks a driver to. The
//! device is held to it before float windows are placed there.

use super::passes::{Job, Part, Pass, Quantity};
use crate::grid::{DType, Shape};
use crate::kernel::window::Needs;

/// Moments of some voxels: mean and M2 as unevaluated pairs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Cell {
    pub n: u32,
    pub mean: [f32; 2],
    pub m2: [f32; 2],
}

impl Cell {
    pub fn of(v: f32) -> Cell {
        if v.is_nan() { Cell::default() } else { Cell { n: 1, mean: [v, 0.0], m2: [0.0; 2] } }
    }

    /// As the device keeps it: 3 or 5 words.
    pub fn from_words(words: &[u32]) -> Cell {
        let f = |i: usize| words.get(i).map_or(0.0, |w| f32::from_bits(*w));
        Cell { n: words[0], mean: [f(1), f(2)], m2: [f(3), f(4)] }
    }

    /// Sum of the voxels.
    pub fn sum(&self) -> f64 {
        (self.mean[0] as f64 + self.mean[1] as f64) * self.n as f64
    }

    pub fn m2(&self) -> f64 {
        self.m2[0] as f64 + self.m2[1] as f64
    }
}

/// Rounded products and sums, or what a compiler that contracts makes of them; the first is what the shader asks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Arithmetic {
    Apart,
    /// Products are fused into the sums after them.
    Fused,
    /// `(a + b) - a` is taken for `b`.
    Reordered,
}

impl Arithmetic {
    /// The error of a + b, whose rounded sum is s.
    fn error_of(self, a: f32, b: f32, s: f32) -> f32 {
        if self == Arithmetic::Reordered {
            return 0.0;
        }
        let t = s - a;
        (a - (s - t)) + (b - t)
    }

    fn add(self, a: [f32; 2], b: f32) -> [f32; 2] {
        let s = a[0] + b;
        let e = self.error_of(a[0], b, s) + a[1];
        let high = s + e;
        [high, e - (high - s)]
    }

    /// The sum of a pair and a product.
    fn add_product(self, a: [f32; 2], x: f32, y: f32) -> [f32; 2] {
        if self != Arithmetic::Fused {
            return self.add(a, x * y);
        }
        let s = x.mul_add(y, a[0]);
        let e = self.error_of(a[0], x * y, s) + a[1];
        let high = s + e;
        [high, e - (high - s)]
    }

    fn inverse(self, v: f32) -> f32 {
        let mut r = f32::from_bits(0x7ef3_11c7 - v.to_bits());
        for _ in 0..4 {
            r *= if self == Arithmetic::Fused { v.mul_add(-r, 2.0) } else { 2.0 - v * r };
        }
        r
    }

    /// Onto the part with more voxels.
    pub fn join(self, a: Cell, b: Cell, square: bool) -> Cell {
        match (a.n, b.n) {
            (_, 0) => a,
            (0, _) => b,
            (x, y) if x < y => self.merge(b, a, square),
            _ => self.merge(a, b, square),
        }
    }

    fn merge(self, a: Cell, b: Cell, square: bool) -> Cell {
        let n = a.n + b.n;
        let s = b.mean[0] - a.mean[0];
        let low = self.error_of(b.mean[0], -a.mean[0], s) + (b.mean[1] - a.mean[1]);
        let d = s + low;
        let share = b.n as f32 * self.inverse(n as f32);
        let mut seen = Cell { n, mean: self.add_product(a.mean, d, share), m2: a.m2 };
        if square {
            seen.m2 = self.add(self.add(seen.m2, b.m2[0]), b.m2[1]);
            seen.m2 = self.add_product(seen.m2, d * d, a.n as f32 * share);
        }
        seen
    }

    /// `walk` of `shaders/window_herk.wgsl` over one line.
    fn walk(self, p: &Pass, block: i64, seen_at: impl Fn(i64) -> Cell, out: &mut [Cell]) {
        let (w, m) = (p.window as i64, p.m as i64);
        let (begin, end) = ((-p.first as i64).max(0), p.n as i64 - p.first as i64);
        let start = block * w - p.phase as i64;
        let square = p.square == 1;
        let mut seen = Cell::default();
        for q in (start.max(0)..(start + w).min(end)).rev() {
            if q >= begin {
                seen = self.join(seen_at(q + p.first as i64), seen, square);
            }
            if q < m {
                out[q as usize] = seen;
            }
        }
        seen = Cell::default();
        for k in start + 1..(start + w).min(m) {
            let q = k + w - 1;
            if q >= begin && q < end {
                seen = self.join(seen, seen_at(q + p.first as i64), square);
            }
            if k >= 0 {
                out[k as usize] = self.join(out[k as usize], seen, square);
            }
        }
    }

    /// All three passes over a part of dense voxels.
    pub fn moments(self, job: &Job, part: &Part, voxels: &[f32], square: bool) -> Vec<Cell> {
        let mut cells: Vec<Cell> = voxels.iter().map(|v| Cell::of(*v)).collect();
        let mut shape = part.src;
        for (axis, pass) in job.passes(part, Quantity::Moments { square }).iter().enumerate() {
            let from = shape;
            shape[axis] = part.dst[axis];
            let mut next = vec![Cell::default(); shape.iter().product()];
            let [i, j] = [[1, 2], [0, 2], [0, 1]][axis];
            let strides = |s: [usize; 3]| [s[1] * s[2], s[2], 1];
            let (a, b) = (strides(from), strides(shape));
            let mut line = vec![Cell::default(); shape[axis]];
            for (u, v) in (0..shape[i]).flat_map(|u| (0..shape[j]).map(move |v| (u, v))) {
                for block in 0..(pass.m + pass.phase).div_ceil(pass.window) as i64 {
                    let at = |q: i64| cells[u * a[i] + v * a[j] + q as usize * a[axis]];
                    self.walk(pass, block, at, &mut line);
                }
                line.iter().enumerate().for_each(|(k, c)| next[u * b[i] + v * b[j] + k * b[axis]] = *c);
            }
            cells = next;
        }
        cells
    }
}

/// Extent of the volume on which a device is held to this.
pub const PROBE: Shape = [5, 6, 43];

/// Windows over it: clipped ones, whole ones, blocks that start within it.
pub fn probe_job() -> (Job, Part) {
    let needs = Needs { extremes: true, mean: true, variance: true, float: true };
    let job = Job::new(DType::F32, PROBE, PROBE, [0; 3], [1, 2, 4], needs);
    let job = job.expect("f32 has a kernel").placed([1, 0, 5]);
    (job, Part { lo: [0; 3], dst: PROBE, from: [0; 3], src: PROBE })
}

/// Values of many sizes about an offset, and gaps.
pub fn probe_voxels() -> Vec<f32> {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let value = |i: usize, v: f32| match i % 7 {
        0 => f32::NAN,
        1..4 => 1000.0 + v,
        _ => v * 3.0 - 1.0,
    };
    (0..PROBE.iter().product()).map(|i| value(i, next())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Region;

    const SHAPE: Shape = [9, 7, 40];

    fn job(radius: [usize; 3]) -> (Job, Part) {
        let needs = Needs { extremes: true, mean: true, variance: true, float: true };
        let job = Job::new(DType::F32, SHAPE, SHAPE, [0; 3], radius, needs).unwrap().placed([5, -2, 33]);
        (job, Part { lo: [0; 3], dst: SHAPE, from: [0; 3], src: SHAPE })
    }

    fn noise(i: usize) -> f64 {
        let h = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40) as f64 / (1 << 24) as f64 - 0.5
    }

    /// Count, mean and variance of a window in f64, about a voxel of it.
    fn exact(voxels: &[f32], c: [i64; 3], radius: [usize; 3]) -> (u32, f64, f64) {
        let window = Region::new(c, c.map(|v| v + 1)).grow(radius).clip(&Region::whole(SHAPE));
        let at = |v: [i64; 3]| voxels[((v[0] * SHAPE[1] as i64 + v[1]) * SHAPE[2] as i64 + v[2]) as usize] as f64;
        let values: Vec<f64> = window.iter().map(at).filter(|v| !v.is_nan()).collect();
        let n = values.len() as f64;
        let pivot = values.first().copied().unwrap_or(0.0);
        let shift = values.iter().map(|v| v - pivot).sum::<f64>() / n;
        (values.len() as u32, pivot + shift, values.iter().map(|v| (v - pivot - shift).powi(2)).sum::<f64>() / n)
    }

    /// Greatest relative error of a variance, and greatest error of a mean in ranges of the fill.
    fn errors(arithmetic: Arithmetic, voxels: &[f32], radius: [usize; 3]) -> (f64, f64) {
        let (job, part) = job(radius);
        let got = arithmetic.moments(&job, &part, voxels, true);
        let known = voxels.iter().filter(|v| !v.is_nan());
        let range = known.clone().copied().fold(f32::MIN, f32::max) - known.copied().fold(f32::MAX, f32::min);
        let mut worst = (0.0f64, 0.0f64);
        for (c, cell) in Region::whole(SHAPE).iter().zip(&got) {
            let (n, mean, variance) = exact(voxels, c, radius);
            assert_eq!(cell.n, n, "voxels are counted exactly");
            if variance > 0.0 {
                worst.0 = worst.0.max((cell.m2() / n as f64 / variance - 1.0).abs());
                worst.1 = worst.1.max((cell.sum() / n as f64 - mean).abs() / range as f64);
            } else if n > 0 {
                assert_eq!((cell.m2(), cell.mean), (0.0, [mean as f32, 0.0]), "a constant is exact");
            }
        }
        worst
    }

    fn fills() -> Vec<(&'static str, Vec<f32>)> {
        let fill = |f: &dyn Fn(usize) -> f64| (0..SHAPE.iter().product()).map(|i| f(i) as f32).collect();
        vec![
            ("noise", fill(&noise)),
            ("offset", fill(&|i| 1e6 + noise(i))),
            ("step", fill(&|i| if i % 40 < 11 { 1e6 + noise(i) } else { noise(i) })),
            ("outlier", fill(&|i| if i == 1000 { 1e6 } else { noise(i) })),
            ("constant", fill(&|_| 0.1)),
            ("gaps", fill(&|i| if i % 3 == 0 { f64::NAN } else { 3.0 + noise(i) })),
        ]
    }

    #[test]
    fn variance_holds_a_part_in_a_hundred_thousand_and_constants_are_exact() {
        for (name, voxels) in fills() {
            for radius in [[1, 1, 1], [2, 3, 5], [0, 0, 40], [8, 6, 20]] {
                let (variance, mean) = errors(Arithmetic::Apart, &voxels, radius);
                assert!(variance < 1e-5, "{name} {radius:?}: variance off by {variance}");
                assert!(mean < 5e-7, "{name} {radius:?}: mean off by {mean}");
            }
        }
    }

    #[test]
    fn a_compiler_that_contracts_or_reorders_changes_bits() {
        let voxels = probe_voxels();
        let (job, part) = probe_job();
        let of = |a: Arithmetic| a.moments(&job, &part, &voxels, true);
        let apart = of(Arithmetic::Apart);
        for other in [Arithmetic::Fused, Arithmetic::Reordered] {
            let differ = apart.iter().zip(of(other)).filter(|(a, b)| **a != *b).count();
            assert!(2 * differ > apart.len(), "{other:?}: {differ} of {} windows show it", apart.len());
        }
        // And reordered pairs are no pairs: what the promise needs them for.
        let (_, offset) = fills().swap_remove(1);
        assert!(errors(Arithmetic::Reordered, &offset, [8, 6, 20]).0 > 1e-5);
    }
}
