//! What is known of skipping before a voxel is read: bricks whose `where` no voxel can meet, and bricks over chunks that
//! are not stored. A run skips these, and others that only their voxels show (constants, masks).

use std::collections::HashMap;

use super::graph::{Mask, Producer, StepId, WireId};
use super::memory::wire_box;
use super::{Group, Plan};
use crate::Result;
use crate::config::WhereRule;
use crate::grid::{Border, Region};
use crate::store::Source;

/// Look-ups of chunks that a plan is worth: a file each, about a microsecond where the folder is known to the system.
const LOOK_UPS: usize = 1 << 20;
/// Bricks that are looked at one by one.
const BRICKS: usize = 1 << 20;

/// Bricks of a group that a run will not compute.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Known {
    /// No voxel meets the `where` of any stage that is read.
    pub masked: u64,
    /// Every chunk of every input is missing.
    pub missing: u64,
}

impl Known {
    pub fn bricks(&self) -> u64 {
        self.masked + self.missing
    }
}

/// Values of an input's chunks that are not stored, by chunk; other chunks are not in it.
type Absent = HashMap<[i64; 3], f64>;

struct Look<'a> {
    plan: &'a Plan,
    group: &'a Group,
    sources: &'a [Source],
    /// By input and component.
    absent: HashMap<(usize, usize), Absent>,
}

/// What is known of a group's bricks; `None` where there are too many of them to look at.
pub fn known(plan: &Plan, group: &Group, sources: &[Source]) -> Result<Option<Known>> {
    if group.brick_count() > BRICKS {
        return Ok(None);
    }
    let mut look = Look { plan, group, sources, absent: HashMap::new() };
    for &wire in &group.inputs {
        look.find_absent(wire)?;
    }
    let mut known = Known::default();
    for task in 0..group.task_count() {
        for brick in group.bricks(group.task_region(task)) {
            match look.brick(brick) {
                Some(true) => known.masked += 1,
                Some(false) => known.missing += 1,
                None => {}
            }
        }
    }
    Ok(Some(known))
}

impl Look<'_> {
    fn find_absent(&mut self, wire: WireId) -> Result<()> {
        let Producer::Input(input) = self.plan.graph.wires[wire].producer else { return Ok(()) };
        let info = self.sources[input].info();
        let Some(chunk) = info.chunk else { return Ok(()) };
        let region = wire_box(self.group.region, self.plan.graph.wires[wire].halo, self.group.shape);
        let cells = region.cells([0; 3], chunk);
        if cells.voxels().saturating_mul(info.components) > LOOK_UPS {
            return Ok(());
        }
        for component in 0..info.components {
            let mut absent = Absent::new();
            for cell in cells.iter() {
                if let Some(fill) = self.sources[input].absent_chunk(component, cell)? {
                    absent.insert(cell, fill);
                }
            }
            self.absent.insert((input, component), absent);
        }
        Ok(())
    }

    /// What an input (its last component) holds over a box of which nothing is stored; `None` where something is.
    fn constant(&self, wire: WireId, region: Region) -> Option<f64> {
        let wire = &self.plan.graph.wires[wire];
        let Producer::Input(input) = wire.producer else { return None };
        let chunk = self.sources[input].info().chunk?;
        let mut value = None;
        for component in 0..wire.components {
            let absent = self.absent.get(&(input, component))?;
            for cell in region.cells([0; 3], chunk).iter() {
                value = Some(*absent.get(&cell)?);
            }
        }
        value
    }

    /// `Some(false)`: no voxel of a box can be needed. `Some(true)`: all are. `None`: the voxels decide.
    fn needed(&self, mask: &Mask, region: Region) -> Option<bool> {
        let wire = &self.plan.graph.wires[mask.wire];
        let Producer::Input(_) = wire.producer else { return None };
        let of_chunks = self.constant(mask.wire, wire_box(region, mask.reach, self.group.shape));
        let value = of_chunks.map(|v| if wire.missing == Some(v as i64) { f64::NAN } else { wire.affine.apply(v) });
        // Every scaled value that the type can hold lies between these.
        let (least, most) = wire.dtype.range();
        let (a, b) = (wire.affine.apply(least), wire.affine.apply(most));
        let bounded = !wire.dtype.is_float();
        let (least, most) = if bounded { (a.min(b), a.max(b)) } else { (f64::NEG_INFINITY, f64::INFINITY) };
        match &mask.rule {
            WhereRule::Range { min, max } => {
                let (min, max) = (min.unwrap_or(f64::NEG_INFINITY), max.unwrap_or(f64::INFINITY));
                match value {
                    Some(v) => Some(v >= min && v <= max),
                    None => (min > most || max < least).then_some(false),
                }
            }
            // A constant crosses nothing, and a value outside the type's range is never crossed.
            WhereRule::Iso { iso, .. } => {
                (value.is_some() || iso.iter().all(|v| *v <= least || *v > most)).then_some(false)
            }
        }
    }

    /// Whether a brick is skipped for its masks (`true`) or for missing chunks (`false`), as a run will count it.
    fn brick(&self, brick: Region) -> Option<bool> {
        let graph = &self.plan.graph;
        let volume = Region::whole(self.group.shape);
        let of_step = |s: StepId| wire_box(brick, graph.steps[s].halo, self.group.shape);
        let needed = |s: StepId| graph.steps[s].mask.as_ref().map_or(Some(true), |m| self.needed(m, of_step(s)));
        let mut known = vec![false; graph.wires.len()];
        for &w in &self.group.inputs {
            let halo = graph.wires[w].halo;
            known[w] = self.constant(w, wire_box(brick, halo, self.group.shape)).is_some();
        }
        let mut read = vec![false; graph.wires.len()];
        self.group.sinks.iter().for_each(|&w| read[w] = true);
        for &s in self.group.steps.iter().rev() {
            let step = &graph.steps[s];
            if needed(s) != Some(false) && step.outputs.iter().any(|&w| read[w]) {
                let made =
                    step.mask.iter().map(|m| m.wire).filter(|&w| matches!(graph.wires[w].producer, Producer::Step(_)));
                step.inputs.iter().copied().chain(made).for_each(|w| read[w] = true);
            }
        }
        // What a streamed step reads beyond the box of its input.
        let beyond = |s: StepId| {
            let step = &graph.steps[s];
            let region = of_step(s).grow(step.reach).clip(&volume);
            step.streamed.is_none_or(|w| self.constant(w, region).is_some())
        };
        let mut masked = false;
        for &s in &self.group.steps {
            let step = &graph.steps[s];
            if !step.outputs.iter().any(|&w| read[w]) {
                continue;
            }
            let within = !matches!(step.border, Border::Constant(_)) || volume.contains(&of_step(s).grow(step.reach));
            match needed(s) {
                Some(false) => masked = true,
                Some(true) if within && beyond(s) && step.inputs.iter().all(|&w| known[w]) => {}
                _ => return None,
            }
            step.outputs.iter().for_each(|&w| known[w] = true);
        }
        self.group.sinks.iter().all(|&w| known[w]).then_some(masked)
    }
}
