// Truncated Gaussian mean along one axis: c + sum_k w_k ((a_k + b_k) - 2 c), where a_k and b_k stand k steps before and
// after the centre c, or are c where they do not exist. One thread makes eight outputs along the axis, whose taps move on
// by one voxel with each step, so that each voxel is read once.
//
// Agrees bit for bit with src/kernel/gaussian (mean_row in f32), since products are rounded by themselves: nothing else
// could be fused into a sum (floats.wgsl).
// Bindings, group 0: 0 uniform Taps; 1 storage, read: packed voxels (`first`) or bits of f32 (`next`); 2 storage, written:
// bits of f32; 3 storage, read: bits of f32 weights, for each step away those of all outputs along the axis.
// Workgroup: gaussian_taps.wgsl.

fn value(index: u32, packed: bool) -> f32 {
    if packed {
        return integer_at(index);
    }
    return bitcast<f32>(input[index]);
}

fn alone4(v: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(alone(v.x), alone(v.y), alone(v.z), alone(v.w));
}

// Of outputs k and on.
fn weights_of(k: u32, d: u32) -> vec4<f32> {
    return vec4<f32>(weight(k, d), weight(k + 1u, d), weight(k + 2u, d), weight(k + 3u, d));
}

// What eight outputs see, the first four and the last four.
struct Eight {
    a: vec4<f32>,
    b: vec4<f32>,
}

// Each voxel in the place of the one after it, and one more before the first; and the other way around.
fn with_first(e: Eight, v: f32) -> Eight {
    return Eight(vec4<f32>(v, e.a.xyz), vec4<f32>(e.a.w, e.b.xyz));
}

fn with_last(e: Eight, v: f32) -> Eight {
    return Eight(vec4<f32>(e.a.yzw, e.b.x), vec4<f32>(e.b.yzw, v));
}

// With what both sides of a step have more than the centres.
fn stepped(sum: Eight, twice: Eight, low: Eight, high: Eight, w: f32) -> Eight {
    return Eight(sum.a + alone4(w * ((low.a + high.a) - twice.a)), sum.b + alone4(w * ((low.b + high.b) - twice.b)));
}

fn kept_at(at: Centre, k: u32, sum: f32) {
    if k < p.m - at.k {
        output[at.output + k * p.out_axis] = bitcast<u32>(sum);
    }
}

// A voxel so many steps after the first centre, or anything where it does not exist.
fn ahead_of(at: Centre, step: u32, packed: bool) -> f32 {
    return value(at.here + min(step, at.after) * p.in_axis, packed);
}

fn centres_of(at: Centre, packed: bool) -> Eight {
    var c = Eight();
    c.a = vec4<f32>(value(at.here, packed), ahead_of(at, 1u, packed), ahead_of(at, 2u, packed), ahead_of(at, 3u, packed));
    c.b = vec4<f32>(ahead_of(at, 4u, packed), ahead_of(at, 5u, packed), ahead_of(at, 6u, packed), ahead_of(at, 7u, packed));
    return c;
}

// Where the windows are whole, all have the same weights. Four steps at a time, whose voxels are all on their way before the first
// is needed: 71 and 76 us along y and z of u8 256^3 at sigma 2, one at a time 80 and 93, eight 76 and 81 (H200, 2026-11-27).
fn smooth_inside(at: Centre, c: Eight, packed: bool) -> Eight {
    let by = p.in_axis;
    let twice = Eight(c.a + c.a, c.b + c.b);
    var sum = c;
    // Each step brings a voxel into both.
    var low = c;
    var high = c;
    var d = 1u;
    for (; d + 3u <= p.radius; d += 4u) {
        let below = at.here - d * by;
        let above = at.here + (d + 7u) * by;
        let l = vec4<f32>(value(below, packed), value(below - by, packed), value(below - 2u * by, packed),
                          value(below - 3u * by, packed));
        let h = vec4<f32>(value(above, packed), value(above + by, packed), value(above + 2u * by, packed),
                          value(above + 3u * by, packed));
        let w = vec4<f32>(weight(at.k, d), weight(at.k, d + 1u), weight(at.k, d + 2u), weight(at.k, d + 3u));
        let low_1 = with_first(low, l.x);
        let high_1 = with_last(high, h.x);
        sum = stepped(sum, twice, low_1, high_1, w.x);
        let low_2 = with_first(low_1, l.y);
        let high_2 = with_last(high_1, h.y);
        sum = stepped(sum, twice, low_2, high_2, w.y);
        let low_3 = with_first(low_2, l.z);
        let high_3 = with_last(high_2, h.z);
        sum = stepped(sum, twice, low_3, high_3, w.z);
        low = with_first(low_3, l.w);
        high = with_last(high_3, h.w);
        sum = stepped(sum, twice, low, high, w.w);
    }
    for (; d <= p.radius; d += 1u) {
        low = with_first(low, value(at.here - d * by, packed));
        high = with_last(high, value(at.here + (d + 7u) * by, packed));
        sum = stepped(sum, twice, low, high, weight(at.k, d));
    }
    return sum;
}

// Where some see an end of the source; what lies beyond it is not kept.
fn smooth_ends(at: Centre, c: Eight, packed: bool) -> Eight {
    let twice = Eight(c.a + c.a, c.b + c.b);
    var sum = c;
    var low = c;
    var high = c;
    let number = vec4<i32>(0, 1, 2, 3);
    let before = vec4<i32>(i32(at.before)) + number;
    let after = vec4<i32>(i32(at.after)) - number;
    for (var d = 1u; d <= p.radius; d += 1u) {
        let step = vec4<i32>(i32(d));
        low = with_first(low, value(at.here - min(d, at.before) * p.in_axis, packed));
        high = with_last(high, ahead_of(at, d + 7u, packed));
        let first = select(c.a, low.a, step <= before) + select(c.a, high.a, step <= after);
        let second = select(c.b, low.b, step <= before + 4) + select(c.b, high.b, step <= after - 4);
        sum.a += alone4(weights_of(at.k, d) * (first - twice.a));
        sum.b += alone4(weights_of(at.k + 4u, d) * (second - twice.b));
    }
    return sum;
}

fn smooth_at(at: Centre, packed: bool) {
    let c = centres_of(at, packed);
    var sum = c;
    if at.before >= p.radius && at.after >= p.radius + 7u {
        sum = smooth_inside(at, c, packed);
    } else {
        sum = smooth_ends(at, c, packed);
    }
    for (var k = 0u; k < 4u; k += 1u) {
        kept_at(at, k, sum.a[k]);
        kept_at(at, k + 4u, sum.b[k]);
    }
}
