//! Bounds of a distribution at one point from four power moments (Chebyshev, Markov, Stieltjes).
//!
//! Values x are relative to the centre, so the point is 0, and `t[k - 1]` is the sum of x^k over the window. The sharp bounds
//! come from the distribution with these moments that has 0 and the roots of `a2 x^2 + a1 x + a0` for nodes. Roots are
//! rounded, though, and moments of a few values make the quadratic vanish. So nothing here trusts them: with any `s, t > 0`
//! there is a polynomial P of degree four that is nowhere below the step at 0, and then the mean of P is a bound, sharp where
//! -1/s and 1/t happen to be the nodes. Its mean is a sum of five products, whose rounding is easily bounded.

/// More than the relative error of any product below: each factor is right to 40 roundings of 2^-53.
const SLACK: f64 = 1.0 / (1u64 << 46) as f64;

/// Least and greatest possible number of voxels below the centre and not above it: `(lower, upper)` with
/// `lower <= #{x < 0}` and `#{x <= 0} <= upper`, whole numbers in [0, n]. `t` is right to a rounding, `t[1] >= 0`; all zero
/// gives `(0, n)`. Never NaN.
#[inline(always)]
pub fn bounds(n: f64, [t1, t2, t3, t4]: [f64; 4]) -> (f64, f64) {
    // Sum over (1 + b x + a x^2)^2, and a bound of what rounding did to it.
    let square = |a: f64, b: f64| {
        let (bb, ab) = (b * b, 2.0 * a * b);
        let sum = n + 2.0 * b * t1 + (bb + 2.0 * a) * t2 + ab * t3 + a * a * t4;
        let size = n + (2.0 * b * t1).abs() + (bb + 2.0 * a.abs()) * t2 + (ab * t3).abs() + a * a * t4;
        (sum, SLACK * size)
    };
    // Two moments: the least of the above with a = 0. The parabola is at least 1 beyond the centre, seen from the mean.
    let far = n - t1 * t1 / t2 + SLACK * n;
    let mut upper = least(if t1 > 0.0 { far } else { n }, n);
    let mut lower = greatest(if t1 < 0.0 { n - far } else { 0.0 }, 0.0);

    let a2 = t2 * t2 - t1 * t3;
    let a1 = t4 * t1 - t3 * t2;
    let a0 = t3 * t3 - t2 * t4;
    // The quadratic, made 1 at 0. One node on each side of the centre, or both on one.
    let by = 1.0 / a0;
    let (a, b) = (a2 * by, a1 * by);
    let (between, beside) = (a2 > 0.0 && a0 < 0.0, a2 < 0.0 && a0 < 0.0);
    // Between: the nodes are -1/s and 1/t, so -s and t solve u^2 + b u + a = 0.
    let q = -0.5 * (b + (b * b - 4.0 * a).sqrt().copysign(b));
    let other = a / q;
    let (s, t) = if q < 0.0 { (-q, other) } else { (-other, q) };
    let (a, b) = if between { (-(s * t), s - t) } else { (a, b) };
    let (sum, error) = square(a, b);

    // P is 1 and flat at -1/s, 1 at 0, 0 and flat at 1/t, which makes it 1 + x (1 + s x)^2 (d x - c).
    let st = s + t;
    let scale = t * t * t / (st * st * st);
    let c = (4.0 * s + 2.0 * t) * scale;
    let d = (3.0 * s + t) * t * scale;
    let ss = s * s;
    let above = n + d * (t2 + 2.0 * s * t3 + ss * t4) - c * (t1 + 2.0 * s * t2 + ss * t3);
    let size = n + d * (t2 + 2.0 * s * t3.abs() + ss * t4) + c * (t1.abs() + 2.0 * s * t2 + ss * t3.abs());
    // The polynomial below the step is P less that square, which is 1 at the centre and flat at 0 in both nodes.
    let (mid_upper, mid_lower) = (above + SLACK * size, above - sum - SLACK * size - error);

    // Both nodes on one side: the square is at least 1 on the other.
    let one = sum + error;
    let no_more = if between {
        mid_upper
    } else if beside && b <= 0.0 {
        one
    } else {
        n
    };
    let no_less = if between {
        mid_lower
    } else if beside && b >= 0.0 {
        n - one
    } else {
        0.0
    };
    upper = least(no_more, upper);
    lower = greatest(no_less, lower);
    // Counts are whole.
    (greatest(up(lower), 0.0), greatest(down(upper), 0.0))
}

/// `a`, unless `b` is less or `a` is NaN.
#[inline(always)]
fn least(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

#[inline(always)]
fn greatest(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// Adding it rounds numbers below 2^51 to whole ones. (The instruction sets of old have no floor.)
pub const WHOLE: f64 = 6_755_399_441_055_744.0;

#[inline(always)]
pub fn down(v: f64) -> f64 {
    let w = (v + WHOLE) - WHOLE;
    if w > v { w - 1.0 } else { w }
}

#[inline(always)]
pub fn up(v: f64) -> f64 {
    let w = (v + WHOLE) - WHOLE;
    if w < v { w + 1.0 } else { w }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hostile::Noise;

    fn sums(x: &[f64]) -> [f64; 4] {
        [1, 2, 3, 4].map(|k| x.iter().map(|v| v.powi(k)).sum())
    }

    fn counts(x: &[f64]) -> (f64, f64) {
        (x.iter().filter(|v| **v < 0.0).count() as f64, x.iter().filter(|v| **v <= 0.0).count() as f64)
    }

    #[test]
    fn three_values_or_fewer_are_known_exactly() {
        // Distinct values, the centre's 0 among them, with any number of voxels each.
        for (low, high) in
            [(-1.0, 2.0), (-65535.0, 1.0), (3.0, 900.0), (-7.0, -5.0), (-1.0, 65535.0), (-20000.0, 40000.0)]
        {
            for [a, b, c] in [[1, 1, 1], [5, 2, 20], [100, 1, 1], [1, 4000, 1], [300, 1, 900], [0, 7, 20], [7, 20, 0]] {
                let mut x = vec![low; a];
                x.extend(vec![0.0; b]);
                x.extend(vec![high; c]);
                assert_eq!(bounds(x.len() as f64, sums(&x)), counts(&x), "{low} {high} {a} {b} {c}");
            }
        }
        for n in [1.0, 2.0, 9261.0, 2_147_483_647.0] {
            assert_eq!(bounds(n, [0.0; 4]), (0.0, n));
        }
    }

    #[test]
    fn whole_numbers_by_hand() {
        for v in [0.0, 0.25, 0.5, 1.0, 1.5, 2.5, 1e9 + 0.75, 2_147_483_647.0, -0.25, -1.5] {
            assert_eq!((down(v), up(v)), (v.floor(), v.ceil()), "{v}");
        }
    }

    /// Windows of few and many values, near ties, outliers and skewed tails, seen from each of their voxels.
    #[test]
    fn the_counts_lie_between_the_bounds() {
        let mut noise = Noise(17);
        let mut width = [0.0; 2];
        for case in 0..4000 {
            let n = 1 + noise.below(60);
            let spread = [2, 3, 5, 200, 65536][case % 5];
            let mut values: Vec<f64> = (0..n).map(|_| noise.below(spread) as f64).collect();
            match case % 7 {
                0 => values[0] = 65535.0,
                1 => values.iter_mut().for_each(|v| *v = (*v / 200.0).powi(3).floor()),
                2 => values.iter_mut().skip(1).for_each(|v| *v += 40000.0),
                3 => values.iter_mut().skip(2).for_each(|v| *v = 60000.0 + *v % 2.0),
                _ => {}
            }
            for centre in values.clone() {
                let x: Vec<f64> = values.iter().map(|v| v - centre).collect();
                let ((lower, upper), (below, at_most)) = (bounds(n as f64, sums(&x)), counts(&x));
                assert!(
                    0.0 <= lower && lower <= below && at_most <= upper && upper <= n as f64,
                    "{case} {centre} {values:?}"
                );
                assert!(lower.fract() == 0.0 && upper.fract() == 0.0);
                width = [width[0] + (upper - lower) / n as f64, width[1] + 1.0];
            }
        }
        // Bounds that said nothing would pass all of the above.
        assert!(width[0] / width[1] < 0.6, "{}", width[0] / width[1]);
    }
}
