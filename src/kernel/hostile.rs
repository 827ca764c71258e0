//! Hostile volumes for tests: noise with runs of constants, extremes of the type, and for floats NaN, infinities, -0.0.

use crate::brick::Voxels;
use crate::grid::hash::mix;
use crate::grid::{DType, Shape, Voxel};
use crate::with_voxels;

/// SplitMix64.
pub(crate) struct Noise(pub u64);

impl Noise {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.0)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Finite noise over a modest range with ties, without extremes.
pub(crate) fn calm(dtype: DType, shape: Shape, seed: u64) -> Voxels {
    fn one<T: Voxel>(v: &mut [T], seed: u64) {
        let mut noise = Noise(seed);
        v.iter_mut().for_each(|v| *v = T::from_f64((noise.unit() * 120.0).floor() * 0.75));
    }
    let mut out = Voxels::zeroed(dtype, shape.iter().product());
    with_voxels!(&mut out, v => one(v, seed));
    out
}

/// [`calm`] with about 1 voxel in 16 an extreme of the type (NaN, infinities and -0.0 among a float's) and a constant run.
pub(crate) fn volume(dtype: DType, shape: Shape, seed: u64) -> Voxels {
    fn one<T: Voxel>(v: &mut [T], seed: u64) {
        let mut noise = Noise(seed ^ 77);
        let (lo, hi) = T::DTYPE.range();
        let specials: &[f64] = if T::DTYPE.is_float() {
            &[f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -0.0, 0.0, 1e30, -1e30, f64::NAN]
        } else {
            &[lo, hi, lo + 1.0, hi - 1.0]
        };
        let constant = v.len() / 3..v.len() / 2;
        for (i, v) in v.iter_mut().enumerate() {
            if constant.contains(&i) {
                *v = T::from_f64(5.0);
            } else if noise.below(16) == 0 {
                *v = T::from_f64(specials[noise.below(specials.len())]);
            }
        }
    }
    let mut out = calm(dtype, shape, seed);
    with_voxels!(&mut out, v => one(v, seed));
    out
}

/// A constant volume.
pub(crate) fn constant(dtype: DType, shape: Shape, value: f64) -> Voxels {
    let mut out = Voxels::zeroed(dtype, shape.iter().product());
    out.fill(value);
    out
}

/// Shapes with odd sizes and axes of one voxel.
pub(crate) const SHAPES: [Shape; 5] = [[1, 1, 1], [1, 1, 40], [7, 1, 9], [9, 11, 37], [5, 6, 70]];
