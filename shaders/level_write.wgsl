// Voxels, or cells of a level, to the type of an output, rounded once. One thread makes one word: one f32, two codes of 16
// bits or four of 8.
//
// Agrees bit for bit with src/kernel/convert and src/kernel/reduce (values), and src/gpu/occlusion.rs: the same formulas in f64 (double.wgsl).
// Parameters: src/gpu/levels.rs, struct Write.
// Bindings, group 0: 0 uniform Write; 1 storage, read: bits of f32 voxels (`first`) or cells (`next`); 2 storage, written:
// codes, dense, the first in the low bits. Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no
// atomics: an output has one writer.

struct Write {
    ny: u32,        // extents of what is written
    nx: u32,
    count: u32,
    start: u32,     // voxel 0 among the input's, and its strides; of cells dense
    plane: u32,
    row: u32,
    kind: u32,      // what cells hold
    packing: u32,   // log2 of codes per word
    linear: u32,    // 1: values are mapped; 2: f32 in [0, 1] are, the product rounded to f32 first; 0: kept
    fill: u32,      // the code of NaN
    threads: u32,
    real: u32,      // 1: f32 is written
    half: vec2<u32>, // code = clamp((v * half - lo) / width * top, low, high), all f64
    lo: vec2<u32>,
    width: vec2<u32>,
    top: vec2<u32>,
    low: vec2<u32>,
    high: vec2<u32>,
    slope: vec2<u32>, // of an occlusion map's values, which are not scaled yet
    intercept: vec2<u32>,
}

@group(0) @binding(0) var<uniform> p: Write;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

fn place(i: u32) -> u32 {
    return p.start + (i / (p.nx * p.ny)) * p.plane + ((i / p.nx) % p.ny) * p.row + i % p.nx;
}

// An occlusion map's mean, a pair of f32, or variance, scaled.
fn mapped(at: u32) -> vec2<u32> {
    var v = widened(input[3u * at + 2u]);
    if p.kind == MAP_MEAN {
        v = sum_of(widened(input[3u * at]), widened(input[3u * at + 1u]));
    }
    return sum_of(product_of(p.slope, v), p.intercept);
}

fn value(cell: Cell) -> vec2<u32> {
    if p.kind != MEAN && p.kind < MOMENTS {
        return cell.value;
    }
    let n = count_of(cell.n);
    let moments = p.kind >= MOMENTS;
    let share = quotient_of(select(cell.value, cell.inner, moments), n);
    if !moments {
        return share;
    }
    let variance = sum_of(share, quotient_of(cell.between, n));
    if p.kind == SPREAD {
        return with_sign(root_of(magnitude_of(variance)), variance);
    }
    return variance;
}

// A number of at most 32 bits to the nearest integer, half to even, in two's complement.
fn nearest(v: vec2<u32>) -> u32 {
    let x = parts_of(v);
    if is_zero64(v) || x.exponent < -64 {
        return 0u;
    }
    let n = u32(-x.exponent);
    // What lies below one, at the top of 64 bits.
    var whole = 0u;
    var rest = x.bits;
    if n < 64u {
        whole = right64(x.bits, n).x;
        rest = left64(x.bits, 64u - n);
    }
    let half = vec2<u32>(0u, 0x80000000u);
    if less64(half, rest) || (all(rest == half) && (whole & 1u) == 1u) {
        whole += 1u;
    }
    return select(whole, 0u - whole, x.sign != 0u);
}

fn code(v: vec2<u32>) -> u32 {
    if is_nan64(v) {
        return p.fill;
    }
    var t = v;
    if p.linear != 0u {
        t = product_of(t, p.half);
        t = product_of(quotient_of(sum_of(t, negated(p.lo)), p.width), p.top);
    }
    if p.linear == 2u {
        t = widened(narrowed(t));
    }
    t = select(p.low, t, is_less64(p.low, t));
    t = select(p.high, t, is_less64(t, p.high));
    return nearest(t);
}

fn one(thread: u32, voxels: bool) {
    if p.real == 1u && voxels {
        output[thread] = input[place(thread)];
        return;
    }
    let many = 1u << p.packing;
    let bits = 32u >> p.packing;
    var word = 0u;
    for (var k = 0u; k < many; k += 1u) {
        let i = thread * many + k;
        if i >= p.count {
            break;
        }
        var v = vec2<u32>();
        if voxels {
            v = widened(input[place(i)]);
        } else if p.kind >= MAP_MEAN {
            v = mapped(place(i));
        } else {
            v = value(cell_from(place(i), p.kind));
        }
        if p.real == 1u {
            word = select(narrowed(v), 0x7fc00000u, is_nan64(v));
        } else {
            word |= (code(v) & ((1u << bits) - 1u)) << (k * bits);
        }
    }
    output[thread] = word;
}
