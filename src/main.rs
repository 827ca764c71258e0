fn main() -> std::process::ExitCode {
    occlude::cli::main()
}
