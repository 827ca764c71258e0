// Unevaluated pairs of f32, high part and what it leaves out, by operations that are rounded one by one (floats.wgsl).

// The error of a + b, whose rounded sum is s (Knuth).
fn error_of(a: f32, b: f32, s: f32) -> f32 {
    let t = alone(s - a);
    return alone(alone(a - alone(s - t)) + alone(b - t));
}

// A pair and a number, its high part again the rounded value of the whole.
fn add(a: vec2<f32>, b: f32) -> vec2<f32> {
    let s = alone(a.x + b);
    let e = alone(error_of(a.x, b, s) + a.y);
    let high = alone(s + e);
    return vec2<f32>(high, alone(e - alone(high - s)));
}

// a - b, rounded once more.
fn distance(a: vec2<f32>, b: vec2<f32>) -> f32 {
    let s = alone(a.x - b.x);
    return alone(s + alone(error_of(a.x, -b.x, s) + alone(a.y - b.y)));
}
