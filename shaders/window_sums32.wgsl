// Sums along x of what window_sums_y.wgsl left.
//
// Agrees bit for bit with src/kernel/window/int.rs (S1 and S2).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: sums; 2 storage, written: sums. Workgroup: window_scan.wgsl.

alias Sum = u32;
