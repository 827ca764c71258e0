//! Commands: words to library calls, results to stdout, everything else to stderr.

pub mod args;
pub mod attributes;
pub mod cmd_compare;
pub mod cmd_info;
pub mod cmd_plan;
pub mod cmd_preview;
pub mod cmd_run;
pub mod draw;
pub mod human;
pub mod messages;
pub mod moments;
pub mod pareto;
pub mod plot;
pub mod process;
pub mod progress;
pub mod reader;
mod similarity;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{CommandFactory, Parser};

use crate::config::check::resolved;
use crate::config::{self, Config, Device};
use crate::{Error, Result};
use args::{Cli, Command, ConfigArgs, DeviceArg};

/// The program: parses the command line, runs the command, returns the exit code (0 done, 1 failed, 2 wrong usage or
/// config, 130 interrupted).
pub fn main() -> ExitCode {
    process::set_up();
    messages::hook_panics(std::env::args_os().any(|a| a == "-v" || a == "-vv" || a == "--verbose"));
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(e.exit_code().clamp(0, 2) as u8);
        }
    };
    messages::start_logs(cli.quiet, cli.verbose);
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| command(&cli)));
    match outcome {
        Ok(Ok(code)) => code,
        Ok(Err(e)) => {
            let goes_on = matches!((&e, &cli.command), (Error::Interrupted, Command::Run(_)));
            messages::error(&e, if goes_on { "; finished tasks are kept, --resume goes on with the rest" } else { "" });
            ExitCode::from(e.exit_code() as u8)
        }
        // The hook has said what there is to say.
        Err(_) => ExitCode::from(1),
    }
}

fn command(cli: &Cli) -> Result<ExitCode> {
    match &cli.command {
        Command::Run(args) => cmd_run::run(args, cli.quiet)?,
        Command::Plan(args) => cmd_plan::run(args)?,
        Command::Info(args) => cmd_info::run(args, cli.quiet)?,
        Command::Compare(args) => return cmd_compare::run(args, cli.quiet),
        Command::Preview(args) => cmd_preview::run(args)?,
        Command::Pareto(args) => pareto::run(args, cli.quiet)?,
        Command::Schema => messages::result_json(&config::schema())?,
        Command::Completions { shell } => {
            let mut text = Vec::new();
            clap_complete::generate(*shell, &mut Cli::command(), "occlude", &mut text);
            messages::result(&String::from_utf8_lossy(&text))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// The config with `--set` and the flags applied.
fn load(args: &ConfigArgs, more: &[String]) -> Result<Config> {
    let sets: Vec<String> = args.sets.iter().chain(more).cloned().collect();
    let mut config = config::load(&args.config, &sets)?;
    drop_unused_inputs(&mut config);
    if let Some(device) = args.device {
        config.run.device = match device {
            DeviceArg::Auto => Device::Auto,
            DeviceArg::Cpu => Device::Cpu,
            DeviceArg::Gpu => Device::Gpu,
            DeviceArg::GpuSoftware => Device::GpuSoftware,
        };
    }
    if let Some(threads) = args.threads {
        config.run.threads = threads.into();
    }
    if let Some(memory) = args.memory {
        config.run.memory = memory;
    }
    Ok(config)
}

/// Inputs that nothing reads have been checked as text; they are not opened, so they need not exist.
fn drop_unused_inputs(config: &mut Config) {
    let used: Vec<String> = config.needed_names().into_iter().map(String::from).collect();
    config.inputs.retain(|i| used.contains(&i.name));
}

/// Wrong usage of a flag (exit code 2).
fn usage(flag: &str, message: impl std::fmt::Display) -> Error {
    Error::config(flag, message)
}

/// Refuses to write a result over a file that is read, or into a folder that is.
fn refuse_overwriting<'a>(flag: &str, out: &Path, read: impl IntoIterator<Item = &'a Path>) -> Result<()> {
    let real = resolved(out);
    match read.into_iter().find(|p| real.starts_with(resolved(p))) {
        Some(_) => Err(usage(flag, format!("got {}, which is read; expected another file", out.display()))),
        None => Ok(()),
    }
}

/// What a result is written to: a file under a temporary name that then takes its place, wherever a link leads; a device or pipe
/// as it is.
fn place_of(path: &Path) -> Result<(PathBuf, Option<PathBuf>)> {
    let target = match std::fs::metadata(path) {
        Ok(m) if !m.is_file() && !m.is_dir() => return Ok((path.to_path_buf(), None)),
        Ok(_) => path.canonicalize().map_err(|e| Error::file(path, format!("cannot write: {e}")))?,
        Err(_) => path.to_path_buf(),
    };
    let mut name = target.file_name().ok_or_else(|| Error::file(path, "is not a file name"))?.to_os_string();
    name.push(format!(".{}.tmp", std::process::id()));
    let temporary = target.with_file_name(name);
    Ok((target, Some(temporary)))
}

/// Whether a file can be made there, which is better known before hours of work than after.
fn can_write(path: &Path) -> Result<()> {
    let (_, Some(temporary)) = place_of(path)? else { return Ok(()) };
    let made = std::fs::File::create(&temporary);
    let _ = std::fs::remove_file(&temporary);
    made.map(drop).map_err(|e| Error::file(path, format!("cannot write: {e}")))
}

/// Writes a file under a temporary name first, so that no reader sees half of it.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let (target, temporary) = place_of(path)?;
    let written = match &temporary {
        None => std::fs::write(&target, bytes),
        Some(temporary) => std::fs::write(temporary, bytes).and_then(|()| std::fs::rename(temporary, &target)),
    };
    written.map_err(|e| {
        temporary.iter().for_each(|t| drop(std::fs::remove_file(t)));
        Error::file(path, format!("cannot write: {e}"))
    })
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn links_are_followed_and_pipes_stay_pipes() {
        use std::os::unix::fs::{FileTypeExt, symlink};
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir(at("far")).unwrap();
        std::fs::write(at("far/real.json"), "old").unwrap();
        symlink(at("far/real.json"), at("link.json")).unwrap();
        can_write(&at("link.json")).unwrap();
        write_whole(&at("link.json"), b"new").unwrap();
        assert_eq!(std::fs::read(at("far/real.json")).unwrap(), b"new");
        assert!(std::fs::symlink_metadata(at("link.json")).unwrap().is_symlink());
        let pipe = at("pipe");
        let path = std::ffi::CString::new(pipe.to_str().unwrap()).unwrap();
        // SAFETY: a path that ends in 0.
        assert_eq!(unsafe { libc::mkfifo(path.as_ptr(), 0o600) }, 0);
        can_write(&pipe).unwrap();
        let reader = {
            let pipe = pipe.clone();
            std::thread::spawn(move || std::fs::read(pipe).unwrap())
        };
        write_whole(&pipe, b"through").unwrap();
        assert_eq!(reader.join().unwrap(), b"through");
        assert!(std::fs::metadata(&pipe).unwrap().file_type().is_fifo());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3, "nothing temporary is left");
    }
}
