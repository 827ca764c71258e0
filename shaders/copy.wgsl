// Copies words, four at once: how fast passes could be that only move what they have to.
//
// Agrees with a copy. Parameters: src/gpu/rate.rs, struct Copy.
// Bindings, group 0: 0 uniform Copy; 1 storage, read: words; 2 storage, written: words.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Copy {
    threads: u32,
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
}

@group(0) @binding(0) var<uniform> p: Copy;
@group(0) @binding(1) var<storage, read> input: array<vec4<u32>>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4<u32>>;

@compute @workgroup_size(64)
fn copy(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        output[thread] = input[thread];
    }
}
