//! The plan of a run, with the GPU that it found, and what a journal keeps of it.

use serde_json::{Value, json};

use super::journal::Journal;
use super::outputs;
use crate::Result;
use crate::config::{Config, Device};
use crate::gpu::{self, Gpu};
use crate::plan::{Placed, Plan};
use crate::store::{Source, VolumeInfo};

/// Where everything runs and why, for who reads the journal.
pub fn reasons(plan: &Plan) -> Value {
    let one = |p: &Placed| json!({ "stage": p.name, "device": p.lane.name(), "why": p.why });
    plan.placement.iter().map(one).collect()
}

/// Plans, and opens the GPU where a step runs on it. With `auto`, a run that was begun without a GPU goes on without one.
pub fn plan_and_gpu(config: &Config, sources: &[Source], resume: bool) -> Result<(Vec<VolumeInfo>, Plan, Option<Gpu>)> {
    let infos: Vec<VolumeInfo> = sources.iter().map(|s| s.info().clone()).collect();
    let mut opened = None;
    let plan = Plan::new(config, &infos, &mut || gpu::find(config.run.device, &mut opened))?;
    let Some(facts) = &plan.gpu else { return Ok((infos, plan, None)) };
    let earlier = if resume { Journal::read(&outputs::journal_dir(&plan)) } else { None };
    if config.run.device == Device::Auto && earlier.is_some_and(|e| e.header["placement"] != json!(plan.held)) {
        let without = Plan::new(config, &infos, &mut || Err("the run was begun without one".into()))?;
        return Ok((infos, without, None));
    }
    if let Some(gpu) = &mut opened {
        gpu.set_cap(facts.buffer_cap(plan.memory));
        gpu.set_slots(plan.slots());
    }
    Ok((infos, plan, opened))
}
