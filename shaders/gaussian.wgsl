// Truncated Gaussian mean along one axis: c + sum_k w_k ((a_k + b_k) - 2 c), where a_k and b_k stand k steps before and
// after the centre c, or are c where they do not exist. One thread makes four outputs along the axis, whose taps move on
// by one voxel with each step, so that each voxel is read once.
//
// Agrees bit for bit with src/kernel/gaussian (mean_row in f32), since every operation is rounded by itself (floats.wgsl).
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels (`first`) or bits of f32 (`next`); 2 storage, written:
// bits of f32; 3 storage, read: bits of f32 weights, for each step away those of all outputs along the axis. Workgroup: gaussian_taps.wgsl.

fn value(index: u32, packed: bool) -> f32 {
    if packed {
        return integer_at(index);
    }
    return bitcast<f32>(input[index]);
}

fn alone4(v: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(alone(v.x), alone(v.y), alone(v.z), alone(v.w));
}

fn weights_at(index: u32) -> vec4<f32> {
    let bits = vec4<u32>(weights[index], weights[index + 1u], weights[index + 2u], weights[index + 3u]);
    return bitcast<vec4<f32>>(bits);
}

// What the four see where they have all their taps, or what lies beyond them, which is not kept.
fn smooth_at(at: Centre, packed: bool) {
    let by = p.in_axis;
    var c = vec4<f32>();
    for (var j = 0u; j < min(4u, at.after + 1u); j += 1u) {
        c[j] = value(at.here + j * by, packed);
    }
    let number = vec4<i32>(0, 1, 2, 3);
    let before = vec4<i32>(i32(at.before)) + number;
    let after = vec4<i32>(i32(at.after)) - number;
    let twice = alone4(c + c);
    var sum = c;
    // Each step brings a voxel into both.
    var low = c;
    var high = c;
    // Along x every row of threads has ends.
    let inside = p.axis != 2u && at.before >= p.radius && at.after >= p.radius + 3u;
    for (var d = 1u; inside && d <= p.radius; d += 1u) {
        low = vec4<f32>(value(at.here - d * by, packed), low.xyz);
        high = vec4<f32>(high.yzw, value(at.here + (d + 3u) * by, packed));
        // All four have the same weights.
        let w = bitcast<f32>(weights[at.weights + (d - 1u) * p.m]);
        sum = alone4(sum + alone4(w * alone4(alone4(low + high) - twice)));
    }
    for (var d = 1u; !inside && d <= p.radius; d += 1u) {
        let step = i32(d);
        low = vec4<f32>(0.0, low.xyz);
        if d <= at.before {
            low.x = value(at.here - d * by, packed);
        }
        high = vec4<f32>(high.yzw, 0.0);
        if d + 3u <= at.after {
            high.w = value(at.here + (d + 3u) * by, packed);
        }
        let a = select(c, low, vec4<i32>(step) <= before);
        let b = select(c, high, vec4<i32>(step) <= after);
        let w = weights_at(at.weights + (d - 1u) * p.m);
        sum = alone4(sum + alone4(w * alone4(alone4(a + b) - twice)));
    }
    for (var j = 0u; j < min(4u, p.m - at.k); j += 1u) {
        output[at.output + j * p.out_axis] = bitcast<u32>(sum[j]);
    }
}
