// Van Herk (window_herk.wgsl), four voxels at a time, since nothing is read ahead of what is written: 94 instead of 139 us along y
// of u8 256^3 at radius 40, the same at radius 10; moments of floats, which take long to join, 354 instead of 271 (H200,
// 2026-11-27).

// Voxel q of a line from the start of window 0 on, or nothing where there is none.
fn voxel(line: Line, q: i32, packed: bool) -> Seen {
    let i = q + p.first;
    if i < 0 || i >= i32(p.n) {
        return nothing();
    }
    return seen_at(line.input + u32(i) * p.in_axis, packed);
}

fn place_of(line: Line, k: i32) -> u32 {
    return line.output + u32(k) * p.out_axis;
}

fn keep_at(line: Line, k: i32, seen: Seen) {
    if k >= 0 && k < i32(p.m) {
        keep(place_of(line, k), seen);
    }
}

// Output k with what lies beyond its block.
fn joined_at(line: Line, k: i32, seen: Seen) -> Seen {
    return join(kept(place_of(line, clamp(k, 0, i32(p.m) - 1))), seen);
}

fn walk(line: Line, packed: bool) {
    let w = i32(p.window);
    let start = line.block * w - i32(p.phase);
    // From each voxel of the block to the block's end ...
    var seen = nothing();
    var q = start + w - 1;
    for (; q >= start + 3; q -= 4) {
        let a = join(voxel(line, q, packed), seen);
        let b = join(voxel(line, q - 1, packed), a);
        let c = join(voxel(line, q - 2, packed), b);
        seen = join(voxel(line, q - 3, packed), c);
        keep_at(line, q, a);
        keep_at(line, q - 1, b);
        keep_at(line, q - 2, c);
        keep_at(line, q - 3, seen);
    }
    for (; q >= start; q -= 1) {
        seen = join(voxel(line, q, packed), seen);
        keep_at(line, q, seen);
    }
    // ... and from the next block's start to the window's end.
    seen = nothing();
    let last = min(start + w, i32(p.m));
    var k = start + 1;
    for (; k + 3 < last; k += 4) {
        let a = join(seen, voxel(line, k + w - 1, packed));
        let b = join(a, voxel(line, k + w, packed));
        let c = join(b, voxel(line, k + w + 1, packed));
        seen = join(c, voxel(line, k + w + 2, packed));
        let whole_a = joined_at(line, k, a);
        let whole_b = joined_at(line, k + 1, b);
        let whole_c = joined_at(line, k + 2, c);
        let whole_d = joined_at(line, k + 3, seen);
        keep_at(line, k, whole_a);
        keep_at(line, k + 1, whole_b);
        keep_at(line, k + 2, whole_c);
        keep_at(line, k + 3, whole_d);
    }
    for (; k < last; k += 1) {
        seen = join(seen, voxel(line, k + w - 1, packed));
        keep_at(line, k, joined_at(line, k, seen));
    }
}
