// Van Herk along x where windows are short (window_herk.wgsl): a workgroup brings a span of several blocks of several rows here,
// whole, and each thread makes one block of one row.

var<workgroup> seen_here: array<Seen, CELLS>;

// Voxel q of a row that starts at `start`, counted from the start of window 0; nothing where it does not exist.
fn voxel_of(start: u32, q: i32) -> Seen {
    let i = q + p.first;
    if i >= 0 && i < i32(p.n) {
        return seen_at(start + u32(i), false);
    }
    return nothing();
}

@compute @workgroup_size(64)
fn spans(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    let number = group.y * groups.x + group.x;
    let first = number / p.blocks * p.rows;
    if first >= p.lines {
        return;
    }
    let w = p.window;
    let begin = i32(number % p.blocks * p.block) - i32(p.phase);
    // Of a row here what the span's windows see; an odd number, so that rows start in different banks.
    let pitch = (p.block + w - 1u) | 1u;
    for (var r = 0u; r < p.rows; r += 4u) {
        let a = start_of(first, r, p.in_i);
        let b = start_of(first, r + 1u, p.in_i);
        let c = start_of(first, r + 2u, p.in_i);
        let d = start_of(first, r + 3u, p.in_i);
        for (var j = local; j < p.block + w - 1u; j += 64u) {
            let q = begin + i32(j);
            let in_a = voxel_of(a, q);
            let in_b = voxel_of(b, q);
            let in_c = voxel_of(c, q);
            let in_d = voxel_of(d, q);
            seen_here[r * pitch + j] = in_a;
            seen_here[(r + 1u) * pitch + j] = in_b;
            seen_here[(r + 2u) * pitch + j] = in_c;
            seen_here[(r + 3u) * pitch + j] = in_d;
        }
    }
    workgroupBarrier();
    let results = p.rows * pitch;
    let row = local / p.many;
    if row < p.rows {
        let seen_from = row * pitch + local % p.many * w;
        let to = results + row * p.block + local % p.many * w;
        // From each voxel to the block's end ...
        var seen = nothing();
        for (var j = w; j > 0u; j -= 1u) {
            seen = join(seen_here[seen_from + j - 1u], seen);
            seen_here[to + j - 1u] = seen;
        }
        // ... and from the next block's start to the window's end.
        seen = nothing();
        for (var j = 1u; j < w; j += 1u) {
            seen = join(seen, seen_here[seen_from + w - 1u + j]);
            seen_here[to + j] = join(seen_here[to + j], seen);
        }
    }
    workgroupBarrier();
    for (var r = 0u; r < p.rows && first + r < p.lines; r += 1u) {
        for (var j = local; j < p.block; j += 64u) {
            let k = begin + i32(j);
            if k >= 0 && k < i32(p.m) {
                keep((first + r) * p.out_i + u32(k), seen_here[results + r * p.block + j]);
            }
        }
    }
}
