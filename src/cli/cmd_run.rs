//! `occlude run`.

use super::args::RunArgs;
use super::progress::Shown;
use super::{can_write, human, load, messages, refuse_overwriting, usage, write_whole};
use crate::config::check::{resolved, work_folder};
use crate::run::{self, Report, RunOptions};
use crate::{Error, Result};

/// Runs the job and says what was done, on stderr; the report goes to its file.
pub fn run(args: &RunArgs, quiet: bool) -> Result<()> {
    let config = load(&args.config, &[])?;
    for (flag, path) in [("--report", &args.report), ("--trace", &args.trace)] {
        let Some(path) = path else { continue };
        // Found out now rather than after hours.
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
        if folder.is_some_and(|f| !f.is_dir()) || path.is_dir() {
            return Err(usage(flag, format!("got {}; expected a file in an existing folder", path.display())));
        }
        let inputs = config.inputs.iter().filter_map(|i| i.kind.path());
        refuse_overwriting(flag, path, inputs.chain([config.file.as_path()]))?;
        let real = resolved(path);
        let writes = |p: &std::path::Path| real.starts_with(resolved(p)) || real.starts_with(resolved(&work_folder(p)));
        if let Some(o) = config.outputs.iter().find(|o| writes(&o.path)) {
            let message = format!("got {}, which output {:?} writes; expected another file", path.display(), o.name);
            return Err(usage(flag, message));
        }
        can_write(path)?;
    }
    if let (Some(report), Some(trace)) = (&args.report, &args.trace)
        && resolved(report) == resolved(trace)
    {
        return Err(usage("--trace", format!("got {}, which --report writes; expected another file", trace.display())));
    }
    let options = RunOptions {
        resume: args.resume,
        overwrite: args.overwrite,
        no_skip: args.no_skip,
        trace: args.trace.clone(),
        report: args.report.clone(),
        cancel: messages::interrupts(),
    };
    let progress = Shown::new(quiet);
    let report = run::run(&config, &options, &progress);
    progress.finish();
    let report = report.map_err(|e| config.locate(e))?;
    if let Some(path) = &args.report {
        let json = serde_json::to_vec_pretty(&report).map_err(|e| Error::Failed(format!("report: {e}")))?;
        write_whole(path, &json)?;
    }
    if !quiet {
        messages::note(&summary(&report));
    }
    Ok(())
}

/// One line for people.
pub fn summary(r: &Report) -> String {
    if r.bricks.resumed > 0 && r.bricks.resumed == r.bricks.total {
        return format!("nothing was left to do: all {} bricks were finished before", r.bricks.total);
    }
    let skipped: u64 = r.bricks.skipped.values().sum();
    let mut parts = vec![format!("{} of {} bricks computed", r.bricks.computed, r.bricks.total)];
    if r.bricks.resumed > 0 {
        parts.push(format!("{} resumed", r.bricks.resumed));
    }
    if skipped > 0 {
        parts.push(format!("{skipped} skipped"));
    }
    format!(
        "done in {}: {} voxels, {} voxels/s; {}; read {}, wrote {}; peak memory {} of {}",
        human::seconds(r.seconds),
        human::count(r.voxels as f64),
        human::count(r.voxels_per_second),
        parts.join(", "),
        human::bytes(r.bytes_read),
        human::bytes(r.bytes_written),
        human::bytes(r.peak_memory_bytes),
        human::bytes(r.memory_budget_bytes),
    )
}
