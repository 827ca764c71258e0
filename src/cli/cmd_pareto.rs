//! `occlude pareto`: run time against error over methods and settings.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use serde_json::json;
use toml::{Table, Value};

use super::args::{ParetoArgs, RawArgs};
use super::cmd_compare::{self, Difference};
use super::pareto_bands::{self as bands, Parts};
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
    cost: Cost,
    difference: Difference,
    parts: Parts,
    front: bool,
}

/// What a run costs.
#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    /// Wall time, the median of the repeats.
    seconds: f64,
    /// Largest of the repeats.
    peak_memory_bytes: u64,
    bytes_read: u64,
    bytes_written: u64,
}

/// A reference that was run: what combinations are compared with, and where their windows vary.
struct Truth {
    settings: Table,
    path: PathBuf,
    spread: Option<PathBuf>,
    seconds: f64,
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
    let gradient = gradient(&job, &accepted[0].1, &cancel)?;
    let mut truths: Vec<Truth> = Vec::new();
    let mut rows = Vec::new();
    let total = accepted.len();
    for (i, (settings, config, path)) in accepted.into_iter().enumerate() {
        let wanted = reference_of(&job, &settings);
        let truth = match truths.iter().position(|t| t.settings == wanted) {
            Some(at) => &truths[at],
            None => {
                say(&format!("reference: {}", label(&wanted)));
                truths.push(Truth::run(args, &job, wanted, truths.len(), &cancel)?);
                &truths[truths.len() - 1]
            }
        };
        let cost = timed(&config, job.repeat, &cancel)?;
        let (difference, parts) = judge(truth, &path, gradient.as_ref(), &cancel)?;
        say(&format!(
            "{}/{total} {}: {}, rmse {}",
            i + 1,
            label(&settings),
            human::seconds(cost.seconds),
            human::number(difference.rmse)
        ));
        rows.push(Row { settings, cost, difference, parts, front: false });
        if !job.keep {
            remove(&path);
        }
    }
    if !job.keep {
        truths.iter().for_each(Truth::remove);
    }
    if let Some((path, _)) = &gradient {
        remove(path);
    }
    mark_front(&mut rows);
    let references: Vec<_> = truths.iter().map(|t| json!({"settings": t.settings, "seconds": t.seconds})).collect();
    let json = json!({
        "stage": job.stage,
        "references": references,
        "runs": rows.iter().map(Row::json).collect::<Vec<_>>(),
        "cheapest": args.max_error.map(|bound| cheapest(&rows, bound).map(Row::json)),
    });
    write_whole(&job.folder.join("pareto.json"), format!("{json:#}\n").as_bytes())?;
    write_whole(&job.folder.join("pareto.csv"), csv(&job, &rows).as_bytes())?;
    write_whole(&job.folder.join("pareto.svg"), picture(&job, &rows).as_bytes())?;
    if args.json {
        return messages::result_json(&json);
    }
    let colours = std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let mut shown = text(&rows, colours);
    if let Some(bound) = args.max_error {
        shown += &advice(&job, &rows, bound);
    }
    messages::result(&shown)
}

/// A combination's reference: the combination, with the keys that `reference` gives.
fn reference_of(job: &Job, settings: &Table) -> Table {
    let mut all = settings.clone();
    all.extend(job.reference.clone());
    all
}

impl Truth {
    fn run(args: &ParetoArgs, job: &Job, settings: Table, index: usize, cancel: &Cancel) -> Result<Truth> {
        let path = job.folder.join(format!("reference{index}.zarr"));
        let config = variant(args, job, &settings, &path)?;
        let seconds = timed(&config, 1, cancel)?.seconds;
        let spread = job.folder.join(format!("spread{index}.zarr"));
        let helper = bands::spread_of(&config, &job.stage, &spread);
        if let Some(helper) = &helper {
            timed(helper, 1, cancel)?;
        }
        Ok(Truth { settings, path, spread: helper.map(|_| spread), seconds })
    }

    fn remove(&self) {
        std::iter::once(&self.path).chain(&self.spread).for_each(|p| remove(p));
    }
}

/// The gradient's magnitude of the stage's input and the least of the surface band; `None` where there is no gradient.
fn gradient(job: &Job, variant: &Config, cancel: &Cancel) -> Result<Option<(PathBuf, f64)>> {
    let path = job.folder.join("gradient.zarr");
    let Some(config) = bands::gradient_of(variant, &job.stage, &path) else { return Ok(None) };
    match timed(&config, 1, cancel) {
        Ok(_) => {
            let volume = Volume::open(&path, 0, &RawArgs::default(), cancel)?;
            Ok(Some((path, bands::band_from(&volume, cancel)?)))
        }
        // Inputs of several components have none.
        Err(Error::Config { .. }) => Ok(None),
        Err(e) => Err(e),
    }
}

fn judge(
    truth: &Truth,
    path: &Path,
    gradient: Option<&(PathBuf, f64)>,
    cancel: &Cancel,
) -> Result<(Difference, Parts)> {
    let open = |path: &Path| Volume::open(path, 0, &RawArgs::default(), cancel);
    let (a, b) = (open(&truth.path)?, open(path)?);
    // Bias is that of the combination: its value less the reference's.
    let difference = cmd_compare::compare(&b, &a, cancel)?;
    let mut parts = Parts::default();
    if let Some(spread) = &truth.spread {
        parts.windows = Some(bands::errors(&a, &b, &open(spread)?, 0.0, cancel)?);
    }
    if let Some((gradient, least)) = gradient {
        let mask = open(gradient)?;
        // An occlusion map may live on a coarser lattice than its input.
        if mask.info().shape == a.info().shape {
            parts.surface = Some(bands::errors(&a, &b, &mask, *least, cancel)?);
        }
    }
    Ok((difference, parts))
}

/// The fastest row within a bound.
fn cheapest(rows: &[Row], bound: f64) -> Option<&Row> {
    let within = rows.iter().filter(|r| r.difference.rmse <= bound);
    within.min_by(|a, b| a.cost.seconds.total_cmp(&b.cost.seconds))
}

/// The cheapest combination within a bound and its lines of the config.
fn advice(job: &Job, rows: &[Row], bound: f64) -> String {
    let Some(row) = cheapest(rows, bound) else {
        return format!("\n\nno combination is within rmse {}", human::number(bound));
    };
    let mut lines = vec![
        format!("\n\ncheapest within rmse {}: {}", human::number(bound), label(&row.settings)),
        format!("[stage.{}]", toml_edit::Key::new(&job.stage)),
    ];
    lines.extend(row.settings.iter().map(|(k, v)| format!("{} = {v}", toml_edit::Key::new(k))));
    lines.join("\n")
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

/// Cost of a run: the median of so many, after one to warm up where there are several.
fn timed(config: &Config, repeat: u32, cancel: &Cancel) -> Result<Cost> {
    let options = RunOptions { overwrite: true, cancel: cancel.clone(), ..RunOptions::default() };
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

/// Takes away an output of ours and what lies beside it.
fn remove(path: &Path) {
    let _ = std::fs::remove_dir_all(path);
    let _ = std::fs::remove_dir_all(crate::store::Sink::work_dir(path));
}

/// Marks rows that no other row beats in time and error both.
fn mark_front(rows: &mut [Row]) {
    let at: Vec<[f64; 2]> = rows.iter().map(|r| [r.cost.seconds, r.difference.rmse]).collect();
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
        let mut json = json!({
            "settings": self.settings, "seconds": self.cost.seconds, "front": self.front,
            "peak_memory_bytes": self.cost.peak_memory_bytes, "bytes_read": self.cost.bytes_read,
            "bytes_written": self.cost.bytes_written, "windows_that_vary": self.parts.windows.map(|p| p.json()),
            "surface_band": self.parts.surface.map(|p| p.json()),
        });
        if let (Some(all), Some(more)) = (json.as_object_mut(), self.difference.json().as_object()) {
            all.extend(more.clone());
        }
        json
    }
}

/// `rmse_vary`: windows that are not constant; `rmse_edge`: surface band.
const COLUMNS: [&str; 12] = [
    "seconds",
    "rmse",
    "mae",
    "bias",
    "max_abs",
    "p99",
    "ssim",
    "rmse_vary",
    "bias_vary",
    "rmse_edge",
    "bias_edge",
    "peak_MiB",
];

fn numbers(r: &Row) -> [f64; 12] {
    let d = &r.difference;
    let part = |p: Option<bands::Part>| p.map_or([f64::NAN; 2], |p| [p.rmse, p.bias]);
    let ([vary, vary_bias], [edge, edge_bias]) = (part(r.parts.windows), part(r.parts.surface));
    let ssim = d.ssim.unwrap_or(f64::NAN);
    let peak = r.cost.peak_memory_bytes as f64 / 1_048_576.0;
    [r.cost.seconds, d.rmse, d.mae, d.bias, d.max_abs, d.p99, ssim, vary, vary_bias, edge, edge_bias, peak]
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

fn text(rows: &[Row], colours: bool) -> String {
    let width = rows.iter().map(|r| label(&r.settings).chars().count()).max().unwrap_or(0).max(8);
    let mut lines = vec![format!("{:width$}  {}", "settings", COLUMNS.map(|c| format!("{c:>10}")).join(" "))];
    let mut sorted: Vec<&Row> = rows.iter().collect();
    sorted.sort_by(|a, b| a.cost.seconds.total_cmp(&b.cost.seconds));
    for row in sorted {
        let cells = numbers(row).map(|v| format!("{:>10}", brief(v))).join(" ");
        let mark = if row.front { " *" } else { "" };
        let line = format!("{:width$}  {cells}{mark}", label(&row.settings));
        lines.push(if colours && !row.front { format!("\x1b[2m{line}\x1b[0m") } else { line });
    }
    let n = rows.first().map_or(0, |r| r.difference.n);
    let part = |f: fn(&Parts) -> Option<bands::Part>| {
        rows.iter().find_map(|r| f(&r.parts)).map_or("none".to_string(), |p| p.n.to_string())
    };
    lines.push(format!(
        "* on the front; voxels: {n}, in windows that vary {}, in the surface band {}",
        part(|p| p.windows),
        part(|p| p.surface)
    ));
    lines.join("\n")
}

/// Four digits are enough to choose by.
fn brief(v: f64) -> String {
    match v {
        v if v == 0.0 || !v.is_finite() => format!("{v}"),
        v if (1e-3..1e5).contains(&v.abs()) => format!("{v:.4}"),
        v => format!("{v:.2e}"),
    }
}

fn picture(job: &Job, rows: &[Row]) -> String {
    let method = |r: &Row| r.settings.get("method").and_then(Value::as_str).unwrap_or(&job.stage).to_string();
    let point = |r: &Row| Point {
        label: label(&r.settings),
        series: method(r),
        at: [r.cost.seconds, r.difference.rmse],
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
            cost: Cost { seconds, ..Cost::default() },
            parts: Parts::default(),
            difference: Difference { rmse, mae: 0.0, bias: 0.0, max_abs: 0.0, p99: 0.0, ssim: None, n: 1 },
            front: false,
        };
        let mut rows = [row(1.0, 0.5), row(2.0, 0.1), row(2.0, 0.2), row(3.0, 0.1), row(0.5, f64::NAN)];
        mark_front(&mut rows);
        assert_eq!(rows.each_ref().map(|r| r.front), [true, true, false, false, false]);
    }

    #[test]
    fn the_cheapest_within_a_bound_is_named_with_its_lines() {
        let job = config(
            "[pareto]\nstage=\"ao\"\nreference={ method=\"exact\" }\nvary={ method=[\"chebyshev\", \"cdf_power\"] }",
        )
        .unwrap();
        let row = |settings, seconds, rmse| Row {
            settings,
            cost: Cost { seconds, ..Cost::default() },
            difference: Difference { rmse, mae: 0.0, bias: 0.0, max_abs: 0.0, p99: 0.0, ssim: None, n: 1 },
            parts: Parts::default(),
            front: false,
        };
        let settings = combinations(&job);
        let rows = [row(settings[0].clone(), 1.0, 0.4), row(settings[1].clone(), 2.0, 0.1)];
        assert!(
            advice(&job, &rows, 0.2).ends_with("[stage.ao]\nmethod = \"cdf_power\""),
            "{}",
            advice(&job, &rows, 0.2)
        );
        assert!(advice(&job, &rows, 0.5).contains("method=chebyshev"));
        assert!(advice(&job, &rows, 0.01).contains("no combination"));
        assert_eq!(label(&reference_of(&job, &settings[0])), "method=exact");
        // A quantity that is not a number is within no bound.
        assert!(cheapest(&[row(Table::new(), 1.0, f64::NAN)], 1.0).is_none());
    }
}
