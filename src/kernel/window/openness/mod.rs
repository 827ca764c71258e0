//! Openness of rows of integer windows, 32 at a time: the arithmetic of [`super::math`] on vectors.

use super::estimate::{Code, RowSum};
use super::math;
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

pub use power::{STRIP, Strip, cdf_power_rows, powers};
pub use spread::{CHEBYSHEV, GAUSSIAN, LITERAL, Squares, spread_rows, spread_strip};

/// Windows of consecutive rows: row `k` of the centres (codes before `flip`) starts at `k * v_pitch`, of the counts `n` at
/// `k * n_pitch`, of everything else at `k * pitch`.
#[derive(Clone, Copy)]
pub struct Rows<'a, T, X1> {
    pub v: &'a [T],
    pub v_pitch: usize,
    pub flip: T,
    pub s1: &'a [X1],
    pub n: &'a [u32],
    pub n_pitch: usize,
    pub pitch: usize,
    /// Most voxels in a window.
    pub most: u64,
    pub rows: usize,
    /// Voxels of a row.
    pub len: usize,
}

/// One of them. All slices are of one length.
#[derive(Clone, Copy)]
pub struct Row<'a, T, X1> {
    pub v: &'a [T],
    pub flip: T,
    pub s1: &'a [X1],
    pub n: &'a [u32],
}

/// Where rows go: row `k` starts at `k * pitch`.
pub struct Target<'a, O> {
    pub data: &'a mut [O],
    pub pitch: usize,
}

/// Types that openness is written as.
pub trait Openness: Copy + Default {
    /// Estimators may err by up to 1.8e-4.
    const COARSE: bool;
    fn of(openness: f32) -> Self;
    /// # Safety
    /// 32 values can be written there.
    unsafe fn put<L: F32x32>(openness: L, to: *mut Self);
}
impl Openness for f32 {
    const COARSE: bool = false;
    fn of(openness: f32) -> f32 {
        openness
    }
    #[inline(always)]
    unsafe fn put<L: F32x32>(openness: L, to: *mut f32) {
        // SAFETY: the caller's promise.
        unsafe { openness.store(to) }
    }
}
/// 2^23: a sum with it holds the other number, rounded half even, in its low bits.
const ROUNDED: f32 = 8_388_608.0;

/// Round half even of 255 times it.
impl Openness for u8 {
    const COARSE: bool = true;
    fn of(openness: f32) -> u8 {
        math::quantise(openness)
    }
    #[inline(always)]
    unsafe fn put<L: F32x32>(openness: L, to: *mut u8) {
        // SAFETY: the caller's promise.
        unsafe { openness.times(L::splat(255.0)).plus(L::splat(ROUNDED)).store_codes(to) }
    }
}

impl<'a, T: Code, X1: RowSum> Rows<'a, T, X1> {
    #[inline(always)]
    fn row(&self, k: usize) -> Row<'a, T, X1> {
        let (s1, n) = (&self.s1[k * self.pitch..][..self.len], &self.n[k * self.n_pitch..][..self.len]);
        Row { v: &self.v[k * self.v_pitch..][..self.len], flip: self.flip, s1, n }
    }

    /// Products of a count and a code, and so all differences of such products and sums, fit in i32.
    fn narrow(&self) -> bool {
        T::TOP <= u16::MAX as u32 && size_of::<X1>() == 4 && (self.most as u128 * T::TOP as u128) < 1 << 31
    }
}

impl<T: Code, X1: RowSum> Row<'_, T, X1> {
    #[inline(always)]
    fn part(&self, from: usize, to: usize) -> Self {
        Row { v: &self.v[from..to], s1: &self.s1[from..to], n: &self.n[from..to], ..*self }
    }
}

/// Row `k`, of less than a block, as the first values of a row of a block, through `of`.
fn one_padded<T: Code, X1: RowSum, O: Openness>(
    rows: &Rows<T, X1>,
    k: usize,
    out: &mut Target<O>,
    of: impl Fn(&Rows<T, X1>, &mut Target<O>),
) {
    let (row, len) = (rows.row(k), rows.len);
    let (v, s1, n) = (padded(row.v, len), padded(row.s1, len), padded(row.n, len));
    let (mut all, pitch) = ([O::default(); SINGLES], SINGLES);
    let block = Rows { v: &v, v_pitch: pitch, s1: &s1, n: &n, n_pitch: pitch, pitch, rows: 1, len: SINGLES, ..*rows };
    of(&block, &mut Target { data: &mut all, pitch });
    out.data[k * out.pitch..][..len].copy_from_slice(&all[..len]);
}

/// The first `len` values, at least one, and the last of them again.
pub fn padded<T: Copy>(from: &[T], len: usize) -> [T; SINGLES] {
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
