// A box that reaches beyond the volume, of one that ends there: what a window sees by its border rule. One thread makes one word
// of a row: one f32, two voxels of 16 bits or four of 8.
//
// Agrees bit for bit with src/brick/gather.rs (extend). Parameters: src/gpu/extend.rs, struct Extend.
// Bindings, group 0: 0 uniform Extend; 1 storage, read: packed voxels or bits of f32; 2 storage, written: the same of the box,
// in rows of whole words. Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has
// one writer.

struct Extend {
    out_y: u32,     // rows of a plane, voxels and words of a row
    out_x: u32,
    words: u32,
    in_z: u32,      // strides of the input, in voxels
    in_y: u32,
    packing: u32,   // log2 of voxels per word
    kind: u32,
    outside: u32,   // the bits of a constant
    lo_z: i32,      // the box's first voxel in the volume
    lo_y: i32,
    lo_x: i32,
    size_z: i32,    // the volume's extents
    size_y: i32,
    size_x: i32,
    from_z: i32,    // the input's first voxel in the volume
    from_y: i32,
    from_x: i32,
    threads: u32,
    spare_0: u32,
    spare_1: u32,
}

@group(0) @binding(0) var<uniform> p: Extend;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

const REFLECT: u32 = 1u;
const CONSTANT: u32 = 2u;

// The voxel of an axis of n that stands for voxel v, or -1.
fn stands_for(v: i32, n: i32) -> i32 {
    if v >= 0 && v < n {
        return v;
    }
    if p.kind == CONSTANT {
        return -1;
    }
    if p.kind == REFLECT {
        var m = v % (2 * n);
        m += select(0, 2 * n, m < 0);
        return min(m, 2 * n - 1 - m);
    }
    return clamp(v, 0, n - 1);
}

@compute @workgroup_size(64)
fn extend(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    let thread = thread_of(group, groups, local);
    if thread >= p.threads {
        return;
    }
    let first = (thread % p.words) << p.packing;
    let y = (thread / p.words) % p.out_y;
    let z = thread / (p.words * p.out_y);
    let from_z = stands_for(p.lo_z + i32(z), p.size_z);
    let from_y = stands_for(p.lo_y + i32(y), p.size_y);
    var word = 0u;
    for (var k = 0u; k < (1u << p.packing) && first + k < p.out_x; k += 1u) {
        let from_x = stands_for(p.lo_x + i32(first + k), p.size_x);
        var bits = p.outside;
        if min(from_z, min(from_y, from_x)) >= 0 {
            let at = u32(from_z - p.from_z) * p.in_z + u32(from_y - p.from_y) * p.in_y + u32(from_x - p.from_x);
            bits = unpacked(input[at >> p.packing], at, p.packing);
        }
        word |= bits << (k * (32u >> p.packing));
    }
    output[thread] = word;
}
