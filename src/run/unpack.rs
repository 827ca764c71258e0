//! Unpacks gzip and re-blocks compressed planes, once, into scratch, before a run reads or deletes anything.

use std::path::PathBuf;

use super::metrics::Metrics;
use super::options::{Progress, RunOptions};
use crate::config::Config;
use crate::plan::Plan;
use crate::plan::memory::planes_read;
use crate::store::{Source, said_of};
use crate::{Error, Result};

/// Inputs that unpack to less than this are unpacked before anybody would read a line about it.
const QUIET: u64 = 64 << 20;

/// Makes of every source what the plan reads ready to be read.
///
/// # Errors
/// A file is broken, scratch has no room, or somebody asked to stop.
pub fn unpack(
    sources: &mut [Source],
    plan: &Plan,
    config: &Config,
    options: &RunOptions,
    progress: &dyn Progress,
    metrics: &Metrics,
) -> Result<()> {
    for (input, source) in sources.iter_mut().enumerate() {
        source.narrow(planes_read(plan, input));
    }
    let total: u64 = sources.iter().map(Source::spool_bytes).sum();
    let beside = config.outputs[0].path.parent().map_or_else(|| PathBuf::from("."), PathBuf::from);
    let folder = config.run.scratch.clone().unwrap_or(beside);
    if total > 0 {
        std::fs::create_dir_all(&folder).map_err(|e| Error::file(&folder, format!("cannot create scratch: {e}")))?;
    }
    for (source, input) in sources.iter_mut().zip(&config.inputs) {
        let prepared = source.prepare(&folder, &|bytes| {
            if total > QUIET {
                progress.update(bytes, total, 0, 0, "unpack");
            }
            !options.cancel.is_cancelled()
        });
        prepared.map_err(|e| said_of(config, &input.name, e))?;
        metrics.bytes_read(source.unpacked_bytes());
    }
    options.cancel.check()
}
