// Running sums along x (window_sums.wgsl, window_tiles.wgsl).

alias Cell = Sum;

// Voxel q of a row, counted from the start of window 0; nothing where it lies before `low` or beyond `high`, or does not exist.
fn seen_of(row: u32, q: i32, low: i32, high: i32) -> Sum {
    let i = q + p.first;
    let there = q >= low && q < high && i >= 0 && i < i32(p.n);
    let place = min(row, p.lines - 1u) * p.in_i + u32(clamp(i, 0, i32(p.n) - 1));
    return select(Sum(), term(place, false), there);
}

// Entries k, k + 64, ... of a tile whose column 0 is voxel q.
fn seen_of_batch(first: u32, k: u32, q: i32, low: i32, high: i32) -> array<Sum, BATCH> {
    return array<Sum, BATCH>(
        seen_of(first + row_of(k), q + i32(column_of(k)), low, high),
        seen_of(first + row_of(k + 64u), q + i32(column_of(k + 64u)), low, high),
        seen_of(first + row_of(k + 128u), q + i32(column_of(k + 128u)), low, high),
        seen_of(first + row_of(k + 192u), q + i32(column_of(k + 192u)), low, high),
    );
}

fn walk_rows(first: u32, span: i32, local: u32) {
    let w = i32(p.window);
    let start = span * i32(p.block);
    let end = min(start + i32(p.block), i32(p.m));
    let step = i32(COLUMNS);
    var sum = Sum();
    // The first window but its last voxel.
    for (var q = start; q < start + w - 1; q += step) {
        workgroupBarrier();
        for (var k = local; k < 64u * COLUMNS; k += 64u * BATCH) {
            bring_ahead(k, seen_of_batch(first, k, q, start, start + w - 1));
        }
        workgroupBarrier();
        for (var c = 0u; c < COLUMNS; c += 1u) {
            sum = plus(sum, ahead[slot_of(local, c)]);
        }
    }
    for (var o = start; o < end; o += step) {
        workgroupBarrier();
        for (var k = local; k < 64u * COLUMNS; k += 64u * BATCH) {
            let come = seen_of_batch(first, k, o + w - 1, start, end + w);
            let gone = seen_of_batch(first, k, o - 1, start, end);
            bring_ahead(k, come);
            bring_made(k, gone);
        }
        workgroupBarrier();
        for (var c = 0u; c < COLUMNS; c += 1u) {
            let slot = slot_of(local, c);
            sum = minus(plus(sum, ahead[slot]), made[slot]);
            made[slot] = sum;
        }
        workgroupBarrier();
        for (var k = local; k < 64u * COLUMNS; k += 64u) {
            let row = first + row_of(k);
            let to = o + i32(column_of(k));
            if row < p.lines && to < end {
                output[row * p.out_i + u32(to)] = made[slot_of(row_of(k), column_of(k))];
            }
        }
    }
}
