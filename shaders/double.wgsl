// f64 in integers: bits of a double as two words, the low one first, each operation rounded once, half to even, as the CPU
// does it. So what is made of it has the CPU's bits on any adapter. NaN keeps its bits and turns quiet, of two the first one's;
// one that arithmetic makes is x86's, negative. Needs integers64.wgsl.

const SIGN: u32 = 0x80000000u;
const INFINITE: u32 = 0x7ff00000u;
const ONE: vec2<u32> = vec2<u32>(0u, 0x3ff00000u);
const UNDEFINED: vec2<u32> = vec2<u32>(0u, 0xfff80000u);

// A finite number: bits * 2^exponent, whose top bit is set unless the number is 0.
struct Parts {
    sign: u32,
    exponent: i32,
    bits: vec2<u32>,
}

fn is_nan64(a: vec2<u32>) -> bool {
    let high = a.y & ~SIGN;
    return high > INFINITE || (high == INFINITE && a.x != 0u);
}

fn is_infinite64(a: vec2<u32>) -> bool {
    return (a.y & ~SIGN) == INFINITE && a.x == 0u;
}

fn is_zero64(a: vec2<u32>) -> bool {
    return (a.y & ~SIGN) == 0u && a.x == 0u;
}

// As a subtraction takes it: NaN keeps its sign.
fn negated(a: vec2<u32>) -> vec2<u32> {
    return select(vec2<u32>(a.x, a.y ^ SIGN), a, is_nan64(a));
}

fn magnitude_of(a: vec2<u32>) -> vec2<u32> {
    return vec2<u32>(a.x, a.y & ~SIGN);
}

fn with_sign(a: vec2<u32>, by: vec2<u32>) -> vec2<u32> {
    return vec2<u32>(a.x, (a.y & ~SIGN) | (by.y & SIGN));
}

fn quiet(a: vec2<u32>) -> vec2<u32> {
    return vec2<u32>(a.x, a.y | 0x80000u);
}

fn parts_of(a: vec2<u32>) -> Parts {
    let exponent = (a.y >> 20u) & 0x7ffu;
    let bits = vec2<u32>(a.x, (a.y & 0xfffffu) | select(0u, 0x100000u, exponent > 0u));
    let shift = zeros64(bits) & 63u;
    return Parts(a.y & SIGN, i32(max(exponent, 1u)) - 1075 - i32(shift), left64(bits, shift));
}

// Rounds bits * 2^exponent, of which the lowest bit may stand for smaller ones.
fn joined(sign: u32, exponent: i32, bits: vec2<u32>) -> vec2<u32> {
    if (bits.x | bits.y) == 0u {
        return vec2<u32>(0u, sign);
    }
    let shift = zeros64(bits);
    var m = left64(bits, shift);
    var e = exponent - i32(shift) + 1086;
    if e >= 2047 {
        return vec2<u32>(0u, sign | INFINITE);
    }
    if e <= 0 {
        m = squeezed(m, u32(1 - e));
        e = 1;
    }
    let rest = m.x & 0x7ffu;
    var kept = right64(m, 11u);
    if rest > 0x400u || (rest == 0x400u && (kept.x & 1u) == 1u) {
        kept = plus64(kept, vec2<u32>(1u, 0u));
    }
    // The leading bit adds one to the exponent.
    return plus64(kept, vec2<u32>(0u, sign | (u32(e - 1) << 20u)));
}

fn sum_of(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    if is_nan64(a) {
        return quiet(a);
    }
    if is_nan64(b) {
        return quiet(b);
    }
    if is_infinite64(a) {
        return select(a, UNDEFINED, is_infinite64(b) && a.y != b.y);
    }
    if is_infinite64(b) {
        return b;
    }
    if is_zero64(b) {
        return select(a, vec2<u32>(0u, a.y & b.y), is_zero64(a));
    }
    if is_zero64(a) {
        return b;
    }
    var x = parts_of(a);
    var y = parts_of(b);
    if x.exponent < y.exponent || (x.exponent == y.exponent && less64(x.bits, y.bits)) {
        let other = x;
        x = y;
        y = other;
    }
    let large = right64(x.bits, 1u);
    let small = squeezed(right64(y.bits, 1u), u32(x.exponent - y.exponent));
    if x.sign == y.sign {
        return joined(x.sign, x.exponent + 1, plus64(large, small));
    }
    let rest = minus64(large, small);
    return joined(select(x.sign, 0u, (rest.x | rest.y) == 0u), x.exponent + 1, rest);
}

fn product_of(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    if is_nan64(a) {
        return quiet(a);
    }
    if is_nan64(b) {
        return quiet(b);
    }
    let sign = (a.y ^ b.y) & SIGN;
    let zero = is_zero64(a) || is_zero64(b);
    if is_infinite64(a) || is_infinite64(b) {
        return select(vec2<u32>(0u, sign | INFINITE), UNDEFINED, zero);
    }
    if zero {
        return vec2<u32>(0u, sign);
    }
    let x = parts_of(a);
    let y = parts_of(b);
    let p = times64(x.bits, y.bits);
    let lost = select(0u, 1u, (p.x | p.y) != 0u);
    return joined(sign, x.exponent + y.exponent + 64, p.zw | vec2<u32>(lost, 0u));
}

fn quotient_of(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    if is_nan64(a) {
        return quiet(a);
    }
    if is_nan64(b) {
        return quiet(b);
    }
    let sign = (a.y ^ b.y) & SIGN;
    if is_infinite64(a) {
        return select(vec2<u32>(0u, sign | INFINITE), UNDEFINED, is_infinite64(b));
    }
    if is_zero64(b) {
        return select(vec2<u32>(0u, sign | INFINITE), UNDEFINED, is_zero64(a));
    }
    if is_zero64(a) || is_infinite64(b) {
        return vec2<u32>(0u, sign);
    }
    let x = parts_of(a);
    let y = parts_of(b);
    if y.bits.x == 0u && y.bits.y == SIGN {
        return joined(sign, x.exponent - y.exponent - 63, x.bits); // a power of two, as most counts are
    }
    // Both have at most 53 bits. A bit, then three digits of 18 bits, each guessed in f32, which is off by less
    // than one as long as a quotient there is good to 2^-20, and put right. What is left is less than the divisor, so that it does
    // not matter that products lose what is above 64 bits.
    let divisor = right64(y.bits, 11u);
    let inverse = 262144.0 / (f32(divisor.y) * 4294967296.0 + f32(divisor.x));
    var rest = right64(x.bits, 11u);
    var q = vec2<u32>();
    if !less64(rest, divisor) {
        rest = minus64(rest, divisor);
        q.x = 1u;
    }
    for (var i = 0; i < 3; i += 1) {
        var guess = u32((f32(rest.y) * 4294967296.0 + f32(rest.x)) * inverse);
        let product = times32(guess, divisor.x) + vec2<u32>(0u, guess * divisor.y);
        rest = minus64(left64(rest, 18u), product);
        if (rest.y & SIGN) != 0u {
            guess -= 1u;
            rest = plus64(rest, divisor);
        }
        if !less64(rest, divisor) {
            guess += 1u;
            rest = minus64(rest, divisor);
        }
        q = plus64(left64(q, 18u), vec2<u32>(guess, 0u));
    }
    q = left64(q, 2u);
    q.x |= select(0u, 1u, (rest.x | rest.y) != 0u);
    return joined(sign, x.exponent - y.exponent - 56, q);
}

fn root_of(a: vec2<u32>) -> vec2<u32> {
    if is_nan64(a) || is_zero64(a) {
        return a;
    }
    if (a.y & SIGN) != 0u {
        return UNDEFINED;
    }
    if is_infinite64(a) {
        return a;
    }
    let x = parts_of(a);
    var bits = x.bits;
    var exponent = x.exponent;
    if (exponent & 1) != 0 {
        bits = right64(bits, 1u);
        exponent += 1;
    }
    var root = vec2<u32>();
    var rest = vec2<u32>();
    for (var i = 0; i < 57; i += 1) {
        rest = left64(rest, 2u) | vec2<u32>(bits.y >> 30u, 0u);
        bits = left64(bits, 2u);
        let trial = left64(root, 2u) | vec2<u32>(1u, 0u);
        root = left64(root, 1u);
        if !less64(rest, trial) {
            rest = minus64(rest, trial);
            root.x |= 1u;
        }
    }
    root.x |= select(0u, 1u, (rest.x | rest.y) != 0u);
    return joined(0u, exponent / 2 - 25, root);
}

// a < b of numbers.
fn is_less64(a: vec2<u32>, b: vec2<u32>) -> bool {
    if is_nan64(a) || is_nan64(b) || (is_zero64(a) && is_zero64(b)) {
        return false;
    }
    let negative = (a.y & SIGN) != 0u;
    if negative != ((b.y & SIGN) != 0u) {
        return negative;
    }
    return select(less64(a, b), less64(b, a), negative);
}

fn of_integer(v: vec2<u32>) -> vec2<u32> {
    return joined(0u, 0, v);
}

// From bits of f32.
fn widened(v: u32) -> vec2<u32> {
    let exponent = (v >> 23u) & 0xffu;
    let bits = v & 0x7fffffu;
    let sign = v & SIGN;
    if exponent == 0u {
        return joined(sign, -149, vec2<u32>(bits, 0u));
    }
    let high = select(exponent + 896u, 2047u, exponent == 255u) << 20u;
    return vec2<u32>(bits << 29u, sign | high | (bits >> 3u));
}

// To bits of f32.
fn narrowed(a: vec2<u32>) -> u32 {
    let sign = a.y & SIGN;
    if is_nan64(a) {
        return sign | 0x7fc00000u | ((a.y & 0x7ffffu) << 3u) | (a.x >> 29u);
    }
    let x = parts_of(a);
    var e = x.exponent + 190;
    if is_infinite64(a) || e >= 255 {
        return sign | 0x7f800000u;
    }
    var m = x.bits;
    if e <= 0 {
        m = squeezed(m, u32(1 - e));
        e = 1;
    }
    if (m.x | m.y) == 0u {
        return sign;
    }
    let rest = vec2<u32>(m.x, m.y & 0xffu);
    let half = vec2<u32>(0u, 0x80u);
    var kept = m.y >> 8u;
    if less64(half, rest) || (all(rest == half) && (kept & 1u) == 1u) {
        kept += 1u;
    }
    return sign | (kept + (u32(e - 1) << 23u));
}
