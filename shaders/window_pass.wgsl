// The parameters of passes over windows.
//
// Parameters: src/gpu/passes.rs, struct Pass. Workgroup: 64 x 1 x 1, groups counted over x, then y. No atomics: an output has
// one writer at a time.

struct Pass {
    n: u32,         // extent of the input along the axis
    m: u32,         // outputs along the axis
    first: i32,     // input index of the first voxel of window 0; negative: cut there
    window: u32,    // 2 r + 1
    in_axis: u32,   // strides, in elements: the input's along the axis and of a line's two indices
    in_i: u32,
    in_j: u32,
    out_axis: u32,  // the output's
    out_i: u32,
    out_j: u32,
    lines: u32,     // extent of the line index i; along x all rows
    blocks: u32,    // blocks per line
    block: u32,     // outputs per block; along x those of a span
    packing: u32,   // log2 of voxels per word
    flip: u32,      // XOR that turns stored bits into codes
    square: u32,    // 1: the first pass sums squares of codes; cells of moments hold M2
    threads: u32,
    phase: u32,     // outputs of block 0 that lie before output 0 (floats)
    zero: u32,      // 0, which no compiler knows
    cell: u32,      // words of a cell of moments
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
    spare_3: u32,
}

@group(0) @binding(0) var<uniform> p: Pass;
