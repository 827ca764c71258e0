// Running sums of windows along one axis. Each thread makes one block of outputs of a line with a running sum, which drifts
// nowhere since integers wrap exactly; it starts with a whole window, and blocks are at least as long as windows, so the
// work per output stays below three loads whatever the radius. A shader adds the type `Sum`, its `plus`, `minus` and `term`.

@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<Sum>;

// A packed voxel's code, or its square.
fn code(index: u32) -> u32 {
    let code = unpacked(input[index >> p.packing], index, p.packing) ^ p.flip;
    return select(code, code * code, p.square == 1u);
}

fn walk(line: Line, packed: bool) {
    // q counts voxels from the start of window 0: output k sees q in k .. k + w, of which begin .. end exist.
    let w = i32(p.window);
    let begin = max(-p.first, 0);
    let end = i32(p.n) - p.first;
    let start = line.block * i32(p.block);
    let last = min(start + i32(p.block), i32(p.m));
    var sum = Sum();
    for (var q = max(start, begin); q < min(start + w, end); q += 1) {
        sum = plus(sum, term(line.input + u32(q + p.first) * p.in_axis, packed));
    }
    output[line.output + u32(start) * p.out_axis] = sum;
    if start >= begin && last + w - 1 <= end {
        // All windows of the block are whole.
        var gone = line.input + u32(start + p.first) * p.in_axis;
        var come = gone + p.window * p.in_axis;
        var to = line.output + u32(start) * p.out_axis;
        for (var k = start + 1; k < last; k += 1) {
            to += p.out_axis;
            sum = minus(plus(sum, term(come, packed)), term(gone, packed));
            output[to] = sum;
            come += p.in_axis;
            gone += p.in_axis;
        }
        return;
    }
    for (var k = start + 1; k < last; k += 1) {
        if k + w - 1 < end {
            sum = plus(sum, term(line.input + u32(k + w - 1 + p.first) * p.in_axis, packed));
        }
        if k - 1 >= begin {
            sum = minus(sum, term(line.input + u32(k - 1 + p.first) * p.in_axis, packed));
        }
        output[line.output + u32(k) * p.out_axis] = sum;
    }
}
