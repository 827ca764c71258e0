fn main() -> std::process::ExitCode {
    // Software Vulkan drivers complain on stderr where this is not set, for a window system that nobody asks for.
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the only thread so far.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    occlude::cli::main()
}
