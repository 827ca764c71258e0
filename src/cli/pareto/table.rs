//! What comes of it: the table on screen, CSV, JSON, the plot and the advice.

use serde_json::json;
use toml::{Table, Value};

use super::super::cmd_compare::Difference;
use super::super::human;
use super::super::plot::{self, Point};
use super::cost::Cost;
use super::judge::{Errors, part_json};
use super::sample::Judged;
use super::settings::{DEVICE, label, lines, plain};
use crate::config::Pareto;

/// One combination and what came of it.
pub struct Row {
    pub settings: Table,
    pub cost: Cost,
    pub errors: Errors,
    pub judged: Judged,
    pub front: bool,
}

/// Marks rows that no other row beats in time and error both.
pub fn mark_front(rows: &mut [Row]) {
    let at: Vec<[f64; 2]> = rows.iter().map(|r| [r.cost.seconds, r.errors.all.rmse]).collect();
    for (row, own) in rows.iter_mut().zip(&at) {
        let beats = |o: &[f64; 2]| o[0] <= own[0] && o[1] <= own[1] && (o[0] < own[0] || o[1] < own[1]);
        row.front = !own[1].is_nan() && !at.iter().any(beats);
    }
}

/// The fastest row within a bound.
pub fn cheapest(rows: &[Row], bound: f64) -> Option<&Row> {
    let within = rows.iter().filter(|r| r.errors.all.rmse <= bound);
    within.min_by(|a, b| a.cost.seconds.total_cmp(&b.cost.seconds))
}

/// The cheapest combination within a bound and its lines of the config.
pub fn advice(job: &Pareto, rows: &[Row], bound: f64) -> String {
    let Some(row) = cheapest(rows, bound) else {
        return format!("\n\nno combination is within rmse {}", human::number(bound));
    };
    let name = label(&row.settings);
    format!("\n\ncheapest within rmse {}: {name}\n{}", human::number(bound), lines(job, &row.settings))
}

impl Row {
    pub fn json(&self) -> serde_json::Value {
        let mut json = json!({
            "settings": self.settings, "seconds": self.cost.seconds, "front": self.front,
            "peak_memory_bytes": self.cost.peak_memory_bytes, "bytes_read": self.cost.bytes_read,
            "bytes_written": self.cost.bytes_written, "judged": self.judged.json(),
            "windows_that_vary": self.errors.windows.as_ref().map(part_json),
            "surface_band": self.errors.surface.as_ref().map(part_json),
        });
        if let (Some(all), Some(more)) = (json.as_object_mut(), self.errors.all.json().as_object()) {
            all.extend(more.clone());
        }
        json
    }
}

/// Numbers of a part of the voxels; `vary`: windows that are not constant, `edge`: surface band.
const PART: [&str; 5] = ["rmse", "mae", "bias", "p99", "max_abs"];

/// Columns on screen.
const SHOWN: [&str; 12] = [
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

/// Every number of a row by name.
fn numbers(r: &Row) -> Vec<(String, f64)> {
    let of = |d: &Difference| [d.rmse, d.mae, d.bias, d.p99, d.max_abs];
    let mut all = vec![("seconds".to_string(), r.cost.seconds)];
    all.extend(PART.map(String::from).into_iter().zip(of(&r.errors.all)));
    all.push(("ssim".into(), r.errors.all.ssim.unwrap_or(f64::NAN)));
    for (part, suffix) in [(&r.errors.windows, "vary"), (&r.errors.surface, "edge")] {
        let values = part.as_ref().map_or([f64::NAN; 5], of);
        all.extend(PART.map(|name| format!("{name}_{suffix}")).into_iter().zip(values));
    }
    let counts = [
        ("peak_MiB", r.cost.peak_memory_bytes as f64 / 1_048_576.0),
        ("bytes_read", r.cost.bytes_read as f64),
        ("bytes_written", r.cost.bytes_written as f64),
        ("judged_voxels", r.judged.voxels as f64),
        ("of_voxels", r.judged.of_voxels as f64),
    ];
    all.extend(counts.map(|(name, v)| (name.to_string(), v)));
    all
}

/// A line per run: settings, every number, and whether it is on the front.
pub fn csv(job: &Pareto, rows: &[Row]) -> String {
    let quote = |text: &str| match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_string(),
    };
    let mut head: Vec<String> = job.vary.iter().map(|(k, _)| quote(k)).collect();
    head.extend(rows.first().map(numbers).into_iter().flatten().map(|(name, _)| name));
    head.push("front".into());
    let mut text = head.join(",") + "\n";
    for row in rows {
        let settings = job.vary.iter().map(|(k, _)| row.settings.get(k).map_or(String::new(), |v| quote(&plain(v))));
        let values = numbers(row).into_iter().map(|(_, v)| v.to_string());
        let cells = settings.chain(values).chain([row.front.to_string()]);
        text += &(cells.collect::<Vec<_>>().join(",") + "\n");
    }
    text
}

/// The table on screen, the fastest row first; rows that others beat are dimmed.
pub fn text(rows: &[Row], colours: bool) -> String {
    let width = rows.iter().map(|r| label(&r.settings).chars().count()).max().unwrap_or(0).max(8);
    let mut lines = vec![format!("{:width$}  {}", "settings", SHOWN.map(|c| format!("{c:>10}")).join(" "))];
    let mut sorted: Vec<&Row> = rows.iter().collect();
    sorted.sort_by(|a, b| a.cost.seconds.total_cmp(&b.cost.seconds));
    for row in sorted {
        let all = numbers(row);
        let value = |name: &str| all.iter().find(|(n, _)| n == name).map_or(f64::NAN, |(_, v)| *v);
        let cells = SHOWN.map(|name| format!("{:>10}", brief(value(name)))).join(" ");
        let mark = if row.front { " *" } else { "" };
        let line = format!("{:width$}  {cells}{mark}", label(&row.settings));
        lines.push(if colours && !row.front { format!("\x1b[2m{line}\x1b[0m") } else { line });
    }
    lines.push("* on the front; seconds are of whole runs".into());
    let mut judged: Vec<&Judged> = rows.iter().map(|r| &r.judged).collect();
    judged.dedup();
    lines.extend(judged.iter().map(|j| format!("judged: {}", j.text())));
    let part = |f: fn(&Errors) -> &Option<Difference>| {
        rows.iter().find_map(|r| f(&r.errors).as_ref()).map_or("none".to_string(), |p| p.n.to_string())
    };
    lines.push(format!(
        "of these, in windows that vary (first row run) {}, in the surface band {}",
        part(|e| &e.windows),
        part(|e| &e.surface)
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

/// Time against error as SVG, coloured by the first key that varies in words.
pub fn picture(job: &Pareto, rows: &[Row]) -> String {
    let words = |(key, values): &&(String, Vec<Value>)| key != DEVICE && values.iter().all(Value::is_str);
    let by = job.vary.iter().find(words).or(job.vary.first()).map(|(key, _)| key.as_str());
    let series = |r: &Row| by.and_then(|k| r.settings.get(k)).map_or(job.stage.name.clone(), plain);
    let point = |r: &Row| Point {
        label: label(&r.settings),
        series: series(r),
        at: [r.cost.seconds, r.errors.all.rmse],
        front: r.front,
    };
    let points: Vec<Point> = rows.iter().filter(|r| r.errors.all.rmse.is_finite()).map(point).collect();
    let sample = rows.iter().find(|r| r.judged.cells.is_some());
    let title = match sample {
        None => format!("stage {}: time against error", job.stage.name),
        Some(r) => format!("stage {}: time against error on {}", job.stage.name, r.judged.text()),
    };
    plot::svg(&title, "seconds", "rmse", &points)
}

#[cfg(test)]
mod tests {
    use super::super::settings::{combinations, tests::job};
    use super::*;
    use crate::config::Sample;

    fn row(settings: Table, seconds: f64, rmse: f64) -> Row {
        let all = Difference { rmse, mae: 0.0, bias: 0.0, max_abs: 0.0, p99: 0.0, ssim: None, n: 1, missing: [0; 2] };
        Row {
            settings,
            cost: Cost { seconds, ..Cost::default() },
            errors: Errors { surface: Some(all.clone()), all, windows: None },
            judged: Judged::choose([130; 3], Sample::Bricks(2), 5),
            front: false,
        }
    }

    #[test]
    fn the_front_has_what_nothing_beats() {
        let row = |seconds, rmse| row(Table::new(), seconds, rmse);
        let mut rows = [row(1.0, 0.5), row(2.0, 0.1), row(2.0, 0.2), row(3.0, 0.1), row(0.5, f64::NAN)];
        mark_front(&mut rows);
        assert_eq!(rows.each_ref().map(|r| r.front), [true, true, false, false, false]);
        let shown = text(&rows, true);
        assert_eq!(shown.matches("\x1b[2m").count(), 3, "what is beaten is dimmed: {shown}");
        assert!(shown.contains("of 2197000 voxels") && shown.contains("(2 of 27 bricks of 64^3, seed 5)"), "{shown}");
        assert!(!text(&rows, false).contains('\x1b'));
    }

    #[test]
    fn the_cheapest_within_a_bound_is_named_with_its_lines() {
        let job = job("[pareto]\nstage=\"ao\"\nvary={ method=[\"chebyshev\", \"cdf_power\"] }").unwrap();
        let settings = combinations(&job);
        let rows = [row(settings[0].clone(), 1.0, 0.4), row(settings[1].clone(), 2.0, 0.1)];
        let said = advice(&job, &rows, 0.2);
        assert!(said.ends_with("[stage.ao]\nmethod = \"cdf_power\""), "{said}");
        assert!(advice(&job, &rows, 0.5).contains("method=chebyshev"));
        assert!(advice(&job, &rows, 0.01).contains("no combination"));
        // A quantity that is not a number is within no bound.
        assert!(cheapest(&[row(Table::new(), 1.0, f64::NAN)], 1.0).is_none());
    }

    #[test]
    fn csv_has_a_cell_for_every_column() {
        let job = job("[pareto]\nstage=\"ao\"\nvary={ radius=[[1, 2, 3], 2], device=[\"cpu\"] }").unwrap();
        let rows: Vec<Row> = combinations(&job).into_iter().map(|s| row(s, 1.0, 0.4)).collect();
        let text = csv(&job, &rows);
        let lines: Vec<&str> = text.lines().collect();
        assert!(
            lines[0].starts_with("radius,device,seconds,rmse,mae,bias,p99,max_abs,ssim,rmse_vary,"),
            "{}",
            lines[0]
        );
        assert!(lines[1].starts_with("\"[1, 2, 3]\",cpu,1,0.4,"), "{}", lines[1]);
        assert_eq!(lines[2].split(',').count(), lines[0].split(',').count());
        assert!(lines[0].contains(",p99_edge,") && lines[0].ends_with("judged_voxels,of_voxels,front"));
    }
}
