// Sums of contributions of the one or two directions along a family of parallel lattice lines. One thread walks one line of
// the box to and fro and finds the next greater code ahead of every voxel by following the answers of the voxels before it
// (each link is followed once and then passed over), so the work per voxel does not depend on the reach.
//
// Threads share out the cross-section of the box at its first plane. A line that leaves the box at one side goes on as
// another one that enters at the other side, so every thread visits every plane once and every voxel belongs to one thread.
//
// Agrees bit for bit with src/kernel/obscurance (integer sums). Parameters: src/gpu/sweep.rs, struct Lines; displacements
// are integers that the CPU made in f64, and are never computed here.
// A dispatch takes up to eight families side by side, since the lines of one are too few to fill a large GPU; integers add up
// to the same sums in any order, so they are added by atomic operations. What a thread left at a voxel (an entry: its code, and
// the steps to the next greater one) stands in one place of the links, first of the backward sense, then of the forward one.
// The nearest links of the chain ahead stand as a stack in workgroup memory, too, where almost every answer is found; each
// thread reads what it wrote itself, so there is no barrier.
//
// A shader adds the type `Entry`, its `entry_of`, `code_of`, `step_of` and `is_beyond`, and `TOP`, the greatest code.
// Bindings, group 0: 0 uniform Lines; 1 storage, read: packed codes; 2 storage, read and written: sums of the output box, which
// start at 0; 3 storage, read: displacements and contributions; 4 storage, read and written: entries of each family,
// [plane][thread].
// Workgroup: 64 x 1 x 1, groups counted over x, then y. A group is of one family.

struct Lines {
    planes: u32,     // extent of the box along the dominant axis
    size_b: u32,     // its cross-section; neighbouring threads are neighbours along c
    size_c: u32,
    reach: u32,      // at most planes - 1
    code_at: u32,    // first voxel of the box in the codes, and strides, in voxels
    code_a: u32,
    code_b: u32,
    code_c: u32,
    out_a: u32,      // extent of the output box
    out_b: u32,
    out_c: u32,
    sum_a: u32,      // strides of the sums
    sum_b: u32,
    sum_c: u32,
    at_a: i32,       // first output voxel, in the box
    at_b: i32,
    at_c: i32,
    shifts: u32,     // displacements by plane from the one before, along b in the low half of a word, along c in the high one
    forward: u32,    // contributions toward growing planes, `reach` + 1 of them, the last where nothing occludes
    backward: u32,   // toward falling planes; 0xffffffff: a sense that is not swept
    packing: u32,    // log2 of codes per word
    first: u32,      // line of thread 0
    threads: u32,    // lines of this dispatch
    links: u32,      // the family's first entry
    groups: u32,     // workgroups of each family
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
}

@group(0) @binding(0) var<uniform> families: array<Lines, 8>;
@group(0) @binding(1) var<storage, read> codes: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read> tables: array<u32>;
@group(0) @binding(4) var<storage, read_write> links: array<Entry>;

const NOT_SWEPT: u32 = 0xffffffffu;
// Steps of a voxel without a greater code ahead: more than there are planes.
const NONE: u32 = 0xffffu;

// Links of the chain that a thread has at hand, less one; a power of two. 42 directions over 256^3 u8 took 5.8 ms with 8, 7.0 with
// 16, which keep threads off the device, 7.4 with 4 (noise; smooth waves 5.5, -, 6.3; H200, 2026-11-27).
const KEPT: u32 = 8u;

var<private> p: Lines;
// Of each thread a ring of codes and planes, every 64 entries one, each greater than the one above it; under the lowest an end.
var<workgroup> stack: array<Entry, KEPT * 64u>;
// Where the thread's highest one stands, and what it is.
var<private> highest: u32;
var<private> top: Entry;

fn code(plane: u32, at: vec2<i32>) -> u32 {
    let index = p.code_at + plane * p.code_a + u32(at.x) * p.code_b + u32(at.y) * p.code_c;
    return unpacked(codes[index >> p.packing], index, p.packing);
}

// The way from the plane before to this one.
fn shift(plane: u32) -> vec2<i32> {
    let both = bitcast<i32>(tables[p.shifts + plane]);
    return vec2<i32>((both << 16u) >> 16u, both >> 16u);
}

// The place at another plane; z is 1 where the way there leaves the box at a side and comes back at the other.
fn move_by(at: vec2<i32>, by: vec2<i32>) -> vec3<i32> {
    let moved = at + by;
    if u32(moved.x) < p.size_b && u32(moved.y) < p.size_c {
        return vec3<i32>(moved, 0);
    }
    let size = vec2<i32>(i32(p.size_b), i32(p.size_c));
    let low = select(vec2<i32>(0), size, moved < vec2<i32>(0));
    let high = select(vec2<i32>(0), size, moved >= size);
    return vec3<i32>(moved + low - high, 1);
}

fn place_of(plane: u32, thread: u32) -> u32 {
    return p.links + plane * p.threads + thread;
}

// Empties the stack.
fn forget() {
    top = entry_of(TOP, NONE);
    stack[highest] = top;
}

fn below_of(slot: u32) -> u32 {
    return (slot - 64u) % (KEPT * 64u);
}

fn above_of(slot: u32) -> u32 {
    return (slot + 64u) % (KEPT * 64u);
}

// A voxel with its answer, and onto the stack, which forgets its lowest when it is full.
fn leave(plane: u32, thread: u32, own: u32, step: u32) {
    links[place_of(plane, thread)] = entry_of(own, step);
    highest = above_of(highest);
    top = entry_of(own, plane);
    stack[highest] = top;
    stack[above_of(highest)] = entry_of(TOP, NONE);
}

// Steps from `plane` to the first greater code than `own`, no more than `room` planes away; `NONE` if there is none. What is
// not greater leaves the stack.
fn seek(plane: u32, own: u32, room: u32, thread: u32, way: i32) -> u32 {
    if own == TOP {
        forget();
        return NONE;
    }
    let below = entry_of(own, NONE);
    var last = NONE; // plane of the lowest that was not greater
    var entry = top;
    while !is_beyond(entry, below) {
        last = step_of(entry);
        highest = below_of(highest);
        entry = stack[highest];
    }
    if step_of(entry) != NONE {
        let d = u32(way * (i32(step_of(entry)) - i32(plane)));
        return select(NONE, d, d <= room);
    }
    if last == NONE {
        return NONE; // no voxel lies ahead on this line
    }
    // From the lowest on along its links; one without a greater code leads beyond all room.
    var d = u32(way * (i32(last) - i32(plane))) + step_of(links[place_of(last, thread)]);
    while d <= room {
        let far = links[place_of(u32(i32(plane) + way * i32(d)), thread)];
        if is_beyond(far, below) {
            return d;
        }
        d += step_of(far);
    }
    return NONE;
}

fn contribution(table: u32, d: u32) -> u32 {
    return tables[table + min(d - 1u, p.reach)];
}

fn add_up(plane: u32, at: vec2<i32>, sum: u32) {
    // What lies before the box wraps to beyond it.
    let out = vec3<u32>(plane - u32(p.at_a), u32(at.x - p.at_b), u32(at.y - p.at_c));
    if out.x < p.out_a && out.y < p.out_b && out.z < p.out_c {
        atomicAdd(&sums[out.x * p.sum_a + out.y * p.sum_b + out.z * p.sum_c], sum);
    }
}

// To the last plane, seeking backward on the way; returns the place there. The code of the next plane is asked for before this
// one's answer is sought, so that it is there when it is needed.
fn go(start: vec2<i32>, thread: u32) -> vec2<i32> {
    var at = start;
    var own = code(0u, at);
    var room = 0u; // planes of this line that lie behind
    for (var i = 0u; i < p.planes; i += 1u) {
        var next = vec3<i32>(at, 0);
        var ahead = 0u;
        if i + 1u < p.planes {
            next = move_by(at, shift(i + 1u));
            ahead = code(i + 1u, next.xy);
        }
        var d = NONE;
        if p.backward != NOT_SWEPT {
            d = seek(i, own, min(room, p.reach), thread, -1);
        }
        leave(i, thread, own, d);
        room += 1u;
        if next.z == 1 {
            room = 0u;
            forget();
        }
        at = next.xy;
        own = ahead;
    }
    return at;
}

// And back, seeking forward and adding up both.
fn come(end: vec2<i32>, thread: u32) {
    var at = end;
    var here = links[place_of(p.planes - 1u, thread)];
    var room = 0u;
    for (var k = p.planes; k > 0u; k -= 1u) {
        let i = k - 1u;
        var next = vec3<i32>(at, 0);
        var ahead = here;
        if i > 0u {
            next = move_by(at, -shift(i));
            ahead = links[place_of(i - 1u, thread)];
        }
        let own = code_of(here);
        var sum = 0u;
        if p.backward != NOT_SWEPT {
            sum = contribution(p.backward, step_of(here));
        }
        if p.forward != NOT_SWEPT {
            let d = seek(i, own, min(room, p.reach), thread, 1);
            leave(i, thread, own, d);
            sum += contribution(p.forward, d);
        }
        add_up(i, at, sum);
        room += 1u;
        if next.z == 1 {
            room = 0u;
            forget();
        }
        at = next.xy;
        here = ahead;
    }
}

@compute @workgroup_size(64)
fn sweep(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    let number = group.y * groups.x + group.x;
    let family = number / families[0].groups;
    if family > 7u {
        return;
    }
    p = families[family];
    let thread = (number % p.groups) * 64u + local;
    if thread >= p.threads {
        return;
    }
    let line = p.first + thread;
    highest = local;
    forget();
    let end = go(vec2<i32>(i32(line / p.size_c), i32(line % p.size_c)), thread);
    forget();
    come(end, thread);
}
