//! Outputs of occlusion maps (paper E): their pyramid is the map's own chain of levels.

use super::OutputPlan;
use super::ground::{Contents, Ground};
use super::values::{choose_dtype, choose_range};
use crate::config::{Config, Ref, op_channels};
use crate::plan::graph::WireId;
use crate::plan::lower::Lowered;
use crate::stage::Reduce;
use crate::store::{Pyramid, VolumeInfo};
use crate::{Error, Result};

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

impl OutputPlan {
    /// What a map is made of, and the voxels of it beyond a brick that the brick's levels see: two cells per level, of which
    /// each is `f` voxels, 2 (1 + 2 + .. + f / 2).
    pub fn map_halo(&self) -> Option<(WireId, [usize; 3])> {
        let map = self.map.as_ref()?;
        Some((map.source, map.chain.levels[self.brick_level()].factor.map(|f| 2 * (f - 1))))
    }
}

/// An output of an occlusion map's channels: its pyramid is the map's own chain.
pub(super) fn map_output(
    config: &Config,
    infos: &[VolumeInfo],
    lowered: &Lowered,
    index: usize,
) -> Result<Option<OutputPlan>> {
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
    let named = |r: &Ref| r.channel.clone().unwrap_or_else(|| channels[0].to_string());
    let names: Vec<String> = output.from.iter().map(named).collect();
    let moments = names.iter().map(|n| usize::from(n == "variance")).collect();
    let wire = &lowered.graph.wires[source];
    if wire.components != 1 {
        return Err(Error::config(key("from"), "an occlusion map needs an input of one component"));
    }
    let native = wire.dtype.result();
    let dtype = choose_dtype(output, native, native);
    let (range, auto) = choose_range(output, dtype, native, false, &key("range"))?;
    if auto {
        return Err(Error::config(key("range"), "\"auto\" is not to be had for an occlusion map; give [lo, hi]"));
    }
    let ground = Ground::of(config, output, infos, &lowered.graph.lattices[wire.lattice])?;
    let chain = ground.pyramid(ground.levels().map(|n| n + first), false);
    // A volume that one chunk holds still has the level that the map starts at, where an axis can be halved.
    let chain = if chain.levels.len() <= first { ground.pyramid(Some(first + 1), false) } else { chain };
    if chain.levels.len() <= first {
        return Err(Error::config(key("from"), "no axis of the volume can be halved; use start_level = 0"));
    }
    let fill = if dtype.is_float() { f64::NAN } else { 0.0 };
    let contents = Contents { dtype, fill, several: names.len() > 1, names, reduce: "gaussian" };
    Ok(Some(OutputPlan {
        index,
        spec: ground.spec(chain.clone().skip(first), contents),
        parts: vec![],
        means: vec![],
        fills: vec![],
        reduce: Reduce::Mean,
        is_std: false,
        range,
        auto_range: None,
        openness: false,
        map: Some(MapPlan { source, first, moments, chain }),
        region: ground.region,
        lattice: wire.lattice,
    }))
}
