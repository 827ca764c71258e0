// Running sums of windows along z or y. Each thread makes one block of outputs of a line with a running sum, which drifts
// nowhere since integers wrap exactly; it starts with a whole window, and blocks are at least as long as windows, so the
// work per output stays below three loads whatever the radius. A shader adds the type `Sum`, its `plus`, `minus`, `term`, and
// the bindings.

// Voxel q of a line from the start of window 0 on, or nothing where there is none.
fn voxel(line: Line, q: i32, packed: bool) -> Sum {
    // One before the first wraps to beyond the last.
    let i = u32(q + p.first);
    return select(Sum(), term(line.input + min(i, p.n - 1u) * p.in_axis, packed), i < p.n);
}

// What output k has more than the one before it.
fn moved(line: Line, k: i32, packed: bool) -> Sum {
    return minus(voxel(line, k + i32(p.window) - 1, packed), voxel(line, k - 1, packed));
}

// Four at a time, since nothing is read ahead of what is written.
fn walk(line: Line, packed: bool) {
    let w = i32(p.window);
    let start = line.block * i32(p.block);
    let last = min(start + i32(p.block), i32(p.m));
    var sum = Sum();
    for (var q = start; q < start + w; q += 1) {
        sum = plus(sum, voxel(line, q, packed));
    }
    var to = line.output + u32(start) * p.out_axis;
    output[to] = sum;
    for (var k = start + 1; k < last; k += 4) {
        let a = plus(sum, moved(line, k, packed));
        let b = plus(a, moved(line, k + 1, packed));
        let c = plus(b, moved(line, k + 2, packed));
        sum = plus(c, moved(line, k + 3, packed));
        output[to + p.out_axis] = a;
        if k + 1 < last {
            output[to + 2u * p.out_axis] = b;
        }
        if k + 2 < last {
            output[to + 3u * p.out_axis] = c;
        }
        if k + 3 < last {
            output[to + 4u * p.out_axis] = sum;
        }
        to += 4u * p.out_axis;
    }
}
