//! What a run costs.

use std::path::Path;

use super::sample::Judged;
use crate::Result;
use crate::config::Config;
use crate::grid::Region;
use crate::run::{self, Cancel, Report, RunOptions, Silent};
use crate::store::Sink;

/// Time, memory and bytes of a run of the whole volume.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cost {
    /// Wall time, the median of the repeats.
    pub seconds: f64,
    /// Largest of the repeats.
    pub peak_memory_bytes: u64,
    pub bytes_read: u64,
    pub bytes_written: u64,
}

fn options(cancel: &Cancel) -> RunOptions {
    RunOptions { overwrite: true, cancel: cancel.clone(), ..RunOptions::default() }
}

/// Cost of a run: the median of so many, after one to warm up where there are several.
pub fn timed(config: &Config, repeat: u32, cancel: &Cancel) -> Result<Cost> {
    let options = options(cancel);
    let run = || run::run(config, &options, &Silent).map_err(|e| config.locate(e));
    if repeat > 1 {
        run()?;
    }
    let mut cost = Cost::default();
    let mut seconds = Vec::new();
    for _ in 0..repeat {
        let report = run()?;
        seconds.push(report.seconds);
        cost.peak_memory_bytes = cost.peak_memory_bytes.max(report.peak_memory_bytes);
        (cost.bytes_read, cost.bytes_written) = (report.bytes_read, report.bytes_written);
    }
    seconds.sort_by(f64::total_cmp);
    let n = seconds.len();
    cost.seconds = (seconds[(n - 1) / 2] + seconds[n / 2]) / 2.0;
    Ok(cost)
}

/// Runs a config once: all of it, or the bricks that these boxes of the volume meet.
pub fn once(config: &Config, boxes: Option<&[Region]>, cancel: &Cancel) -> Result<Report> {
    let options = options(cancel);
    let report = match boxes {
        None => run::run(config, &options, &Silent),
        Some(boxes) => part(config, &options, boxes),
    };
    report.map_err(|e| config.locate(e))
}

/// Bricks as large as the judged ones, so that little else is computed; or those that the planner takes, where the budget
/// holds no such brick.
fn part(config: &Config, options: &RunOptions, boxes: &[Region]) -> Result<Report> {
    let mut small = config.clone();
    let largest = |a: usize| boxes.iter().map(|b| b.shape()[a]).max().unwrap_or(1);
    small.run.brick = Some([0, 1, 2].map(largest));
    match run::run_part(&small, options, &Silent, boxes) {
        Err(crate::Error::Config { .. }) => run::run_part(config, options, &Silent, boxes),
        report => report,
    }
}

/// Boxes to run for what is judged of an output.
pub fn boxes(judged: &Judged, config: &Config, scale: [usize; 3]) -> Option<Vec<Region>> {
    judged.boxes(scale, config.run.region.map_or([0; 3], |r| r.map(|ends| ends[0] as i64)))
}

/// Takes away an output of ours and what lies beside it.
pub fn remove(path: &Path) {
    if path.is_dir() {
        let _ = std::fs::remove_dir_all(path);
    } else {
        let _ = std::fs::remove_file(path);
    }
    let _ = std::fs::remove_dir_all(Sink::work_dir(path));
}
