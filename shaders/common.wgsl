// What every shader shares; the program puts it before each of them (src/gpu/shaders.rs), since WGSL includes nothing.

// The number of a thread: workgroups of 64 are counted over x, then y, since no axis may have more than 65535.
fn thread_of(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.y * groups.x + group.x) * 64u + local;
}

// Threads of a dispatch: of one that has more to do than a device holds threads, each does every so manieth piece of work, since
// starting a workgroup takes as long as a voxel's work.
fn all_threads(groups: vec3<u32>) -> u32 {
    return groups.x * groups.y * 64u;
}

// The bits of element `index` among the 2^packing in its word, the first in the low bits.
fn unpacked(word: u32, index: u32, packing: u32) -> u32 {
    let bits = 32u >> packing;
    return (word >> ((index & ((1u << packing) - 1u)) * bits)) & (0xffffffffu >> (32u - bits));
}
