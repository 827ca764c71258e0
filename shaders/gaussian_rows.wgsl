// Truncated Gaussian mean along x (gaussian.wgsl), of up to 128 steps: a workgroup holds a part of a row, of 256 outputs, with what
// its windows see beyond it, and each thread makes four outputs, 64 apart.
//
// Agrees bit for bit with src/kernel/gaussian (mean_row in f32).
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels; 2 storage, written: bits of f32; 3 storage, read: bits of f32
// weights, for each step away those of all outputs along the axis. Workgroup: 64 x 1 x 1, groups counted over x, then y.

var<workgroup> row_values: array<f32, 512>;

fn alone2(v: vec2<f32>) -> vec2<f32> {
    return vec2<f32>(alone(v.x), alone(v.y));
}

fn values_at(at: vec2<u32>) -> vec2<f32> {
    return vec2<f32>(row_values[at.x], row_values[at.y]);
}

// Two outputs whose centres stand at `at` among the values here, and whose windows are whole: they have the same weights.
fn smooth_inside(k: u32, at: vec2<u32>) -> vec2<f32> {
    let c = values_at(at);
    let twice = c + c;
    var sum = c;
    for (var d = 1u; d <= p.radius; d += 1u) {
        sum += alone2(weight(k, d) * ((values_at(at - d) + values_at(at + d)) - twice));
    }
    return sum;
}

// Two outputs, k among those of the row, wherever they are.
fn smooth_anywhere(k: vec2<u32>, at: vec2<u32>) -> vec2<f32> {
    let c = values_at(at);
    let twice = c + c;
    var sum = c;
    let before = p.at + k;
    let after = p.n - 1u - before;
    for (var d = 1u; d <= p.radius; d += 1u) {
        let a = select(c, values_at(at - d), vec2<u32>(d) <= before);
        let b = select(c, values_at(at + d), vec2<u32>(d) <= after);
        let w = vec2<f32>(weight(k.x, d), weight(k.y, d));
        sum += alone2(w * ((a + b) - twice));
    }
    return sum;
}

fn put(to: u32, k: vec2<u32>, sum: vec2<f32>) {
    if k.x < p.m {
        output[to + k.x] = bitcast<u32>(sum.x);
    }
    if k.y < p.m {
        output[to + k.y] = bitcast<u32>(sum.y);
    }
}

fn smooth_part(row: u32, begin: u32, local: u32) {
    let count = min(256u, p.m - begin);
    let start = row / p.middle * p.in_i + row % p.middle * p.in_j;
    let to = row / p.middle * p.out_i + row % p.middle * p.out_j;
    workgroupBarrier();
    for (var e = local; e < count + 2u * p.radius; e += 64u) {
        // In the whole source, where what does not exist is not looked at.
        let at = clamp(i32(p.at + begin + e) - i32(p.radius), 0, i32(p.n) - 1);
        row_values[e] = integer_at(start + u32(at) - p.start);
    }
    workgroupBarrier();
    // The outer two see the ends of a row, the inner ones hardly ever: of all of their threads or none, so that none waits.
    let first = p.at + begin;
    let whole = first >= p.radius && first + 255u + p.radius < p.n && count == 256u;
    let inner = first + 64u >= p.radius && first + 191u + p.radius < p.n && count >= 192u;
    let outer_at = vec2<u32>(local, local + 192u);
    let inner_at = vec2<u32>(local + 64u, local + 128u);
    if whole {
        put(to, begin + outer_at, smooth_inside(begin + 64u, outer_at + p.radius));
    } else {
        put(to, begin + outer_at, smooth_anywhere(begin + outer_at, outer_at + p.radius));
    }
    if inner {
        put(to, begin + inner_at, smooth_inside(begin + 64u, inner_at + p.radius));
    } else {
        put(to, begin + inner_at, smooth_anywhere(begin + inner_at, inner_at + p.radius));
    }
}

@compute @workgroup_size(64)
fn rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let parts = (p.m + 255u) / 256u;
    for (var part = thread_of(group, groups, 0u) / 64u; part < p.inner * parts; part += all_threads(groups) / 64u) {
        smooth_part(part / parts, part % parts * 256u, local);
    }
}
