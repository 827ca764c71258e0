//! `occlude info`.

use std::fmt::Write;

use serde_json::{Value, json};

use super::args::InfoArgs;
use super::attributes::{self, Attributes};
use super::moments::{Histogram, Moments};
use super::progress::{Count, Shown};
use super::reader::{self, Volume};
use super::{human, messages};
use crate::Result;
use crate::run::{Cancel, Progress};
use crate::store::{Source, VolumeInfo};

const BINS: usize = 64;

/// Prints what a volume is.
pub fn run(args: &InfoArgs, quiet: bool) -> Result<()> {
    let attributes = attributes::read(&args.path);
    let cancel = messages::interrupts();
    let statistics = if args.stats { Some(statistics(args, &cancel, quiet)?) } else { None };
    let info = match &statistics {
        Some((info, _)) if args.level == 0 => info.clone(),
        _ => Source::open(&reader::described(&args.path, 0, &args.raw, &attributes)?)?.info().clone(),
    };
    let levels = levels(args, &info, &attributes);
    let warnings = warnings(&info, &attributes);
    let statistics = statistics.map(|(_, s)| s);
    if args.json {
        let json = as_json(args, &info, &attributes, &levels, &warnings, statistics.as_deref());
        return messages::result_json(&json);
    }
    messages::result(&as_text(args, &info, &attributes, &levels, &warnings, statistics.as_deref()))
}

/// Shape, spacing and origin of each level, fine to coarse.
fn levels(args: &InfoArgs, first: &VolumeInfo, attributes: &Attributes) -> Vec<VolumeInfo> {
    let open = |level: usize| {
        let input = reader::described(&args.path, level, &args.raw, attributes).ok()?;
        Source::open(&input).ok().map(|s| s.info().clone())
    };
    std::iter::once(first.clone()).chain((1..attributes.datasets.len()).map_while(open)).collect()
}

fn warnings(info: &VolumeInfo, attributes: &Attributes) -> Vec<String> {
    let mut found = info.warnings.clone();
    if attributes.complete() == Some(false) {
        found.push("this output was not finished".to_string());
    }
    if info.unit.is_none() {
        found.push("no unit of length is known: physical lengths need `unit` in the config".to_string());
    }
    let long = || (0..3).filter(|&a| info.shape[a] > 1).map(|a| info.spacing[a]);
    let (least, most) = (long().fold(f64::INFINITY, f64::min), long().fold(0.0, f64::max));
    if most > 3.0 * least {
        found.push(format!(
            "spacing differs by {} between axes: a window of one radius in voxels is that much longer on one axis; a physical radius evens it out",
            human::number(most / least)
        ));
    }
    if info.orientation.as_ref().is_some_and(|o| o.straight_origin().is_none()) {
        found.push(
            "the direction matrix is not diagonal and positive: origin 0 is used, and the matrix is kept as orientation".into(),
        );
    }
    found
}

/// Statistics of one component.
struct Statistics {
    moments: Moments,
    histogram: Histogram,
}

fn statistics(args: &InfoArgs, cancel: &Cancel, quiet: bool) -> Result<(VolumeInfo, Vec<Statistics>)> {
    let volume = Volume::open(&args.path, args.level, &args.raw, cancel)?;
    let components = volume.info().components.max(1);
    let shown = Shown::patient(quiet);
    let each = (0..components).map(|c| of_component(&volume, c, cancel, &shown)).collect::<Result<_>>();
    shown.finish();
    Ok((volume.info().clone(), each?))
}

fn of_component(volume: &Volume, component: usize, cancel: &Cancel, progress: &dyn Progress) -> Result<Statistics> {
    // Types of few values: one pass with a bin per value, joined afterwards. Others: the range first.
    let (lo, hi) = volume.info().dtype.range();
    let fine = (volume.info().dtype.size() <= 2).then(|| {
        let ends = [volume.affine.apply(lo), volume.affine.apply(hi)];
        let codes = (hi - lo) as usize + 1;
        let half = (ends[1] - ends[0]).abs() / (codes - 1) as f64 / 2.0;
        Histogram::new(ends[0].min(ends[1]) - half, ends[0].max(ends[1]) + half, codes)
    });
    let mut fine = fine;
    let mut moments = Moments::default();
    let count = || Count::new(progress, "statistics", volume.info().voxels());
    volume.each_plane(component, cancel, &mut count(), &mut |plane| {
        moments = moments.merge(Moments::of(plane));
        if let Some(fine) = &mut fine {
            fine.add(plane);
        }
    })?;
    // Infinities have no bin.
    let ends = if moments.n == 0 { [0.0, 0.0] } else { moments.finite };
    let mut histogram = Histogram::new(ends[0], ends[1], BINS);
    match fine {
        Some(fine) => {
            let width = (fine.hi - fine.lo) / fine.counts.len() as f64;
            for (i, count) in fine.counts.iter().enumerate().filter(|(_, c)| **c > 0) {
                let centre = (fine.lo + (i as f64 + 0.5) * width).clamp(histogram.lo, histogram.hi);
                histogram.add_times(centre, *count);
            }
        }
        None => volume.each_plane(component, cancel, &mut count(), &mut |plane| histogram.add(plane))?,
    }
    Ok(Statistics { moments, histogram })
}

fn level_json(info: &VolumeInfo) -> Value {
    json!({"shape": info.shape, "spacing": info.spacing, "origin": info.origin, "chunk": info.chunk})
}

fn as_json(
    args: &InfoArgs,
    info: &VolumeInfo,
    attributes: &Attributes,
    levels: &[VolumeInfo],
    warnings: &[String],
    statistics: Option<&[Statistics]>,
) -> Value {
    let mut json = json!({
        "path": args.path.display().to_string(),
        "format": info.format,
        "shape": info.shape,
        "dtype": info.dtype.name(),
        "components": info.components,
        "component_names": info.component_names,
        "times": info.times,
        "voxels": info.voxels(),
        "spacing": info.spacing,
        "unit": info.unit,
        "origin": info.origin,
        "slope": info.affine.slope,
        "intercept": info.affine.intercept,
        "nodata": info.nodata,
        "chunk": info.chunk,
        "levels": levels.iter().map(level_json).collect::<Vec<_>>(),
        "orientation": info.orientation.as_ref().map(|o| json!({"matrix": o.matrix, "space": o.space})),
        "occlude": attributes.occlude,
        "warnings": warnings,
    });
    if let Some(statistics) = statistics {
        let of = |s: &Statistics| {
            let m = &s.moments;
            let known = |v: f64| if m.n == 0 { Value::Null } else { json!(v) };
            json!({
                "level": args.level, "min": known(m.min), "max": known(m.max), "mean": known(m.mean),
                "variance": known(m.variance()), "std": known(m.variance().sqrt()), "count": m.n,
                "missing": m.missing, "infinite": m.infinite,
                "histogram": {"lo": s.histogram.lo, "hi": s.histogram.hi, "counts": s.histogram.counts},
            })
        };
        let all: Vec<Value> = statistics.iter().map(of).collect();
        json["stats"] = if all.len() == 1 { all.into_iter().next().unwrap_or_default() } else { Value::Array(all) };
    }
    json
}

fn as_text(
    args: &InfoArgs,
    info: &VolumeInfo,
    attributes: &Attributes,
    levels: &[VolumeInfo],
    warnings: &[String],
    statistics: Option<&[Statistics]>,
) -> String {
    let mut t = String::new();
    let triple = |v: [f64; 3]| v.map(human::number).join(", ");
    let unit = info.unit.as_deref().unwrap_or("unknown unit");
    let _ = writeln!(t, "{}", args.path.display());
    let _ = writeln!(t, "  format    {}", info.format);
    let _ = writeln!(
        t,
        "  shape     {} (z, y, x), {} voxels",
        human::extent(info.shape),
        human::count(info.voxels() as f64)
    );
    let bytes = info.voxels() as u64 * info.dtype.size() as u64 * info.components.max(1) as u64;
    let _ = writeln!(t, "  dtype     {}, {} unpacked", info.dtype, human::bytes(bytes));
    if info.components > 1 {
        let _ = writeln!(t, "  channels  {} {}", info.components, info.component_names.join(", "));
    }
    if info.times > 1 {
        let _ = writeln!(t, "  times     {}; inputs read the first unless `time` says another", info.times);
    }
    let _ = writeln!(t, "  spacing   {} (z, y, x), {unit}", triple(info.spacing));
    let _ = writeln!(t, "  origin    {} (z, y, x)", triple(info.origin));
    if !info.affine.is_identity() {
        let (a, b) = (human::number(info.affine.slope), human::number(info.affine.intercept));
        let _ = writeln!(t, "  scaling   {a} * stored + {b}");
    }
    if let Some(nodata) = info.nodata {
        let _ = writeln!(t, "  nodata    {}", human::number(nodata));
    }
    for (i, level) in levels.iter().enumerate().filter(|_| levels.len() > 1 || info.chunk.is_some()) {
        let chunk = level.chunk.map_or(String::new(), |c| format!(", chunks of {}", human::extent(c)));
        let _ = writeln!(t, "  level {i:<3} {}, spacing {}{chunk}", human::extent(level.shape), triple(level.spacing));
    }
    if let Some(occlude) = &attributes.occlude {
        let _ = writeln!(t, "  written by occlude:");
        for (key, value) in occlude.as_object().into_iter().flatten().filter(|(k, _)| *k != "config") {
            let _ = writeln!(t, "    {key}: {value}");
        }
    }
    for (i, s) in statistics.into_iter().flatten().enumerate() {
        statistics_text(&mut t, i, s);
    }
    warnings.iter().for_each(|w| {
        let _ = writeln!(t, "  warning: {w}");
    });
    t
}

fn statistics_text(t: &mut String, component: usize, s: &Statistics) {
    let m = &s.moments;
    let _ = writeln!(t, "  values of component {component}");
    let _ = writeln!(t, "    count {}, missing {}, infinite {}", m.n, m.missing, m.infinite);
    if m.n == 0 {
        return;
    }
    let shown = [m.min, m.max, m.mean, m.variance(), m.variance().sqrt()].map(human::number);
    let _ = writeln!(
        t,
        "    min {}, max {}, mean {}, variance {}, std {}",
        shown[0], shown[1], shown[2], shown[3], shown[4]
    );
    let most = s.histogram.counts.iter().copied().max().unwrap_or(1).max(1) as f64;
    // Four bins a line keep it short; the JSON has all.
    let width = (s.histogram.hi - s.histogram.lo) / s.histogram.counts.len() as f64;
    for (i, four) in s.histogram.counts.chunks(4).enumerate() {
        let from = s.histogram.lo + width * (4 * i) as f64;
        let sum: u64 = four.iter().sum();
        let bar = "#".repeat(((sum as f64 / most / 4.0).sqrt() * 40.0).ceil() as usize);
        let _ = writeln!(t, "    {:>12} {sum:>12} {bar}", human::number(from));
    }
}
