// Unsigned integers of 64 and 128 bits as words, the lowest first. Shifts by a whole word or more are asked for by name, since
// WGSL shifts by a count modulo 32.

fn plus64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2<u32>(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn minus64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    return vec2<u32>(a.x - b.x, a.y - b.y - select(0u, 1u, a.x < b.x));
}

fn less64(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.y < b.y || (a.y == b.y && a.x < b.x);
}

// By 0 to 63.
fn left64(v: vec2<u32>, n: u32) -> vec2<u32> {
    if n == 0u {
        return v;
    }
    if n >= 32u {
        return vec2<u32>(0u, v.x << (n - 32u));
    }
    return vec2<u32>(v.x << n, (v.y << n) | (v.x >> (32u - n)));
}

fn right64(v: vec2<u32>, n: u32) -> vec2<u32> {
    if n == 0u {
        return v;
    }
    if n >= 32u {
        return vec2<u32>(v.y >> (n - 32u), 0u);
    }
    return vec2<u32>((v.x >> n) | (v.y << (32u - n)), v.y >> n);
}

// To the right by any count; the lowest bit remembers what was shifted out.
fn squeezed(v: vec2<u32>, n: u32) -> vec2<u32> {
    let nothing = (v.x | v.y) == 0u;
    if n == 0u || nothing {
        return v;
    }
    if n > 63u {
        return vec2<u32>(1u, 0u);
    }
    let lost = left64(v, 64u - n);
    return right64(v, n) | vec2<u32>(select(0u, 1u, (lost.x | lost.y) != 0u), 0u);
}

fn zeros64(v: vec2<u32>) -> u32 {
    return select(countLeadingZeros(v.y), 32u + countLeadingZeros(v.x), v.y == 0u);
}

fn times32(a: u32, b: u32) -> vec2<u32> {
    let low = (a & 0xffffu) * (b & 0xffffu);
    let one = (a >> 16u) * (b & 0xffffu);
    let two = (a & 0xffffu) * (b >> 16u);
    let high = (a >> 16u) * (b >> 16u);
    let middle = (low >> 16u) + (one & 0xffffu) + (two & 0xffffu);
    return vec2<u32>((low & 0xffffu) | (middle << 16u), high + (one >> 16u) + (two >> 16u) + (middle >> 16u));
}

fn times64(a: vec2<u32>, b: vec2<u32>) -> vec4<u32> {
    let low = times32(a.x, b.x);
    let high = times32(a.y, b.y);
    let one = times32(a.x, b.y);
    let two = times32(a.y, b.x);
    let middle = plus64(vec2<u32>(low.y, 0u), vec2<u32>(one.x, 0u));
    let both = plus64(middle, vec2<u32>(two.x, 0u));
    let top = plus64(plus64(high, vec2<u32>(one.y, 0u)), plus64(vec2<u32>(two.y, 0u), vec2<u32>(both.y, 0u)));
    return vec4<u32>(low.x, both.x, top.x, top.y);
}

fn minus128(a: vec4<u32>, b: vec4<u32>) -> vec4<u32> {
    let low = minus64(a.xy, b.xy);
    let borrow = vec2<u32>(select(0u, 1u, less64(a.xy, b.xy)), 0u);
    return vec4<u32>(low, minus64(minus64(a.zw, b.zw), borrow));
}

fn less128(a: vec4<u32>, b: vec4<u32>) -> bool {
    return less64(a.zw, b.zw) || (all(a.zw == b.zw) && less64(a.xy, b.xy));
}
