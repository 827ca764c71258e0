// Extremes of windows along x, of up to `HELD` / 2 voxels: a workgroup takes a span of a row, makes of it the extremes of windows
// of 3 voxels, of those 9, and so on, and joins up to three of these for each window. So every voxel is read once, neighbours by
// neighbours, and the work grows with the logarithm of the radius. A thread has what starts at every 64th voxel at hand.

const HELD: u32 = 512u;
const EACH: u32 = 8u;

var<workgroup> held: array<Seen, 512>;

// Voxel e of the span that output `begin` starts, or nothing where there is none.
fn held_of(row: u32, begin: u32, e: u32) -> Seen {
    // One before the first wraps to beyond the last.
    let i = u32(i32(begin + e) + p.first);
    return select(nothing(), seen_at(row * p.in_i + min(i, p.n - 1u), false), i < p.n);
}

// Output voxels `begin` and on of a row.
fn walk_span(row: u32, begin: u32, local: u32) {
    let count = min(p.block, p.m - begin);
    let length = count + p.window - 1u;
    var mine: array<Seen, EACH>;
    for (var j = 0u; j < EACH; j += 1u) {
        if 64u * j < length {
            mine[j] = held_of(row, begin, local + 64u * j);
        }
    }
    workgroupBarrier();
    for (var j = 0u; j < EACH; j += 1u) {
        held[local + 64u * j] = mine[j];
    }
    var size = 1u;
    while 3u * size <= p.window {
        workgroupBarrier();
        for (var j = 0u; j < EACH; j += 1u) {
            let e = local + 64u * j;
            if e + 3u * size <= length {
                mine[j] = join(join(mine[j], held[e + size]), held[e + 2u * size]);
            }
        }
        workgroupBarrier();
        for (var j = 0u; j < EACH; j += 1u) {
            if 64u * j < length {
                held[local + 64u * j] = mine[j];
            }
        }
        size *= 3u;
    }
    workgroupBarrier();
    let last = p.window - size;
    for (var j = 0u; j < EACH; j += 1u) {
        let k = local + 64u * j;
        if k < count {
            keep(row * p.out_i + begin + k, join(join(mine[j], held[k + min(size, last)]), held[k + last]));
        }
    }
}

@compute @workgroup_size(64)
fn near(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let spans = p.lines * p.blocks;
    for (var span = thread_of(group, groups, 0u) / 64u; span < spans; span += all_threads(groups) / 64u) {
        walk_span(span / p.blocks, span % p.blocks * p.block, local);
    }
}
