// Extremes along y of what window_extremes_z.wgsl left.
//
// Agrees bit for bit with src/kernel/window/int.rs (extremes of codes).
// Bindings, group 0: 0 uniform Pass; 1 storage, read: pairs; 2 storage, read and written: pairs. Workgroup: window_pass.wgsl.
