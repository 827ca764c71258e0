//! Opening all inputs of a config.

use super::Source;
use crate::Result;
use crate::config::Config;

/// Opens the config's inputs in order: headers only. Errors name the line of the input.
pub fn open_inputs(config: &Config) -> Result<Vec<Source>> {
    config.inputs.iter().map(|i| Source::open(i).map_err(|e| e.located(&config.file, i.place.line))).collect()
}
