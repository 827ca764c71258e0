//! Moments of 32-bit integers, whose numerators do not fit in 53 bits: rounded once all the same.

use super::estimate::Acc;
use crate::grid::Voxel;

/// A number below 2^127 as a sum of two f64, the second at most a unit in the last place of the first. By parts of 52 bits:
/// casts of 128 bits are calls (2-core Zen 4 VM, AVX-512, 2026-11-27, variance of u32, r=10: 22 ns per voxel with casts, 9 so).
#[inline(always)]
pub fn split(v: u128) -> [f64; 2] {
    const PART: u64 = (1 << 52) - 1;
    const STEP: f64 = 4_503_599_627_370_496.0; // 2^52
    let (low, high) = (v as u64, (v >> 64) as u64);
    let part = |bits: u64| f64::from_bits((bits & PART) | STEP.to_bits()) - STEP;
    let (first, second) = (part(high >> 40) * (STEP * STEP), part(low >> 52 | high << 12) * STEP);
    // Each sum is at least as large as what joins it, so its error is exact.
    let sum = first + second;
    let rest = (second - (sum - first)) + part(low);
    let all = sum + rest;
    [all, rest - (all - sum)]
}

/// `numerator / denominator`, rounded once (to half an ulp and a 2^-50th of one): the numerator is split in two f64, and
/// the remainder of the first quotient comes from a fused multiply-add. 0 / 0 is NaN.
#[inline(always)]
fn ratio(numerator: u128, denominator: f64) -> f64 {
    let [high, low] = split(numerator);
    let quotient = high / denominator;
    let rest = (-quotient).mul_add(denominator, high) + low;
    quotient + rest / denominator
}

crate::multiversion! {
    /// Population variance of windows of codes from their exact sums.
    pub fn variance_row[X1: Acc, X2: Acc](s1: &[X1], s2: &[X2], n: &[u32], out: &mut [f64]) -> () = variance_inner;
}

#[inline(always)]
fn variance_inner<X1: Acc, X2: Acc>(s1: &[X1], s2: &[X2], n: &[u32], out: &mut [f64]) {
    for (i, o) in out.iter_mut().enumerate() {
        let (s1, s2, n) = (s1[i].wide(), s2[i].wide(), n[i] as u64);
        // n < 2^31 and codes < 2^32: n * s2 < 2^126.
        *o = ratio(n as u128 * s2 - s1 * s1, (n * n) as f64);
    }
}

crate::multiversion! {
    /// Mean square of windows of stored values, which are codes less `offset`.
    pub fn moment2_row[X1: Acc, X2: Acc, O: Voxel](s1: &[X1], s2: &[X2], n: &[u32], offset: u32, out: &mut [O]) -> () = moment2_inner;
}

#[inline(always)]
fn moment2_inner<X1: Acc, X2: Acc, O: Voxel>(s1: &[X1], s2: &[X2], n: &[u32], offset: u32, out: &mut [O]) {
    let offset = offset as u128;
    for (i, o) in out.iter_mut().enumerate() {
        let (s1, s2, n) = (s1[i].wide(), s2[i].wide(), n[i] as u128);
        let squares = s2 + n * offset * offset - 2 * offset * s1;
        *o = O::from_f64(ratio(squares, n as f64));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    /// The quotient by long division, rounded half to even once.
    fn reference(numerator: u128, denominator: u128) -> f64 {
        if numerator == 0 {
            return 0.0;
        }
        let shift = numerator.leading_zeros();
        let shifted = numerator << shift;
        // At least 2^65: the sticky bit lies far below the place where f64 rounds.
        let quotient = (shifted / denominator) | !shifted.is_multiple_of(denominator) as u128;
        quotient as f64 * f64::from_bits((1023 - shift as u64) << 52)
    }

    #[test]
    fn halves_of_numbers_add_up_and_the_first_is_nearly_all() {
        let mut state = 1u128;
        for i in 0..20_000u32 {
            state = state.wrapping_mul(0x2360_ed05_1fc6_5da4_4385_df64_9fcc_f645).wrapping_add(0x5851_f42d_4c95_7f2d);
            let bits = i % 128;
            // Random digits, a power of two, and the numbers beside it.
            for v in [
                state >> 1 >> (127 - bits),
                1 << bits >> 1,
                (1u128 << bits >> 1).saturating_sub(1),
                (1 << bits >> 1) + 1,
            ] {
                let [high, low] = split(v);
                assert!(low.abs() <= high * f64::EPSILON, "{v}: {high} {low}");
                // What is left after the first is small enough for i128, and all but the last digit of the second.
                let rest = v as i128 - high as i128;
                assert!((rest as f64 - low).abs() <= f64::EPSILON * low.abs(), "{v}: {high} {low}, {rest}");
            }
        }
        assert_eq!(split(0), [0.0; 2]);
    }

    #[test]
    fn moments_of_32_bits_are_rounded_once() {
        let mut state = 7u64;
        let mut random = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 32) as u32
        };
        let half = 1i64 << 31;
        let draws: [&mut dyn FnMut() -> u32; 4] = [&mut random, &mut || u32::MAX, &mut || 0, &mut {
            let mut k = 0u32;
            move || {
                k += 1;
                u32::MAX - k % 3
            }
        }];
        for draw in draws {
            for count in [1u32, 2, 3, 7, 27, 1000, 9261] {
                let codes: Vec<u32> = (0..count).map(|_| draw()).collect();
                let s1: u64 = codes.iter().map(|c| *c as u64).sum();
                let s2: u128 = codes.iter().map(|c| (*c as u128).pow(2)).sum();
                let squares: u128 = codes.iter().map(|c| ((*c as i64 - half) as i128).pow(2) as u128).sum();
                let n = count as u128;
                for level in Level::available() {
                    let (mut variance, mut moment2) = ([0.0], [0.0f64]);
                    variance_row(level, &[s1], &[s2], &[count], &mut variance);
                    moment2_row(level, &[s1], &[s2], &[count], half as u32, &mut moment2);
                    assert_eq!(variance[0], reference(n * s2 - (s1 as u128).pow(2), n * n), "{count} {level:?}");
                    assert_eq!(moment2[0], reference(squares, n), "{count} {level:?}");
                }
            }
        }
        let mut none = [1.0];
        variance_row(Level::Baseline, &[0u64], &[0u128], &[0], &mut none);
        assert!(none[0].is_nan(), "a window without voxels");
    }
}
