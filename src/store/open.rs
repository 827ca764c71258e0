//! Opening all inputs of a config.

use super::Source;
use crate::config::Config;
use crate::{Error, Result};

/// Opens the config's inputs in order, for a run within its budget: headers only. Errors name the line of the key.
pub fn open_inputs(config: &Config) -> Result<Vec<Source>> {
    let open = |i| {
        let mut source = Source::open(i).map_err(|e| said_of(config, &i.name, e))?;
        source.flatten(config.run.memory);
        Ok(source)
    };
    config.inputs.iter().map(open).collect()
}

/// An error of opening an input with the place in the config that names the file.
fn said_of(config: &Config, name: &str, error: Error) -> Error {
    let Error::File { path, message } = error else { return config.locate(error) };
    let key = format!("input.{name}.path");
    let line = config.line_of(&key).map_or(String::new(), |line| format!(":{line}"));
    Error::File { path, message: format!("{message} ({}{line}: {key})", config.file.display()) }
}
