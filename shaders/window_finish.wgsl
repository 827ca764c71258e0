// From moments of windows of f32 to results: means, extremes, spreads and estimators of openness, one plane per channel. One
// thread makes all channels of one voxel.
//
// Agrees within facts::tolerance with src/kernel/window/float_estimate.rs; a window with an infinity, or whose numbers lie at
// the ends of f32, gets MARKED in every channel, and is left to the CPU. Parameters: src/gpu/finish.rs, struct Finish.
// Bindings, group 0: 0 uniform Finish; 1 storage, read: bits of f32 voxels; 2 storage, written: bits of f32 results; 3
// storage, read: least and greatest, as codes; 4 storage, read: cells of `cell` words (window_moments.wgsl).
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Finish {
    out_z: u32,     // extents of the output
    out_y: u32,
    out_x: u32,
    centre: u32,    // output 0 among the voxels, and their strides
    in_z: u32,
    in_y: u32,
    cell: u32,      // words of a cell; 0: no channel needs them
    flipped: u32,   // 1: smaller is denser
    count: u32,     // channels
    zero: u32,      // 0, which no compiler knows
    threads: u32,
    stride: u32,    // from plane to plane of the results
    channels: array<vec4<u32>, 4>, // what each is, and 256 where constant windows are half open
}

@group(0) @binding(0) var<uniform> p: Finish;
@group(0) @binding(1) var<storage, read> voxels: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> order: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> cells: array<u32>;

const MARKED: u32 = 0xffffffffu;
const MISSING: u32 = 0x7fc00000u;
// Magnitudes of a window's largest voxel between which sums and squares stay normal: 2^40, 2^-30.
const LARGE: u32 = 0x53800000u;
const SMALL: u32 = 0x30800000u;
// 2^-90.
const LEAST: f32 = 8.077936e-28;

// A code's number; zeros lose their sign.
fn number(code: u32) -> f32 {
    let bits = select(~code, code ^ 0x80000000u, code >= 0x80000000u);
    return bitcast<f32>(select(bits, 0u, bits == 0x80000000u));
}

// What a window gives.
struct Window {
    v: f32,
    lo: f32,
    hi: f32,
    mean: vec2<f32>,
    variance: f32,
}

fn openness(w: Window, kind: u32, below: f32, above: f32) -> f32 {
    if kind == 6u {
        let over = distance(w.mean, vec2<f32>(w.lo, 0.0));
        let under = distance(vec2<f32>(w.hi, 0.0), w.mean);
        let turned = p.flipped == 1u;
        return power(below, above, w.hi - w.lo, select(over, under, turned), select(under, over, turned));
    }
    let away = distance(vec2<f32>(w.v, 0.0), w.mean);
    return by_spread(kind, select(away, -away, p.flipped == 1u) / sqrt(w.variance));
}

// Whether f32 cannot hold what a window needs.
fn is_left(w: Window) -> bool {
    let most = max(bitcast<u32>(w.lo) & 0x7fffffffu, bitcast<u32>(w.hi) & 0x7fffffffu);
    if most >= LARGE || (most < SMALL && most > 0u) {
        return true;
    }
    let least = (w.hi - w.lo) * LEAST;
    return (w.v != w.lo && w.v - w.lo < least) || (w.v != w.hi && w.hi - w.v < least);
}

// The mean's square in exact parts, the small ones first.
fn moment2(w: Window) -> f32 {
    let a = bitcast<f32>(bitcast<u32>(w.mean.x) & 0xfffff000u);
    let b = w.mean.x - a;
    return a * a + (2.0 * a * b + (b * b + 2.0 * w.mean.x * w.mean.y + w.variance));
}

fn result(w: Window, channel: u32) -> f32 {
    let kind = channel & 255u;
    switch kind {
        case 0u: {
            return w.mean.x;
        }
        case 1u: {
            return w.lo;
        }
        case 2u: {
            return w.hi;
        }
        case 3u: {
            return w.variance;
        }
        case 4u: {
            return sqrt(w.variance);
        }
        case 5u: {
            return moment2(w);
        }
        default: {
            if w.lo == w.hi {
                return select(1.0, 0.5, channel >= 256u);
            }
            let sides = vec2<f32>(w.v - w.lo, w.hi - w.v);
            let turned = select(sides, sides.yx, p.flipped == 1u);
            return openness(w, kind, turned.x, turned.y);
        }
    }
}

fn finish_at(thread: u32) {
    let x = thread % p.out_x;
    let y = (thread / p.out_x) % p.out_y;
    let z = thread / (p.out_x * p.out_y);
    let bits = voxels[p.centre + z * p.in_z + y * p.in_y + x];
    let missing = (bits & 0x7fffffffu) > 0x7f800000u;
    let extremes = order[thread];
    var w = Window(bitcast<f32>(bits), number(extremes.x), number(extremes.y), vec2<f32>(), 0.0);
    if p.cell > 0u {
        let start = thread * p.cell;
        w.mean = vec2<f32>(bitcast<f32>(cells[start + 1u]), bitcast<f32>(cells[start + 2u]));
        if p.cell > 3u && w.lo != w.hi {
            w.variance = bitcast<f32>(cells[start + 3u]) / f32(cells[start]);
        }
    }
    let marked = p.cell > 0u && !missing && is_left(w);
    for (var c = 0u; c < p.count; c += 1u) {
        var made = MISSING;
        if marked {
            made = MARKED;
        } else if !missing {
            made = bitcast<u32>(result(w, p.channels[c / 4u][c % 4u]));
        }
        output[c * p.stride + thread] = made;
    }
}

@compute @workgroup_size(64)
fn finish(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        finish_at(thread);
    }
}
