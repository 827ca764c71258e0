// From exact sums and extremes of windows of small integers to results: statistics in f64 (double.wgsl), openness in f32
// (estimators.wgsl), one plane per channel.
//
// Agrees bit for bit in statistics with src/kernel/window (estimate.rs, emit.rs), in openness within facts::tolerance. Parameters:
// src/gpu/finish.rs, struct Codes.
// Bindings, group 0: 0 uniform Codes; 1 storage, read: packed voxels; 2 storage, written: bits of f32 results; 3 storage,
// read: extremes of codes (window_extremes.wgsl); 4 storage, read: sums of codes; 5 storage, read: sums of their squares. What
// no channel needs may be anything. One thread makes `STRIP` voxels along y.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Codes {
    out_y: u32,     // extents of the output
    out_x: u32,
    centre: u32,    // output 0 among the voxels, and their strides
    in_z: u32,
    in_y: u32,
    packing: u32,   // log2 of voxels per word
    flip: u32,      // the sign bit of a packed voxel, or 0: what codes are more than values
    wide: u32,      // 1: sums of squares have two words
    at_z: u32,      // output 0 in the source, whose windows are cut there
    at_y: u32,
    at_x: u32,
    radius_z: u32,
    radius_y: u32,
    radius_x: u32,
    size_z: u32,    // extents of the source
    size_y: u32,
    size_x: u32,
    centred: u32,   // how the numerator is made exact: 0 as it is, 1 about 2^15, 2 in 128 bits
    count: u32,     // channels
    stride: u32,    // from plane to plane of the results
    flipped: u32,   // 1: smaller is denser
    scaled: u32,    // 1: results are of slope * v + intercept
    threads: u32,
    needs: u32,     // 1: sums of codes are there, 2: of squares, 4: extremes; 8: means are asked for in f64, 16: variances
    whole: u32,     // voxels of a whole window
    strips: u32,    // of `STRIP` rows, in a plane
    share: vec2<u32>, // f64: 1 / whole
    slope: vec2<u32>,
    intercept: vec2<u32>,
    inverse: f32,   // 1 / whole
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
    channels: array<vec4<u32>, 4>, // what each is, and 256 where constant windows are half open
}

// What is compiled: 1 results in f64, 2 numerators of variances, 4 openness by powers, 8 by spreads, 16 counts
// of voxels, 32 other channels than one mean that is not scaled, 64 sums of codes of two words.
override parts: u32 = 127u;

// Divisions that find a thread's place cost as much as a voxel.
const STRIP: u32 = 8u;

@group(0) @binding(0) var<uniform> p: Codes;
@group(0) @binding(1) var<storage, read> voxels: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> extremes: array<u32>;
@group(0) @binding(4) var<storage, read> sums: array<u32>;
@group(0) @binding(5) var<storage, read> squares: array<u32>;

// What a window of codes holds.
struct Window {
    v: u32,
    lo: u32,
    hi: u32,
    n: u32,
    s1: vec2<u32>,
    s2: vec2<u32>,
    numerator: vec2<u32>, // f64, as what follows: n^2 times the variance
    mean: vec2<u32>,      // scaled
    variance: vec2<u32>,  // not scaled
}

fn along(at: u32, radius: u32, size: u32) -> u32 {
    return min(at + radius, size - 1u) - (max(at, radius) - radius) + 1u;
}

fn zeros128(v: vec4<u32>) -> u32 {
    if (v.z | v.w) == 0u {
        return 64u + zeros64(v.xy);
    }
    return zeros64(v.zw);
}

// An integer of 128 bits, rounded once.
fn of_wide(sign: u32, v: vec4<u32>) -> vec2<u32> {
    let shift = zeros128(v);
    if shift >= 64u {
        return joined(sign, 0, v.xy);
    }
    var top = v.zw;
    var low = v.xy;
    if shift > 0u {
        top = left64(v.zw, shift) | right64(v.xy, 64u - shift);
        low = left64(v.xy, shift);
    }
    top.x |= select(0u, 1u, (low.x | low.y) != 0u);
    return joined(sign, 64 - i32(shift), top);
}

// The integer nearest to one of 128 bits that f64 holds.
fn held(v: vec4<u32>) -> vec4<u32> {
    let x = parts_of(of_wide(0u, v));
    if x.exponent <= 0 {
        return vec4<u32>(right64(x.bits, u32(-x.exponent)), 0u, 0u);
    }
    if x.exponent >= 64 {
        return vec4<u32>(0u, 0u, left64(x.bits, u32(x.exponent) - 64u));
    }
    let n = u32(x.exponent);
    return vec4<u32>(left64(x.bits, n), right64(x.bits, 64u - n));
}

fn difference(a: vec4<u32>, b: vec4<u32>) -> vec2<u32> {
    if less128(a, b) {
        return of_wide(SIGN, minus128(b, a));
    }
    return of_wide(0u, minus128(a, b));
}

// n s2 - s1^2 as src/kernel/window/estimate.rs rounds it: fused products, the square in two parts.
fn fused(n: u32, s1: vec2<u32>, s2: vec2<u32>) -> vec2<u32> {
    let square = times64(s1, s1);
    let high = held(square);
    let first = difference(times64(vec2<u32>(n, 0u), s2), high);
    return sum_of(first, negated(difference(square, high)));
}

fn numerator(w: Window) -> vec2<u32> {
    if p.centred == 2u {
        return of_wide(0u, minus128(times64(vec2<u32>(w.n, 0u), w.s2), times64(w.s1, w.s1)));
    }
    if p.centred == 0u {
        return fused(w.n, w.s1, w.s2);
    }
    let shift = left64(vec2<u32>(w.n, 0u), 15u);
    let low = less64(w.s1, shift);
    let s1 = select(minus64(w.s1, shift), minus64(shift, w.s1), low);
    let s2 = plus64(minus64(w.s2, left64(w.s1, 16u)), left64(vec2<u32>(w.n, 0u), 30u));
    return fused(w.n, s1, s2);
}

fn scaled(v: vec2<u32>) -> vec2<u32> {
    if p.scaled == 0u {
        return v;
    }
    return sum_of(product_of(p.slope, v), p.intercept);
}

// Of a positive or negative integer a - b.
fn of_difference(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    if less64(a, b) {
        return negated(of_integer(minus64(b, a)));
    }
    return of_integer(minus64(a, b));
}

// The f32 nearest to d / n, half to even, of a count n below 2^27 and an integer d below 2^16 n: 26 bits of the quotient from one
// in f32 that is a few units in the last place off (by way of `inverse`, 1 / n), which the rest puts right. The rest is small (at
// most 16 n), so its low word is all of it. Rounding to f64 first would change nothing, since between a quotient of such a count and
// a number halfway between two f32 lie more than 2^-53 of it.
fn nearest(d: vec2<u32>, n: u32, inverse: f32) -> u32 {
    let guess = (f32(d.y) * 4294967296.0 + f32(d.x)) * inverse;
    var exponent = bitcast<u32>(guess) >> 23u;
    // d / n is about q 2^-shift; it is below 2^16, so that d moves to the left.
    let shift = 152u - exponent;
    var q = u32(guess * bitcast<f32>((279u - exponent) << 23u));
    var rest = i32(select(d.x << (shift & 31u), 0u, shift > 31u) - q * n);
    let off = i32(floor(f32(rest) * inverse));
    q += u32(off);
    rest -= off * i32(n);
    // A quotient next to an integer may have been taken for one on its other side.
    let low = rest < 0;
    q -= select(0u, 1u, low);
    rest += select(0, i32(n), low);
    let high = rest >= i32(n);
    q += select(0u, 1u, high);
    rest -= select(0, i32(n), high);
    if q < 0x2000000u {
        // Below a power of two numbers are half as far apart. q is a few units below it at most.
        rest *= 2;
        q = 2u * q + select(0u, 1u, rest >= i32(n));
        rest -= select(0, i32(n), rest >= i32(n));
        exponent -= 1u;
    }
    q |= select(0u, 1u, rest != 0);
    if q > 0x3ffffffu {
        // And from one on twice as far.
        q = (q >> 1u) | (q & 1u);
        exponent += 1u;
    }
    // The lowest of the two bits that go stands for the rest, too; the leading bit adds one to the exponent.
    let m = (q + 1u + ((q >> 2u) & 1u)) >> 2u;
    return select(m + ((exponent - 1u) << 23u), 0u, (d.x | d.y) == 0u);
}

// The mean of values that are not scaled, as f32.
fn plain_mean(w: Window) -> u32 {
    var inverse = p.inverse;
    if w.n != p.whole {
        inverse = 1.0 / f32(w.n);
    }
    if p.flip == 0u {
        return nearest(w.s1, w.n, inverse);
    }
    let shift = times32(w.n, p.flip);
    if less64(w.s1, shift) {
        return SIGN | nearest(minus64(shift, w.s1), w.n, inverse);
    }
    return nearest(minus64(w.s1, shift), w.n, inverse);
}

fn mean(w: Window) -> vec2<u32> {
    return scaled(quotient_of(of_difference(w.s1, times32(w.n, p.flip)), of_integer(vec2<u32>(w.n, 0u))));
}

fn variance(w: Window) -> vec2<u32> {
    var inverse = p.share;
    if w.n != p.whole {
        inverse = quotient_of(ONE, of_integer(vec2<u32>(w.n, 0u)));
    }
    return product_of(product_of(w.numerator, inverse), inverse);
}

// Of values that are not scaled, from the exact sum of their squares: below 2^63, so what wraps on the way comes back.
fn mean_square(w: Window) -> vec2<u32> {
    let shift = times64(times32(w.n, p.flip), vec2<u32>(p.flip, 0u)).xy;
    let twice = left64(times64(w.s1, vec2<u32>(p.flip, 0u)).xy, 1u);
    let squares = minus64(plus64(w.s2, shift), twice);
    return quotient_of(of_integer(squares), of_integer(vec2<u32>(w.n, 0u)));
}

fn spread(v: vec2<u32>) -> vec2<u32> {
    if p.scaled == 0u {
        return v;
    }
    return product_of(product_of(p.slope, p.slope), v);
}

fn single(v: vec2<u32>) -> f32 {
    return bitcast<f32>(narrowed(v));
}

// a - b >= 0 as f32; rounded once where it has 32 bits, else nearly so.
fn single_of(a: vec2<u32>, b: vec2<u32>) -> f32 {
    let d = minus64(a, b);
    return f32(d.y) * 4294967296.0 + f32(d.x);
}

fn openness(w: Window, kind: u32, half: bool) -> f32 {
    let constant = select(1.0, 0.5, half);
    let turned = p.flipped == 1u;
    if (parts & 4u) != 0u && kind == 6u {
        if w.lo == w.hi {
            return constant;
        }
        let below = f32(w.v - w.lo);
        let above = f32(w.hi - w.v);
        let over = single_of(w.s1, times32(w.n, w.lo));
        let under = single_of(times32(w.n, w.hi), w.s1);
        if turned {
            return power(above, below, f32(w.hi - w.lo), under, over);
        }
        return power(below, above, f32(w.hi - w.lo), over, under);
    }
    if (parts & 8u) == 0u || is_zero64(w.numerator) {
        return constant;
    }
    let away = single(of_difference(times32(w.n, w.v), w.s1));
    return by_spread(kind, select(away, -away, turned) / sqrt(single(w.numerator)));
}

fn extreme(code: u32) -> u32 {
    if (parts & 1u) == 0u || p.scaled == 0u {
        return bitcast<u32>(f32(i32(code) - i32(p.flip)));
    }
    return narrowed(scaled(of_difference(vec2<u32>(code, 0u), vec2<u32>(p.flip, 0u))));
}

fn is_plain(w: Window) -> bool {
    return p.scaled == 0u && w.n < 0x8000000u;
}

fn result(w: Window, channel: u32) -> u32 {
    let negative = p.scaled == 1u && (p.slope.y & SIGN) != 0u;
    switch channel & 255u {
        case 0u: {
            if (parts & 1u) == 0u || is_plain(w) {
                return plain_mean(w);
            }
            return narrowed(w.mean);
        }
        case 1u, 2u: {
            return extreme(select(w.lo, w.hi, negative != (channel == 2u)));
        }
        case 3u: {
            if (parts & 1u) == 0u {
                return 0u;
            }
            return narrowed(spread(w.variance));
        }
        case 4u: {
            if (parts & 1u) == 0u {
                return 0u;
            }
            let root = root_of(w.variance);
            if p.scaled == 0u {
                return narrowed(root);
            }
            return narrowed(product_of(vec2<u32>(p.slope.x, p.slope.y & ~SIGN), root));
        }
        case 5u: {
            if (parts & 1u) == 0u {
                return 0u;
            }
            if p.scaled == 0u {
                return narrowed(mean_square(w));
            }
            return narrowed(sum_of(spread(w.variance), product_of(w.mean, w.mean)));
        }
        default: {
            if (parts & 12u) == 0u {
                return 0u;
            }
            return bitcast<u32>(openness(w, channel & 255u, channel >= 256u));
        }
    }
}

@compute @workgroup_size(64)
fn finish(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        let x = thread % p.out_x;
        let first = (thread / p.out_x) % p.strips * STRIP;
        let z = thread / (p.out_x * p.strips);
        var across = 0u;
        if (parts & 16u) != 0u {
            across = along(p.at_z + z, p.radius_z, p.size_z) * along(p.at_x + x, p.radius_x, p.size_x);
        }
        for (var y = first; y < min(first + STRIP, p.out_y); y += 1u) {
            finish_at((z * p.out_y + y) * p.out_x + x, window_at(z, y, x, across));
        }
    }
}

// What is there of a window; `across`: its voxels in a row along y.
fn window_at(z: u32, y: u32, x: u32, across: u32) -> Window {
    let voxel = (z * p.out_y + y) * p.out_x + x;
    let index = p.centre + z * p.in_z + y * p.in_y + x;
    var w = Window();
    if (parts & 12u) != 0u {
        w.v = unpacked(voxels[index >> p.packing], index, p.packing) ^ p.flip;
    }
    if (parts & 16u) != 0u {
        w.n = across * along(p.at_y + y, p.radius_y, p.size_y);
    }
    if (p.needs & 4u) != 0u {
        w.lo = extremes[voxel] & 0xffffu;
        w.hi = extremes[voxel] >> 16u;
    }
    if (p.needs & 1u) != 0u {
        w.s1 = vec2<u32>(sums[voxel], 0u);
        if (parts & 64u) != 0u {
            w.s1 = vec2<u32>(sums[2u * voxel], sums[2u * voxel + 1u]);
        }
    }
    if (parts & 2u) != 0u && (p.needs & 2u) != 0u {
        w.s2 = vec2<u32>(squares[voxel], 0u);
        if p.wide == 1u {
            w.s2 = vec2<u32>(squares[2u * voxel], squares[2u * voxel + 1u]);
        }
    }
    return w;
}

fn finish_at(voxel: u32, window: Window) {
    if (parts & 32u) == 0u {
        output[voxel] = plain_mean(window);
        return;
    }
    var w = window;
    if (parts & 2u) != 0u && (p.needs & 2u) != 0u {
        w.numerator = numerator(w);
    }
    if (parts & 1u) != 0u && (p.needs & 8u) != 0u {
        w.mean = mean(w);
    }
    if (parts & 1u) != 0u && (p.needs & 16u) != 0u {
        w.variance = variance(w);
    }
    for (var c = 0u; c < p.count; c += 1u) {
        output[c * p.stride + voxel] = result(w, p.channels[c / 4u][c % 4u]);
    }
}
