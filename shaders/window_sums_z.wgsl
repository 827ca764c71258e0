// Sums along z of codes, or of their squares, as u32: a line is of four columns.
//
// Agrees bit for bit with src/kernel/window/int.rs (S1 and S2).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes; 2 storage, written: sums. Workgroup: window_pass.wgsl.

@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4<u32>>;

alias Sum = vec4<u32>;

// What is compiled: 1 squares, 2 codes of 16 bits.
override parts: u32 = 3u;

fn term(index: u32, packed: bool) -> Sum {
    let codes = codes_at(index);
    if (parts & 1u) != 0u {
        return codes * codes;
    }
    return codes;
}
