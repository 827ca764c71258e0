// Sums of codes, or of their squares, in the windows along one axis, as u32. Each thread makes one block of outputs of a
// line with a running sum, which drifts nowhere since integers wrap exactly; it starts with a whole window, and blocks
// are at least as long as windows, so the work per output stays below three loads whatever the radius.
//
// Agrees bit for bit with src/kernel/window/int.rs (S1 and S2). Parameters: src/gpu/passes.rs, struct Pass.
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or sums (`next`); 2 storage, written: sums.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

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
    lines: u32,     // extent of the line index i
    blocks: u32,    // blocks per line
    block: u32,     // outputs per block
    along: u32,     // 1: neighbouring threads take neighbouring blocks of a line (x), 0: neighbouring lines
    shift: u32,     // log2 of codes per word
    flip: u32,      // XOR that turns stored bits into codes
    square: u32,    // 1: the first pass sums squares of codes
    threads: u32,
    spare_0: u32,
    spare_1: u32,
}

@group(0) @binding(0) var<uniform> p: Pass;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

fn plus(a: u32, b: u32) -> u32 {
    return a + b;
}

fn minus(a: u32, b: u32) -> u32 {
    return a - b;
}

fn term(index: u32, packed: bool) -> u32 {
    if !packed {
        return input[index];
    }
    let bits = 32u >> p.shift;
    let code = ((input[index >> p.shift] >> ((index & ((1u << p.shift) - 1u)) * bits)) & ((1u << bits) - 1u)) ^ p.flip;
    return select(code, code * code, p.square == 1u);
}

fn walk(thread: u32, packed: bool) {
    if thread >= p.threads {
        return;
    }
    var i = thread % p.lines;
    var b = (thread / p.lines) % p.blocks;
    if p.along == 1u {
        b = thread % p.blocks;
        i = (thread / p.blocks) % p.lines;
    }
    let j = thread / (p.lines * p.blocks);
    let line_in = i * p.in_i + j * p.in_j;
    let line_out = i * p.out_i + j * p.out_j;
    // q counts voxels from the start of window 0: output k sees q in k .. k + w, of which begin .. end exist.
    let w = i32(p.window);
    let begin = max(-p.first, 0);
    let end = i32(p.n) - p.first;
    let start = i32(b * p.block);
    let last = min(start + i32(p.block), i32(p.m));
    var sum = u32();
    for (var q = max(start, begin); q < min(start + w, end); q += 1) {
        sum = plus(sum, term(line_in + u32(q + p.first) * p.in_axis, packed));
    }
    output[line_out + u32(start) * p.out_axis] = sum;
    for (var k = start + 1; k < last; k += 1) {
        if k + w - 1 < end {
            sum = plus(sum, term(line_in + u32(k + w - 1 + p.first) * p.in_axis, packed));
        }
        if k - 1 >= begin {
            sum = minus(sum, term(line_in + u32(k - 1 + p.first) * p.in_axis, packed));
        }
        output[line_out + u32(k) * p.out_axis] = sum;
    }
}

@compute @workgroup_size(64)
fn first(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    walk((group.y * groups.x + group.x) * 64u + local, true);
}

@compute @workgroup_size(64)
fn next(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    walk((group.y * groups.x + group.x) * 64u + local, false);
}
