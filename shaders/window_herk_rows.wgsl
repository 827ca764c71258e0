// Van Herk along x (window_herk.wgsl, window_tiles.wgsl). A span holds several blocks.

alias Cell = Seen;

// Whether voxel q of rows exists, counted from the start of window 0.
fn is_there(q: i32) -> bool {
    return q + p.first >= 0 && q + p.first < i32(p.n);
}

// Brings voxel q + column of 64 rows.
fn bring(first: u32, q: i32, local: u32, into_made: bool) {
    let there = is_there(q + column_of(local));
    let at = u32(clamp(q + column_of(local) + p.first, 0, i32(p.n) - 1));
    for (var k = 0u; k < COLUMNS; k += 2u) {
        let r = row_of(local) + k * APART;
        var a = seen_at(start_of(first, r, p.in_i) + at, false);
        var b = seen_at(start_of(first, r + APART, p.in_i) + at, false);
        if !there {
            a = nothing();
            b = nothing();
        }
        let slot = slot_of(r, u32(column_of(local)));
        let other = slot_of(r + APART, u32(column_of(local)));
        if into_made {
            made[slot] = a;
            made[other] = b;
        } else {
            ahead[slot] = a;
            ahead[other] = b;
        }
    }
}

// Brings what was kept at output o + column of 64 rows, from 0 on and before `high`.
fn bring_kept(first: u32, o: i32, high: i32, local: u32) {
    let to = o + column_of(local);
    if to < 0 || to >= high {
        return;
    }
    for (var k = 0u; k < COLUMNS; k += 2u) {
        let r = row_of(local) + k * APART;
        let a = kept(start_of(first, r, p.out_i) + u32(to));
        let b = kept(start_of(first, r + APART, p.out_i) + u32(to));
        made[slot_of(r, u32(column_of(local)))] = a;
        made[slot_of(r + APART, u32(column_of(local)))] = b;
    }
}

// What `made` holds of 64 rows from output `o` on, to those from `low` on and before `high`.
fn keep_tile(first: u32, o: i32, low: i32, high: i32, local: u32) {
    let to = o + column_of(local);
    if to < low || to >= high {
        return;
    }
    for (var k = 0u; k < COLUMNS; k += 1u) {
        let r = row_of(local) + k * APART;
        if first + r < p.lines {
            keep((first + r) * p.out_i + u32(to), made[slot_of(r, u32(column_of(local)))]);
        }
    }
}

fn walk_rows(first: u32, span: i32, local: u32) {
    let w = i32(p.window);
    let m = i32(p.m);
    let step = i32(COLUMNS);
    let start = span * i32(p.block) - i32(p.phase);
    let stop = start + i32(p.block);
    // From each voxel to its block's end ...
    let top = min(stop, i32(p.n) - p.first);
    let bottom = max(start, 0);
    var seen = nothing();
    for (var high = top; high > bottom; high -= step) {
        let low = high - step;
        workgroupBarrier();
        bring(first, low, local, true);
        workgroupBarrier();
        var place = (high - 1 - start) % w;
        for (var c = COLUMNS; c > 0u; c -= 1u) {
            let slot = slot_of(local, c - 1u);
            if place == w - 1 {
                seen = nothing();
            }
            seen = join(made[slot], seen);
            made[slot] = seen;
            place = select(place - 1, w - 1, place == 0);
        }
        workgroupBarrier();
        keep_tile(first, low, bottom, min(high, m), local);
    }
    // ... and from the next block's start to the window's end.
    storageBarrier();
    seen = nothing();
    let last = min(stop, m);
    for (var o = start; o < last; o += step) {
        workgroupBarrier();
        bring(first, o + w - 1, local, false);
        bring_kept(first, o, last, local);
        workgroupBarrier();
        var place = (o - start) % w;
        for (var c = 0u; c < COLUMNS; c += 1u) {
            let slot = slot_of(local, c);
            if place == 0 {
                seen = nothing();
            } else {
                seen = join(seen, ahead[slot]);
                made[slot] = join(made[slot], seen);
            }
            place = select(place + 1, 0, place == w - 1);
        }
        workgroupBarrier();
        keep_tile(first, o, 0, last, local);
    }
}
