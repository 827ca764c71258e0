// Sums of contributions of the one or two directions along a family of parallel lattice lines. One thread walks one line of
// the box to and fro and finds the next greater code ahead of every voxel by following the answers of the voxels before it
// (each link is followed once and then passed over), so the work per voxel does not depend on the reach.
//
// Threads share out the cross-section of the box at its first plane. A line that leaves the box at one side goes on as
// another one that enters at the other side, so every thread visits every plane once and every voxel belongs to one thread.
//
// Agrees bit for bit with src/kernel/obscurance (integer sums). Parameters: src/gpu/sweep.rs, struct Lines; displacements
// are integers that the CPU made in f64, and are never computed here.
// Bindings, group 0: 0 uniform Lines; 1 storage, read: packed codes; 2 storage, read and written: sums of the output box;
// 3 storage, read: displacements and contributions; 4 storage, read and written: steps to the next greater code of both
// senses, 16 bits each, 0 for none, [plane][thread].
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: a voxel has one thread.

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
    shifts: u32,     // displacement along b by plane, less the first plane's; then along c
    forward: u32,    // contributions toward growing planes, `reach` + 1 of them, the last where nothing occludes
    backward: u32,   // toward falling planes; 0xffffffff: a sense that is not swept
    packing: u32,    // log2 of codes per word
    first: u32,      // line of thread 0
    threads: u32,
    fresh: u32,      // 1: the sums start here
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
    spare_3: u32,
}

@group(0) @binding(0) var<uniform> p: Lines;
@group(0) @binding(1) var<storage, read> codes: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;
@group(0) @binding(3) var<storage, read> tables: array<u32>;
@group(0) @binding(4) var<storage, read_write> links: array<u32>;

const NOT_SWEPT: u32 = 0xffffffffu;

fn code(plane: u32, at: vec2<i32>) -> u32 {
    let index = p.code_at + plane * p.code_a + u32(at.x) * p.code_b + u32(at.y) * p.code_c;
    return unpacked(codes[index >> p.packing], index, p.packing);
}

fn shift(plane: u32) -> vec2<i32> {
    return vec2<i32>(bitcast<i32>(tables[p.shifts + plane]), bitcast<i32>(tables[p.shifts + p.planes + plane]));
}

// The place at another plane; z is 1 where the way there leaves the box at a side and comes back at the other.
fn move_by(at: vec2<i32>, by: vec2<i32>) -> vec3<i32> {
    let size = vec2<i32>(i32(p.size_b), i32(p.size_c));
    let moved = at + by;
    let inside = all(moved >= vec2<i32>(0)) && all(moved < size);
    let low = select(vec2<i32>(0), size, moved < vec2<i32>(0));
    let high = select(vec2<i32>(0), size, moved >= size);
    return vec3<i32>(moved + low - high, select(1, 0, inside));
}

// Steps from `plane` to the first greater code, no more than `room` planes away; 0 if there is none. `half` tells where the
// links of this sense stand, `way` its direction.
fn seek(plane: u32, at: vec2<i32>, room: u32, thread: u32, half: u32, way: i32) -> u32 {
    let own = code(plane, at);
    let here = shift(plane);
    var d = 1u;
    loop {
        if d > room {
            return 0u;
        }
        let other = u32(i32(plane) + way * i32(d));
        if code(other, at + shift(other) - here) > own {
            return d;
        }
        let link = (links[other * p.threads + thread] >> half) & 0xffffu;
        if link == 0u {
            return 0u;
        }
        d += link;
    }
    return 0u;
}

fn contribution(table: u32, d: u32) -> u32 {
    return tables[table + select(d - 1u, p.reach, d == 0u)];
}

@compute @workgroup_size(64)
fn sweep(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) local: u32) {
    let thread = thread_of(group, groups, local);
    if thread >= p.threads {
        return;
    }
    let line = p.first + thread;
    var at = vec2<i32>(i32(line / p.size_c), i32(line % p.size_c));
    // To the last plane, seeking backward on the way; `room` counts the planes of this line that lie behind.
    var room = 0u;
    for (var i = 0u; i < p.planes; i += 1u) {
        if i > 0u {
            let moved = move_by(at, shift(i) - shift(i - 1u));
            at = moved.xy;
            room = select(room + 1u, 0u, moved.z == 1);
        }
        var d = 0u;
        if p.backward != NOT_SWEPT {
            d = seek(i, at, min(room, p.reach), thread, 0u, -1);
        }
        links[i * p.threads + thread] = d;
    }
    // And back, seeking forward and adding up both.
    room = 0u;
    for (var k = p.planes; k > 0u; k -= 1u) {
        let i = k - 1u;
        if k < p.planes {
            let moved = move_by(at, shift(i) - shift(k));
            at = moved.xy;
            room = select(room + 1u, 0u, moved.z == 1);
        }
        let place = i * p.threads + thread;
        let behind = links[place];
        var sum = 0u;
        if p.backward != NOT_SWEPT {
            sum = contribution(p.backward, behind);
        }
        if p.forward != NOT_SWEPT {
            let d = seek(i, at, min(room, p.reach), thread, 16u, 1);
            links[place] = behind | (d << 16u);
            sum += contribution(p.forward, d);
        }
        let out = vec3<i32>(i32(i) - p.at_a, at.x - p.at_b, at.y - p.at_c);
        if all(out >= vec3<i32>(0)) && all(out < vec3<i32>(i32(p.out_a), i32(p.out_b), i32(p.out_c))) {
            let to = u32(out.x) * p.sum_a + u32(out.y) * p.sum_b + u32(out.z) * p.sum_c;
            if p.fresh == 1u {
                sums[to] = sum;
            } else {
                sums[to] += sum;
            }
        }
    }
}
