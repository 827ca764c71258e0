// One thread of a shader's next passes, from what passes left. `one` is the shader's own.

@compute @workgroup_size(64)
fn next(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    for (var thread = thread_of(group, groups, local); thread < p.threads; thread += all_threads(groups)) {
        one(thread, false);
    }
}
