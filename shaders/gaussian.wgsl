// Truncated Gaussian mean along one axis: c + sum_k w_k ((a_k + b_k) - 2 c), where a_k and b_k stand k steps before and
// after the centre c, or are c where they do not exist. One thread makes one output.
//
// Agrees bit for bit with src/kernel/gaussian (mean_row in f32), since every operation is rounded by itself
// (floats.wgsl). Weights come from the CPU, in f64 and rounded.
// Parameters: src/gpu/taps.rs, struct Taps.
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels (`first`) or bits of f32 (`next`); 2 storage, written:
// bits of f32; 3 storage, read: bits of f32 weights, `radius` for each output along the axis.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Taps {
    n: u32,         // extent of the whole source along the axis
    at: u32,        // centre of output 0, in the whole source
    start: u32,     // first position of the whole source that the input holds
    m: u32,         // outputs along the axis
    radius: u32,
    in_axis: u32,   // strides, in elements: the input's along the axis and of a line's two indices
    in_i: u32,
    in_j: u32,
    out_axis: u32,  // the output's
    out_i: u32,
    out_j: u32,
    inner: u32,     // extents, the fastest first: of the outputs' x, and of their y
    middle: u32,
    axis: u32,      // which of z, y, x the axis is; i and j are the others in this order
    weights: u32,   // where the axis' weights start
    packing: u32,   // log2 of voxels per word
    sign: u32,      // the sign bit of a packed voxel, or 0
    zero: u32,      // 0, which no compiler knows
    threads: u32,
    spare: u32,
}

@group(0) @binding(0) var<uniform> p: Taps;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> weights: array<u32>;

fn value(index: u32, packed: bool) -> f32 {
    if !packed {
        return bitcast<f32>(input[index]);
    }
    let code = unpacked(input[index >> p.packing], index, p.packing);
    return f32(i32(code ^ p.sign) - i32(p.sign));
}

fn mean(thread: u32, packed: bool) {
    if thread >= p.threads {
        return;
    }
    let x = thread % p.inner;
    let y = (thread / p.inner) % p.middle;
    let z = thread / (p.inner * p.middle);
    var k = z;
    var i = y;
    var j = x;
    if p.axis == 1u {
        k = y;
        i = z;
    }
    if p.axis == 2u {
        k = x;
        i = z;
        j = y;
    }
    let centre = p.at + k;
    let line = i * p.in_i + j * p.in_j;
    let here = line + (centre - p.start) * p.in_axis;
    let before = centre;
    let after = p.n - 1u - centre;
    let c = value(here, packed);
    let twice = alone(c + c);
    var sum = c;
    for (var d = 1u; d <= p.radius; d += 1u) {
        var a = c;
        var b = c;
        if d <= before {
            a = value(here - d * p.in_axis, packed);
        }
        if d <= after {
            b = value(here + d * p.in_axis, packed);
        }
        let w = bitcast<f32>(weights[p.weights + k * p.radius + d - 1u]);
        sum = alone(sum + alone(w * alone(alone(a + b) - twice)));
    }
    output[k * p.out_axis + i * p.out_i + j * p.out_j] = bitcast<u32>(sum);
}

@compute @workgroup_size(64)
fn first(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    mean(thread_of(group, groups, local), true);
}

@compute @workgroup_size(64)
fn next(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    mean(thread_of(group, groups, local), false);
}
