// Sums of codes, or of their squares, as pairs of u32: low word, high word, which little-endian memory holds as one u64.
//
// Agrees bit for bit with src/kernel/window/int.rs (S1 and S2).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or words of pairs of sums (`next`, `rows`); 2
// storage, written: pairs. Workgroup: window_pass.wgsl, window_scan.wgsl.

@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<Sum>;

alias Sum = vec2<u32>;

fn plus(a: Sum, b: Sum) -> Sum {
    let low = a.x + b.x;
    return Sum(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn minus(a: Sum, b: Sum) -> Sum {
    return Sum(a.x - b.x, a.y - b.y - select(0u, 1u, a.x < b.x));
}

// A packed voxel's code, or its square.
fn code(index: u32) -> u32 {
    let code = unpacked(input[index >> p.packing], index, p.packing) ^ p.flip;
    return select(code, code * code, p.square == 1u);
}

fn term(index: u32, packed: bool) -> Sum {
    if packed {
        return Sum(code(index), 0u);
    }
    return Sum(input[2u * index], input[2u * index + 1u]);
}
