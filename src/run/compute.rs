//! Evaluates a program on a loaded brick, step by step, giving buffers back as soon as nobody reads them.

use std::cell::Cell;

use super::flows::Ready;
use super::metrics::Since;
use super::program::Program;
use super::read::{Loaded, Reader};
use super::steps::{Engine, MaskValue, Piece};
use super::trace::Trace;
use super::value::Value;
use crate::Result;
use crate::brick::Scratch;
use crate::grid::{AnyViewMut, Region};
use crate::plan::graph::{Step, StepId, WireId};

/// A brick whose sinks are made.
#[derive(Debug)]
pub struct Finished {
    pub brick: Region,
    /// By wire; only sinks remain.
    pub values: Vec<Option<Value>>,
    pub masks: Vec<(StepId, MaskValue)>,
    /// Levels that are made already.
    pub ready: Vec<Ready>,
}

impl Finished {
    pub fn value(&self, wire: WireId) -> &Value {
        self.values[wire].as_ref().expect("every sink is delivered")
    }

    /// The levels of a component of an output, where they are made already.
    pub fn ready(&self, output: usize, component: usize) -> Option<&Ready> {
        self.ready.iter().find(|r| (r.output, r.component) == (output, component))
    }

    /// The mask of the step that made a wire, over that step's box.
    pub fn mask(&self, step: StepId) -> Option<&MaskValue> {
        self.masks.iter().find(|(s, _)| *s == step).map(|(_, m)| m)
    }
}

/// Runs every step that the sinks need. Counts the brick as computed, or as skipped and why.
///
/// # Errors
/// A GPU that failed twice.
pub fn evaluate(reader: &Reader, loaded: Loaded, scratch: &mut Scratch, trace: &Trace) -> Result<Finished> {
    let Loaded { brick, mut values, mut masks, all_missing } = loaded;
    let Reader { engine, program, metrics, .. } = *reader;
    let stored = Cell::new(false);
    let fetch = |wire: WireId, region: Region, dst: AnyViewMut| {
        stored.set(reader.fetch(wire, region, dst)? || stored.get());
        Ok(())
    };
    let plan = engine.plan;
    let volume = Region::whole(program.volume);
    let off: Vec<StepId> =
        masks.iter().filter(|(_, m)| matches!(m, MaskValue::None) && engine.skip).map(|(s, _)| *s).collect();
    let needed = program.needed(plan, &off);
    let (mut masked, mut constant, mut ran) = (false, false, false);
    let (mut made, mut ready) = (Vec::new(), Vec::new());
    for (at, &s) in program.steps.iter().enumerate() {
        let step = &plan.graph.steps[s];
        if let Some(flow) = program.flow_at(s) {
            let since = Since::now();
            if let Some(done) = engine.flow(program, flow, &mut values, &masks, &needed, brick)? {
                ran = true;
                let voxels = |t| program.step_box(plan, t, brick).voxels() as u64;
                match flow.steps[..] {
                    [only] => metrics.step(only, since, voxels(only)),
                    _ => {
                        metrics.flow(plan.flow_of(s).unwrap_or_default(), since.clock, brick.voxels() as u64);
                        done.steps.iter().for_each(|&t| metrics.step_in_flow(t, voxels(t)));
                    }
                }
                let names: Vec<String> = done.steps.iter().flat_map(|t| plan.graph.steps[*t].stages.clone()).collect();
                trace.span(&names.join("+"), since.clock, &[("brick", format!("{brick:?}"))]);
                made.extend(done.steps);
                ready.extend(done.ready);
                done.values.into_iter().for_each(|(w, value)| values[w] = Some(value));
            }
        }
        if made.contains(&s) {
            release(engine, program, at, &mut values);
            continue;
        }
        if !step.outputs.iter().any(|&w| needed[w]) {
            continue;
        }
        let region = program.step_box(plan, s, brick);
        if let Some(mask) = &step.mask
            && !masks.iter().any(|(m, _)| *m == s)
        {
            let value = values[mask.wire].as_mut().expect("a mask's wire is made before its reader");
            let known = program.same_mask(plan, s, brick, &masks);
            masks.push((s, known.unwrap_or_else(|| engine.mask(mask, value, region, volume, scratch))));
        }
        let known = masks.iter().find(|(m, _)| *m == s).map_or(&MaskValue::All, |(_, m)| m);
        let since = Since::now();
        let outputs = if off.contains(&s) {
            engine.filled(step, region)
        } else {
            let piece = Piece { id: s, step, mask: known, region, volume };
            engine.run(piece, &mut values, &fetch, scratch)?
        };
        if matches!(known, MaskValue::None) {
            masked = true;
        } else if outputs.iter().all(|v| v.constants().is_some()) {
            constant = true;
        } else {
            ran = true;
            metrics.step(s, since, region.voxels() as u64);
            trace.span(&step.stages.join("+"), since.clock, &[("brick", format!("{brick:?}"))]);
        }
        keep(engine, program, step, outputs, &needed, at, &mut values);
    }
    let plain_constant = program.steps.is_empty()
        && program.sinks.iter().all(|&w| values[w].as_ref().is_some_and(|v| v.constants().is_some()));
    match (ran, masked, constant || plain_constant) {
        (true, ..) => metrics.computed(),
        (false, true, _) => metrics.skipped("where"),
        (false, false, true) if all_missing && !stored.get() => metrics.skipped("missing_chunk"),
        (false, false, true) => metrics.skipped("constant"),
        _ => metrics.computed(),
    }
    Ok(Finished { brick, values, masks, ready })
}

/// Keeps what a step made and somebody needs, and gives back what nobody reads after the step at position `at`.
fn keep(
    engine: &Engine,
    program: &Program,
    step: &Step,
    outputs: Vec<Value>,
    needed: &[bool],
    at: usize,
    values: &mut [Option<Value>],
) {
    for (value, &w) in outputs.into_iter().zip(&step.outputs) {
        if needed[w] {
            values[w] = Some(value);
        } else {
            value.recycle(engine.pool);
        }
    }
    release(engine, program, at, values);
}

/// Gives back what nobody reads after the step at position `at`.
fn release(engine: &Engine, program: &Program, at: usize, values: &mut [Option<Value>]) {
    for (w, value) in values.iter_mut().enumerate() {
        if value.is_some() && !program.wanted_after(engine.plan, at, w) {
            value.take().into_iter().for_each(|v| v.recycle(engine.pool));
        }
    }
}
