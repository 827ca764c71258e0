// Extremes along x of what window_extremes_y.wgsl left.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: pairs; 2 storage, read and written: pairs. Workgroup: window_tiles.wgsl,
// window_thirds.wgsl.

const COLUMNS: u32 = 16u;

alias Seen = u32;

fn nothing() -> Seen {
    return 0x0000ffffu;
}

fn join(a: Seen, b: Seen) -> Seen {
    return min(a & 0xffffu, b & 0xffffu) | (max(a, b) & 0xffff0000u);
}
