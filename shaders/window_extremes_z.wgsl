// Least and greatest code of windows along z, a line of four columns: the least in the low 16 bits, the greatest in the high 16.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes; 2 storage, read and written: pairs. Workgroup:
// window_pass.wgsl.

@group(0) @binding(1) var<storage, read> input: array<u32>;

// What is compiled: 2 codes of 16 bits.
override parts: u32 = 3u;

fn seen_at(index: u32, packed: bool) -> Seen {
    let codes = codes_at(index);
    return codes | (codes << vec4<u32>(16u));
}
