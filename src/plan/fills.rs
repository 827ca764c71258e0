//! Whether channels can hold what `fill` puts where a mask excludes voxels.

use super::graph::{Graph, Producer, Wire};
use crate::config::Config;

/// Warns of every `fill` that the type of one of its stage's channels cannot hold: its nearest value is stored.
pub fn warnings(config: &Config, graph: &Graph) -> Vec<String> {
    graph.wires.iter().filter_map(|wire| of_wire(config, wire)).collect()
}

fn of_wire(config: &Config, wire: &Wire) -> Option<String> {
    let Producer::Step(_) = wire.producer else { return None };
    let makes = |name: &str| wire.name.strip_suffix(&wire.channel).and_then(|n| n.strip_suffix('.')) == Some(name);
    let stage = config.stages.iter().find(|s| makes(&s.name))?;
    let (fill, dtype) = (stage.fill?, wire.dtype);
    let (least, most) = dtype.range();
    if (least..=most).contains(&fill) && (dtype.is_float() || fill.fract() == 0.0) {
        return None;
    }
    let whole = if dtype.is_float() { "a number" } else { "a whole number" };
    let key = format!("{}.fill", stage.place.key);
    let holds = format!("{} ({dtype}) holds {whole} from {least} to {most}: the nearest is stored", wire.name);
    Some(format!("{key}: {fill} is given, and {holds}"))
}
