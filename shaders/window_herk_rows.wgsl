// Van Herk along x (window_herk.wgsl, window_tiles.wgsl). A span holds several blocks.

alias Cell = Seen;

// Voxel q of a row, counted from the start of window 0; nothing where it does not exist.
fn seen_of(row: u32, q: i32) -> Seen {
    let i = q + p.first;
    if row < p.lines && i >= 0 && i < i32(p.n) {
        return seen_at(row * p.in_i + u32(i), false);
    }
    return nothing();
}

// Entries k, k + 64, ... of a tile whose column 0 is voxel q.
fn seen_of_batch(first: u32, k: u32, q: i32) -> array<Seen, BATCH> {
    return array<Seen, BATCH>(
        seen_of(first + row_of(k), q + i32(column_of(k))),
        seen_of(first + row_of(k + 64u), q + i32(column_of(k + 64u))),
        seen_of(first + row_of(k + 128u), q + i32(column_of(k + 128u))),
        seen_of(first + row_of(k + 192u), q + i32(column_of(k + 192u))),
    );
}

// What was kept at output o of a row; nothing where it does not exist or lies beyond `high`.
fn kept_of(row: u32, o: i32, high: i32) -> Seen {
    if row < p.lines && o >= 0 && o < high {
        return kept(row * p.out_i + u32(o));
    }
    return nothing();
}

fn kept_of_batch(first: u32, k: u32, o: i32, high: i32) -> array<Seen, BATCH> {
    return array<Seen, BATCH>(
        kept_of(first + row_of(k), o + i32(column_of(k)), high),
        kept_of(first + row_of(k + 64u), o + i32(column_of(k + 64u)), high),
        kept_of(first + row_of(k + 128u), o + i32(column_of(k + 128u)), high),
        kept_of(first + row_of(k + 192u), o + i32(column_of(k + 192u)), high),
    );
}

// What `made` holds of 64 rows from output `o` on, to those from `low` on and before `high`.
fn keep_tile(first: u32, o: i32, low: i32, high: i32, local: u32) {
    for (var k = local; k < 64u * COLUMNS; k += 64u) {
        let row = first + row_of(k);
        let to = o + i32(column_of(k));
        if row < p.lines && to >= low && to < high {
            keep(row * p.out_i + u32(to), made[slot_of(row_of(k), column_of(k))]);
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
        for (var k = local; k < 64u * COLUMNS; k += 64u * BATCH) {
            bring_made(k, seen_of_batch(first, k, low));
        }
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
        for (var k = local; k < 64u * COLUMNS; k += 64u * BATCH) {
            let come = seen_of_batch(first, k, o + w - 1);
            let before = kept_of_batch(first, k, o, last);
            bring_ahead(k, come);
            bring_made(k, before);
        }
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
