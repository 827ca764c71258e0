// Voxels that a mask excludes get a fill. One thread looks at one voxel.
//
// Agrees bit for bit with what src/run/steps.rs does where a stage's `where` needs no voxel. Parameters: src/gpu/masks.rs, struct
// Masked.
// Bindings, group 0: 0 uniform Masked; 1 storage, read: the mask, bytes; 2 storage, written: bits of a channel, dense.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Masked {
    ny: u32,
    nx: u32,
    plane: u32,     // of the mask, in bytes
    row: u32,
    fill: u32,
    threads: u32,
    spare_0: u32,
    spare_1: u32,
}

@group(0) @binding(0) var<uniform> p: Masked;
@group(0) @binding(1) var<storage, read> needed: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

@compute @workgroup_size(64)
fn fill(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let i = thread_of(group, groups, local);
    if i >= p.threads {
        return;
    }
    let at = (i / (p.nx * p.ny)) * p.plane + ((i / p.nx) % p.ny) * p.row + i % p.nx;
    if unpacked(needed[at / 4u], at, 2u) == 0u {
        output[i] = p.fill;
    }
}
