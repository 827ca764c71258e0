//! Whether channels can hold what `fill` puts where a mask excludes voxels.

use super::graph::{Graph, Producer, Wire};
use crate::config::Config;
use crate::{Error, Result};

/// Refuses a `fill` that the type of one of its stage's channels cannot hold.
pub fn check(config: &Config, graph: &Graph) -> Result<()> {
    graph.wires.iter().try_for_each(|wire| of_wire(config, wire))
}

fn of_wire(config: &Config, wire: &Wire) -> Result<()> {
    let Producer::Step(_) = wire.producer else { return Ok(()) };
    let makes = |name: &str| wire.name.strip_suffix(&wire.channel).and_then(|n| n.strip_suffix('.')) == Some(name);
    let Some((stage, fill)) = config.stages.iter().find(|s| makes(&s.name)).and_then(|s| Some((s, s.fill?))) else {
        return Ok(());
    };
    let (dtype, (least, most)) = (wire.dtype, wire.dtype.range());
    if (least..=most).contains(&fill) && (dtype.is_float() || fill.fract() == 0.0) {
        return Ok(());
    }
    let whole = if dtype.is_float() { "a number" } else { "a whole number" };
    let message =
        format!("got {fill}, which {} ({dtype}) cannot hold; expected {whole} from {least} to {most}", wire.name);
    let key = format!("{}.fill", stage.place.key);
    Err(config.locate(Error::config(key, message)))
}
