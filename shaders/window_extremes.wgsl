// Least and greatest code of the windows along one axis, by van Herk: blocks as long as the window, so the work per
// output does not depend on the radius.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or pairs (`next`); 2 storage, read and
// written: pairs, the least code in the low 16 bits, the greatest in the high 16. Workgroup: window_pass.wgsl.

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
    let code = unpacked(input[index >> p.packing], index, p.packing) ^ p.flip;
    return code | (code << 16u);
}

fn walk(line: Line, packed: bool) {
    // q counts voxels from the start of window 0: output k sees q in k .. k + w, of which begin .. end exist.
    let w = i32(p.window);
    let begin = max(-p.first, 0);
    let end = i32(p.n) - p.first;
    let m = i32(p.m);
    let start = line.block * w;
    // From each voxel of the block to the block's end ...
    var seen = NOTHING;
    for (var q = min(start + w, end) - 1; q >= start; q -= 1) {
        if q >= begin {
            seen = join(seen, pair(line.input + u32(q + p.first) * p.in_axis, packed));
        }
        if q < m {
            output[line.output + u32(q) * p.out_axis] = seen;
        }
    }
    // ... and from the next block's start to the window's end.
    seen = NOTHING;
    let last = min(start + w, m);
    for (var k = start + 1; k < last; k += 1) {
        let q = k + w - 1;
        if q < end {
            seen = join(seen, pair(line.input + u32(q + p.first) * p.in_axis, packed));
        }
        let place = line.output + u32(k) * p.out_axis;
        output[place] = join(output[place], seen);
    }
}
