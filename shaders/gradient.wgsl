// Gradient by regression: sum_k w_k f_k over the 3^3 or 5^3 voxels around the centre, for three components. The weights are
// odd along the component's axis and even along the others, so voxels that mirror each other are subtracted or added before
// they are weighed: integers exactly, floats without losing a large value that they share. One thread makes one output.
//
// Agrees with src/kernel/gradient within tolerance::GRADIENT (src/gpu/facts.rs); constants give exactly 0. A window that
// holds a missing voxel, an infinity or magnitudes at the ends of f32 gets MARKED, and is left to the CPU.
// Parameters: src/gpu/slopes.rs, struct Slopes.
// Bindings, group 0: 0 uniform Slopes; 1 storage, read: packed voxels; 2 storage, written: bits of f32, the magnitudes or
// one plane per component; 3 storage, read: bits of f32 weights [component][|dz|][|dy|][|dx|], three each.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Slopes {
    out_z: u32,     // extents of the output
    out_y: u32,
    out_x: u32,
    in_z: u32,      // strides of the input, in voxels; along x it is 1
    in_y: u32,
    at_z: u32,      // centre of output 0 in the input
    at_y: u32,
    at_x: u32,
    size_z: u32,    // extents of the input; voxels beyond it are those at its edge
    size_y: u32,
    size_x: u32,
    half: u32,      // 1 or 2
    packing: u32,   // log2 of voxels per word
    sign: u32,      // the sign bit of a packed integer, or 0
    real: u32,      // 1: voxels are f32
    gaps: u32,      // 1: integers may be missing
    missing: u32,   // their bits
    vector: u32,    // 1: components, 0: magnitude
    threads: u32,
    table: u32,     // where the weights start
    stride: u32,    // from plane to plane of the results
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
}

@group(0) @binding(0) var<uniform> p: Slopes;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> weights: array<u32>;

const MARKED: u32 = 0xffffffffu;
// 2^100 and 2^-40: between them neither weighted sums nor squares leave the normal numbers.
const LARGE: u32 = 0x71800000u;
const SMALL: u32 = 0x2b800000u;

// The greatest magnitude seen, as bits: of NaN and infinities, too. Integers only tell whether one is missing.
var<private> most: u32 = 0u;

fn value(index: u32) -> f32 {
    if p.real == 1u {
        let bits = input[index];
        most = max(most, bits & 0x7fffffffu);
        return bitcast<f32>(bits);
    }
    let code = unpacked(input[index >> p.packing], index, p.packing);
    if p.gaps == 1u && code == p.missing {
        most = MARKED;
    }
    return f32(i32(code ^ p.sign) - i32(p.sign));
}

// The voxels of a plane at +y +x, +y -x, -y +x, -y -x: rows and columns a step before and after the centre. Where a step is 0
// both sides are one voxel: its weight along that axis is 0, and the weights along the others are shared between the sides.
fn corners(plane: u32, rows: vec2<u32>, columns: vec2<u32>, dy: u32, dx: u32) -> vec4<f32> {
    var c = vec4<f32>(value(plane + rows.y + columns.y));
    if dx > 0u {
        c.y = value(plane + rows.y + columns.x);
    }
    c = c.xyxy;
    if dy > 0u {
        c.z = value(plane + rows.x + columns.y);
        c.w = c.z;
        if dx > 0u {
            c.w = value(plane + rows.x + columns.x);
        }
    }
    return c;
}

// Positions a step before and after the centre.
fn sides(centre: u32, step: u32, size: u32) -> vec2<u32> {
    return vec2<u32>(max(centre, step) - step, min(centre + step, size - 1u));
}

fn weight(component: u32, dz: u32, dy: u32, dx: u32) -> f32 {
    return bitcast<f32>(weights[p.table + ((component * 3u + dz) * 3u + dy) * 3u + dx]);
}

// Root of the sum of squares; scaled by a power of two, so that no square leaves f32.
fn length_of(g: vec3<f32>) -> f32 {
    let high = max(max(abs(g.x), abs(g.y)), abs(g.z));
    let exponent = (bitcast<u32>(high) >> 23u) & 0xffu;
    if exponent == 0u {
        return 0.0;
    }
    let scaled = g * bitcast<f32>((254u - exponent) << 23u);
    let sum = scaled.x * scaled.x + scaled.y * scaled.y + scaled.z * scaled.z;
    // A driver's root may be off by a few bits; Newton's step mends them.
    let root = sqrt(sum);
    return (root + (sum - root * root) * (0.5 / root)) * bitcast<f32>(exponent << 23u);
}

fn slope_at(thread: u32) {
    let x = thread % p.out_x;
    let y = (thread / p.out_x) % p.out_y;
    let z = thread / (p.out_x * p.out_y);
    var g = vec3<f32>();
    for (var dz = 0u; dz <= p.half; dz += 1u) {
        let planes = sides(p.at_z + z, dz, p.size_z) * p.in_z;
        for (var dy = 0u; dy <= p.half; dy += 1u) {
            let rows = sides(p.at_y + y, dy, p.size_y) * p.in_y;
            for (var dx = 0u; dx <= p.half; dx += 1u) {
                let columns = sides(p.at_x + x, dx, p.size_x);
                let u = corners(planes.y, rows, columns, dy, dx);
                var d = u;
                if dz > 0u {
                    d = corners(planes.x, rows, columns, dy, dx);
                }
                let odd_z = ((u.x - d.x) + (u.y - d.y)) + ((u.z - d.z) + (u.w - d.w));
                let odd_y = ((u.x - u.z) + (u.y - u.w)) + ((d.x - d.z) + (d.y - d.w));
                let odd_x = ((u.x - u.y) + (u.z - u.w)) + ((d.x - d.y) + (d.z - d.w));
                g += vec3<f32>(weight(0u, dz, dy, dx) * odd_z, weight(1u, dz, dy, dx) * odd_y,
                               weight(2u, dz, dy, dx) * odd_x);
            }
        }
    }
    let small = p.real == 1u && most != 0u && most < SMALL;
    let marked = most >= LARGE || small;
    if p.vector == 1u {
        output[thread] = select(bitcast<u32>(g.x), MARKED, marked);
        output[p.stride + thread] = select(bitcast<u32>(g.y), MARKED, marked);
        output[2u * p.stride + thread] = select(bitcast<u32>(g.z), MARKED, marked);
    } else {
        output[thread] = select(bitcast<u32>(length_of(g)), MARKED, marked);
    }
}

@compute @workgroup_size(64)
fn slopes(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        slope_at(thread);
    }
}
