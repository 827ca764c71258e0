// Steps that look at one voxel of up to three channels, in f64 (double.wgsl), rounded once. One thread makes one voxel.
//
// Agrees bit for bit with src/kernel/pointwise. Parameters: src/gpu/points.rs, struct Point.
// Bindings, group 0: 0 uniform Point; 1 storage, read: channel 0, packed voxels or bits of f32; 2 storage, written: bits of
// f32; 3, 4 storage, read: channels 1 and 2, where there are any; 5 storage, read: a transfer table, ten words per point: its
// place, opacity, red, green, blue, all f64.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Channel {
    start: u32,     // output 0 among the voxels, and their strides
    plane: u32,
    row: u32,
    packing: u32,   // log2 of voxels per word; 3: f32, 4: u32
    sign: u32,      // the sign bit of a packed voxel, or 0
    scaled: u32,    // 1: values are slope * v + intercept
    slope: vec2<u32>,
    intercept: vec2<u32>,
    spare: vec2<u32>,
}

struct Point {
    out_y: u32,     // extents of the output
    out_x: u32,
    op: u32,
    count: u32,     // channels that are combined, or points of the table
    table: u32,     // where it starts
    component: u32, // of the table: 1 to 4
    threads: u32,
    inputs: u32,    // channels that are read
    a: vec2<u32>,   // the operation's constants, f64
    b: vec2<u32>,
    channels: array<Channel, 3>,
}

@group(0) @binding(0) var<uniform> p: Point;
@group(0) @binding(1) var<storage, read> first_input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> second_input: array<u32>;
@group(0) @binding(4) var<storage, read> third_input: array<u32>;
@group(0) @binding(5) var<storage, read> tables: array<u32>;

const NOTHING: vec2<u32> = vec2<u32>(0u, 0x7ff80000u);

fn place_of(thread: u32, c: u32) -> u32 {
    let x = thread % p.out_x;
    let y = (thread / p.out_x) % p.out_y;
    let z = thread / (p.out_x * p.out_y);
    return p.channels[c].start + z * p.channels[c].plane + y * p.channels[c].row + x;
}

fn value_of(word: u32, index: u32, c: u32) -> vec2<u32> {
    var v = vec2<u32>();
    if p.channels[c].packing == 3u {
        v = widened(word);
    } else if p.channels[c].packing == 4u {
        v = of_integer(vec2<u32>(word, 0u));
    } else {
        let sign = p.channels[c].sign;
        let stored = i32(unpacked(word, index, p.channels[c].packing) ^ sign) - i32(sign);
        v = joined(u32(stored) & SIGN, 0, vec2<u32>(u32(abs(stored)), 0u));
    }
    if p.channels[c].scaled == 1u {
        v = sum_of(product_of(p.channels[c].slope, v), p.channels[c].intercept);
    }
    return v;
}

fn input_of(thread: u32, c: u32) -> vec2<u32> {
    let index = place_of(thread, c);
    let at = index >> select(p.channels[c].packing, 0u, p.channels[c].packing >= 3u);
    var word = 0u;
    switch c {
        case 0u: {
            word = first_input[at];
        }
        case 1u: {
            word = second_input[at];
        }
        default: {
            word = third_input[at];
        }
    }
    return value_of(word, index, c);
}

// Entry `k` of point `i` of the table.
fn entry_of(i: u32, k: u32) -> vec2<u32> {
    let at = p.table + 10u * i + 2u * k;
    return vec2<u32>(tables[at], tables[at + 1u]);
}

fn looked_up(v: vec2<u32>) -> vec2<u32> {
    if is_nan64(v) {
        return NOTHING;
    }
    var above = 0u;
    while above < p.count && !is_less64(v, entry_of(above, 0u)) {
        above += 1u;
    }
    let k = p.component;
    if above == 0u {
        return entry_of(0u, k);
    }
    let low = entry_of(above - 1u, k);
    if above == p.count {
        return low;
    }
    let start = entry_of(above - 1u, 0u);
    let t = quotient_of(sum_of(v, negated(start)), sum_of(entry_of(above, 0u), negated(start)));
    return sum_of(low, product_of(t, sum_of(entry_of(above, k), negated(low))));
}

fn windowed(v: vec2<u32>, stretched: bool) -> vec2<u32> {
    if is_less64(v, p.a) {
        return vec2<u32>();
    }
    if is_less64(p.b, v) {
        return ONE;
    }
    if !stretched || is_nan64(v) {
        return v;
    }
    if is_less64(p.a, p.b) {
        return quotient_of(sum_of(v, negated(p.a)), sum_of(p.b, negated(p.a)));
    }
    return ONE;
}

fn by_variance(opacity: vec2<u32>, variance: vec2<u32>) -> vec2<u32> {
    var share = variance;
    if !is_nan64(variance) {
        let zero = vec2<u32>();
        if !is_less64(variance, p.a) && is_less64(zero, variance) {
            share = ONE;
        } else if !is_less64(zero, variance) {
            share = zero;
        } else {
            share = quotient_of(variance, p.a);
        }
    }
    return product_of(opacity, share);
}

fn by_saliency(opacity: vec2<u32>, s: vec2<u32>) -> vec2<u32> {
    if is_nan64(opacity) || is_nan64(s) {
        return NOTHING;
    }
    if is_less64(s, p.a) {
        return vec2<u32>();
    }
    let v = product_of(product_of(opacity, s), p.b);
    if is_less64(v, vec2<u32>()) {
        return vec2<u32>();
    }
    return select(v, ONE, is_less64(ONE, v));
}

fn combined(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    switch p.op {
        case 6u: {
            return product_of(a, b);
        }
        case 7u: {
            return select(a, b, is_less64(b, a) || is_nan64(b));
        }
        case 8u: {
            return select(a, b, is_less64(a, b) || is_nan64(b));
        }
        default: {
            return sum_of(a, b);
        }
    }
}

fn all_combined(v: array<vec2<u32>, 3>) -> vec2<u32> {
    var values = v;
    var all = values[0];
    for (var c = 1u; c < p.count; c += 1u) {
        all = combined(all, values[c]);
    }
    if p.op == 9u {
        return quotient_of(all, of_integer(vec2<u32>(p.count, 0u)));
    }
    return all;
}

fn length_of(v: array<vec2<u32>, 3>) -> vec2<u32> {
    var values = v;
    var sum = vec2<u32>();
    for (var c = 0u; c < 3u; c += 1u) {
        sum = sum_of(sum, product_of(values[c], values[c]));
    }
    return root_of(sum);
}

fn made(v: array<vec2<u32>, 3>) -> vec2<u32> {
    switch p.op {
        case 0u: {
            return v[0];
        }
        case 1u, 2u: {
            return windowed(v[0], p.op == 2u);
        }
        case 3u: {
            return by_variance(v[0], v[1]);
        }
        case 4u: {
            return by_saliency(v[0], v[1]);
        }
        case 10u: {
            return product_of(product_of(p.a, v[0]), v[1]);
        }
        case 11u: {
            return looked_up(v[0]);
        }
        case 12u: {
            return length_of(v);
        }
        case 13u: {
            return sum_of(product_of(p.a, v[0]), vec2<u32>());
        }
        case 14u: {
            return select(quotient_of(v[0], p.a), NOTHING, p.inputs > 1u && is_nan64(v[1]));
        }
        default: {
            return all_combined(v);
        }
    }
}

fn make(thread: u32) {
    var v: array<vec2<u32>, 3>;
    for (var c = 0u; c < p.inputs; c += 1u) {
        v[c] = input_of(thread, c);
    }
    output[thread] = narrowed(made(v));
}

@compute @workgroup_size(64)
fn point(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        make(thread);
    }
}
