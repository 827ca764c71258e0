//! Polynomials of the estimators. Only IEEE operations and explicit fused multiply-adds, so that every instruction set
//! (and the shaders) computes the same bits. The coefficients are minimax fits of relative error, made for this project.

use crate::kernel::convert::unit_code;

/// `2^x` for `x <= 0`, relative error 1e-7; anything below -125 gives about 2e-38.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    const LINEAR: f32 = f32::from_bits(0x3f31_7215); // 0.69314700, a little below ln 2
    const MAGIC: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to the nearest integer
    let x = if x > -125.0 { x } else { -125.0 };
    let z = x + MAGIC;
    let f = x - (z - MAGIC);
    let p = 0.001_326_472_7f32
        .mul_add(f, 0.009_671_513)
        .mul_add(f, 0.055_507_336)
        .mul_add(f, 0.240_222_42)
        .mul_add(f, LINEAR)
        .mul_add(f, 1.0);
    // The low bits of `z` hold the integer; wrapping, the shift drops the rest.
    f32::from_bits(p.to_bits().wrapping_add(z.to_bits() << 23))
}

/// `log2(1 + f) / f` for `f` in [-1/3, 1/3], relative error 1.1e-6.
#[inline(always)]
fn log2_ratio(f: f32) -> f32 {
    0.246_199_53f32
        .mul_add(f, -0.279_993_83)
        .mul_add(f, 0.285_692_45)
        .mul_add(f, -0.358_389_38)
        .mul_add(f, 0.480_960_9)
        .mul_add(f, -0.721_379_9)
        .mul_add(f, 1.442_694_8)
}

/// `log2(1 + f)` for `f` in [-1/3, 1/3], relative error 1.1e-6.
#[inline(always)]
pub fn log2_1p(f: f32) -> f32 {
    f * log2_ratio(f)
}

/// `log2(x)` for finite `x > 0`, subnormal or not, absolute error 1e-6.
pub fn log2(x: f64) -> f64 {
    const SCALE: f64 = 18_014_398_509_481_984.0; // 2^54
    const TWO_THIRDS: u64 = 0x3fe5_5555_5555_5556;
    let (x, shift) = if x < f64::MIN_POSITIVE { (x * SCALE, -54.0) } else { (x, 0.0) };
    let bits = x.to_bits().wrapping_sub(TWO_THIRDS);
    let mantissa = f64::from_bits((bits & 0xf_ffff_ffff_ffff) + TWO_THIRDS) - 1.0;
    shift + ((bits as i64) >> 52) as f64 + log2_1p(mantissa as f32) as f64
}

/// Natural logarithm of a normal `x > 0`, f64, relative error 4e-16 away from 1, absolute 1e-16 near it.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    const ROOT_HALF: u64 = 0x3fe6_a09e_667f_3bcd;
    const LN2_HIGH: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000); // 32 bits: its multiples are exact
    const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    let bits = x.to_bits().wrapping_sub(ROOT_HALF);
    let exponent = ((bits as i64) >> 52) as f64;
    let f = f64::from_bits((bits & 0xf_ffff_ffff_ffff) + ROOT_HALF) - 1.0;
    // 2 artanh(s), s in [-0.172, 0.172]: ten terms of the series leave 2e-17.
    let s = f / (2.0 + f);
    let w = s * s;
    let mut p = 1.0 / 21.0;
    for odd in [19.0, 17.0, 15.0, 13.0, 11.0, 9.0, 7.0, 5.0, 3.0] {
        p = w.mul_add(p, 1.0 / odd);
    }
    let near = 2.0 * s * (w * p) + 2.0 * s;
    exponent.mul_add(LN2_HIGH, exponent.mul_add(LN2_LOW, near))
}

/// `e^x` in f64 for `x` in [-700, 700] (clamped), relative error 2e-14.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    const LN2_HIGH: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000);
    const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    const MAGIC: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52: adding it rounds to the nearest integer
    let x = if x > -700.0 { x } else { -700.0 };
    let x = if x < 700.0 { x } else { 700.0 };
    let z = x.mul_add(std::f64::consts::LOG2_E, MAGIC);
    let n = z - MAGIC;
    let r = n.mul_add(-LN2_LOW, n.mul_add(-LN2_HIGH, x));
    let mut p = 1.0 / 39_916_800.0; // 1 / 11!
    for inverse in [3_628_800.0, 362_880.0, 40_320.0, 5_040.0, 720.0, 120.0, 24.0, 6.0, 2.0, 1.0, 1.0] {
        p = r.mul_add(p, 1.0 / inverse);
    }
    f64::from_bits(p.to_bits().wrapping_add(z.to_bits() << 52))
}

/// Standard normal distribution function, absolute error 2e-7 (Abramowitz and Stegun 7.1.26).
#[inline(always)]
pub fn phi(z: f32) -> f32 {
    let x = z.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let t = 1.0 / 0.327_591_1f32.mul_add(x, 1.0);
    let p =
        1.061_405_4f32.mul_add(t, -1.453_152).mul_add(t, 1.421_413_8).mul_add(t, -0.284_496_72).mul_add(t, 0.254_829_6)
            * t;
    let tail = 0.5 * p * exp2(-(x * x) * std::f32::consts::LOG2_E);
    if z >= 0.0 { 1.0 - tail } else { tail }
}

/// Round half even of `255 o` for `o` in [0, 1].
#[inline(always)]
pub fn quantise(o: f32) -> u8 {
    unit_code(o, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phi_is_symmetric_and_right_at_known_points() {
        let known = [(0.0, 0.5), (1.0, 0.841_344_746), (2.0, 0.977_249_868), (3.5, 0.999_767_371), (40.0, 1.0)];
        for (z, p) in known {
            assert!((phi(z) as f64 - p).abs() < 3e-7, "{z}");
            assert!((phi(-z) as f64 - (1.0 - p)).abs() < 3e-7, "-{z}");
        }
    }

    #[test]
    fn ln_and_exp_agree_with_the_library() {
        for i in 0..20_000 {
            let x = 10f64.powf(-300.0 + 0.03 * i as f64);
            assert!((ln(x) - x.ln()).abs() <= 5e-16 * x.ln().abs().max(0.3), "ln {x}");
            let y = -690.0 + 0.069 * i as f64;
            assert!((exp(y) / y.exp() - 1.0).abs() < 3e-14, "exp {y}");
        }
        assert_eq!((ln(1.0), exp(0.0)), (0.0, 1.0));
    }

    #[test]
    fn quantise_rounds_half_even() {
        for i in 0..=100_000 {
            let o = i as f32 / 100_000.0;
            assert_eq!(quantise(o), (255.0 * o).round_ties_even() as u8, "{o}");
        }
        assert_eq!((quantise(0.5), quantise(1.0), quantise(0.0)), (128, 255, 0));
    }
}
