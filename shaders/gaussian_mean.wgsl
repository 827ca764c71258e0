// What means share: the weights, and products that stand alone before they are added. Sums need no hiding (floats.wgsl): nothing
// fuses into them but products.

// Of output k, d steps away.
fn weight(k: u32, d: u32) -> f32 {
    return bitcast<f32>(weights[p.weights + (d - 1u) * p.m + min(k, p.m - 1u)]);
}

fn alone4(v: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(alone(v.x), alone(v.y), alone(v.z), alone(v.w));
}
