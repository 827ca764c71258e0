//! `occlude pareto`: run time against error over methods and settings.
//!
//! Every combination runs the whole volume through the pipeline and is timed; errors are taken where they are judged
//! ([`sample`]), against a truth that is computed only there ([`truth`]).

mod cost;
mod judge;
mod sample;
mod settings;
mod table;
mod truth;
mod two_pass;
mod work;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use serde_json::json;
use toml::Table;

use super::args::{ParetoArgs, RawArgs};
use super::reader::Volume;
use super::{human, load, messages, write_whole};
use crate::config::{Config, Pareto};
use crate::run::Cancel;
use crate::{Error, Result};
use judge::{Errors, Judges};
use settings::{combinations, label, variant};
use table::Row;
use truth::{Ground, Truth, open};
use work::Work;

/// The gradients of the judged parts of lattices; `None` where there is none.
type Gradient = Option<(PathBuf, f64)>;

/// Runs every combination, then prints and writes the table.
pub fn run(args: &ParetoArgs, quiet: bool) -> Result<()> {
    let base = load(&args.config, &[])?;
    let results = table_of(&base)?;
    let cancel = messages::interrupts();
    let work = Work::make(results, &base)?;
    let job = &Pareto { folder: work.path.clone(), ..results.clone() };
    let say = |text: &str| {
        if !quiet {
            messages::note(text);
        }
    };
    let accepted = accepted(args, job, &say)?;
    let ground = Ground { args, job, cancel: &cancel };
    let (rows, truths) = all_rows(&ground, accepted, &say)?;
    let json = json!({
        "stage": job.stage.name,
        "channel": job.stage.channel,
        "references": truths.iter().map(Truth::json).collect::<Vec<_>>(),
        "runs": rows.iter().map(Row::json).collect::<Vec<_>>(),
        "cheapest": args.max_error.map(|bound| table::cheapest(&rows, bound).map(Row::json)),
    });
    write_whole(&results.folder.join("pareto.json"), format!("{json:#}\n").as_bytes())?;
    write_whole(&results.folder.join("pareto.csv"), table::csv(job, &rows).as_bytes())?;
    write_whole(&results.folder.join("pareto.svg"), table::picture(job, &rows).as_bytes())?;
    if args.json {
        return messages::result_json(&json);
    }
    let colours = std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let mut shown = table::text(&rows, colours);
    if let Some(bound) = args.max_error {
        shown += &table::advice(job, &rows, bound);
    }
    messages::result(&shown)
}

/// The table `[pareto]`.
fn table_of(config: &Config) -> Result<&Pareto> {
    let missing = || {
        Error::config("pareto", "missing; `occlude pareto` needs a table [pareto] with stage and vary")
            .located(&config.file, None)
    };
    config.pareto.as_ref().ok_or_else(missing)
}

/// Combinations with their configs and outputs. What the config refuses is found before hours of runs, and left out.
fn accepted(args: &ParetoArgs, job: &Pareto, say: &dyn Fn(&str)) -> Result<Vec<(Table, Config, PathBuf)>> {
    let (mut accepted, mut refused) = (Vec::new(), Vec::new());
    for (i, settings) in combinations(job).into_iter().enumerate() {
        let path = job.folder.join(format!("run{i}.zarr"));
        match variant(args, job, &settings, &path) {
            Ok(config) => accepted.push((settings, config, path)),
            Err(e) => refused.push(left_out(&settings, &e, say)),
        }
    }
    match accepted.is_empty() {
        true => Err(none_left(job, args, &refused)),
        false => Ok(accepted),
    }
}

/// Tells that a combination is left out; which and why.
fn left_out(settings: &Table, error: &Error, say: &dyn Fn(&str)) -> String {
    let what = format!("{}: {error}", label(settings));
    say(&format!("left out: {what}"));
    what
}

/// Says why the first one was refused.
fn none_left(job: &Pareto, args: &ParetoArgs, refused: &[String]) -> Error {
    let first = refused.first().map_or("", String::as_str);
    let message = format!("none of {} combinations is accepted; the first: {first}", refused.len());
    job.place.error("vary", message).located(&args.config.config, None)
}

/// Runs and judges all combinations; the truths, whose volumes are gone unless they are kept.
fn all_rows(
    ground: &Ground,
    accepted: Vec<(Table, Config, PathBuf)>,
    say: &dyn Fn(&str),
) -> Result<(Vec<Row>, Vec<Truth>)> {
    let (job, cancel) = (ground.job, ground.cancel);
    let mut truths: Vec<Truth> = Vec::new();
    let mut gradient: Option<Gradient> = None;
    let (mut rows, mut refused) = (Vec::new(), Vec::new());
    let total = accepted.len();
    for (i, (settings, config, path)) in accepted.into_iter().enumerate() {
        let cost = match cost::timed(&config, job.repeat, cancel) {
            Ok(cost) => cost,
            // The planner refuses, or there is no such device.
            Err(e @ (Error::Config { .. } | Error::NoDevice(_))) => {
                refused.push(left_out(&settings, &e, say));
                continue;
            }
            Err(e) => return Err(e),
        };
        let run = Volume::open(&path, 0, &RawArgs::default(), cancel)?;
        let wanted = ground.settings(&config, &settings);
        let at = match truths.iter().position(|t| t.settings == wanted) {
            Some(at) => at,
            None => {
                say(&format!("reference: {}", label(&wanted)));
                truths.push(ground.truth(&config, wanted, run.info().shape, truths.len())?);
                truths.len() - 1
            }
        };
        let truth = &truths[at];
        if gradient.is_none() {
            gradient = Some(band(ground, &config, truth, run.info().shape)?);
        }
        let errors = judge(truth, &run, gradient.as_ref().and_then(Option::as_ref), cancel)?;
        say(&format!(
            "{}/{total} {}: {}, rmse {}",
            i + 1,
            label(&settings),
            human::seconds(cost.seconds),
            human::number(errors.all.rmse)
        ));
        rows.push(Row { settings, cost, errors, judged: truth.judged.clone(), front: false });
        if !job.keep {
            cost::remove(&path);
        }
    }
    if !job.keep {
        truths.iter().for_each(Truth::remove);
    }
    if let Some(Some((path, _))) = &gradient {
        cost::remove(path);
    }
    table::mark_front(&mut rows);
    match rows.is_empty() {
        true => Err(none_left(job, ground.args, &refused)),
        false => Ok((rows, truths)),
    }
}

/// The gradient of the input where it is judged, and the least of the surface band.
fn band(ground: &Ground, config: &Config, truth: &Truth, shape: [usize; 3]) -> Result<Gradient> {
    let scale = ground.scale(config, shape)?;
    let Some(path) = ground.gradient(config, &truth.judged, scale)? else { return Ok(None) };
    let least = judge::band_from(&open(&path, ground.cancel)?, &truth.judged, ground.cancel)?;
    Ok(Some((path, least)))
}

fn judge(truth: &Truth, run: &Volume, gradient: Option<&(PathBuf, f64)>, cancel: &Cancel) -> Result<Errors> {
    let part = |path: &Path| open(path, cancel);
    let truth_volume = part(&truth.path)?;
    let spread = truth.spread.as_deref().map(part).transpose()?;
    let band = match gradient {
        Some((path, least)) => Some((part(path)?, *least)),
        None => None,
    };
    // A run on a lattice of its own has no surface band there.
    let band = band.as_ref().filter(|(v, _)| v.info().shape == run.info().shape);
    let judges = Judges {
        truth: &truth_volume,
        spread: spread.as_ref(),
        gradient: band.map(|(v, least)| (v, *least)),
        judged: &truth.judged,
    };
    judge::errors(&judges, run, cancel)
}

#[cfg(test)]
mod tests {
    use super::settings::tests::job;
    use super::*;
    use crate::config::Sample;

    #[test]
    fn broken_tables_are_refused_by_key() {
        for (text, key) in [
            ("", "pareto"),
            ("[pareto]\nstag=\"ao\"", "pareto.stag"),
            ("[pareto]\nstage=\"ai\"\nvary={ radius=[3] }", "pareto.stage"),
            ("[pareto]\nstage=\"ct\"\nvary={ radius=[3] }", "pareto.stage"),
            ("[pareto]\nstage=\"ao.mean\"\nvary={ radius=[3] }", "pareto.stage"),
            ("[pareto]\nstage=\"ao\"", "pareto.vary"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=3 }", "pareto.vary.radius"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[] }", "pareto.vary.radius"),
            ("[pareto]\nstage=\"ao\"\nvary={}", "pareto.vary"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nrepeat=0", "pareto.repeat"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nreference=3", "pareto.reference"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nsample=0", "pareto.sample"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nsample=0.5", "pareto.sample"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nsample=\"0 %\"", "pareto.sample"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nsample=\"101%\"", "pareto.sample"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nsample=\"some\"", "pareto.sample"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nseed=-1", "pareto.seed"),
        ] {
            match job(text) {
                Err(Error::Config { key: named, line, .. }) => {
                    assert_eq!(named, key, "{text}");
                    assert!(line.is_some() || text.is_empty(), "no line: {text}");
                }
                _ => panic!("accepted: {text}"),
            }
        }
    }

    #[test]
    fn samples_are_counts_or_shares() {
        let sample =
            |v: &str| job(&format!("[pareto]\nstage=\"ao\"\nvary={{ radius=[3] }}\nsample={v}")).unwrap().sample;
        assert_eq!(sample("\"auto\""), Sample::Auto);
        assert_eq!(sample("\"all\""), Sample::All);
        assert_eq!(sample("17"), Sample::Bricks(17));
        assert_eq!(sample("\"12.5 %\""), Sample::Share(0.125));
        assert_eq!(job("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }").unwrap().sample, Sample::Auto);
    }
}
