//! Openness of rows of integer windows, 32 at a time: the arithmetic of [`super::math`] on vectors.

use super::estimate::{Code, RowSum};
use crate::kernel::singles::{F32x32, SINGLES};

/// Runs `$body` for starts of blocks of 32 that cover `0..len`, at least 32 values; the last may overlap its neighbour, and
/// makes the same values again.
macro_rules! blocks {
    ($len:ident, |$at:ident| $body:block) => {
        let mut $at = 0;
        loop {
            $body
            if $at + SINGLES >= $len {
                break;
            }
            $at = ($at + SINGLES).min($len - SINGLES);
        }
    };
}

mod power;
mod spread;
#[cfg(test)]
mod tests;

pub use power::cdf_power_row;
pub use spread::spread_row;

/// Codes of the centres (before `flip`), and their windows. All slices are of one length.
#[derive(Clone, Copy)]
pub struct Row<'a, T, X1> {
    pub v: &'a [T],
    pub flip: T,
    pub s1: &'a [X1],
    pub n: &'a [u32],
    /// Most voxels in a window.
    pub most: u64,
}

impl<T: Code, X1: RowSum> Row<'_, T, X1> {
    #[inline(always)]
    fn part(&self, from: usize, to: usize) -> Self {
        Row { v: &self.v[from..to], s1: &self.s1[from..to], n: &self.n[from..to], ..*self }
    }

    /// Products of a count and a code, and so all differences of such products and sums, fit in i32.
    fn narrow(&self) -> bool {
        T::TOP <= u16::MAX as u32 && size_of::<X1>() == 4 && (self.most as u128 * T::TOP as u128) < 1 << 31
    }
}

/// The first `len` values and the last of them again.
fn padded<T: Copy>(from: &[T], len: usize) -> [T; SINGLES] {
    std::array::from_fn(|i| from[i.min(len - 1)])
}

// Polynomials are split into pairs of terms, whose sums do not wait for each other.

/// [`super::math::exp2`] within its error, but 0 below -125.
#[inline(always)]
fn exp2<L: F32x32>(x: L) -> L {
    let magic = L::splat(12_582_912.0);
    let z = x.plus(magic);
    let f = x.minus(z.minus(magic));
    let square = f.times(f);
    let low = f.fused(L::splat(f32::from_bits(0x3f31_7215)), L::splat(1.0));
    let middle = f.fused(L::splat(0.055_507_336), L::splat(0.240_222_42));
    let high = f.fused(L::splat(0.001_326_472_7), L::splat(0.009_671_513));
    let p = high.fused(square, middle).fused(square, low);
    L::pick(x.is_below(L::splat(-125.0)), L::splat(0.0), p.scaled(z))
}
