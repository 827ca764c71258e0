//! Moments of rows of integer windows, from exact sums to results.

use super::emit::IntRows;
use super::estimate::{Acc, Code, RowSum, exact_mean, long_mean, numerators};
use super::openness::Target;
use crate::grid::{Affine, Voxel};
use crate::stage::WindowChannel;

crate::multiversion! {
    /// Writes mean, variance, std or second moment of 8- and 16-bit codes, scaled and rounded once. A stored value is
    /// `code - offset`. Every value stays in registers from sums to result: 2-core Zen 4 VM, AVX-512, 2026-11-27, all
    /// four moments of u8, r=10: 3.4 ns per voxel with steps of 256 values through buffers, 2.75 so.
    pub fn moment_rows['a, T: Code, X1: RowSum, X2: Acc, O: Voxel](
        channel: WindowChannel, rows: &IntRows<T, X1, X2>, offset: f64, affine: Affine, to: Target<'a, O>
    ) -> () = moments_inner;
}

#[inline(always)]
fn moments_inner<T: Code, X1: RowSum, X2: Acc, O: Voxel>(
    channel: WindowChannel,
    rows: &IntRows<T, X1, X2>,
    offset: f64,
    affine: Affine,
    to: Target<O>,
) {
    let exact = rows.most as u128 * (T::TOP as u128) < 1 << 52;
    let (a, b) = (affine.slope, affine.intercept);
    for k in 0..rows.rows {
        let (start, counted) = (k * rows.pitch, k * rows.n_pitch);
        let (s1, n) = (&rows.s1[start..][..rows.len], &rows.n[counted..][..rows.len]);
        let inverse = &rows.inverse[counted..][..rows.len];
        let out = &mut to.data[k * to.pitch..][..rows.len];
        // Sums of squares are made where they are needed.
        let s2 = if channel == WindowChannel::Mean { &[][..] } else { &rows.s2[start..][..rows.len] };
        match channel {
            WindowChannel::Mean if exact => {
                for i in 0..rows.len {
                    out[i] = O::from_f64(a * exact_mean(s1[i], n[i], inverse[i], offset) + b);
                }
            }
            WindowChannel::Mean => {
                for i in 0..rows.len {
                    out[i] = O::from_f64(a * long_mean(s1[i], n[i], offset) + b);
                }
            }
            // Within 2^-51 of itself.
            WindowChannel::Variance => numerators!(s1, s2, n, rows.width, |i, m| {
                out[i] = O::from_f64(a * a * (m * inverse[i] * inverse[i]));
            }),
            WindowChannel::Std => numerators!(s1, s2, n, rows.width, |i, m| {
                out[i] = O::from_f64(a.abs() * (m * inverse[i] * inverse[i]).sqrt());
            }),
            // Unscaled: from the exact sum, so that halves between two f32 go to the even one.
            WindowChannel::Moment2 if affine.is_identity() => {
                let few = rows.most as u128 * (T::TOP as u128).pow(2) < 1 << 52;
                for i in 0..rows.len {
                    let squares = squares(s1[i].low(), s2[i].low(), n[i], offset as u64);
                    out[i] = O::from_f64(match few {
                        true => exact_mean(squares, n[i], inverse[i], 0.0),
                        false => squares as f64 / n[i] as f64,
                    });
                }
            }
            _ => numerators!(s1, s2, n, rows.width, |i, m| {
                let mean = match exact {
                    true => exact_mean(s1[i], n[i], inverse[i], offset),
                    false => long_mean(s1[i], n[i], offset),
                };
                let mean = a * mean + b;
                out[i] = O::from_f64(a * a * (m * inverse[i] * inverse[i]) + mean * mean);
            }),
        }
    }
}

/// Sum of the squares of stored values, which are codes less `offset`: below 2^63, so what wraps on the way comes back.
#[inline(always)]
fn squares(s1: u64, s2: u64, n: u32, offset: u64) -> u64 {
    let shift = (n as u64 * offset).wrapping_mul(offset);
    s2.wrapping_add(shift).wrapping_sub(2u64.wrapping_mul(offset).wrapping_mul(s1))
}
