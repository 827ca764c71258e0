//! `occlude pareto`: run time against error over methods and settings.

use std::path::{Path, PathBuf};

use serde_json::json;
use toml::{Table, Value};

use super::args::{ParetoArgs, RawArgs};
use super::cmd_compare::{self, Difference};
use super::plot::{self, Point};
use super::reader::Volume;
use super::{human, load, messages, write_whole};
use crate::config::{Config, suggest};
use crate::run::{self, Cancel, RunOptions, Silent};
use crate::{Error, Result};

/// Keys of `[pareto]`; documented in the command's help.
const KEYS: [&str; 6] = ["stage", "reference", "vary", "folder", "repeat", "keep"];
const MAX_RUNS: usize = 1000;
/// Name of the one output that is measured.
const OUTPUT: &str = "pareto";

/// The table, checked.
struct Job {
    stage: String,
    reference: Table,
    vary: Vec<(String, Vec<Value>)>,
    folder: PathBuf,
    repeat: u32,
    keep: bool,
}

/// One combination and what came of it.
struct Row {
    settings: Table,
    seconds: f64,
    difference: Difference,
    front: bool,
}

/// Runs every combination, then prints and writes the table.
pub fn run(args: &ParetoArgs, quiet: bool) -> Result<()> {
    let base = load(&args.config, &[])?;
    let job = job(&base).map_err(|e| e.located(&base.file, None))?;
    let cancel = messages::interrupts();
    std::fs::create_dir_all(&job.folder)
        .map_err(|e| Error::file(&job.folder, format!("cannot make the folder: {e}")))?;
    let say = |text: &str| {
        if !quiet {
            messages::note(text);
        }
    };
    let settings = combinations(&job);
    let reference_path = job.folder.join("reference.zarr");
    let reference = variant(args, &job, &job.reference, &reference_path)?;
    // Combinations that the config refuses are found before hours of runs, and left out.
    let mut accepted = Vec::new();
    for (i, settings) in settings.into_iter().enumerate() {
        let path = job.folder.join(format!("run{i}.zarr"));
        match variant(args, &job, &settings, &path) {
            Ok(config) => accepted.push((settings, config, path)),
            Err(e) => say(&format!("left out: {}: {e}", label(&settings))),
        }
    }
    if accepted.is_empty() {
        return Err(Error::config("pareto.vary", "no combination is accepted").located(&base.file, None));
    }
    say(&format!("reference: {}", label(&job.reference)));
    let reference_seconds = timed(&reference, 1, &cancel)?;
    let mut rows = Vec::new();
    let total = accepted.len();
    for (i, (settings, config, path)) in accepted.into_iter().enumerate() {
        let seconds = timed(&config, job.repeat, &cancel)?;
        let raw = RawArgs::default();
        let a = Volume::open(&reference_path, 0, &raw, &cancel)?;
        let b = Volume::open(&path, 0, &raw, &cancel)?;
        let difference = cmd_compare::compare(&a, &b, &cancel)?;
        say(&format!(
            "{}/{total} {}: {}, rmse {}",
            i + 1,
            label(&settings),
            human::seconds(seconds),
            human::number(difference.rmse)
        ));
        rows.push(Row { settings, seconds, difference, front: false });
        if !job.keep {
            remove(&path);
        }
    }
    if !job.keep {
        remove(&reference_path);
    }
    mark_front(&mut rows);
    let json = json!({
        "stage": job.stage,
        "reference": {"settings": job.reference, "seconds": reference_seconds},
        "runs": rows.iter().map(Row::json).collect::<Vec<_>>(),
    });
    write_whole(&job.folder.join("pareto.json"), format!("{json:#}\n").as_bytes())?;
    write_whole(&job.folder.join("pareto.csv"), csv(&job, &rows).as_bytes())?;
    write_whole(&job.folder.join("pareto.svg"), picture(&job, &rows).as_bytes())?;
    if args.json { messages::result_json(&json) } else { messages::result(&text(&rows, reference_seconds)) }
}

fn wrong(key: &str, message: impl std::fmt::Display) -> Error {
    Error::config(format!("pareto.{key}"), message)
}

fn job(config: &Config) -> Result<Job> {
    let Some(table) = &config.pareto else {
        return Err(Error::config(
            "pareto",
            "missing; `occlude pareto` needs a table [pareto] with stage, reference and vary",
        ));
    };
    if let Some(unknown) = table.keys().find(|k| !KEYS.contains(&k.as_str())) {
        let hint = suggest::hint(unknown, KEYS);
        return Err(wrong(unknown, format!("no such key{hint}; accepted: {}", KEYS.join(", "))));
    }
    let stages: Vec<&str> = config.stages.iter().map(|s| s.name.as_str()).collect();
    let stage = match table.get("stage") {
        Some(Value::String(s)) if stages.contains(&s.as_str()) => s.clone(),
        given => {
            let given = given.map_or("missing".to_string(), |v| format!("got {v}"));
            return Err(wrong("stage", format!("{given}; expected the name of a stage: {}", stages.join(", "))));
        }
    };
    let reference = match table.get("reference") {
        None => Table::new(),
        Some(Value::Table(t)) => t.clone(),
        Some(v) => {
            return Err(wrong("reference", format!("got {v}; expected stage keys, e.g. {{ method = \"exact\" }}")));
        }
    };
    let Some(Value::Table(vary)) = table.get("vary") else {
        return Err(wrong(
            "vary",
            "missing; expected lists by stage key, e.g. { method = [\"cdf_power\"], radius = [5, 10] }",
        ));
    };
    let list = |(key, value): (&String, &Value)| match value {
        Value::Array(values) if !values.is_empty() => Ok((key.clone(), values.clone())),
        other => Err(wrong(&format!("vary.{key}"), format!("got {other}; expected a list of values"))),
    };
    let vary = vary.iter().map(list).collect::<Result<Vec<_>>>()?;
    let runs = vary.iter().try_fold(1usize, |n, (_, v)| n.checked_mul(v.len())).filter(|n| *n <= MAX_RUNS);
    if runs.is_none() || vary.is_empty() {
        return Err(wrong("vary", format!("expected 1 to {MAX_RUNS} combinations")));
    }
    let folder = match table.get("folder") {
        None => "pareto",
        Some(Value::String(s)) if !s.is_empty() => s,
        Some(v) => return Err(wrong("folder", format!("got {v}; expected a folder as a string"))),
    };
    let repeat = match table.get("repeat") {
        None => 1,
        Some(Value::Integer(n)) if (1..=100).contains(n) => *n as u32,
        Some(v) => return Err(wrong("repeat", format!("got {v}; expected 1 to 100"))),
    };
    let keep = match table.get("keep") {
        None => false,
        Some(Value::Boolean(b)) => *b,
        Some(v) => return Err(wrong("keep", format!("got {v}; expected true or false"))),
    };
    let folder = config.file.parent().unwrap_or(Path::new("")).join(folder);
    Ok(Job { stage, reference, vary, folder, repeat, keep })
}

/// Every choice of one value per key; the first key varies slowest.
fn combinations(job: &Job) -> Vec<Table> {
    let mut all = vec![Table::new()];
    for (key, values) in &job.vary {
        let with = |t: &Table, v: &Value| {
            let mut t = t.clone();
            t.insert(key.clone(), v.clone());
            t
        };
        all = all.iter().flat_map(|t| values.iter().map(move |v| with(t, v))).collect();
    }
    all
}

/// The config with these settings of the stage and, as its only output, the stage's main channel, unrounded, level 0.
fn variant(args: &ParetoArgs, job: &Job, settings: &Table, path: &Path) -> Result<Config> {
    let key = |name: &str| toml_edit::Key::new(name).to_string();
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let path = Value::String(absolute.to_string_lossy().into_owned());
    let from = Value::String(job.stage.clone());
    let mut sets: Vec<String> =
        settings.iter().map(|(k, v)| format!("stage.{}.{}={v}", key(&job.stage), key(k))).collect();
    sets.push(format!(
        "output.{OUTPUT}={{ path = {path}, from = {from}, dtype = \"native\", levels = 1, codec = \"none\" }}"
    ));
    let mut config = load(&args.config, &sets)?;
    config.outputs.retain(|o| o.name == OUTPUT);
    Ok(config)
}

/// Seconds of the fastest of so many runs.
fn timed(config: &Config, repeat: u32, cancel: &Cancel) -> Result<f64> {
    let options = RunOptions { overwrite: true, cancel: cancel.clone(), ..RunOptions::default() };
    let mut best = f64::INFINITY;
    for _ in 0..repeat {
        let report = run::run(config, &options, &Silent).map_err(|e| e.located(&config.file, None))?;
        best = best.min(report.seconds);
    }
    Ok(best)
}

/// Takes away an output of ours and what lies beside it.
fn remove(path: &Path) {
    let _ = std::fs::remove_dir_all(path);
    let _ = std::fs::remove_dir_all(crate::store::Sink::work_dir(path));
}

/// Marks rows that no other row beats in time and error both.
fn mark_front(rows: &mut [Row]) {
    let at: Vec<[f64; 2]> = rows.iter().map(|r| [r.seconds, r.difference.rmse]).collect();
    for (row, own) in rows.iter_mut().zip(&at) {
        let beats = |o: &[f64; 2]| o[0] <= own[0] && o[1] <= own[1] && (o[0] < own[0] || o[1] < own[1]);
        row.front = !own[1].is_nan() && !at.iter().any(beats);
    }
}

/// `method=cdf_power radius=5`.
fn label(settings: &Table) -> String {
    let plain = |v: &Value| v.as_str().map_or_else(|| v.to_string(), String::from);
    let parts: Vec<String> = settings.iter().map(|(k, v)| format!("{k}={}", plain(v))).collect();
    if parts.is_empty() { "as configured".into() } else { parts.join(" ") }
}

impl Row {
    fn json(&self) -> serde_json::Value {
        let mut json = json!({"settings": self.settings, "seconds": self.seconds, "front": self.front});
        if let (Some(all), Some(more)) = (json.as_object_mut(), self.difference.json().as_object()) {
            all.extend(more.clone());
        }
        json
    }
}

const COLUMNS: [&str; 7] = ["seconds", "rmse", "mae", "bias", "max_abs", "p99", "ssim"];

fn numbers(r: &Row) -> [f64; 7] {
    let d = &r.difference;
    [r.seconds, d.rmse, d.mae, d.bias, d.max_abs, d.p99, d.ssim.unwrap_or(f64::NAN)]
}

fn csv(job: &Job, rows: &[Row]) -> String {
    let quote = |text: &str| match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_string(),
    };
    let keys = job.vary.iter().map(|(k, _)| quote(k));
    let mut text = keys.chain(COLUMNS.map(String::from)).chain(["front".into()]).collect::<Vec<_>>().join(",") + "\n";
    for row in rows {
        let plain = |v: &Value| quote(&v.as_str().map_or_else(|| v.to_string(), String::from));
        let settings = row.settings.values().map(plain);
        let cells = settings.chain(numbers(row).map(|v| v.to_string())).chain([row.front.to_string()]);
        text += &(cells.collect::<Vec<_>>().join(",") + "\n");
    }
    text
}

fn text(rows: &[Row], reference_seconds: f64) -> String {
    let width = rows.iter().map(|r| label(&r.settings).chars().count()).max().unwrap_or(0).max(8);
    let mut lines = vec![format!("{:width$}  {}", "settings", COLUMNS.map(|c| format!("{c:>11}")).join(" "))];
    let mut sorted: Vec<&Row> = rows.iter().collect();
    sorted.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    for row in sorted {
        let cells = numbers(row).map(|v| format!("{:>11}", human::number(v))).join(" ");
        let mark = if row.front { " *" } else { "" };
        lines.push(format!("{:width$}  {cells}{mark}", label(&row.settings)));
    }
    lines.push(format!("* on the front; reference: {}", human::seconds(reference_seconds)));
    lines.join("\n")
}

fn picture(job: &Job, rows: &[Row]) -> String {
    let method = |r: &Row| r.settings.get("method").and_then(Value::as_str).unwrap_or(&job.stage).to_string();
    let point = |r: &Row| Point {
        label: label(&r.settings),
        series: method(r),
        at: [r.seconds, r.difference.rmse],
        front: r.front,
    };
    let points: Vec<Point> = rows.iter().filter(|r| r.difference.rmse.is_finite()).map(point).collect();
    plot::svg(&format!("stage {}: time against error", job.stage), "seconds", "rmse", &points)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(pareto: &str) -> Result<Job> {
        let text = format!(
            "[input.ct]\npath=\"a.nrrd\"\n[stage.ao]\nop=\"ambient_occlusion\"\ninput=\"ct\"\nradius=1\nmethod=\"exact\"\n[output.o]\npath=\"o.zarr\"\nfrom=\"ao\"\n{pareto}"
        );
        job(&crate::config::parse(&text, Path::new("/c/x.toml"), &[])?)
    }

    #[test]
    fn combinations_are_the_product() {
        let job =
            config("[pareto]\nstage=\"ao\"\nvary={ method=[\"chebyshev\", \"cdf_power\"], radius=[1, 2, 3] }").unwrap();
        let all = combinations(&job);
        assert_eq!(all.len(), 6);
        assert_eq!(label(&all[1]), "method=chebyshev radius=2");
        assert_eq!(job.folder, Path::new("/c/pareto"));
    }

    #[test]
    fn broken_tables_are_refused_by_key() {
        for (text, key) in [
            ("", "pareto"),
            ("[pareto]\nstag=\"ao\"", "pareto.stag"),
            ("[pareto]\nstage=\"ai\"", "pareto.stage"),
            ("[pareto]\nstage=\"ao\"", "pareto.vary"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=3 }", "pareto.vary.radius"),
            ("[pareto]\nstage=\"ao\"\nvary={}", "pareto.vary"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nrepeat=0", "pareto.repeat"),
            ("[pareto]\nstage=\"ao\"\nvary={ radius=[3] }\nreference=3", "pareto.reference"),
        ] {
            match config(text) {
                Err(Error::Config { key: named, .. }) => assert_eq!(named, key, "{text}"),
                _ => panic!("accepted: {text}"),
            }
        }
    }

    #[test]
    fn the_front_has_what_nothing_beats() {
        let row = |seconds, rmse| Row {
            settings: Table::new(),
            seconds,
            difference: Difference { rmse, mae: 0.0, bias: 0.0, max_abs: 0.0, p99: 0.0, ssim: None, n: 1 },
            front: false,
        };
        let mut rows = [row(1.0, 0.5), row(2.0, 0.1), row(2.0, 0.2), row(3.0, 0.1), row(0.5, f64::NAN)];
        mark_front(&mut rows);
        assert_eq!(rows.each_ref().map(|r| r.front), [true, true, false, false, false]);
    }
}
