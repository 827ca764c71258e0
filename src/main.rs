fn main() -> std::process::ExitCode {
    // Software Vulkan drivers complain on stderr where this is not set, for a window system that nobody asks for.
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the only thread so far.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    give_large_buffers_back();
    occlude::cli::main()
}

/// Buffers of bricks that are freed go back to the system at once. Left to itself, glibc soon cuts blocks of up to 32 MiB
/// from its heap, and what is freed between others stays resident: memory that the budget counts as free. 2-core Zen 4 VM,
/// 2026-11-26, the chain of stages of `tests/memory_budget.rs` under 160 MiB: a peak of 171 to 177 MiB without this, 138 to
/// 145 with it, 134 with 1 MiB; chains of bricks of 294 MiB under 1400 MiB: 1587 MiB without, 1321 with. The shipped
/// example takes the same time with 4 MiB, and a tenth more system time with 1 MiB.
///
/// The end of a heap is kept up to 4 MiB: naming the first number sets this one to 128 KiB, so that every decoded chunk would be cut
/// from pages that the system has just cleared. Pyramid of a 1 GiB Zarr, 2026-11-27, by turns: 1.83 to 2.02 s with 128 KiB, 1.92 to 1.99
/// with 2 MiB, 1.45 to 1.67 with 4, 1.55 to 1.65 with 8; the chain's peak is 150 to 152 MiB with 4, 147 to 153 with 8.
fn give_large_buffers_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: sets two numbers of the allocator; the only thread so far.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 4 << 20);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 4 << 20);
    }
}
