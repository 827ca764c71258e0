//! What each output holds: wires, element type, mapping, pyramid, and which levels are made where.

mod ground;
mod map;
mod values;

use super::graph::{Wire, WireId, max3};
use super::lower::{Lowered, UNROUNDED_MEAN};
use super::{Prepass, PrepassKind};
use crate::config::{Config, Output, Ref};
use crate::grid::{DType, Region};
use crate::stage::Reduce;
use crate::store::{SinkSpec, VolumeInfo};
use crate::{Error, Result};
use ground::{Contents, Ground};
use map::map_output;
pub use map::{MAP_BLOCK, MapPlan};
use values::{choose_dtype, choose_range, choose_reduce, fill_of, fill_value, reduce_name, value_dtype};

/// One output, planned.
#[derive(Debug, Clone)]
pub struct OutputPlan {
    /// Index into the config's outputs.
    pub index: usize,
    pub spec: SinkSpec,
    /// Wire and component of each channel written.
    pub parts: Vec<(WireId, usize)>,
    /// For `Reduce::Moments`: the mean beside each part.
    pub means: Vec<Option<WireId>>,
    /// What stands for missing voxels of each part in integer outputs, in the channel's units; empty for maps.
    pub fills: Vec<f64>,
    pub reduce: Reduce,
    /// Whether a `std` (not a variance) is pooled.
    pub is_std: bool,
    /// Values that map to 0 and the integer type's maximum.
    pub range: Option<[f64; 2]>,
    /// The pre-pass that finds `range`.
    pub auto_range: Option<usize>,
    pub openness: bool,
    /// The output is an occlusion map with its own chain of levels.
    pub map: Option<MapPlan>,
    /// The part of the volume that level 0 covers, in voxels of the input.
    pub region: Region,
    pub lattice: usize,
}

/// Plans all outputs; may add pre-passes, and demands of wires the halos that occlusion maps need.
pub fn plan_outputs(config: &Config, infos: &[VolumeInfo], lowered: &mut Lowered) -> Result<Vec<OutputPlan>> {
    let plans = (0..config.outputs.len())
        .map(|i| {
            let output = &config.outputs[i];
            plan_output(config, infos, lowered, i).map_err(|e| of_output(config, output, e))
        })
        .collect::<Result<Vec<_>>>()?;
    for (source, halo) in plans.iter().filter_map(OutputPlan::map_halo) {
        let wire = &mut lowered.graph.wires[source];
        wire.sink_halo = max3(wire.sink_halo, halo);
    }
    lowered.graph.demand_halos();
    Ok(plans)
}

/// Adds the line of the output's table to an error about one of its keys.
fn of_output(config: &Config, output: &Output, error: Error) -> Error {
    let error = config.locate(error);
    let own = matches!(&error, Error::Config { key, .. } if key.starts_with(&output.place.key));
    error.located(&config.file, output.place.line.filter(|_| own))
}

fn plan_output(config: &Config, infos: &[VolumeInfo], lowered: &mut Lowered, index: usize) -> Result<OutputPlan> {
    let output = &config.outputs[index];
    let key = |k: &str| format!("{}.{k}", output.place.key);
    if let Some(plan) = map_output(config, infos, lowered, index)? {
        return Ok(plan);
    }
    let wires = wires_of(config, output, lowered)?;
    let graph = &lowered.graph;
    let parts: Vec<(WireId, usize)> =
        wires.iter().flat_map(|&w| (0..graph.wires[w].components).map(move |c| (w, c))).collect();
    let used: Vec<&Wire> = parts.iter().map(|&(w, _)| &graph.wires[w]).collect();
    let openness = used.iter().all(|w| w.channel == "openness");
    let same = used.iter().all(|w| value_dtype(w) == value_dtype(used[0]));
    let native = if same { value_dtype(used[0]) } else { DType::F32 };
    let dtype = choose_dtype(output, native, if openness { DType::U8 } else { native });
    let reduce = choose_reduce(output, &used, &key("reduce"))?;
    let (range, auto) = choose_range(output, dtype, native, openness, &key("range"))?;
    let ground = Ground::of(config, output, infos, &graph.lattices[used[0].lattice])?;
    let pyramid = ground.pyramid(ground.levels(), reduce == Reduce::Stride);
    let contents = Contents {
        dtype,
        fill: fill_value(config, output, dtype, native, range, used[0]),
        names: component_names(output, &used, &parts),
        several: parts.len() > 1 || output.from.len() > 1,
        reduce: reduce_name(reduce),
    };
    let coded = range.is_some() || auto;
    let mut plan = OutputPlan {
        index,
        spec: ground.spec(pyramid, contents),
        means: wires_beside(lowered, &parts),
        fills: used.iter().map(|w| fill_of(w, coded)).collect(),
        reduce,
        is_std: used[0].channel == "std",
        range,
        auto_range: None,
        openness,
        map: None,
        region: ground.region,
        lattice: used[0].lattice,
        parts,
    };
    if auto {
        plan.auto_range = Some(lowered.prepasses.len());
        lowered.prepasses.push(Prepass { wires, kind: PrepassKind::MinMax });
    }
    Ok(plan)
}

/// The wires that an output is written from, in order; refuses those of different shapes.
fn wires_of(config: &Config, output: &Output, lowered: &Lowered) -> Result<Vec<WireId>> {
    let key = format!("{}.from", output.place.key);
    let wire = |r: &Ref| {
        lowered
            .wire_of(config, r)
            .ok_or_else(|| Error::config(&key, format!("\"{}\" cannot share an output with other channels", r.name)))
    };
    let wires: Vec<WireId> = output.from.iter().map(wire).collect::<Result<_>>()?;
    let graph = &lowered.graph;
    let shape = |w: WireId| graph.lattices[graph.wires[w].lattice].shape;
    let first = wires[0];
    if let Some(&other) = wires.iter().find(|&&w| shape(w) != shape(first)) {
        let (a, b) = (&graph.wires[first].name, &graph.wires[other].name);
        let (of_a, of_b) = (shape(first), shape(other));
        let message = format!("\"{a}\" is {of_a:?}, \"{b}\" is {of_b:?}; channels of one output have one shape");
        return Err(Error::config(key, message));
    }
    Ok(wires)
}

fn component_names(output: &Output, used: &[&Wire], parts: &[(WireId, usize)]) -> Vec<String> {
    let several = output.from.len() > 1;
    used.iter()
        .zip(parts)
        .map(|(wire, (_, c))| match wire.component_names.get(*c) {
            Some(name) if several => format!("{} {name}", wire.name),
            Some(name) => name.clone(),
            None if wire.components > 1 => format!("{} {c}", wire.name),
            None => wire.name.clone(),
        })
        .collect()
}

/// The means beside the variances or standard deviations of an output, for pooled levels.
fn wires_beside(lowered: &Lowered, parts: &[(WireId, usize)]) -> Vec<Option<WireId>> {
    let mean = |w| lowered.beside(w, UNROUNDED_MEAN).or_else(|| lowered.beside(w, "mean"));
    parts.iter().map(|&(w, _)| mean(w)).collect()
}
