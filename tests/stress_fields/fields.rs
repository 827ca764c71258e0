//! Fields on which sums cancel, overflow, drift or are poisoned.

use occlude::brick::Voxels;
use occlude::grid::{DType, Shape, Voxel};

/// A synthetic volume and the windows to look at.
pub struct Field {
    pub name: &'static str,
    pub dtype: DType,
    pub shape: Shape,
    pub radius: [usize; 3],
    value: fn(usize, [usize; 3], &mut Noise) -> f64,
}

/// Deterministic noise.
pub struct Noise(u64);

impl Noise {
    pub fn bits(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// In [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// About N(0, 1).
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

impl Field {
    pub fn voxels(&self) -> Voxels {
        fn fill<T: Voxel>(out: &mut [T], mut f: impl FnMut(usize) -> f64) {
            for (i, o) in out.iter_mut().enumerate() {
                *o = T::from_f64(f(i));
            }
        }
        let mut noise = Noise(0x9e37_79b9_7f4a_7c15);
        let mut voxels = Voxels::zeroed(self.dtype, self.shape.iter().product());
        let value = |i: usize| (self.value)(i, super::exact::place(self.shape, i), &mut noise);
        occlude::with_voxels!(&mut voxels, v => fill(v, value));
        voxels
    }

    /// Voxels to compare: a few hundred places of a fixed hash, the corners and, of long rows, the end.
    pub fn samples(&self) -> Vec<usize> {
        let n: usize = self.shape.iter().product();
        let window: usize = (0..3).map(|a| (2 * self.radius[a] + 1).min(self.shape[a])).product();
        let count = (4_000_000 / window).clamp(24, 1500).min(n);
        let mut noise = Noise(77);
        let mut all: Vec<usize> = (0..count).map(|_| (noise.bits() % n as u64) as usize).collect();
        all.extend([0, n - 1]);
        all.extend(n.saturating_sub(20)..n);
        all.sort_unstable();
        all.dedup();
        all
    }
}

const SHAPE: Shape = [18, 20, 60];
const R: [usize; 3] = [3, 4, 5];

/// Every field of the suite.
pub fn all() -> Vec<Field> {
    let field = |name, dtype, shape, radius, value| Field { name, dtype, shape, radius, value };
    use DType::{F32, F64, I8, I16, I32, U8, U16, U32};
    vec![
        field("noise", F32, SHAPE, R, |_, _, n| n.normal()),
        field("1e3 + noise", F32, SHAPE, R, |_, _, n| 1e3 + n.normal()),
        field("1e6 + noise", F32, SHAPE, R, |_, _, n| 1e6 + n.normal()),
        field("1e15 + 1e9 noise", F32, SHAPE, R, |_, _, n| 1e15 + 1e9 * n.normal()),
        field("1e30 + 1e24 noise", F32, SHAPE, R, |_, _, n| 1e30 + 1e24 * n.normal()),
        field("ramp to 1e6", F32, SHAPE, R, |_, c, _| 1e6 * c[2] as f64 / 59.0),
        field("step of 1e6 in noise", F32, SHAPE, R, |_, c, n| n.normal() + if c[2] < 30 { 0.0 } else { 1e6 }),
        field("step of 1e6 in 1e-3 noise", F32, SHAPE, R, |_, c, n| {
            1e-3 * n.normal() + if c[2] < 30 { 0.0 } else { 1e6 }
        }),
        field("denormals", F32, SHAPE, R, |i, _, _| (i % 7) as f64 * 1e-45),
        field("squares that are denormal", F32, SHAPE, R, |_, _, n| 1e-21 * n.normal()),
        field("1e6 + noise, radius 64", F32, [40, 40, 40], [64; 3], |_, _, n| 1e6 + n.normal()),
        field("constant and an outlier of 1e6", F32, SHAPE, R, |i, _, _| if i == 10_830 { 1e6 } else { 1.0 }),
        field("constant and one ulp", F32, SHAPE, R, |i, _, _| if i == 10_830 { 1.000_000_1 } else { 1.0 }),
        field("constant 0.1", F32, SHAPE, R, |_, _, _| 0.1),
        field("alternating +-3.4e38", F32, SHAPE, R, |i, _, _| if i % 2 == 0 { 3.4e38 } else { -3.4e38 }),
        field("alternating 1e30 and 1e-30", F32, SHAPE, R, |i, _, _| if i % 3 == 0 { 1e30 } else { 1e-30 }),
        field("noise, NaN and infinities", F32, SHAPE, R, |_, _, n| match n.bits() % 4000 {
            0 => f64::INFINITY,
            1 => f64::NEG_INFINITY,
            2..400 => f64::NAN,
            _ => 1e6 + n.normal(),
        }),
        field("row of 1e6, start at 1e6", F32, [1, 1, 1_000_000], [0, 0, 10], |i, _, n| {
            if i < 1000 { 1e6 * n.normal() } else { 1e-3 * n.normal() }
        }),
        field("row of 1e6, 1000 + noise", F32, [1, 1, 1_000_000], [0, 0, 10], |_, _, n| 1e3 + n.normal()),
        field("plane", F32, [1, 150, 150], [5; 3], |_, _, n| 1e6 + n.normal()),
        field("column", F32, [3000, 1, 1], [9; 3], |_, _, n| 1e6 + n.normal()),
        field("1e15 + noise", F64, SHAPE, R, |_, _, n| 1e15 + 10.0 * n.normal()),
        field("step of 1e6 in 1e-9 noise", F64, SHAPE, R, |_, c, n| {
            1e-9 * n.normal() + if c[2] < 30 { 0.0 } else { 1e6 }
        }),
        field("1e30 + 1e18 noise", F64, SHAPE, R, |_, _, n| 1e30 + 1e18 * n.normal()),
        field("1e200 noise", F64, SHAPE, R, |_, _, n| 1e200 * n.normal()),
        field("1e-200 noise", F64, SHAPE, R, |_, _, n| 1e-200 * n.normal()),
        field("1e-160 + 1e-170 noise", F64, SHAPE, R, |_, _, n| 1e-160 + 1e-170 * n.normal()),
        field("alternating +-1.7e308", F64, SHAPE, R, |i, _, _| if i % 2 == 0 { 1.7e308 } else { -1.7e308 }),
        field("denormals", F64, SHAPE, R, |i, _, _| (i % 7) as f64 * 5e-324),
        field("1e300 beside 1e-300", F64, SHAPE, R, |_, c, n| n.normal() * if c[2] < 30 { 1e300 } else { 1e-300 }),
        field("noise", U8, SHAPE, R, |_, _, n| (n.bits() % 256) as f64),
        field("noise, radius 64", U8, [40, 40, 40], [64; 3], |_, _, n| (n.bits() % 256) as f64),
        field("all -128", I8, SHAPE, R, |_, _, _| -128.0),
        field("-128 and one 127", I8, SHAPE, R, |i, _, _| if i == 10_830 { 127.0 } else { -128.0 }),
        field("alternating -128, 127", I8, SHAPE, R, |i, _, _| if i % 2 == 0 { -128.0 } else { 127.0 }),
        field("all 65535", U16, SHAPE, R, |_, _, _| 65535.0),
        field("65535 less 0 or 1", U16, SHAPE, R, |_, _, n| 65535.0 - (n.bits() % 2) as f64),
        field("65535 less 0 or 1, radius 64", U16, [40, 40, 40], [64; 3], |_, _, n| 65535.0 - (n.bits() % 2) as f64),
        field("65535 and one 65534", U16, SHAPE, R, |i, _, _| if i == 10_830 { 65534.0 } else { 65535.0 }),
        field("alternating 0, 65535", U16, SHAPE, R, |i, _, _| if i % 2 == 0 { 0.0 } else { 65535.0 }),
        field("row of 1e6 at 65535", U16, [1, 1, 1_000_000], [0, 0, 10], |_, _, n| 65535.0 - (n.bits() % 3) as f64),
        field("alternating -32768, 32767", I16, SHAPE, R, |i, _, _| if i % 3 == 0 { -32768.0 } else { 32767.0 }),
        field("top less 0 or 1", U32, SHAPE, R, |_, _, n| 4_294_967_295.0 - (n.bits() % 2) as f64),
        field("noise", I32, SHAPE, R, |_, _, n| (n.bits() >> 32) as u32 as i32 as f64),
    ]
}
