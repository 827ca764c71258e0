// Sums of windows along x. A workgroup makes two whole rows, 256 outputs of each at a time: each differs from the one before it by
// the voxel that comes and the one that goes, and prefix sums of these differences, eight in a row by a thread and then over the
// threads of a row, make outputs of the first window. So every voxel is read twice at most, neighbours by neighbours, whatever the
// radius. A shader adds the type `Sum`, its `plus` and `minus`, and `term`, an input.
//
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No atomics: an output has one writer.

// What a thread adds: its eight differences, and its share of the row's first window.
struct Share {
    moved: Sum,
    first: Sum,
}

// Outputs of a row at a time.
const AT_ONCE: u32 = 256u;

// A step of the scan reads one half and writes the other.
var<workgroup> shares: array<Share, 128>;
var<workgroup> row_sums: array<Sum, 528>;

// Where output k of those at a time stands, so that threads which read eight in a row meet no bank of memory twice.
fn slot_of(k: u32) -> u32 {
    return k + (k >> 5u);
}

// Voxel q of a row from the start of window 0 on, or nothing where there is none.
fn seen_at(start: u32, q: i32) -> Sum {
    // One before the first wraps to beyond the last.
    let i = u32(q + p.first);
    return select(Sum(), term(start + min(i, p.n - 1u), false), i < p.n);
}

// What output k has more than the one before it; the first one's are the whole window's last voxel.
fn change(start: u32, k: i32) -> Sum {
    let gone = select(Sum(), seen_at(start, k - 1), k > 0);
    return minus(seen_at(start, k + i32(p.window) - 1), gone);
}

// Four changes, 32 apart.
fn bring(start: u32, base: u32, k: u32, o: u32) {
    let a = change(start, i32(o + k));
    let b = change(start, i32(o + k + 32u));
    let c = change(start, i32(o + k + 64u));
    let d = change(start, i32(o + k + 96u));
    row_sums[base + slot_of(k)] = a;
    row_sums[base + slot_of(k + 32u)] = b;
    row_sums[base + slot_of(k + 64u)] = c;
    row_sums[base + slot_of(k + 96u)] = d;
}

// The sum of the shares of a row's threads up to this one's; all of them are left in the last one's place.
fn scanned(own: Share, local: u32) -> Share {
    var share = own;
    var half = 0u;
    shares[local] = share;
    for (var d = 1u; d < 32u; d *= 2u) {
        workgroupBarrier();
        if (local & 31u) >= d {
            let other = shares[half + local - d];
            share = Share(plus(share.moved, other.moved), plus(share.first, other.first));
        }
        half ^= 64u;
        shares[half + local] = share;
    }
    workgroupBarrier();
    return share;
}

// Two rows, of which the second may not be there.
fn walk_rows(pair: u32, local: u32) {
    let w = i32(p.window);
    let row = 2u * pair + (local >> 5u);
    let lane = local & 31u;
    let there = row < p.lines;
    let start = min(row, p.lines - 1u) * p.in_i;
    let to = row * p.out_i;
    let base = (local >> 5u) * 264u;
    // The row's first window but its last voxel.
    var first = Sum();
    for (var q = i32(lane); q < w - 1; q += 32) {
        first = plus(first, seen_at(start, q));
    }
    var before = Sum();
    for (var o = 0u; o < p.m; o += AT_ONCE) {
        workgroupBarrier();
        bring(start, base, lane, o);
        bring(start, base, lane + 128u, o);
        workgroupBarrier();
        var run: array<Sum, 8>;
        var sum = Sum();
        for (var j = 0u; j < 8u; j += 1u) {
            sum = plus(sum, row_sums[base + slot_of(8u * lane + j)]);
            run[j] = sum;
        }
        let share = scanned(Share(sum, first), local);
        // The scan ends in the other half after an odd number of steps.
        let all = shares[64u + (local | 31u)];
        before = plus(before, all.first);
        let ahead = plus(before, minus(share.moved, sum));
        for (var j = 0u; j < 8u; j += 1u) {
            row_sums[base + slot_of(8u * lane + j)] = plus(ahead, run[j]);
        }
        workgroupBarrier();
        for (var k = lane; there && k < min(AT_ONCE, p.m - o); k += 32u) {
            output[to + o + k] = row_sums[base + slot_of(k)];
        }
        before = plus(before, all.moved);
        first = Sum();
    }
}

@compute @workgroup_size(64)
fn rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let pairs = (p.lines + 1u) / 2u;
    for (var pair = thread_of(group, groups, 0u) / 64u; pair < pairs; pair += all_threads(groups) / 64u) {
        walk_rows(pair, local);
    }
}
