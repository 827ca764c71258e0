// What Gaussian passes along one axis share: parameters and bindings.
//
// Parameters: src/gpu/taps.rs, struct Taps. Weights come from the CPU, in f64 and rounded.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No atomics: an output has one writer.

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
    inner: u32,     // extents, the fastest first: of the outputs' x, and of their y; along the axis of strips
    middle: u32,
    axis: u32,      // which of z, y, x the axis is; i and j are the others in this order
    weights: u32,   // where the axis' weights start: of each step away those of all outputs
    packing: u32,   // log2 of voxels per word
    sign: u32,      // the sign bit of a packed voxel, or 0
    zero: u32,      // 0, which no compiler knows
    threads: u32,
    centres: u32,   // where the centres' weights of the axis start (variance)
    last: u32,      // 1: of a cell only the variance is kept
    strip: u32,     // outputs of a thread, one after the other along the axis
    spare_0: u32,
    spare_1: u32,
}

@group(0) @binding(0) var<uniform> p: Taps;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> weights: array<u32>;

// The weight of a tap d steps away from output k; of one beyond the last that of the last.
fn weight(k: u32, d: u32) -> f32 {
    return bitcast<f32>(weights[p.weights + (d - 1u) * p.m + min(k, p.m - 1u)]);
}
