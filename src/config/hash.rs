//! The config hash: changes with everything that can change voxels or layout, and with nothing else.

use std::fmt::Write;

use super::{Config, InputKind};

/// Hex of a BLAKE3 hash over inputs' selection and overrides, the stages that outputs need, outputs and region.
///
/// Left out: memory, threads, brick, scratch, device (placement is kept by the journal), report paths, unused stages, lines
/// and comments, paths of outputs, and paths of inputs (the input's identity says more than its name). Numbers enter with
/// all their digits. The order of tables does not matter, that of lists does.
pub fn config_hash(config: &Config) -> String {
    let mut parts: Vec<String> = Vec::new();
    let stages = config.needed_stages();
    let used = config.needed_names();
    for i in config.inputs.iter().filter(|i| used.contains(&i.name.as_str())) {
        let kind = match &i.kind {
            InputKind::Path { raw, .. } => format!("{raw:?}"),
            synthetic => format!("{synthetic:?}"),
        };
        parts.push(format!(
            "input {:?} {kind} {} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
            i.name, i.level, i.array, i.channel, i.time, i.spacing, i.unit, i.origin, i.slope, i.intercept, i.nodata
        ));
    }
    for s in stages {
        parts.push(format!("stage {:?} {:?} {:?} {:?} {:?}", s.name, s.op, s.border, s.where_, s.fill));
    }
    for o in &config.outputs {
        parts.push(format!(
            "output {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
            o.name, o.format, o.from, o.dtype, o.range, o.chunk, o.shard, o.codec, o.levels, o.reduce
        ));
    }
    parts.sort();
    let mut text = String::from("occlude config 1\n");
    let _ = writeln!(text, "region {:?} lanes {:?}", config.run.region, config.run.lanes);
    text.push_str(&parts.join("\n"));
    blake3::hash(text.as_bytes()).to_hex().to_string()
}
