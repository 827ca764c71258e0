//! Opening, continuing and finishing outputs, and what they say about themselves.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::assemble::Target;
use super::journal;
use crate::config::{Config, Output, provenance, stage_constants, stage_parameters};
use crate::grid::Region;
use crate::kernel::reduce::planes;
use crate::plan::{Group, OutputPlan, Plan};
use crate::store::sink::{Claim, Existing, Sink, existing, remove_ours, waiting};
use crate::store::{Spill, VolumeInfo, os};
use crate::{Error, Result};

/// What is to be done with the outputs' paths as they are.
#[derive(Debug, PartialEq)]
pub enum Start {
    Afresh,
    /// Tasks that are done, and the pre-pass results found then.
    Resume {
        done: Vec<usize>,
        globals: Vec<Vec<f64>>,
    },
    /// Every output is complete already.
    Complete,
}

/// The folder that holds the journal: the last output's, since outputs are finished in order.
pub fn journal_dir(plan: &Plan) -> PathBuf {
    Sink::work_dir(&plan.outputs.last().expect("a config has outputs").spec.path)
}

/// Whether output `o` is complete and made by the config and from the inputs that a journal's header names.
pub fn is_complete(plan: &Plan, o: usize, header: &Value) -> bool {
    let Existing::Ours { complete: true, occlude: Some(attributes) } = existing(&plan.outputs[o].spec.path) else {
        return false;
    };
    let inputs = attributes["input"].as_array().into_iter().flatten().map(|i| &i["identity"]);
    missing_level(&plan.outputs[o]).is_none()
        && attributes["config_hash"] == header["config_hash"]
        && header["inputs"].as_array().is_some_and(|wanted| inputs.eq(wanted))
}

/// Claims the outputs that an earlier run began, before anything of them is read or deleted: one run at a time writes them.
pub fn claim_begun(config: &Config, plan: &Plan) -> Result<Vec<Option<Claim>>> {
    let claim = |o: &OutputPlan| Claim::existing(&o.spec.path).map_err(|_| busy(config, o));
    plan.outputs.iter().map(claim).collect()
}

/// Claims those that were not begun, or begun and now deleted.
pub fn claim_all(config: &Config, plan: &Plan, claims: &mut [Option<Claim>]) -> Result<()> {
    for (output, claim) in plan.outputs.iter().zip(claims) {
        if !claim.as_ref().is_some_and(Claim::holds) {
            let made = Claim::make(&output.spec.path).map_err(|e| of_path(config, output, e))?;
            *claim = Some(made.map_err(|_| busy(config, output))?);
        }
    }
    Ok(())
}

/// A file error told with the key that led to it: the path may be one that only the config can mend.
fn of_path(config: &Config, output: &OutputPlan, error: Error) -> Error {
    let Error::File { path, message } = error else { return error };
    let place = &config_output(config, output).place;
    let line = place.line_of("path").map(|n| format!(":{n}")).unwrap_or_default();
    Error::file(path, format!("{message}; see {}.path in {}{line}", place.key, config.file.display()))
}

fn busy(config: &Config, output: &OutputPlan) -> Error {
    refused(config, output, "is being written by another run; wait until that has ended, or stop it")
}

/// Decides by what lies at the outputs' paths. Deletes only what this program wrote.
pub fn start(config: &Config, plan: &Plan, header: &Value, resume: bool, overwrite: bool) -> Result<Start> {
    if overwrite {
        refuse_foreigners(config, plan)?;
        forget_tasks(plan)?;
        for output in &plan.outputs {
            clear(config, output)?;
        }
        return Ok(Start::Afresh);
    }
    let found: Vec<Existing> = plan.outputs.iter().map(|o| existing(&o.spec.path)).collect();
    if found.iter().all(|f| matches!(f, Existing::None)) {
        forget_tasks(plan)?;
        return Ok(Start::Afresh);
    }
    for (output, found) in plan.outputs.iter().zip(&found) {
        if matches!(found, Existing::Foreign) {
            return Err(refused(config, output, "exists and was not written by this program; choose another path"));
        }
        if !resume && !matches!(found, Existing::None) {
            return Err(refused(config, output, "exists; --resume continues it, --overwrite deletes it first"));
        }
    }
    let complete: Vec<bool> = (0..plan.outputs.len()).map(|o| is_complete(plan, o, header)).collect();
    if !complete.contains(&false) {
        return Ok(Start::Complete);
    }
    if let Some(earlier) = journal::Journal::read(&journal_dir(plan)) {
        if let Some(what) = journal::difference(&earlier.header, header) {
            let last = plan.outputs.last().expect("a config has outputs");
            let message = format!("was begun with other settings: {what} changed; --overwrite starts afresh");
            return Err(refused(config, last, &message));
        }
        // All are begun before the first task: one that is not there was deleted, and what tasks left in it is gone.
        let mut pairs = plan.outputs.iter().zip(&found);
        if pairs.all(|(output, found)| *found != Existing::None && missing_level(output).is_none()) {
            return Ok(Start::Resume { done: earlier.done, globals: journal::globals(&earlier.header) });
        }
    }
    make_others(config, plan, &found, &complete)
}

/// No task counts as done: killed before the journal's first line, or an output was deleted since. What is complete stays, the
/// others are made from the start.
fn make_others(config: &Config, plan: &Plan, found: &[Existing], complete: &[bool]) -> Result<Start> {
    let others = || plan.outputs.iter().zip(found).zip(complete).filter(|(_, complete)| !**complete);
    for ((output, found), _) in others() {
        if matches!(found, Existing::Ours { complete: true, .. }) {
            let message = match missing_level(output) {
                Some(level) => {
                    format!("is complete but for level {level}, which is gone; --overwrite deletes it first")
                }
                None => {
                    "is complete and was made with other settings or from another input; --overwrite deletes it first"
                        .to_string()
                }
            };
            return Err(refused(config, output, &message));
        }
    }
    forget_tasks(plan)?;
    for ((output, _), _) in others() {
        clear(config, output)?;
    }
    match complete.contains(&true) {
        true => Ok(Start::Resume { done: Vec::new(), globals: Vec::new() }),
        false => Ok(Start::Afresh),
    }
}

/// The first level of a Zarr output whose array is not there.
fn missing_level(output: &OutputPlan) -> Option<usize> {
    let there = |k: &usize| {
        let folder = output.spec.path.join(k.to_string());
        ["zarr.json", ".zarray"].iter().any(|name| folder.join(name).is_file())
    };
    (0..output.spec.pyramid.levels.len()).find(|k| output.is_zarr() && !there(k))
}

fn config_output<'a>(config: &'a Config, output: &OutputPlan) -> &'a Output {
    &config.outputs[output.index]
}

fn refused(config: &Config, output: &OutputPlan, what: &str) -> Error {
    let place = &config_output(config, output).place;
    place.error("path", format!("{} {what}", output.spec.path.display())).located(&config.file, place.line)
}

/// Removes all journals, durably, before anything goes that their tasks wrote: killed halfway, no task counts as done.
fn forget_tasks(plan: &Plan) -> Result<()> {
    for output in &plan.outputs {
        let dir = Sink::work_dir(&output.spec.path);
        journal::remove(&dir);
        if dir.is_dir() {
            os::sync_dir(&dir).map_err(|e| Error::file(&dir, format!("cannot remove the journal: {e}")))?;
        }
    }
    Ok(())
}

fn clear(config: &Config, output: &OutputPlan) -> Result<()> {
    let found = existing(&output.spec.path);
    refuse_foreign(config, output, &found)?;
    remove_ours(&output.spec.path)
}

/// Refuses to overwrite what this program did not write: all are looked at before the first is deleted.
pub fn refuse_foreigners(config: &Config, plan: &Plan) -> Result<()> {
    plan.outputs.iter().try_for_each(|output| refuse_foreign(config, output, &existing(&output.spec.path)))
}

fn refuse_foreign(config: &Config, output: &OutputPlan, found: &Existing) -> Result<()> {
    if !matches!(found, Existing::Foreign) {
        return Ok(());
    }
    Err(refused(config, output, "was not written by this program, so --overwrite leaves it alone"))
}

/// Opens every output of a group that is not complete.
///
/// # Errors
/// What tasks left in scratch (`begun`: some are done) is gone, or a file cannot be made.
pub fn open_target(
    plan: &Plan,
    group: &Group,
    o: usize,
    globals: &[Vec<f64>],
    scratch: Option<&Path>,
    resume: bool,
    begun: bool,
) -> Result<Target> {
    let output = &plan.outputs[o];
    let range = output.mapped(globals);
    let mut spec = output.spec.clone();
    if output.auto_range.is_some() {
        spec.fill = output.missing(0, range);
    }
    let sink = Sink::create(spec, resume)?;
    let deepest = output.brick_level();
    let two_phases = output.level_count() - 1 > deepest || (0..=deepest).any(|k| output.shared(k, group));
    let dir = match two_phases {
        true => waiting::folder(&output.spec.path, scratch, begun)?,
        false => Sink::work_dir(&output.spec.path),
    };
    let parts = output.spec.components.unwrap_or(1);
    let mut levels = Vec::new();
    let open = |name: String, shape, planes, item| {
        let path = dir.join(name);
        if begun { Spill::reopen(&path, shape, planes, item) } else { Spill::open(&path, shape, planes, item) }
    };
    for k in 0..=deepest {
        let shape = output.level(k).expect("level exists").shape;
        let level = || open(format!("level.{k}"), shape, parts, output.spec.dtype.size());
        levels.push(output.shared(k, group).then(level).transpose()?);
    }
    let cells = (output.level_count() - 1 > deepest).then(|| {
        let per_cell = if output.map.is_some() { 2 } else { parts * planes(output.reduce) };
        let shape = output.level(deepest).expect("level exists").shape;
        open(format!("cells.{deepest}"), shape, per_cell, size_of::<f64>())
    });
    Ok(Target { sink, levels, cells: cells.transpose()?, scratch: dir, range })
}

/// Commits what a finished task left in one output.
pub fn commit_task(group: &Group, output: &OutputPlan, target: &Target, task: Region) -> Result<()> {
    for k in output.first_level()..=output.brick_level() {
        if output.owned(k, group) {
            target.sink.commit(k - output.first_level(), output.level_box(k, task))?;
        }
    }
    for spill in target.levels.iter().flatten().chain(&target.cells) {
        spill.flush()?;
    }
    Ok(())
}

/// The attribute `occlude` of a finished output.
pub fn attributes(
    config: &Config,
    plan: &Plan,
    o: usize,
    infos: &[VolumeInfo],
    identities: &[Value],
    hash: &str,
    range: Option<[f64; 2]>,
) -> Value {
    let output = &plan.outputs[o];
    let lattice = &plan.graph.lattices[output.lattice];
    let from: Vec<String> = config_output(config, output)
        .from
        .iter()
        .map(|r| r.channel.as_ref().map_or(r.name.clone(), |c| format!("{}.{c}", r.name)))
        .collect();
    let inputs: Vec<Value> = config
        .inputs
        .iter()
        .zip(infos)
        .zip(identities)
        .map(|((input, info), identity)| {
            json!({
                "name": input.name, "identity": identity, "shape": info.shape, "dtype": info.dtype.numpy_name(),
                "spacing": info.spacing, "unit": info.unit, "slope": info.affine.slope,
                "intercept": info.affine.intercept, "nodata": info.nodata, "format": info.format,
            })
        })
        .collect();
    let methods: Vec<Value> = methods(config, &config_output(config, output).from);
    let integer = !output.spec.dtype.is_float();
    json!({
        "complete": true,
        "version": env!("CARGO_PKG_VERSION"),
        "config": provenance(&config.text),
        "config_hash": hash,
        "input": inputs,
        "from": from,
        "stages": methods,
        "dtype": output.spec.dtype.numpy_name(),
        "value_range": range.filter(|_| integer),
        "fill": json_number(if output.auto_range.is_some() { output.missing(0, range) } else { output.spec.fill }),
        "polarity": output.openness.then_some("openness: 1 is open, 0 is occluded"),
        "channel": channel_names(config, output),
        "units": lattice.unit,
        "spacing": lattice.spacing,
        "region": [output.region.lo, output.region.hi],
        "reduce": output.spec.reduce_name,
        "orientation": infos[lattice.input].orientation.as_ref().map(|o| json!({ "matrix_xyz": o.matrix, "space": o.space })),
    })
}

/// The channel's own name (`openness`, `variance`, ...; `value` for an input), a list where there are several.
fn channel_names(config: &Config, output: &OutputPlan) -> Value {
    let from = &config_output(config, output).from;
    let names: Vec<&str> = from.iter().map(|r| config.channel_of(r).unwrap_or("value")).collect();
    if let [one] = names[..] { json!(one) } else { json!(names) }
}

fn json_number(v: f64) -> Value {
    if v.is_finite() { json!(v) } else { json!(v.to_string()) }
}

/// Stages that an output hangs on, with their parameters by the names of the config.
fn methods(config: &Config, from: &[crate::config::Ref]) -> Vec<Value> {
    let mut open: Vec<&crate::config::Ref> = from.iter().collect();
    let mut seen: Vec<&str> = Vec::new();
    let mut list = Vec::new();
    while let Some(reference) = open.pop() {
        let Some(stage) = config.stage(&reference.name) else { continue };
        if seen.contains(&stage.name.as_str()) {
            continue;
        }
        seen.push(&stage.name);
        open.extend(stage.reads().into_iter().map(|(_, r)| r));
        let op = stage.op.word();
        list.push(json!({
            "name": stage.name, "op": op, "parameters": stage_parameters(&config.text, &stage.name, op),
            "constants": stage_constants(&stage.op),
        }));
    }
    list
}
