// Least and greatest code of windows: the least in the low 16 bits, the greatest in the high 16.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or pairs (`next`); 2 storage, read and
// written: pairs. Workgroup: window_pass.wgsl.

const COLUMNS: u32 = 16u;

alias Seen = u32;

fn nothing() -> Seen {
    return 0x0000ffffu;
}

fn join(a: Seen, b: Seen) -> Seen {
    return min(a & 0xffffu, b & 0xffffu) | max(a & 0xffff0000u, b & 0xffff0000u);
}

fn seen_at(index: u32, packed: bool) -> Seen {
    if !packed {
        return input[index];
    }
    let code = unpacked(input[index >> p.packing], index, p.packing) ^ p.flip;
    return code | (code << 16u);
}
