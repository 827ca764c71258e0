// Sums of codes, or of their squares, as u32.
//
// Agrees bit for bit with src/kernel/window/int.rs (S1 and S2).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: packed codes (`first`) or sums (`next`); 2 storage, written: sums.
// Workgroup: window_pass.wgsl.

const COLUMNS: u32 = 16u;

alias Sum = u32;

fn plus(a: Sum, b: Sum) -> Sum {
    return a + b;
}

fn minus(a: Sum, b: Sum) -> Sum {
    return a - b;
}

fn term(index: u32, packed: bool) -> Sum {
    if packed {
        return code(index);
    }
    return input[index];
}
