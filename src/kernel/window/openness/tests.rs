use super::*;
use crate::kernel::simd::Level;
use crate::kernel::window::estimate::{Polarity, Spread, Width};

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

/// All windows as one row, or as three with the rest left out.
fn rows<'a, X1>(w: &'a Windows, s1: &'a [X1], most: u64, rows: usize) -> Rows<'a, u16, X1> {
    let pitch = w.v.len() / rows;
    Rows { v: &w.v, v_pitch: pitch, flip: 0, s1, n: &w.n, n_pitch: pitch, pitch, most, rows, len: pitch }
}

/// What `of` writes of windows, as one row and as three, where it must be the same.
fn written<O: Openness + PartialEq + std::fmt::Debug>(len: usize, of: impl Fn(usize, &mut Target<O>)) -> Vec<O> {
    let [one, three] = [1, 3].map(|rows| {
        let mut out = vec![O::default(); len];
        of(rows, &mut Target { data: &mut out, pitch: len / rows });
        out
    });
    assert_eq!(one[..len / 3 * 3], three[..len / 3 * 3]);
    one
}

#[test]
fn power_is_within_2e6_of_the_formula_and_the_same_at_every_level_and_width() {
    for (len, flipped) in [(3, false), (31, true), (32, false), (33, true), (255, false), (700, true), (4000, false)] {
        let w = windows(len, 30_000);
        let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
        let polarity = Polarity { flipped, constant: if len % 2 == 0 { 0.5 } else { 1.0 } };
        let mut first: Option<(Vec<f32>, Vec<u8>)> = None;
        for level in Level::available() {
            let of = |k: usize, to: &mut Target<f32>| {
                cdf_power_rows(level, &rows(&w, &narrow, 30_000, k), &w.lo, &w.hi, polarity, to)
            };
            let out = written(len, of);
            let wide = written(len, |k, to: &mut Target<f32>| {
                cdf_power_rows(level, &rows(&w, &w.s1, 30_000, k), &w.lo, &w.hi, polarity, to)
            });
            let codes: Vec<u8> =
                written(len, |k, to| cdf_power_rows(level, &rows(&w, &narrow, 30_000, k), &w.lo, &w.hi, polarity, to));
            assert_eq!(wide, out, "{level:?}");
            let all = (out.clone(), codes.clone());
            assert_eq!(first.get_or_insert_with(|| all.clone()), &all, "{level:?}");
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
                let code = codes[i] as f64;
                assert!((code - 255.0 * exact).abs() <= 0.5 + 255.0 * 1.3e-4, "{level:?} {i}: {code} {exact}");
                assert!(hi > lo || codes[i] == u8::of(polarity.constant), "constant windows are exact");
            }
        }
    }
}

#[test]
fn spreads_follow_their_formulas_and_are_the_same_at_every_level_and_width() {
    for (len, flipped) in [(3, false), (31, true), (40, false), (3000, true)] {
        let mut w = windows(len, 30_000);
        // Any spread is possible beside a sum; some windows are constant.
        let mut s2 = vec![0u128; len];
        for (i, s2) in s2.iter_mut().enumerate() {
            if i % 7 == 0 {
                w.s1[i] = w.n[i] as u64 * w.lo[i] as u64;
            }
            let spread = if i % 7 == 0 { 0 } else { 10u128.pow(i as u32 % 18) };
            *s2 = (w.s1[i] as u128 * w.s1[i] as u128 + spread).div_ceil(w.n[i] as u128);
        }
        let squares = Squares { s2: &s2, width: Width::Big };
        let spread: Vec<u128> = (0..len).map(|i| w.n[i] as u128 * s2[i] - w.s1[i] as u128 * w.s1[i] as u128).collect();
        let narrow: Vec<u32> = w.s1.iter().map(|s| *s as u32).collect();
        let polarity = Polarity { flipped, constant: 0.5 };
        for kind in [Spread::Gaussian, Spread::Chebyshev, Spread::Literal] {
            let mut first: Option<Vec<f32>> = None;
            for level in Level::available() {
                let wide = written(len, |k, to: &mut Target<f32>| {
                    spread_rows(level, kind, &rows(&w, &w.s1, 30_000, k), &squares, polarity, to)
                });
                let out = written(len, |k, to: &mut Target<f32>| {
                    spread_rows(level, kind, &rows(&w, &narrow, 30_000, k), &squares, polarity, to)
                });
                let codes: Vec<u8> = written(len, |k, to| {
                    spread_rows(level, kind, &rows(&w, &narrow, 30_000, k), &squares, polarity, to)
                });
                assert!(codes.iter().zip(&out).all(|(c, o)| *c == (255.0 * o).round_ties_even() as u8));
                assert_eq!(wide, out, "{level:?}");
                assert_eq!(first.get_or_insert_with(|| out.clone()), &out, "{level:?}");
                for (i, got) in out.iter().enumerate() {
                    let d = w.n[i] as f64 * w.v[i] as f64 - w.s1[i] as f64;
                    let (d, m) = (if flipped { -d } else { d }, spread[i] as f64);
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
    // The deviation is that of the centre.
    let s2 = [2 * s1[0] as u128 * (u32::MAX as u128 / 2); 40];
    let squares = Squares { s2: &s2, width: Width::Big };
    for level in Level::available() {
        let mut out = [0.0; 40];
        let most = n[0] as u64;
        let rows = Rows { v: &v, v_pitch: 40, flip: 0, s1: &s1, n: &n, n_pitch: 40, pitch: 40, most, rows: 1, len: 40 };
        let polarity = Polarity { flipped: false, constant: 1.0 };
        let to = &mut Target { data: &mut out[..], pitch: 40 };
        spread_rows(level, Spread::Gaussian, &rows, &squares, polarity, to);
        assert!(out.iter().all(|o| (o - 0.841_344_7).abs() < 1e-6), "{level:?} {out:?}");
    }
}
