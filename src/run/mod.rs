//! Executes a plan: a stream of bricks per group, tasks marked as they finish, a second phase for the coarse levels, then
//! the attributes that say `complete`.

pub mod assemble;
pub mod budget;
pub mod cache;
pub mod cancel;
pub mod commits;
mod compute;
mod flows;
pub mod journal;
mod lanes;
pub mod maps;
mod masked;
pub mod metrics;
pub mod options;
pub mod outputs;
pub mod planned;
mod prepass;
pub mod program;
pub mod read;
mod repair;
pub mod report;
pub mod second;
pub mod session;
pub mod sketch;
pub mod steps;
pub mod stream;
pub mod trace;
mod uniform;
mod unpack;
pub mod value;
pub mod windowed;
mod windows;

pub use cancel::Cancel;
pub use options::{Progress, RunOptions, Silent};
pub use report::Report;
pub use session::Session;

use crate::Result;
use crate::config::Config;
use crate::grid::Region;

/// Runs the whole job: plans, opens, streams every task that is not done, finishes.
///
/// # Errors
/// Wrong configs, unreadable inputs, full disks; whatever was finished stays, and `resume` continues it.
pub fn run(config: &Config, options: &RunOptions, progress: &dyn Progress) -> Result<Report> {
    let session = Session::open(config, options, progress)?;
    let tasks = session.open_tasks();
    tracing::info!(open = tasks.len(), of = session.task_count(), "tasks");
    if let Err(error) = session.run_tasks(&tasks) {
        // When a trace is wanted most; what ended the run is the error to tell.
        let _ = session.write_trace();
        return Err(error);
    }
    session.finish()
}

/// Computes only the bricks that meet one of these boxes of the volume (see [`Session::run_boxes`]); the outputs stay
/// unfinished.
///
/// # Errors
/// As for [`run`].
pub fn run_part(config: &Config, options: &RunOptions, progress: &dyn Progress, boxes: &[Region]) -> Result<Report> {
    let session = Session::open(config, options, progress)?;
    session.run_boxes(boxes)?;
    Ok(session.report())
}
