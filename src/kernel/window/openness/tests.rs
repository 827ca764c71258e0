use super::*;
use crate::kernel::simd::Level;
use crate::kernel::window::estimate::{Polarity, Spread};

/// Windows of u16 codes with every order of size of beta, t and count, constant ones among them.
struct Windows {
    v: Vec<u16>,
    lo: Vec<u16>,
    hi: Vec<u16>,
    s1: Vec<u64>,
    n: Vec<u32>,
}

fn windows(len: usize, most: u32) -> Windows {
    let mut state = 1u64;
    let mut next = |below: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % below.max(1)
    };
    let mut w = Windows { v: vec![], lo: vec![], hi: vec![], s1: vec![], n: vec![] };
    for i in 0..len {
        let lo = next(65_536);
        let range = next(65_536 - lo) >> next(16);
        let v = lo + [0, range, next(range + 1), range - next(range + 1) / 64][i % 4];
        let n = 3 + next(most as u64 - 3);
        // The extremes and the centre are in the window; the rest lies anywhere between.
        let rest = (n - 3) * lo + next((n - 3) * range + 1) / [1, 1000, 1_000_000][i % 3];
        w.v.push(v as u16);
        w.lo.push(lo as u16);
        w.hi.push((lo + range) as u16);
        w.s1.push(rest + lo + (lo + range) + v);
        w.n.push(n as u32);
    }
    w
}

fn row<'a, X1>(w: &'a Windows, s1: &'a [X1], flip: u16, most: u64) -> Row<'a, u16, X1> {
    Row { v: &w.v, flip, s1, n: &w.n, most }
}

#[test]
fn power_is_within_2e6_of_the_formula_and_the_same_at_every_level_and_width() {
    for (len, flipped) in [(1, false), (31, true), (32, false), (33, true), (255, false), (700, true), (4000, false)] {
        let w = windows(len, 30_000);
        let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
        let polarity = Polarity { flipped, constant: if len % 2 == 0 { 0.5 } else { 1.0 } };
        let mut first: Option<Vec<f32>> = None;
        for level in Level::available() {
            let (mut wide, mut out) = (vec![7.0; len], vec![7.0; len]);
            cdf_power_row(level, &row(&w, &w.s1, 0, 30_000), &w.lo, &w.hi, polarity, &mut wide);
            cdf_power_row(level, &row(&w, &narrow, 0, 30_000), &w.lo, &w.hi, polarity, &mut out);
            assert_eq!(wide, out, "{level:?}");
            assert_eq!(first.get_or_insert_with(|| out.clone()), &out, "{level:?}");
            for (i, got) in out.iter().enumerate() {
                let (v, lo, hi, s, n) = (w.v[i] as f64, w.lo[i] as f64, w.hi[i] as f64, w.s1[i] as f64, w.n[i] as f64);
                let (a, p, q) = match flipped {
                    false => (v - lo, s - n * lo, n * hi - s),
                    true => (hi - v, n * hi - s, s - n * lo),
                };
                let t = a / (hi - lo);
                let log = if t > 0.5 { ((a - (hi - lo)) / (hi - lo)).ln_1p() } else { t.ln() };
                let exact = if hi == lo { polarity.constant as f64 } else { ((p / q).clamp(1e-6, 1e6) * log).exp() };
                assert!((*got as f64 - exact).abs() < 2e-6, "{level:?} {i}: {got} {exact}");
                assert!(hi > lo || *got == polarity.constant, "constant windows are exact");
            }
        }
    }
}

#[test]
fn spreads_follow_their_formulas_and_are_the_same_at_every_level_and_width() {
    for (len, flipped) in [(1, false), (31, true), (40, false), (3000, true)] {
        let w = windows(len, 30_000);
        let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
        // Any spread is possible beside a sum; 0 stands for a constant window.
        let spread: Vec<f64> = (0..len).map(|i| if i % 7 == 0 { 0.0 } else { 10f64.powi(i as i32 % 18) }).collect();
        let polarity = Polarity { flipped, constant: 0.5 };
        for kind in [Spread::Gaussian, Spread::Chebyshev, Spread::Literal] {
            let mut first: Option<Vec<f32>> = None;
            for level in Level::available() {
                let (mut wide, mut out) = (vec![7.0; len], vec![7.0; len]);
                spread_row(level, kind, &row(&w, &w.s1, 0, 30_000), &spread, polarity, &mut wide);
                spread_row(level, kind, &row(&w, &narrow, 0, 30_000), &spread, polarity, &mut out);
                assert_eq!(wide, out, "{level:?}");
                assert_eq!(first.get_or_insert_with(|| out.clone()), &out, "{level:?}");
                for (i, got) in out.iter().enumerate() {
                    let d = w.n[i] as f64 * w.v[i] as f64 - w.s1[i] as f64;
                    let (d, m) = (if flipped { -d } else { d }, spread[i]);
                    let exact = match kind {
                        _ if m == 0.0 => 0.5,
                        Spread::Gaussian => crate::kernel::window::math::phi((d / m.sqrt()) as f32) as f64,
                        Spread::Chebyshev => {
                            if d > 0.0 {
                                d * d / (m + d * d)
                            } else {
                                0.0
                            }
                        }
                        Spread::Literal => {
                            if d > 0.0 {
                                m / (m + d * d)
                            } else {
                                1.0
                            }
                        }
                    };
                    assert!((*got as f64 - exact).abs() < 6e-7, "{kind:?} {level:?} {i}: {got} {exact}");
                }
            }
        }
    }
}

/// Sums of 2^31 voxels of 32 bits: products of deviations would leave f32.
#[test]
fn huge_spreads_do_not_overflow() {
    let (v, n) = ([u32::MAX; 40], [i32::MAX as u32; 40]);
    let s1 = [n[0] as u64 * (u32::MAX as u64 / 2); 40];
    let deviation = n[0] as f64 * (u32::MAX as f64 / 2.0);
    for level in Level::available() {
        let mut out = [0.0; 40];
        let row = Row { v: &v, flip: 0, s1: &s1, n: &n, most: n[0] as u64 };
        let polarity = Polarity { flipped: false, constant: 1.0 };
        spread_row(level, Spread::Gaussian, &row, &[deviation * deviation; 40], polarity, &mut out);
        assert!(out.iter().all(|o| (o - 0.841_344_7).abs() < 1e-6), "{level:?} {out:?}");
    }
}
