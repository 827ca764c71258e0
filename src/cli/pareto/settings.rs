//! Combinations of settings, their names, and the configs that run them.

use std::path::Path;

use toml::{Table, Value};

use super::super::args::ParetoArgs;
use super::super::load;
use crate::Result;
use crate::config::{Config, Device, Pareto, StageNode};

/// Name of the one output that is measured.
const OUTPUT: &str = "pareto";
/// Key of `vary` that is not the stage's: `run.device`.
pub const DEVICE: &str = "device";

/// Every choice of one value per key; the first key varies slowest.
pub fn combinations(job: &Pareto) -> Vec<Table> {
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

/// `method=cdf_power radius=5`.
pub fn label(settings: &Table) -> String {
    let parts: Vec<String> = settings.iter().map(|(k, v)| format!("{k}={}", plain(v))).collect();
    if parts.is_empty() { "as configured".into() } else { parts.join(" ") }
}

/// A value as a word.
pub fn plain(v: &Value) -> String {
    v.as_str().map_or_else(|| v.to_string(), String::from)
}

/// The lines of the config for a combination.
pub fn lines(job: &Pareto, settings: &Table) -> String {
    let line = |(k, v): (&String, &Value)| format!("{} = {v}", toml_edit::Key::new(k));
    let mut lines = Vec::new();
    if let Some(device) = settings.get_key_value(DEVICE) {
        lines.extend(["[run]".to_string(), line(device), String::new()]);
    }
    lines.push(format!("[stage.{}]", toml_edit::Key::new(&job.stage.name)));
    lines.extend(settings.iter().filter(|(k, _)| *k != DEVICE).map(line));
    lines.join("\n")
}

/// The config with these settings and, as its only output, the measured channel, unrounded, level 0.
pub fn variant(args: &ParetoArgs, job: &Pareto, settings: &Table, path: &Path) -> Result<Config> {
    let key = |name: &str| toml_edit::Key::new(name).to_string();
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let path = Value::String(absolute.to_string_lossy().into_owned());
    let channel = job.stage.channel.as_ref().map(|c| format!(".{c}")).unwrap_or_default();
    let from = Value::String(job.stage.name.clone() + &channel);
    let set = |(k, v): (&String, &Value)| match k.as_str() {
        DEVICE => format!("run.device={v}"),
        k => format!("stage.{}.{}={v}", key(&job.stage.name), key(k)),
    };
    let mut sets: Vec<String> = settings.iter().map(set).collect();
    sets.push(format!(
        "output.{OUTPUT}={{ path = {path}, from = {from}, dtype = \"native\", levels = 1, codec = \"none\" }}"
    ));
    let mut config = load(&args.config, &sets)?;
    config.outputs.retain(|o| o.name == OUTPUT);
    if let Some(device) = settings.get(DEVICE).and_then(Value::as_str) {
        // A flag --device does not undo what is varied.
        config.run.device = match device {
            "cpu" => Device::Cpu,
            "gpu" => Device::Gpu,
            "gpu:software" => Device::GpuSoftware,
            _ => Device::Auto,
        };
    }
    Ok(config)
}

/// The stage that a config varies.
pub fn node<'c>(config: &'c Config, job: &Pareto) -> Option<&'c StageNode> {
    config.stages.iter().find(|s| s.name == job.stage.name)
}

/// Takes out of settings, which also have the keys `reference`, what their stage would refuse beside them: a truth that
/// counts has no levels.
pub fn agreeing(mut settings: Table) -> Table {
    let counts = |m: &Value| m.as_str() != Some("levels");
    if settings.get("method").is_some_and(counts) {
        settings.remove("level_count");
    }
    settings
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// The table of a config with one stage `ao`.
    pub fn job(pareto: &str) -> Result<Pareto> {
        let text = format!(
            "[input.ct]\npath=\"a.nrrd\"\n[stage.ao]\nop=\"ambient_occlusion\"\ninput=\"ct\"\nradius=1\nmethod=\"exact\"\n[output.o]\npath=\"o.zarr\"\nfrom=\"ao\"\n{pareto}"
        );
        let config = crate::config::parse(&text, Path::new("/c/x.toml"), &[])?;
        super::super::table_of(&config).cloned()
    }

    #[test]
    fn combinations_are_the_product() {
        let job =
            job("[pareto]\nstage=\"ao\"\nvary={ method=[\"chebyshev\", \"cdf_power\"], radius=[1, 2, 3] }").unwrap();
        let all = combinations(&job);
        assert_eq!(all.len(), 6);
        assert_eq!(label(&all[1]), "method=chebyshev radius=2");
        assert_eq!(job.folder, Path::new("/c/pareto"));
    }

    #[test]
    fn the_lines_to_copy_name_the_device_where_it_varies() {
        let job = job("[pareto]\nstage=\"ao\"\nvary={ device=[\"gpu:software\"], radius=[2] }").unwrap();
        let all = combinations(&job);
        assert_eq!(lines(&job, &all[0]), "[run]\ndevice = \"gpu:software\"\n\n[stage.ao]\nradius = 2");
    }

    #[test]
    fn a_truth_that_counts_has_no_levels() {
        let settings = |text: &str| text.parse::<Table>().unwrap();
        assert_eq!(label(&agreeing(settings("level_count = 16\nmethod = \"exact\""))), "method=exact");
        assert_eq!(agreeing(settings("level_count = 16\nmethod = \"levels\"")).len(), 2);
        assert_eq!(agreeing(settings("level_count = 16")).len(), 1);
    }
}
