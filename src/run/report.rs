//! What a run did: the JSON of `--report`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::metrics::{FlowTotals, Metrics, StepTotals};
use crate::plan::graph::StepId;
use crate::plan::{Lane, Placed, Plan};

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// Wall time.
    pub seconds: f64,
    /// Level-0 voxels of the region, once, however many outputs there are.
    pub voxels: u64,
    pub voxels_per_second: f64,
    pub bricks: BrickCounts,
    /// Bytes read from the inputs' storage.
    pub bytes_read: u64,
    pub bytes_written: u64,
    /// Voxels gathered for bricks, halos included, per voxel that this run made.
    pub read_amplification: f64,
    pub memory_budget_bytes: u64,
    pub peak_memory_bytes: u64,
    pub stages: Vec<StageReport>,
    /// Seconds of all threads together: waiting for bytes of the budget, for a worker or a writer (`budget`, `workers_busy`,
    /// `writers_busy`), and at work beside the stages (`read_busy`, `encode_busy`).
    pub waits: BTreeMap<String, f64>,
    /// Stage to device (`cpu`, `gpu`).
    pub placement: BTreeMap<String, String>,
    /// `lanes = "mixed"` let a float stage's bricks go to either lane: bytes may depend on which took them.
    pub byte_identity_waived: bool,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct BrickCounts {
    pub total: u64,
    pub computed: u64,
    /// Found finished by an earlier run.
    pub resumed: u64,
    /// Not computed, by cause.
    pub skipped: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct StageReport {
    pub name: String,
    /// Time in its kernels, summed over threads.
    pub seconds: f64,
    /// Of a stage on the CPU: how much of that its threads had a core. The rest they waited for one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub core_seconds: Option<f64>,
    pub device: String,
    /// Why it ran there.
    pub reason: String,
    pub voxels: u64,
    /// Of a stage on the GPU: bricks that CPU workers took while all of its slots were taken.
    pub bricks_on_cpu: u64,
    /// Of a sweep: its lines in strips of bricks (`total`), and those of them that were not searched: without a needed voxel
    /// (`where`), or with nothing greater in reach (`open`).
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub lines: BTreeMap<String, u64>,
    /// Of a stage that runs on the GPU in one go with others: the row that has their time. Its own is that of bricks that it
    /// made by itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_of: Option<String>,
    /// Of such a row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub together: Option<Together>,
}

/// Stages that ran on the GPU in one go.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Together {
    pub stages: Vec<String>,
    /// Bricks made so, and bricks that the device left, whose stages ran one by one. Others had nothing to compute.
    pub bricks: u64,
    pub bricks_left: u64,
}

/// A row for every stage, and for all that ran on the GPU in one go.
pub(super) fn stages(plan: &Plan, metrics: &Metrics) -> Vec<StageReport> {
    let stages = (0..plan.graph.steps.len()).map(|s| stage(plan, metrics, s));
    stages.chain((0..plan.flows.len()).filter_map(|f| flow(plan, metrics, f))).collect()
}

fn stage(plan: &Plan, metrics: &Metrics, s: StepId) -> StageReport {
    let StepTotals { seconds, core_seconds, voxels } = metrics.step_totals(s);
    let Placed { lane, why, .. } = &plan.placement[s];
    StageReport {
        name: plan.graph.steps[s].stages.join("+"),
        seconds,
        core_seconds: (*lane == Lane::Cpu).then_some(core_seconds),
        device: lane.name().into(),
        reason: why.clone(),
        voxels,
        bricks_on_cpu: metrics.shared_bricks(s),
        lines: metrics.line_counts(s),
        part_of: plan.flow_of(s).and_then(|f| flow(plan, metrics, f)).map(|r| r.name),
        together: None,
    }
}

/// The row of a flow; one of a single step is its stage's.
fn flow(plan: &Plan, metrics: &Metrics, f: usize) -> Option<StageReport> {
    let steps = &plan.flows[f].steps;
    let stages: Vec<String> = steps.iter().map(|&s| plan.graph.steps[s].stages.join("+")).collect();
    let FlowTotals { seconds, voxels, bricks, left } = metrics.flow_totals(f);
    (steps.len() > 1).then(|| StageReport {
        name: format!("{} in one go", stages.join(", ")),
        seconds,
        device: "gpu".into(),
        reason: plan.placement[steps[0]].why.clone(),
        voxels,
        together: Some(Together { stages, bricks, bricks_left: left }),
        ..StageReport::default()
    })
}
