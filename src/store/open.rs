//! Opening all inputs of a config.

use super::Source;
use crate::Result;
use crate::config::Config;

/// Opens the config's inputs in order, for a run within its budget: headers only. Errors name the line of the key.
pub fn open_inputs(config: &Config) -> Result<Vec<Source>> {
    let open = |i| {
        let mut source = Source::open(i).map_err(|e| config.locate(e))?;
        source.flatten(config.run.memory);
        Ok(source)
    };
    config.inputs.iter().map(open).collect()
}
