// Whether any result is left to the CPU: a flag, which the program clears before.
//
// Agrees with the marks of window_finish.wgsl and gradient.wgsl. Parameters: src/gpu/points.rs, struct Marks.
// Bindings, group 0: 0 uniform Marks; 1 storage, read: bits of results; 2 storage, written: the flag.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory; writers of the flag all write 1.

struct Marks {
    threads: u32,
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
}

@group(0) @binding(0) var<uniform> p: Marks;
@group(0) @binding(1) var<storage, read> results: array<u32>;
@group(0) @binding(2) var<storage, read_write> marked: array<atomic<u32>>;

@compute @workgroup_size(64)
fn look(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let thread = thread_of(group, groups, local);
    if thread < p.threads && results[thread] == 0xffffffffu {
        atomicStore(&marked[0], 1u);
    }
}
