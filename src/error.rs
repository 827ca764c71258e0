//! The one error type: what went wrong, where, with which value, and what would have been accepted.

use std::fmt;
use std::path::{Path, PathBuf};

/// Result of everything in this crate that can fail.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Failures, sorted by who can mend them; [`Error::exit_code`] follows from the kind.
#[derive(Debug)]
pub enum Error {
    /// Wrong usage or configuration: the user edits the config or the command line (exit code 2).
    Config {
        /// The config file, when there is one.
        file: Option<PathBuf>,
        /// Line in it, from 1.
        line: Option<usize>,
        /// Dotted key, e.g. `stage.ao.radius`.
        key: String,
        message: String,
    },
    /// A file that cannot be read, written or understood (exit code 1).
    File { path: PathBuf, message: String },
    /// A GPU that was asked for and is not there (exit code 1): the config is right where there is one.
    NoDevice(String),
    /// The run failed for another reason (exit code 1).
    Failed(String),
    /// Stopped on request; what was finished is kept (exit code 130).
    Interrupted,
}

impl Error {
    pub fn file(path: impl AsRef<Path>, message: impl fmt::Display) -> Error {
        Error::File { path: path.as_ref().to_path_buf(), message: message.to_string() }
    }

    /// A config error that does not know its file and line yet; see [`Error::located`].
    pub fn config(key: impl Into<String>, message: impl fmt::Display) -> Error {
        Error::Config { file: None, line: None, key: key.into(), message: message.to_string() }
    }

    /// Adds file and line to a config error that lacks them.
    pub fn located(self, at_file: &Path, at_line: Option<usize>) -> Error {
        match self {
            Error::Config { file, line, key, message } => Error::Config {
                file: file.or_else(|| Some(at_file.to_path_buf())),
                line: line.or(at_line),
                key,
                message,
            },
            other => other,
        }
    }

    pub fn exit_code(&self) -> i32 {
        match self {
            Error::Config { .. } => 2,
            Error::File { .. } | Error::NoDevice(_) | Error::Failed(_) => 1,
            Error::Interrupted => 130,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Config { file, line, key, message } => {
                if let Some(file) = file {
                    write!(f, "{}", file.display())?;
                    if let Some(line) = line {
                        write!(f, ":{line}")?;
                    }
                    write!(f, ": ")?;
                }
                if key.is_empty() {
                    return f.write_str(message);
                }
                // Keys come from files; what is no character could be a command to a terminal.
                for c in key.chars() {
                    if c.is_control() { write!(f, "{}", c.escape_default())? } else { write!(f, "{c}")? }
                }
                write!(f, ": {message}")
            }
            Error::File { path, message } => write!(f, "{}: {message}", path.display()),
            Error::NoDevice(message) | Error::Failed(message) => f.write_str(message),
            Error::Interrupted => f.write_str("interrupted"),
        }
    }
}

impl std::error::Error for Error {}
