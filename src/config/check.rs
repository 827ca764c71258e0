//! Checks of the graph as a whole: cycles, channels, ranges, paths. No file is opened.

use std::path::{Component, Path, PathBuf};

use super::section::error;
use super::{Config, Op, Output, OutputDType, OutputRange, Place, Ref, StageNode, op_channels};
use crate::stage::{Method, Reduce};
use crate::{Error, Result};

/// Everything that a config can be refused for after its tables have been read.
pub fn check(config: &Config) -> Result<()> {
    cycles(config)?;
    for stage in &config.stages {
        for (key, reference) in stage.reads() {
            channel_exists(config, reference).map_err(|m| stage.place.error(key, m))?;
        }
    }
    if config.outputs.is_empty() {
        return Err(error("output", None, "no output; expected at least one table [output.NAME]".into()));
    }
    for output in &config.outputs {
        check_output(config, output)?;
    }
    paths(config)
}

impl StageNode {
    /// What it reads with its `where`, by key.
    pub fn reads(&self) -> Vec<(&'static str, &Ref)> {
        let mut reads = self.op.reads();
        reads.extend(self.where_.iter().map(|w| ("where", &w.input)));
        reads
    }
}

impl Config {
    /// Gives an error of a later step (planning, opening) the file and the line of the key that it names, as far as the
    /// file has that key; else the line of the table.
    pub fn locate(&self, error: Error) -> Error {
        let Error::Config { file: None, line: None, key, .. } = &error else { return error };
        let line = self.line_of(key);
        error.located(&self.file, line)
    }

    /// The line of a key, as [`Config::locate`] finds it.
    pub fn line_of(&self, key: &str) -> Option<usize> {
        let places = std::iter::once(&self.run.place)
            .chain(self.inputs.iter().map(|i| &i.place))
            .chain(self.stages.iter().map(|s| &s.place))
            .chain(self.outputs.iter().map(|o| &o.place));
        // Names may hold dots: the longest table wins.
        let within =
            |place: &&Place| key == place.key || key.strip_prefix(&place.key).is_some_and(|r| r.starts_with('.'));
        let place = places.filter(within).max_by_key(|p| p.key.len())?;
        let rest = key.get(place.key.len() + 1..).unwrap_or_default();
        let named = |k: &str| rest == k || rest.strip_prefix(k).is_some_and(|r| r.starts_with('.'));
        place.lines.iter().find(|(k, _)| named(k)).map(|(_, line)| *line).or(place.line)
    }

    pub fn stage(&self, name: &str) -> Option<&StageNode> {
        self.stages.iter().find(|s| s.name == name)
    }

    /// The channel of a stage that a reference means; `None` for inputs.
    pub fn channel_of<'a>(&'a self, reference: &'a Ref) -> Option<&'a str> {
        let stage = self.stage(&reference.name)?;
        reference.channel.as_deref().or_else(|| op_channels(stage.op.word()).first().copied())
    }

    /// Names that outputs and the stages they need read; inputs among them are the ones that must exist.
    pub fn needed_names(&self) -> Vec<&str> {
        let stages = self.needed_stages();
        let read = stages.iter().flat_map(|s| s.reads()).map(|(_, r)| r.name.as_str());
        read.chain(self.outputs.iter().flat_map(|o| &o.from).map(|r| r.name.as_str())).collect()
    }

    /// Stages that outputs need, directly or not, in the order of the file.
    pub fn needed_stages(&self) -> Vec<&StageNode> {
        let mut needed = vec![false; self.stages.len()];
        let mut open: Vec<&Ref> = self.outputs.iter().flat_map(|o| &o.from).collect();
        while let Some(reference) = open.pop() {
            if let Some(at) = self.stages.iter().position(|s| s.name == reference.name)
                && !std::mem::replace(&mut needed[at], true)
            {
                open.extend(self.stages[at].reads().into_iter().map(|(_, r)| r));
            }
        }
        self.stages.iter().zip(needed).filter(|(_, n)| *n).map(|(s, _)| s).collect()
    }
}

fn cycles(config: &Config) -> Result<()> {
    // Stages whose inputs are all known are known; what is left over has a cycle in it or before it.
    let mut known = vec![false; config.stages.len()];
    let at = |name: &str| config.stages.iter().position(|s| s.name == name);
    loop {
        let mut changed = false;
        for (i, stage) in config.stages.iter().enumerate() {
            if !known[i] && stage.reads().iter().all(|(_, r)| at(&r.name).is_none_or(|j| known[j])) {
                known[i] = true;
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    let Some(start) = known.iter().position(|k| !k) else { return Ok(()) };
    // Walk back along unknown stages until one repeats: that is on the cycle.
    let back = |i: usize| {
        let unknown = |(key, r): (&'static str, &Ref)| at(&r.name).filter(|&j| !known[j]).map(|j| (key, j));
        config.stages[i].reads().into_iter().find_map(unknown)
    };
    let mut path: Vec<(usize, &str)> = Vec::new();
    let mut i = start;
    while let Some((key, next)) = back(i) {
        if let Some(first) = path.iter().position(|(seen, _)| *seen == i) {
            let names = path[first..].iter().map(|(s, _)| config.stages[*s].name.as_str());
            let round: Vec<&str> = names.chain([config.stages[i].name.as_str()]).collect();
            let message = format!("the stages read each other in a circle: {}", round.join(" <- "));
            return Err(config.stages[i].place.error(key, message));
        }
        path.push((i, key));
        i = next;
    }
    Ok(())
}

/// `rgb` of an obscurance stage exists only with `colour`, bounds of an openness only with `method = "moments4"`.
fn channel_exists(config: &Config, reference: &Ref) -> Result<(), String> {
    let stage = config.stage(&reference.name);
    match (stage.map(|s| &s.op), reference.channel.as_deref()) {
        (Some(Op::Obscurance(o)), Some("rgb")) if o.colour.is_none() => {
            Err(format!("stage {:?} has channel rgb only with its key `colour`", reference.name))
        }
        (Some(Op::AmbientOcclusion { method, .. }), Some(bound @ ("lower" | "upper")))
            if *method != Method::Moments4 =>
        {
            let word = super::stages::method_word(*method);
            let name = &reference.name;
            Err(format!("stage {name:?} has no channel {bound:?} with method {word:?}; method \"moments4\" has it"))
        }
        _ => Ok(()),
    }
}

fn check_output(config: &Config, output: &Output) -> Result<()> {
    for reference in &output.from {
        channel_exists(config, reference).map_err(|m| output.place.error("from", m))?;
        let Some(channel) = config.channel_of(reference) else { continue };
        let integer = matches!(output.dtype, Some(OutputDType::U8 | OutputDType::U16));
        if integer && channel != "openness" && output.range == OutputRange::Unset {
            let message = format!("missing; integers of channel {channel} need range = [lo, hi] or \"auto\"");
            return Err(output.place.error("range", message));
        }
        if output.reduce == Some(Reduce::Moments) && !["variance", "std"].contains(&channel) {
            let message = format!("got \"moments\" for channel {channel}; it is for variance and std");
            return Err(output.place.error("reduce", message));
        }
    }
    Ok(())
}

fn paths(config: &Config) -> Result<()> {
    let inputs: Vec<(&str, PathBuf)> =
        config.inputs.iter().filter_map(|i| Some((i.name.as_str(), resolved(i.kind.path()?)))).collect();
    let outputs: Vec<PathBuf> = config.outputs.iter().map(|o| resolved(&o.path)).collect();
    for (i, output) in config.outputs.iter().enumerate() {
        let path = &outputs[i];
        let refuse = |message: String| Err(output.place.error("path", format!("got {:?}; {message}", output.path)));
        if let Some(file) = path.ancestors().skip(1).find(|p| p.exists()).filter(|p| !p.is_dir()) {
            return refuse(format!("{} is a file; expected a path whose folders are, or can be made", file.display()));
        }
        let beside = work_folder(path);
        for (name, input) in &inputs {
            if input.starts_with(&beside) {
                return refuse(format!(
                    "input {name:?} lies in {}, where its run keeps what is unfinished",
                    beside.display()
                ));
            }
            if path == input {
                return refuse(format!("it is the path of input {name:?}; expected another one"));
            }
            if path.starts_with(input) {
                return refuse(format!("it lies inside input {name:?}; expected a path outside"));
            }
            if input.starts_with(path) {
                return refuse(format!("input {name:?} lies inside it; expected another path"));
            }
        }
        for (j, other) in outputs[..i].iter().enumerate() {
            if path.starts_with(work_folder(other)) || other.starts_with(&beside) {
                let name = &config.outputs[j].name;
                return refuse(format!("a folder NAME.occlude beside an output is its own; see output {name:?}"));
            }
            if path == other {
                return refuse(format!("output {:?} has the same path; expected another one", config.outputs[j].name));
            }
            if path.starts_with(other) || other.starts_with(path) {
                let name = &config.outputs[j].name;
                return refuse(format!(
                    "it and the path of output {name:?} lie inside each other; expected separate ones"
                ));
            }
        }
    }
    Ok(())
}

/// The folder beside an output in which sinks keep what is unfinished.
pub fn work_folder(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(".occlude");
    path.with_file_name(name)
}

/// Absolute, without `.` and `..`, links in the part that exists followed.
pub fn resolved(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let mut clean = PathBuf::new();
    for part in absolute.components() {
        match part {
            Component::CurDir => {}
            // After a link, `..` is the target's parent, so the link is followed first.
            Component::ParentDir => {
                clean = std::fs::canonicalize(&clean).unwrap_or(clean);
                clean.pop();
            }
            part => clean.push(part),
        }
    }
    let mut tail = Vec::new();
    let mut head = clean.clone();
    loop {
        if let Ok(real) = std::fs::canonicalize(&head) {
            return tail.into_iter().rev().fold(real, |p: PathBuf, part| p.join(part));
        }
        match (head.file_name().map(|n| n.to_os_string()), head.pop()) {
            (Some(name), true) => tail.push(name),
            _ => return clean,
        }
    }
}
