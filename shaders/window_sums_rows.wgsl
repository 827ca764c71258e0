// Running sums along x (window_sums.wgsl, window_tiles.wgsl).

alias Cell = Sum;

// Where voxel q of a row stands in it, counted from the start of window 0, and whether it is there and within low .. high.
struct Seen {
    at: u32,
    there: bool,
}

fn seen_of(q: i32, low: i32, high: i32) -> Seen {
    let i = q + p.first;
    let there = q >= low && q < high && i >= 0 && i < i32(p.n);
    return Seen(u32(clamp(i, 0, i32(p.n) - 1)), there);
}

fn term_of(start: u32, seen: Seen) -> Sum {
    return select(Sum(), term(start + seen.at, false), seen.there);
}

fn walk_rows(first: u32, span: i32, local: u32) {
    let w = i32(p.window);
    let begin = span * i32(p.block);
    let end = min(begin + i32(p.block), i32(p.m));
    let step = i32(COLUMNS);
    let row = row_of(local);
    let column = column_of(local);
    var sum = Sum();
    // The first window but its last voxel.
    for (var q = begin; q < begin + w - 1; q += step) {
        let seen = seen_of(q + column, begin, begin + w - 1);
        workgroupBarrier();
        for (var k = 0u; k < COLUMNS; k += 4u) {
            let r = row + k * APART;
            let a = term_of(start_of(first, r, p.in_i), seen);
            let b = term_of(start_of(first, r + APART, p.in_i), seen);
            let c = term_of(start_of(first, r + 2u * APART, p.in_i), seen);
            let d = term_of(start_of(first, r + 3u * APART, p.in_i), seen);
            ahead[slot_of(r, u32(column))] = a;
            ahead[slot_of(r + APART, u32(column))] = b;
            ahead[slot_of(r + 2u * APART, u32(column))] = c;
            ahead[slot_of(r + 3u * APART, u32(column))] = d;
        }
        workgroupBarrier();
        for (var c = 0u; c < COLUMNS; c += 1u) {
            sum = plus(sum, ahead[slot_of(local, c)]);
        }
    }
    for (var o = begin; o < end; o += step) {
        let come = seen_of(o + column + w - 1, begin, end + w);
        let gone = seen_of(o + column - 1, begin, end);
        workgroupBarrier();
        for (var k = 0u; k < COLUMNS; k += 2u) {
            let r = row + k * APART;
            let start = start_of(first, r, p.in_i);
            let next = start_of(first, r + APART, p.in_i);
            let a = term_of(start, come);
            let b = term_of(next, come);
            let c = term_of(start, gone);
            let d = term_of(next, gone);
            let slot = slot_of(r, u32(column));
            let other = slot_of(r + APART, u32(column));
            ahead[slot] = a;
            ahead[other] = b;
            made[slot] = c;
            made[other] = d;
        }
        workgroupBarrier();
        for (var c = 0u; c < COLUMNS; c += 1u) {
            let slot = slot_of(local, c);
            sum = minus(plus(sum, ahead[slot]), made[slot]);
            made[slot] = sum;
        }
        workgroupBarrier();
        if o + column < end {
            for (var k = 0u; k < COLUMNS; k += 1u) {
                let r = row + k * APART;
                if first + r < p.lines {
                    output[(first + r) * p.out_i + u32(o + column)] = made[slot_of(r, u32(column))];
                }
            }
        }
    }
}
