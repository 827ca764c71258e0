//! What does not fit the device once bricks are known: flows, whose steps then run one by one, and sweeps. The bits are the
//! same, so that a resumed run, whose budget or brick may be another, may settle it anew.

use super::graph::{StepId, StepKind};
use super::place::{Cause, Lane};
use super::{Plan, memory};
use crate::gpu::Unfit;

/// Takes apart the flows and leaves to the CPU the sweeps that do not fit; the placement says why.
pub fn settle(plan: &mut Plan) {
    let Some(cap) = plan.gpu.as_ref().map(|gpu| gpu.buffer_cap(plan.memory)) else { return };
    for f in (0..plan.flows.len()).rev() {
        if let Some(why) = unfit_flow(plan, f, cap) {
            part(plan, f, why);
        }
    }
    for s in 0..plan.graph.steps.len() {
        if plan.on_gpu(s)
            && plan.flow_of(s).is_none()
            && let Some(why) = unfit_sweep(plan, s, cap)
        {
            plan.placement[s].go(Lane::Cpu, Cause::Facts, format!("the sweep {why}: runs on the CPU"));
        }
    }
}

/// Why a flow does not fit on some group's bricks.
fn unfit_flow(plan: &Plan, f: usize, cap: u64) -> Option<Unfit> {
    plan.groups.iter().find_map(|g| memory::inner_flow(plan, &plan.flows[f], g)?.parts(cap).err())
}

fn unfit_sweep(plan: &Plan, s: StepId, cap: u64) -> Option<Unfit> {
    let step = &plan.graph.steps[s];
    if !matches!(step.kind, StepKind::Obscurance { .. }) {
        return None;
    }
    let parts = |g| memory::with_sweep(plan, g, step, |job| job.ok_or(Unfit::Kernel)?.parts(cap));
    plan.groups.iter().filter(|g| g.steps.contains(&s)).find_map(|g| parts(g).err())
}

/// A flow's steps one by one: those with windows on the GPU as before, the others on the CPU.
fn part(plan: &mut Plan, f: usize, why: Unfit) {
    let flow = plan.flows.remove(f);
    let names: Vec<String> = flow.steps.iter().map(|&s| plan.graph.steps[s].stages.join("+")).collect();
    let what = format!("in one go {} {why}", names.join(", "));
    for s in flow.steps {
        let place = &mut plan.placement[s];
        match place.cause {
            Cause::Beside => {
                place.go(Lane::Cpu, Cause::Facts, format!("looks at one voxel, and {what}: runs on the CPU"));
            }
            _ => place.why += &format!("; by itself, its levels on the CPU: {what}"),
        }
    }
}
