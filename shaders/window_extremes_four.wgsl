// Pairs of extremes of four columns.

alias Seen = vec4<u32>;

fn nothing() -> Seen {
    return vec4<u32>(0x0000ffffu);
}

fn join(a: Seen, b: Seen) -> Seen {
    let low = vec4<u32>(0xffffu);
    return min(a & low, b & low) | (max(a, b) & ~low);
}
