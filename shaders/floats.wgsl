// f32 arithmetic that is rounded operation by operation. Needs a uniform `p` with a `zero` that no compiler knows.

// Hides a result behind integers, so that no product can be fused into the sum after it and no sum put in another order.
// Where a driver rounds otherwise the lane finds out before it is used (src/gpu/probe.rs).
fn alone(v: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(v) ^ p.zero);
}
