//! `[pareto]`: what `occlude pareto` compares, to [`Pareto`].

use std::path::{Path, PathBuf};

use toml::{Table, Value};

use super::keys::Section;
use super::section::Reader;
use super::tree::{self, Node};
use super::{Names, Place, Ref, join_path, read};
use crate::Result;

/// Most combinations of one table.
pub const MAX_RUNS: usize = 1000;

/// The table `[pareto]`.
#[derive(Debug, Clone)]
pub struct Pareto {
    /// The stage that is varied, and the channel that is measured (`None`: its main one).
    pub stage: Ref,
    /// Keys in which a combination's truth differs from it; `None`: the truth that fits the stage.
    pub reference: Option<Table>,
    /// Values by key, in the order of the file.
    pub vary: Vec<(String, Vec<Value>)>,
    pub folder: PathBuf,
    pub repeat: u32,
    pub keep: bool,
    pub sample: Sample,
    pub seed: u64,
    pub place: Place,
}

/// How much of a volume is judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sample {
    /// All of it, or so many bricks that the truth stays affordable.
    Auto,
    All,
    /// So many bricks.
    Bricks(u64),
    /// A share of the bricks, above 0 and at most 1.
    Share(f64),
}

/// Reads the table.
pub fn read(node: &Node, base: &Path, names: &Names) -> Result<Pareto> {
    let r = Reader::new(Section::Pareto, "pareto".into(), "", node)?;
    let vary = r.get("vary", vary)?;
    let runs = vary.iter().try_fold(1usize, |n, (_, v)| n.checked_mul(v.len())).filter(|n| *n <= MAX_RUNS);
    if runs.is_none() || vary.is_empty() {
        return Err(r.error("vary", format!("expected 1 to {MAX_RUNS} combinations")));
    }
    Ok(Pareto {
        stage: r.get("stage", |n| stage(n, names))?,
        reference: r.opt("reference", table)?,
        vary,
        folder: r.get("folder", |n| join_path(n, base))?,
        repeat: r.int("repeat")? as u32,
        keep: r.get("keep", read::boolean)?,
        sample: r.get("sample", sample)?,
        seed: r.int("seed")? as u64,
        place: r.place,
    })
}

fn stage(node: &Node, names: &Names) -> Result<Ref, read::Bad> {
    let found = names.resolve(read::non_empty(node)?)?;
    match names.op_of(&found.name) {
        Some(Some(_)) => Ok(found),
        _ => Err(format!("{:?} is an input; only stages can be varied", found.name).into()),
    }
}

fn table(node: &Node) -> Result<Table, read::Bad> {
    match &node.value {
        tree::Value::Table(t) => Ok(read::toml_table(t)),
        _ => Err(String::new().into()),
    }
}

fn vary(node: &Node) -> Result<Vec<(String, Vec<Value>)>, read::Bad> {
    let tree::Value::Table(lists) = &node.value else { return Err(String::new().into()) };
    let mut values = table(node)?;
    let list = |(key, node): &(String, Node)| match values.remove(key) {
        Some(Value::Array(list)) if !list.is_empty() => Ok((key.clone(), list)),
        _ => Err(read::Bad { key: Some(key.clone()), line: node.line, reason: format!("{node} is no list of values") }),
    };
    lists.iter().map(list).collect()
}

/// `"auto"`, `"all"`, a number of bricks, or a share in per cent.
fn sample(node: &Node) -> Result<Sample, read::Bad> {
    if let tree::Value::Int(_) = node.value {
        return read::integer(node, 1, i64::MAX).map(|n| Sample::Bricks(n as u64));
    }
    match read::text(node)? {
        "auto" => Ok(Sample::Auto),
        "all" => Ok(Sample::All),
        text => {
            let number = text.strip_suffix('%').and_then(|n| n.trim().parse::<f64>().ok());
            let share = number.filter(|n| *n > 0.0 && *n <= 100.0);
            share.map(|n| Sample::Share(n / 100.0)).ok_or_else(|| String::new().into())
        }
    }
}
