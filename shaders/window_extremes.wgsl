// Least and greatest code of the windows along one axis, by van Herk: blocks as long as the window, so the work per
// output does not depend on the radius. One thread makes the outputs whose windows start in one block of one line.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes). Parameters: src/gpu/passes.rs, struct Pass.
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or pairs (`next`); 2 storage, read and
// written: pairs, the least code in the low 16 bits, the greatest in the high 16.
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
    block: u32,     // outputs per block: here the window
    along: u32,     // 1: neighbouring threads take neighbouring blocks of a line (x), 0: neighbouring lines
    shift: u32,     // log2 of codes per word
    flip: u32,      // XOR that turns stored bits into codes
    square: u32,    // unused here
    threads: u32,
    spare_0: u32,
    spare_1: u32,
}

@group(0) @binding(0) var<uniform> p: Pass;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

const NOTHING: u32 = 0x0000ffffu;

fn join(a: u32, b: u32) -> u32 {
    return min(a & 0xffffu, b & 0xffffu) | max(a & 0xffff0000u, b & 0xffff0000u);
}

fn pair(index: u32, packed: bool) -> u32 {
    if !packed {
        return input[index];
    }
    let bits = 32u >> p.shift;
    let code = ((input[index >> p.shift] >> ((index & ((1u << p.shift) - 1u)) * bits)) & ((1u << bits) - 1u)) ^ p.flip;
    return code | (code << 16u);
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
    let m = i32(p.m);
    let start = i32(b) * w;
    // From each voxel of the block to the block's end ...
    var seen = NOTHING;
    for (var q = min(start + w, end) - 1; q >= start; q -= 1) {
        if q >= begin {
            seen = join(seen, pair(line_in + u32(q + p.first) * p.in_axis, packed));
        }
        if q < m {
            output[line_out + u32(q) * p.out_axis] = seen;
        }
    }
    // ... and from the next block's start to the window's end.
    seen = NOTHING;
    let last = min(start + w, m);
    for (var k = start + 1; k < last; k += 1) {
        let q = k + w - 1;
        if q < end {
            seen = join(seen, pair(line_in + u32(q + p.first) * p.in_axis, packed));
        }
        let place = line_out + u32(k) * p.out_axis;
        output[place] = join(output[place], seen);
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
