//! The configuration: TOML text to typed, checked values.
//!
//! [`tree`] keeps lines and applies `--set`; [`keys`] is the one table of keys; [`section`] reads a table through it;
//! [`inputs`], [`stages`], [`outputs`] and [`mod@pareto`] build the [`model`]; [`check`] looks at the graph as a whole.

pub mod check;
pub mod hash;
pub mod inputs;
pub mod keys;
pub mod kinds;
pub mod model;
pub mod outputs;
pub mod pareto;
pub mod provenance;
pub mod read;
pub mod schema;
pub mod section;
pub mod stages;
pub mod suggest;
pub mod tree;
pub mod units;

use std::path::{Path, PathBuf};

pub use hash::config_hash;
pub use keys::op_channels;
pub use model::*;
pub use pareto::{Pareto, Sample};
pub use provenance::{provenance, stage_constants, stage_parameters};
pub use schema::schema;

use crate::{Error, Result};
use keys::Section;
use section::{Reader, error};
use tree::{Edit, Node, Table, Value};

/// Top-level tables.
const TABLES: [&str; 5] = ["run", "input", "stage", "output", "pareto"];
/// Larger files are no configs.
const MAX_BYTES: u64 = 16 << 20;

/// Reads a config file, applies `--set key=value` edits and checks everything that needs no other file.
pub fn load(path: &Path, sets: &[String]) -> Result<Config> {
    let refuse =
        |message: String| Error::Config { file: Some(path.to_path_buf()), line: None, key: String::new(), message };
    let meta = std::fs::metadata(path).map_err(|e| refuse(format!("cannot read the config: {e}")))?;
    if meta.is_dir() {
        return Err(refuse("is a folder; expected a config file".into()));
    }
    if meta.len() > MAX_BYTES {
        return Err(refuse(format!("{} bytes are too many for a config (at most {MAX_BYTES})", meta.len())));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(format!("cannot read the config: {e}")))?;
    let text = String::from_utf8(bytes).map_err(|_| refuse("the config is not UTF-8 text".into()))?;
    parse(&text, path, sets)
}

/// Like [`load`], from text; `file` names it in errors, and its folder is where relative paths start.
pub fn parse(text: &str, file: &Path, sets: &[String]) -> Result<Config> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    build(text, file, sets).map_err(|e| e.located(file, None))
}

fn build(text: &str, file: &Path, sets: &[String]) -> Result<Config> {
    let mut root = tree::parse(text).map_err(|f| error(&f.key, f.line, f.message))?;
    let mut document = text.parse::<toml_edit::DocumentMut>().ok();
    for set in sets {
        let edit = Edit::parse(set).map_err(|m| error("", None, m))?;
        edit.apply(&mut root).map_err(|m| error(&edit.key(), None, format!("--set {set}: {m}")))?;
        if let Some(document) = &mut document {
            edit.apply_to_text(document);
        }
    }
    let text = document.filter(|_| !sets.is_empty()).map_or_else(|| text.to_string(), |d| d.to_string());
    for (name, node) in &root {
        if !TABLES.contains(&name.as_str()) {
            let hint = suggest::hint(name, TABLES);
            return Err(error(name, node.line, format!("no such table{hint}; accepted: {}", TABLES.join(", "))));
        }
    }
    let base = file.parent().unwrap_or(Path::new(""));
    let names = Names::collect(&root)?;
    let config = Config {
        file: file.to_path_buf(),
        text,
        run: read_run(&root, base)?,
        inputs: members(&root, "input")?.map(|(name, node)| inputs::read(name, node, base)).collect::<Result<_>>()?,
        stages: members(&root, "stage")?.map(|(name, node)| stages::read(name, node, &names)).collect::<Result<_>>()?,
        outputs: members(&root, "output")?
            .map(|(name, node)| outputs::read(name, node, base, &names))
            .collect::<Result<_>>()?,
        pareto: tree::find(&root, "pareto").map(|n| pareto::read(n, base, &names)).transpose()?,
    };
    check::check(&config)?;
    Ok(config)
}

/// Named tables of one kind: the entries of `[input]`, `[stage]` or `[output]`.
fn members<'a>(root: &'a Table, kind: &str) -> Result<std::slice::Iter<'a, (String, Node)>> {
    match tree::find(root, kind) {
        None => Ok([].iter()),
        Some(Node { value: Value::Table(t), .. }) => Ok(t.iter()),
        Some(node) => Err(error(kind, node.line, format!("got {node}; expected tables [{kind}.NAME]"))),
    }
    .map(|iter: std::slice::Iter<'a, (String, Node)>| iter)
}

fn read_run(root: &Table, base: &Path) -> Result<Run> {
    let empty = Node { value: Value::Table(Vec::new()), line: None, set: false };
    let node = tree::find(root, "run").unwrap_or(&empty);
    let r = Reader::new(Section::Run, "run".into(), "", node)?;
    let devices =
        [("auto", Device::Auto), ("cpu", Device::Cpu), ("gpu", Device::Gpu), ("gpu:software", Device::GpuSoftware)];
    Ok(Run {
        memory: r.get("memory", read::bytes)?,
        threads: r.int("threads")? as usize,
        device: r.choice("device", &devices)?,
        brick: r.get("brick", read::brick)?,
        region: r.get("region", read::region)?,
        scratch: r.get("scratch", |n| read::non_empty(n).map(|s| (s != "auto").then(|| base.join(s))))?,
        lanes: r.choice("lanes", &[("pure", Lanes::Pure), ("mixed", Lanes::Mixed)])?,
        place: r.place,
    })
}

/// Names of inputs and stages, for references.
pub struct Names {
    /// Name, and the `op` of stages.
    known: Vec<(String, Option<String>)>,
}

impl Names {
    fn collect(root: &Table) -> Result<Names> {
        let mut known: Vec<(String, Option<String>)> = Vec::new();
        for kind in ["input", "stage", "output"] {
            for (name, node) in members(root, kind)? {
                let key = format!("{kind}.{name}");
                check_name(name).map_err(|m| error(&key, node.line, m))?;
                if kind == "output" {
                    continue;
                }
                if known.iter().any(|(n, _)| n == name) {
                    let message =
                        format!("the name {name:?} is taken by an input; inputs and stages need different names");
                    return Err(error(&key, node.line, message));
                }
                let op = match &node.value {
                    Value::Table(t) if kind == "stage" => Some(match tree::find(t, "op").map(|n| &n.value) {
                        Some(Value::Text(op)) => op.clone(),
                        _ => String::new(),
                    }),
                    _ => None,
                };
                known.push((name.clone(), op));
            }
        }
        Ok(Names { known })
    }

    /// `name` or `stage.channel`; a name that holds dots is tried as a whole first.
    pub fn resolve(&self, text: &str) -> Result<Ref, read::Bad> {
        if self.op_of(text).is_some() {
            return Ok(Ref { name: text.to_string(), channel: None });
        }
        let names = || self.known.iter().map(|(n, _)| n.as_str());
        let unknown = |name: &str| {
            let given: Vec<String> = names().take(20).map(|n| format!("{n:?}")).collect();
            format!(
                "no input or stage is named {name:?}{}; named are: {}",
                suggest::hint(name, names()),
                if given.is_empty() { "none".into() } else { given.join(", ") }
            )
        };
        let Some((name, channel)) = text.rsplit_once('.') else { return Err(unknown(text).into()) };
        let channels = match self.op_of(name) {
            None => return Err(unknown(name).into()),
            Some(None) => return Err(format!("{name:?} is an input, which has no named channels").into()),
            Some(Some(op)) => op_channels(op),
        };
        if !channels.contains(&channel) {
            let hint = suggest::hint(channel, channels.iter().copied());
            return Err(
                format!("stage {name:?} has no channel {channel:?}{hint}; it has {}", channels.join(", ")).into()
            );
        }
        Ok(Ref { name: name.to_string(), channel: Some(channel.to_string()) })
    }

    /// `None`: no such name; `Some(None)`: an input; else the stage's `op` as typed.
    pub fn op_of(&self, name: &str) -> Option<Option<&str>> {
        self.known.iter().find(|(n, _)| n == name).map(|(_, op)| op.as_deref())
    }
}

fn check_name(name: &str) -> Result<(), String> {
    let bad = |c: char| c.is_control() || c == '/' || c == '\\';
    if name.is_empty() || name.chars().count() > 100 || name.chars().any(bad) || name.trim() != name {
        return Err(format!("{name:?} cannot be a name; expected 1 to 100 characters without slashes and line breaks"));
    }
    Ok(())
}

/// A path of the config: relative ones start at its folder.
fn join_path(node: &Node, base: &Path) -> Result<PathBuf, read::Bad> {
    let text = read::non_empty(node)?;
    if text.contains('\0') { Err("a path cannot hold a NUL".into()) } else { Ok(base.join(text)) }
}
