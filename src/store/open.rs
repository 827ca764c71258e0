//! Opening all inputs of a config.

use std::path::{Path, PathBuf};

use super::Source;
use crate::config::Config;
use crate::config::check::resolved;
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
    for output in &config.outputs {
        if let Some(file) = read_of(&sources, &output.path) {
            let (path, file) = (&output.path, file.display());
            let message = format!("got {path:?}; {file} is read for an input; expected another path");
            return Err(config.locate(Error::config(format!("output.{}.path", output.name), message)));
        }
    }
    Ok(sources)
}

/// The file or folder of these volumes that writing to `path` would change.
pub fn read_of(sources: &[Source], path: &Path) -> Option<PathBuf> {
    let target = resolved(path);
    let hit = |file: &PathBuf| {
        let real = resolved(file);
        target.starts_with(&real) || real.starts_with(&target)
    };
    sources.iter().flat_map(Source::paths).find(hit)
}

/// An error of opening or unpacking an input with the place in the config that names the file.
pub fn said_of(config: &Config, name: &str, error: Error) -> Error {
    let Error::File { path, message } = error else { return config.locate(error) };
    let key = format!("input.{name}.path");
    let line = config.line_of(&key).map_or(String::new(), |line| format!(":{line}"));
    Error::File { path, message: format!("{message} ({}{line}: {key})", config.file.display()) }
}
