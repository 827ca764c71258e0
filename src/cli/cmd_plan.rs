//! `occlude plan`.

use super::args::PlanArgs;
use super::{load, messages};
use crate::Result;

/// Prints the plan.
pub fn run(args: &PlanArgs) -> Result<()> {
    let config = load(&args.config, &[])?;
    let (text, json) = crate::plan::explain(&config).map_err(|e| config.locate(e))?;
    if args.json { messages::result_json(&json) } else { messages::result(&text) }
}
