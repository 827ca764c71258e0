//! Opening all inputs of a config.

use std::path::{Path, PathBuf};

use super::Source;
use crate::config::check::resolved;
use crate::config::{Config, Input};
use crate::{Error, Result};

/// Opens the config's inputs in order, for a run within its budget: headers only. Errors name the line of the key.
///
/// # Errors
/// Files that cannot be read, and outputs that would take the place of a file that headers name.
pub fn open_inputs(config: &Config) -> Result<Vec<Source>> {
    let open = |i| {
        let mut source = Source::open(i).map_err(|e| said_of(config, &i.name, e))?;
        source.flatten(config.run.memory);
        Ok(source)
    };
    let sources = config.inputs.iter().map(open).collect::<Result<Vec<_>>>()?;
    let named = named_files(config, &sources);
    for output in &config.outputs {
        if let Some(file) = changed_by(&named, &output.path) {
            let (path, file) = (&output.path, file.display());
            let message = format!("got {path:?}; {file} is read for an input; expected another path");
            return Err(config.locate(Error::config(format!("output.{}.path", output.name), message)));
        }
    }
    Ok(sources)
}

/// Files that headers name, links followed: they are read, too, and the config does not tell. What it tells is checked before
/// anything is opened, and slices of a folder may be many.
pub fn named_files(config: &Config, sources: &[Source]) -> Vec<PathBuf> {
    let beside = |(input, source): (&Input, &Source)| {
        let Some(path) = input.kind.path() else { return Vec::new() };
        source.paths().into_iter().filter(|file| !file.starts_with(path)).map(|file| resolved(&file)).collect()
    };
    config.inputs.iter().zip(sources).flat_map(beside).collect()
}

/// The one of [`named_files`] that writing to `path` would change.
pub fn changed_by<'a>(named: &'a [PathBuf], path: &Path) -> Option<&'a PathBuf> {
    let target = resolved(path);
    named.iter().find(|file| target.starts_with(file) || file.starts_with(&target))
}

/// An error of opening or unpacking an input with the place in the config that names the file.
pub fn said_of(config: &Config, name: &str, error: Error) -> Error {
    let Error::File { path, message } = error else { return config.locate(error) };
    let key = format!("input.{name}.path");
    let line = config.line_of(&key).map_or(String::new(), |line| format!(":{line}"));
    Error::File { path, message: format!("{message} ({}{line}: {key})", config.file.display()) }
}
