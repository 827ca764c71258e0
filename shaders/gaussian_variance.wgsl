// Truncated Gaussian mean and variance along one axis, pooled: the variance is sum_k w_k (V_k + (m_k - mean)^2). Means are
// unevaluated pairs of f32 and enter by their distances, so that nothing cancels and constants have variance 0.
//
// Agrees with src/kernel/gaussian (variance_row) within facts::tolerance::VARIANCE.
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels (`first`) or cells (`next`); 2 storage, written: cells of
// three words: mean (high, low), variance, of which the last pass keeps the variance; 3 storage, read: bits of f32 weights, for
// each step away those of all outputs along the axis, and one more for each centre. Workgroup: gaussian_taps.wgsl.

fn smooth_at(at: Centre, packed: bool) {
    let c = cell_at(at.here, packed);
    var moved = 0.0;
    for (var d = 1u; d <= p.radius; d += 1u) {
        var both = 0.0;
        if d <= at.before {
            both += distance(cell_at(at.here - d * p.in_axis, packed).mean, c.mean);
        }
        if d <= at.after {
            both += distance(cell_at(at.here + d * p.in_axis, packed).mean, c.mean);
        }
        moved += weight(at.k, d) * both;
    }
    let mean = add(c.mean, alone(moved));
    var sum = vec2<f32>(spread(c, mean, bitcast<f32>(weights[p.centres + at.k])), 0.0);
    for (var d = 1u; d <= p.radius; d += 1u) {
        let w = weight(at.k, d);
        if d <= at.before {
            sum = add(sum, alone(spread(cell_at(at.here - d * p.in_axis, packed), mean, w)));
        }
        if d <= at.after {
            sum = add(sum, alone(spread(cell_at(at.here + d * p.in_axis, packed), mean, w)));
        }
    }
    if p.last == 1u {
        output[at.output] = bitcast<u32>(sum.x);
        return;
    }
    let to = 3u * at.output;
    output[to] = bitcast<u32>(mean.x);
    output[to + 1u] = bitcast<u32>(mean.y);
    output[to + 2u] = bitcast<u32>(sum.x);
}
