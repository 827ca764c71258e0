// Truncated Gaussian mean along one axis: c + sum_k w_k ((a_k + b_k) - 2 c), where a_k and b_k stand k steps before and
// after the centre c, or are c where they do not exist. One thread makes one output.
//
// Agrees bit for bit with src/kernel/gaussian (mean_row in f32), since every operation is rounded by itself (floats.wgsl).
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels (`first`) or bits of f32 (`next`); 2 storage, written:
// bits of f32; 3 storage, read: bits of f32 weights, `radius` for each output along the axis. Workgroup: gaussian_taps.wgsl.

fn value(index: u32, packed: bool) -> f32 {
    if packed {
        return integer_at(index);
    }
    return bitcast<f32>(input[index]);
}

fn smooth_at(at: Centre, packed: bool) {
    let c = value(at.here, packed);
    let twice = alone(c + c);
    var sum = c;
    for (var d = 1u; d <= p.radius; d += 1u) {
        var a = c;
        var b = c;
        if d <= at.before {
            a = value(at.here - d * p.in_axis, packed);
        }
        if d <= at.after {
            b = value(at.here + d * p.in_axis, packed);
        }
        let w = bitcast<f32>(weights[at.weights + d - 1u]);
        sum = alone(sum + alone(w * alone(alone(a + b) - twice)));
    }
    output[at.output] = bitcast<u32>(sum);
}
