//! What each output holds: wires, element type, mapping, pyramid, and which levels are made where.

use super::graph::{Producer, Wire, WireId};
use super::lower::{Lowered, UNROUNDED_MEAN};
use super::{Prepass, PrepassKind};
use crate::config::{Config, Op, Output, OutputDType, OutputFormat, OutputRange, op_channels};
use crate::grid::{DType, Region};
use crate::kernel::convert::Mapping;
use crate::stage::Reduce;
use crate::store::{Pyramid, SinkSpec, VolumeInfo};
use crate::{Error, Result};

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

/// An occlusion map: the chain from the input's voxels.
#[derive(Debug, Clone)]
pub struct MapPlan {
    pub source: WireId,
    /// Level of the chain that is dataset 0.
    pub first: usize,
    /// Which of mean (0) and variance (1) each component is.
    pub moments: Vec<usize>,
    /// The whole chain, level 0 = the data; `spec.pyramid` is it without the first `first` levels.
    pub chain: Pyramid,
}

/// Planes and rows of level 1 that are made of level 0 at a time, where nobody stores that. 2-core Xeon VM, AVX-512, 2026-11-28, a
/// map, `cdf_power` and a mean of 1024 x 1024 x 512 u8 under 256 MiB: 11.5 s, of whole planes 12.9, of the whole brick 14.5.
pub const MAP_BLOCK: [usize; 2] = [8, 32];

impl MapPlan {
    /// Whether bricks whose last level is `last` make level 1 block by block, and level 0 is never there as a whole.
    pub fn by_blocks(&self, last: usize) -> bool {
        self.first > 0 && last > 0
    }
}

/// Plans all outputs; may add pre-passes.
pub fn plan_outputs(config: &Config, infos: &[VolumeInfo], lowered: &mut Lowered) -> Result<Vec<OutputPlan>> {
    (0..config.outputs.len())
        .map(|i| {
            let output = &config.outputs[i];
            plan_output(config, infos, lowered, i).map_err(|e| of_output(config, output, e))
        })
        .collect()
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
    let wires: Vec<WireId> = output
        .from
        .iter()
        .map(|r| {
            lowered.wire_of(config, r).ok_or_else(|| {
                Error::config(key("from"), format!("\"{}\" cannot share an output with other channels", r.name))
            })
        })
        .collect::<Result<_>>()?;
    let graph = &lowered.graph;
    let first = &graph.wires[wires[0]];
    for &w in &wires[1..] {
        let (a, b) = (&graph.lattices[first.lattice], &graph.lattices[graph.wires[w].lattice]);
        if a.shape != b.shape {
            let message = format!("\"{}\" is {:?}, \"{}\" is {:?}", first.name, a.shape, graph.wires[w].name, b.shape);
            return Err(Error::config(key("from"), message + "; channels of one output have one shape"));
        }
    }
    let parts: Vec<(WireId, usize)> =
        wires.iter().flat_map(|&w| (0..graph.wires[w].components).map(move |c| (w, c))).collect();
    let used: Vec<&Wire> = parts.iter().map(|&(w, _)| &graph.wires[w]).collect();
    let openness = used.iter().all(|w| w.channel == "openness");
    let same = used.iter().all(|w| value_dtype(w) == value_dtype(used[0]));
    let native = if same { value_dtype(used[0]) } else { DType::F32 };
    let dtype = match output.dtype {
        None if openness => DType::U8,
        None | Some(OutputDType::Native) => native,
        Some(OutputDType::U8) => DType::U8,
        Some(OutputDType::U16) => DType::U16,
        Some(OutputDType::F32) => DType::F32,
    };
    let reduce = choose_reduce(output, &used, &key("reduce"))?;
    let (range, auto) = choose_range(output, dtype, native, openness, &key("range"))?;
    let auto_range = auto.then(|| {
        lowered.prepasses.push(Prepass { wires: wires.clone(), kind: PrepassKind::MinMax });
        lowered.prepasses.len() - 1
    });
    let graph = &lowered.graph;
    let first = &graph.wires[wires[0]];
    let used: Vec<&Wire> = parts.iter().map(|&(w, _)| &graph.wires[w]).collect();
    let lattice = &graph.lattices[first.lattice];
    let region = region_of(config, lattice.shape)?;
    let origin = std::array::from_fn(|a| lattice.origin[a] + region.lo[a] as f64 * lattice.spacing[a]);
    let zarr = matches!(output.format, OutputFormat::OmeZarr04 | OutputFormat::OmeZarr05);
    let levels = if zarr { output.levels } else { Some(1) };
    let stride = reduce == Reduce::Stride;
    let pyramid = Pyramid::new(region.shape(), lattice.spacing, origin, output.chunk, levels, stride);
    let names = component_names(output, &used, &parts);
    let multi = parts.len() > 1 || output.from.len() > 1;
    let means = parts.iter().map(|&(w, _)| mean_beside(lowered, w)).collect();
    let coded = range.is_some() || auto;
    let fills = used.iter().map(|w| fill_of(w, coded)).collect();
    let spec = SinkSpec {
        name: output.name.clone(),
        path: output.path.clone(),
        format: output.format,
        dtype,
        fill: fill_value(config, output, dtype, native, range, used[0]),
        pyramid,
        components: multi.then_some(parts.len()),
        component_names: names,
        chunk: output.chunk,
        shard: output.shard,
        codec: output.codec,
        unit: lattice.unit.clone(),
        orientation: infos[lattice.input].orientation.clone(),
        region_start: region.lo,
        reduce_name: reduce_name(reduce).into(),
    };
    Ok(OutputPlan {
        index,
        spec,
        parts,
        means,
        fills,
        reduce,
        is_std: used[0].channel == "std",
        range,
        auto_range,
        openness,
        map: None,
        region,
        lattice: first.lattice,
    })
}

/// An output of an occlusion map's channels: its pyramid is the map's own chain.
fn map_output(config: &Config, infos: &[VolumeInfo], lowered: &Lowered, index: usize) -> Result<Option<OutputPlan>> {
    let output = &config.outputs[index];
    let key = |k: &str| format!("{}.{k}", output.place.key);
    let stage_of = |name: &str| config.stages.iter().position(|s| s.name == name);
    let stage = stage_of(&output.from[0].name);
    let Some((stage, &(source, first))) = stage.and_then(|s| lowered.maps.get(&s).map(|m| (s, m))) else {
        return Ok(None);
    };
    if output.from.iter().any(|r| stage_of(&r.name) != Some(stage)) {
        return Err(Error::config(key("from"), "channels of an occlusion map share an output with each other only"));
    }
    if output.reduce.is_some() {
        return Err(Error::config(key("reduce"), "an occlusion map's levels are its own chain; leave `reduce` out"));
    }
    let channels = op_channels(config.stages[stage].op.word());
    let named = |r: &crate::config::Ref| r.channel.clone().unwrap_or_else(|| channels[0].to_string());
    let names: Vec<String> = output.from.iter().map(named).collect();
    let moments = names.iter().map(|n| usize::from(n == "variance")).collect();
    let wire = &lowered.graph.wires[source];
    if wire.components != 1 {
        return Err(Error::config(key("from"), "an occlusion map needs an input of one component"));
    }
    let lattice = &lowered.graph.lattices[wire.lattice];
    let native = wire.dtype.result();
    let dtype = match output.dtype {
        None | Some(OutputDType::Native) => native,
        Some(OutputDType::U8) => DType::U8,
        Some(OutputDType::U16) => DType::U16,
        Some(OutputDType::F32) => DType::F32,
    };
    let (range, auto) = choose_range(output, dtype, native, false, &key("range"))?;
    if auto {
        return Err(Error::config(key("range"), "\"auto\" is not to be had for an occlusion map; give [lo, hi]"));
    }
    let region = region_of(config, lattice.shape)?;
    let origin = std::array::from_fn(|a| lattice.origin[a] + region.lo[a] as f64 * lattice.spacing[a]);
    let zarr = matches!(output.format, OutputFormat::OmeZarr04 | OutputFormat::OmeZarr05);
    let levels = if zarr { output.levels } else { Some(1) };
    let chain = Pyramid::new(region.shape(), lattice.spacing, origin, output.chunk, levels.map(|n| n + first), false);
    // A volume that one chunk holds still has the level that the map starts at, where an axis can be halved.
    let chain = if chain.levels.len() <= first {
        Pyramid::new(region.shape(), lattice.spacing, origin, output.chunk, Some(first + 1), false)
    } else {
        chain
    };
    if chain.levels.len() <= first {
        return Err(Error::config(key("from"), "no axis of the volume can be halved; use start_level = 0"));
    }
    let spec = SinkSpec {
        name: output.name.clone(),
        path: output.path.clone(),
        format: output.format,
        dtype,
        fill: if dtype.is_float() { f64::NAN } else { 0.0 },
        pyramid: chain.clone().skip(first),
        components: (names.len() > 1).then_some(names.len()),
        component_names: names,
        chunk: output.chunk,
        shard: output.shard,
        codec: output.codec,
        unit: lattice.unit.clone(),
        orientation: infos[lattice.input].orientation.clone(),
        region_start: region.lo,
        reduce_name: "gaussian".into(),
    };
    Ok(Some(OutputPlan {
        index,
        spec,
        parts: vec![],
        means: vec![],
        fills: vec![],
        reduce: Reduce::Mean,
        is_std: false,
        range,
        auto_range: None,
        openness: false,
        map: Some(MapPlan { source, first, moments, chain }),
        region,
        lattice: wire.lattice,
    }))
}

/// Element type of a wire's scaled values: its own, unless scaling applies.
fn value_dtype(wire: &Wire) -> DType {
    if wire.affine.is_identity() { wire.dtype } else { wire.dtype.result() }
}

fn region_of(config: &Config, shape: [usize; 3]) -> Result<Region> {
    let whole = Region::whole(shape);
    let Some(r) = config.run.region else { return Ok(whole) };
    let lo = r.map(|[lo, _]| i64::try_from(lo).unwrap_or(i64::MAX));
    let hi = r.map(|[_, hi]| i64::try_from(hi).unwrap_or(i64::MAX));
    let region = Region::new(lo, hi);
    if region.is_empty() || !whole.contains(&region) {
        let message = format!("{r:?} does not lie inside the volume of {shape:?} voxels (z, y, x; half-open)");
        return Err(config.locate(Error::config("run.region", message)));
    }
    Ok(region)
}

/// How cells of levels are made; refuses what the channels do not have.
fn choose_reduce(output: &Output, used: &[&Wire], key: &str) -> Result<Reduce> {
    let all = |names: &[&str]| used.iter().all(|w| names.contains(&w.channel.as_str()));
    let refuse = |what: &str| Err(Error::config(key, format!("{what}; accepted here: \"mean\" or \"stride\"")));
    match output.reduce {
        None => Ok(Reduce::Mean),
        Some(Reduce::Min) if !all(&["min"]) => refuse("\"min\" is for channels named min"),
        Some(Reduce::Max) if !all(&["max"]) => refuse("\"max\" is for channels named max"),
        Some(Reduce::Moments) if all(&["variance", "std"]) && !all(&["variance"]) && !all(&["std"]) => {
            refuse("\"moments\" is for variances or for standard deviations, not for both in one array")
        }
        Some(Reduce::Moments) if !all(&["variance"]) && !all(&["std"]) => {
            refuse("\"moments\" is for the channels variance and std")
        }
        Some(reduce) => Ok(reduce),
    }
}

pub fn reduce_name(reduce: Reduce) -> &'static str {
    match reduce {
        Reduce::Mean => "mean",
        Reduce::Min => "min",
        Reduce::Max => "max",
        Reduce::Stride => "stride",
        Reduce::Moments => "moments",
    }
}

/// The values that map to 0 and an integer type's maximum, and whether a pre-pass must find them.
fn choose_range(
    output: &Output,
    dtype: DType,
    native: DType,
    openness: bool,
    key: &str,
) -> Result<(Option<[f64; 2]>, bool)> {
    let asked = matches!(output.dtype, Some(OutputDType::U8 | OutputDType::U16));
    if dtype.is_float() || (dtype == native && !asked && output.range == OutputRange::Unset) {
        if output.range != OutputRange::Unset {
            return Err(Error::config(key, format!("a range is for dtype u8 or u16; this output is {dtype}")));
        }
        return Ok((None, false));
    }
    match output.range {
        OutputRange::Fixed(range) => Ok((Some(range), false)),
        OutputRange::Auto => Ok((None, true)),
        OutputRange::Unset if openness => Ok((Some([0.0, 1.0]), false)),
        OutputRange::Unset if dtype == native => Ok((None, false)),
        OutputRange::Unset => Err(Error::config(
            key,
            format!("an output of dtype {dtype} from {native} values needs `range = [lo, hi]` (or \"auto\")"),
        )),
    }
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

/// The mean of the stage that a variance or std comes from, for pooled levels.
fn mean_beside(lowered: &Lowered, wire: WireId) -> Option<WireId> {
    let wire = &lowered.graph.wires[wire];
    let stage = wire.name.strip_suffix(&format!(".{}", wire.channel))?;
    let named = |channel: &str| {
        let name = format!("{stage}.{channel}");
        lowered.graph.wires.iter().position(|w| w.name == name)
    };
    named(UNROUNDED_MEAN).or_else(|| named("mean"))
}

/// What skipped bricks hold, in the output's type.
fn fill_value(
    config: &Config,
    output: &Output,
    dtype: DType,
    native: DType,
    range: Option<[f64; 2]>,
    wire: &Wire,
) -> f64 {
    let stage = config.stages.iter().find(|s| s.name == output.from[0].name);
    let masked = stage.is_some_and(|s| s.where_.is_some() || s.fill.is_some());
    if dtype.is_float() {
        return if masked { wire.fill } else { f64::NAN };
    }
    let map_op = stage.is_some_and(|s| matches!(s.op, Op::OcclusionMap { .. }));
    debug_assert!(!map_op);
    match range {
        None if dtype != native => 0.0, // not known yet: see `OutputPlan::missing`
        _ => code(dtype, fill_of(wire, range.is_some()), range),
    }
}

/// What stands for missing voxels of a channel in integer outputs. Copies of an input keep its nodata value; where a range
/// turns values into codes, that value means nothing any more.
fn fill_of(wire: &Wire, coded: bool) -> f64 {
    if coded && matches!(wire.producer, Producer::Input(_)) { 0.0 } else { wire.fill }
}

/// A value as an integer type stores it.
fn code(dtype: DType, value: f64, range: Option<[f64; 2]>) -> f64 {
    let (least, most) = dtype.range();
    match range {
        Some([lo, hi]) => ((value - lo) / (hi - lo) * most).round_ties_even().clamp(0.0, most),
        None => value.round_ties_even().clamp(least, most),
    }
}

impl OutputPlan {
    /// How values of a component become the output's type, once the range is known.
    pub fn mapping(&self, component: usize, range: Option<[f64; 2]>) -> Mapping {
        Mapping { range, fill: self.missing(component, range) }
    }

    /// What missing voxels of a component hold, once the range is known.
    pub fn missing(&self, component: usize, range: Option<[f64; 2]>) -> f64 {
        match self.fills.get(component) {
            Some(fill) if !self.spec.dtype.is_float() => code(self.spec.dtype, *fill, range),
            _ => self.spec.fill,
        }
    }
}
