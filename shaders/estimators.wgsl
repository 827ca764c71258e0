// Openness from what a window holds, in f32: roots and quotients may be off by a few bits, logarithm and exponential are
// polynomials of our own.

// Twice the inverse hyperbolic tangent of |s| <= 1/3.
fn twice_atanh(s: f32) -> f32 {
    let q = s * s;
    var sum = 1.0 / 17.0;
    sum = sum * q + 1.0 / 15.0;
    sum = sum * q + 1.0 / 13.0;
    sum = sum * q + 1.0 / 11.0;
    sum = sum * q + 1.0 / 9.0;
    sum = sum * q + 1.0 / 7.0;
    sum = sum * q + 1.0 / 5.0;
    sum = sum * q + 1.0 / 3.0;
    return 2.0 * s + 2.0 * s * (q * sum);
}

// Natural logarithm of a positive normal number.
fn ln(v: f32) -> f32 {
    let bits = bitcast<u32>(v) - 0x3f3504f3u;
    let exponent = bitcast<i32>(bits) >> 23u;
    let m = bitcast<f32>((bits & 0x007fffffu) + 0x3f3504f3u);
    return f32(exponent) * 0.6931472 + twice_atanh((m - 1.0) / (m + 1.0));
}

// Natural logarithm of 1 - u, 0 <= u <= 1/2.
fn ln_less(u: f32) -> f32 {
    return twice_atanh(-u / (2.0 - u));
}

// e^v of a number that is not positive.
fn exp_of(v: f32) -> f32 {
    if v < -87.0 {
        return 0.0;
    }
    let k = floor(v * 1.442695 + 0.5);
    // The first has so few bits that its product is exact.
    let r = (v - k * 0.693359375) + k * 2.1219444e-4;
    var sum = 1.0 / 720.0;
    sum = sum * r + 1.0 / 120.0;
    sum = sum * r + 1.0 / 24.0;
    sum = sum * r + 1.0 / 6.0;
    sum = sum * r + 0.5;
    sum = (sum * r + 1.0) * r + 1.0;
    return sum * bitcast<f32>(u32(i32(k) + 127) << 23u);
}

// Half of the complementary error function of x >= 0, relative error 1.2e-7 (Numerical Recipes, Chebyshev fit).
fn half_erfc(x: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.5 * x);
    var sum = 0.17087277;
    sum = sum * t - 0.82215223;
    sum = sum * t + 1.48851587;
    sum = sum * t - 1.13520398;
    sum = sum * t + 0.27886807;
    sum = sum * t - 0.18628806;
    sum = sum * t + 0.09678418;
    sum = sum * t + 0.37409196;
    sum = sum * t + 1.00002368;
    return 0.5 * t * exp_of(min(-x * x - 1.26551223 + t * sum, 0.0));
}

// Standard normal distribution function.
fn phi(z: f32) -> f32 {
    let tail = half_erfc(min(abs(z), 14.0) * 0.70710678);
    return select(tail, 1.0 - tail, z > 0.0);
}

// t^beta (A 3.2) of a centre `below` from the least value and `above` from the greatest, in the order of density, and of the
// sums of such distances over the window.
fn power(below: f32, above: f32, range: f32, over: f32, under: f32) -> f32 {
    if below == 0.0 {
        return 0.0;
    }
    if above == 0.0 {
        return 1.0;
    }
    let beta = clamp(over / under, 1e-6, 1e6);
    if 2.0 * above < range {
        return exp_of(beta * ln_less(above / range));
    }
    return exp_of(beta * min(ln(below / range), 0.0));
}

// A 3.3, E 3.4 and its literal form by their numbers, of a centre z standard deviations denser than the mean.
fn by_spread(kind: u32, z: f32) -> f32 {
    if kind == 7u {
        return phi(z);
    }
    let least = 1.0 / (1.0 + z * z);
    if kind == 8u {
        return select(0.0, 1.0 - least, z > 0.0);
    }
    return select(1.0, least, z > 0.0);
}
