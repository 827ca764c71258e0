//! Executes a plan.

pub mod cancel;
pub mod options;
pub mod report;

pub use cancel::Cancel;
pub use options::{Progress, RunOptions, Silent};
pub use report::Report;

use crate::Result;
use crate::config::Config;

/// Runs the job.
pub fn run(config: &Config, options: &RunOptions, progress: &dyn Progress) -> Result<Report> {
    let _ = (config, options, progress);
    todo!()
}
