// Voxels, mean and sum of squared deviations (M2) of windows of f32, merged as Chan, Golub and LeVeque do: with d the
// distance between two means, M2 = M2_a + M2_b + d^2 n_a n_b / n. Nothing large is subtracted but means, which are unevaluated
// pairs of f32, as M2 is; so a step beside the window, or in it, costs no accuracy, and nothing drifts along a row.
//
// Agrees bit for bit with src/gpu/pairs.rs, and within facts::tolerance with src/kernel/window/float.rs; windows with an
// infinity or with magnitudes at the ends of f32 are left to the CPU, which sees them in the extremes.
// Bindings, group 0: 0 uniform Pass; 1 storage, read: bits of f32 (`first`) or cells (`next`); 2 storage, read and written:
// cells of `cell` words: voxels, mean (high, low), and where `square` is 1 M2 (high, low). Workgroup: window_pass.wgsl.

const COLUMNS: u32 = 4u;

struct Seen {
    n: u32,
    mean: vec2<f32>,
    m2: vec2<f32>,
}

@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

fn nothing() -> Seen {
    return Seen();
}

// 1 / v of a positive number up to 2^32: from the exponent, by Newton's steps, since drivers divide as they like.
fn inverse(v: f32) -> f32 {
    var r = bitcast<f32>(0x7ef311c7u - bitcast<u32>(v));
    for (var i = 0; i < 4; i += 1) {
        r = alone(r * alone(2.0 - alone(v * r)));
    }
    return r;
}

// Onto the part with more voxels, so that rounding the distance to its mean costs no more than half of itself.
fn merge(a: Seen, b: Seen) -> Seen {
    let n = a.n + b.n;
    let d = distance(b.mean, a.mean);
    let share = alone(f32(b.n) * inverse(f32(n)));
    var seen = Seen(n, add(a.mean, alone(d * share)), a.m2);
    if p.square == 1u {
        seen.m2 = add(add(seen.m2, b.m2.x), b.m2.y);
        seen.m2 = add(seen.m2, alone(alone(d * d) * alone(f32(a.n) * share)));
    }
    return seen;
}

fn join(a: Seen, b: Seen) -> Seen {
    if b.n == 0u {
        return a;
    }
    if a.n == 0u {
        return b;
    }
    if a.n < b.n {
        return merge(b, a);
    }
    return merge(a, b);
}

fn seen_at(index: u32, packed: bool) -> Seen {
    if packed {
        let bits = input[index];
        if (bits & 0x7fffffffu) > 0x7f800000u {
            return nothing();
        }
        return Seen(1u, vec2<f32>(bitcast<f32>(bits), 0.0), vec2<f32>());
    }
    let start = index * p.cell;
    var seen = Seen(input[start], vec2<f32>(bitcast<f32>(input[start + 1u]), bitcast<f32>(input[start + 2u])), vec2<f32>());
    if p.square == 1u {
        seen.m2 = vec2<f32>(bitcast<f32>(input[start + 3u]), bitcast<f32>(input[start + 4u]));
    }
    return seen;
}

fn kept(place: u32) -> Seen {
    let start = place * p.cell;
    var seen = Seen(output[start], vec2<f32>(bitcast<f32>(output[start + 1u]), bitcast<f32>(output[start + 2u])), vec2<f32>());
    if p.square == 1u {
        seen.m2 = vec2<f32>(bitcast<f32>(output[start + 3u]), bitcast<f32>(output[start + 4u]));
    }
    return seen;
}

fn keep(place: u32, seen: Seen) {
    let to = place * p.cell;
    output[to] = seen.n;
    output[to + 1u] = bitcast<u32>(seen.mean.x);
    output[to + 2u] = bitcast<u32>(seen.mean.y);
    if p.square == 1u {
        output[to + 3u] = bitcast<u32>(seen.m2.x);
        output[to + 4u] = bitcast<u32>(seen.m2.y);
    }
}
