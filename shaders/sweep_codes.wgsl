// Voxels as unsigned codes in the order of density, as lines compare them (obscurance.wgsl): integers packed as they are, f32
// as 32 bits, 0 for NaN. One thread makes one word.
//
// Agrees bit for bit with src/kernel/obscurance/keys.rs. Parameters: src/gpu/sweep.rs, struct Keys.
// Bindings, group 0: 0 uniform Keys; 1 storage, read: packed voxels or bits of f32; 2 storage, written: codes.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Keys {
    threads: u32,
    real: u32,      // 1: f32
    mask: u32,      // what integers are joined with: their sign bits, and all bits where smaller is denser
    flipped: u32,   // 1: smaller is denser
}

@group(0) @binding(0) var<uniform> p: Keys;
@group(0) @binding(1) var<storage, read> voxels: array<u32>;
@group(0) @binding(2) var<storage, read_write> codes: array<u32>;

@compute @workgroup_size(64)
fn code(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let thread = thread_of(group, groups, local);
    if thread >= p.threads {
        return;
    }
    let word = voxels[thread];
    if p.real == 0u {
        codes[thread] = word ^ p.mask;
        return;
    }
    let magnitude = word & 0x7fffffffu;
    if magnitude > 0x7f800000u {
        codes[thread] = 0u;
        return;
    }
    let bits = select(word, 0u, magnitude == 0u);
    let order = bits ^ select(0x80000000u, 0xffffffffu, (bits & 0x80000000u) != 0u);
    codes[thread] = select(order, ~order, p.flipped == 1u);
}
