//! How users are addressed: errors, panics, logs, interrupts. All but results goes to stderr.

use std::io::Write;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use tracing_subscriber::EnvFilter;

use super::process;
use crate::Error;
use crate::run::Cancel;

/// Prints an error, and what a user can do after it.
pub fn error(e: &Error, then: &str) {
    let _ = writeln!(std::io::stderr(), "error: {e}{then}");
}

/// Prints a line for people.
pub fn note(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Whether only errors are printed.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Prints something that a user should know, but need not act on; nothing with `-q`.
pub fn warning(text: &str) {
    if QUIET.load(Ordering::Relaxed) {
        return;
    }
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
    QUIET.store(quiet, Ordering::Relaxed);
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
        .log_internal_errors(false)
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
            let ignored = process::ignored_signals();
            // Without a handler Ctrl-C still ends the process, only less gently.
            let _ = ctrlc::set_handler(handler);
            ignored.into_iter().for_each(process::ignore_signal);
            token
        })
        .clone()
}

/// Writes a result to stdout. That its reader has seen enough (`occlude plan | head`) is no error.
pub fn result(text: &str) -> crate::Result<()> {
    let mut out = std::io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    let written = write!(out, "{text}{end}").and_then(|()| out.flush());
    match written {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Error::Failed(format!("cannot write to stdout: {e}")))
        }
        _ => Ok(()),
    }
}

/// Writes JSON to stdout.
pub fn result_json(value: &serde_json::Value) -> crate::Result<()> {
    result(&format!("{value:#}"))
}
