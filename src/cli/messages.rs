//! How users are addressed: errors, panics, logs, signals. Everything here goes to stderr.

use std::io::Write;
use std::sync::OnceLock;

use tracing_subscriber::EnvFilter;

use crate::Error;
use crate::run::Cancel;

/// Prints an error.
pub fn error(e: &Error) {
    let _ = writeln!(std::io::stderr(), "error: {e}");
}

/// Prints a line for people.
pub fn note(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Prints something that a user should know, but need not act on.
pub fn warning(text: &str) {
    let _ = writeln!(std::io::stderr(), "warning: {text}");
}

/// What a panic says instead of Rust's own text. With `-v` the place is added, for reports.
pub fn hook_panics(verbose: bool) {
    std::panic::set_hook(Box::new(move |info| {
        let mut err = std::io::stderr().lock();
        let _ = writeln!(err, "error: internal error; please report it with the config and the command line");
        if verbose {
            let place = info.location().map(|l| format!("{}:{}", l.file(), l.line())).unwrap_or_default();
            let text = info.payload_as_str().unwrap_or("no text");
            let _ = writeln!(err, "  at {place}: {text}");
        }
    }));
}

/// Logs to stderr: warnings by default, nothing but errors with `-q`, more with each `-v`.
pub fn start_logs(quiet: bool, verbose: u8) {
    let level = match (quiet, verbose) {
        (true, _) => "error",
        (_, 0) => "warn",
        (_, 1) => "info",
        (_, 2) => "debug",
        _ => "trace",
    };
    let filter = EnvFilter::new(format!("warn,occlude={level}"));
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .without_time()
        .with_target(verbose > 1)
        .with_ansi(false)
        .try_init();
}

/// The token that the first Ctrl-C raises; the second ends the process with 130.
pub fn interrupts() -> Cancel {
    static TOKEN: OnceLock<Cancel> = OnceLock::new();
    TOKEN
        .get_or_init(|| {
            let token = Cancel::new();
            let raised = token.clone();
            let handler = move || {
                if raised.is_cancelled() {
                    std::process::exit(130);
                }
                raised.cancel();
                let text = "stopping after the bricks in hand; interrupt again to stop at once";
                let _ = writeln!(std::io::stderr(), "{text}");
            };
            // Without a handler Ctrl-C still ends the process, only less gently.
            let _ = ctrlc::set_handler(handler);
            token
        })
        .clone()
}

/// Ends quietly when the reader of stdout goes away (`occlude plan | head`), like other command-line programs; a limit of file
/// sizes (`ulimit -f`) is an error of the write that exceeds it, not the end of the process.
pub fn set_signals() {
    #[cfg(unix)]
    // SAFETY: called once at the start, before any thread; both are valid dispositions.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
}

/// Writes a result to stdout.
pub fn result(text: &str) -> crate::Result<()> {
    let mut out = std::io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    let written = write!(out, "{text}{end}").and_then(|()| out.flush());
    written.map_err(|e| Error::Failed(format!("cannot write to stdout: {e}")))
}

/// Writes JSON to stdout.
pub fn result_json(value: &serde_json::Value) -> crate::Result<()> {
    result(&format!("{value:#}"))
}
