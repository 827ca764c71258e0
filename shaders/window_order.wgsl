// Least and greatest f32 of windows, as codes in the order of the numbers, so that no comparison meets NaN, subnormals or
// the signs of zeros as a driver likes them. NaN does not count.
//
// Agrees with src/kernel/window/float.rs bit for bit (extremes; the host undoes the codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: bits of f32 (`first`) or words of pairs (`next`); 2 storage, read and
// written: pairs, least and greatest. Workgroup: window_pass.wgsl, window_tiles.wgsl,
// window_thirds.wgsl.

@group(0) @binding(1) var<storage, read> input: array<u32>;

const COLUMNS: u32 = 8u;

alias Seen = vec2<u32>;

fn nothing() -> Seen {
    return Seen(0xffffffffu, 0u);
}

fn join(a: Seen, b: Seen) -> Seen {
    return Seen(min(a.x, b.x), max(a.y, b.y));
}

fn seen_at(index: u32, packed: bool) -> Seen {
    if !packed {
        return Seen(input[2u * index], input[2u * index + 1u]);
    }
    let bits = input[index];
    if (bits & 0x7fffffffu) > 0x7f800000u {
        return nothing();
    }
    return Seen(select(bits | 0x80000000u, ~bits, (bits & 0x80000000u) != 0u));
}
