// Van Herk over the windows along one axis: blocks as long as the window, so the work per output does not depend on the
// radius. Every output joins what its block holds from it to the end with what the next block holds up to the window's end.
// A shader adds the type `Seen`, `nothing`, `join` (first what lies before), `seen_at` (an input), `kept` and `keep` (an
// output). Blocks start `phase` outputs before output 0: where joining rounds, they start at multiples of the window in the
// volume, and bricks do not show.

fn walk(line: Line, packed: bool) {
    // q counts voxels from the start of window 0: output k sees q in k .. k + w, of which begin .. end exist.
    let w = i32(p.window);
    let begin = max(-p.first, 0);
    let end = i32(p.n) - p.first;
    let m = i32(p.m);
    let start = line.block * w - i32(p.phase);
    // From each voxel of the block to the block's end ...
    var seen = nothing();
    for (var q = min(start + w, end) - 1; q >= max(start, 0); q -= 1) {
        if q >= begin {
            seen = join(seen_at(line.input + u32(q + p.first) * p.in_axis, packed), seen);
        }
        if q < m {
            keep(line.output + u32(q) * p.out_axis, seen);
        }
    }
    // ... and from the next block's start to the window's end.
    seen = nothing();
    let last = min(start + w, m);
    for (var k = start + 1; k < last; k += 1) {
        let q = k + w - 1;
        if q >= begin && q < end {
            seen = join(seen, seen_at(line.input + u32(q + p.first) * p.in_axis, packed));
        }
        if k >= 0 {
            let place = line.output + u32(k) * p.out_axis;
            keep(place, join(kept(place), seen));
        }
    }
}
