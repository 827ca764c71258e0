//! Set-ups of whole runs that several files of tests share.

use std::path::Path;

use occlude::gpu::{GpuFacts, GpuKind};
use occlude::grid::Shape;
use occlude::plan::Plan;
use occlude::run::{Report, RunOptions};

use super::common::{mixed_u16, parse, run_with, u16_bytes, write_npy};

/// The device of [`super::kind`].
pub fn lane() -> &'static str {
    match super::kind() {
        GpuKind::Hardware => "run.device='gpu'",
        GpuKind::Software => "run.device='gpu:software'",
    }
}

pub const CPU: &str = "run.device='cpu'";

/// A folder with `vol.npy` of these voxels, and `bytes.npy` of their high bytes.
pub fn folder_of(voxels: &[u16], shape: Shape) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(voxels));
    let high: Vec<u8> = voxels.iter().map(|v| (v >> 8) as u8).collect();
    write_npy(&dir.path().join("bytes.npy"), "|u1", shape, &high);
    dir
}

/// The same of voxels of every kind.
pub fn folder(shape: Shape) -> tempfile::TempDir {
    folder_of(&mixed_u16(shape), shape)
}

/// A run in place of what an earlier one left.
pub fn run_on(dir: &Path, text: &str, sets: &[&str]) -> Report {
    run_with(&parse(dir, text, sets), &RunOptions { overwrite: true, ..Default::default() })
}

/// An adapter that need not exist.
pub fn found() -> GpuFacts {
    GpuFacts { name: "Test 9000".into(), software: false, most_bytes: 1 << 30, exact_floats: true, close_floats: true }
}

/// A plan with this adapter or none: the planner sees facts only, and asks for them once at most.
pub fn plan_with(
    dir: &Path,
    text: &str,
    sets: &[&str],
    found: Result<GpuFacts, String>,
) -> occlude::Result<(Plan, usize)> {
    let config = parse(dir, text, sets);
    let infos: Vec<_> = occlude::store::open_inputs(&config)?.iter().map(|s| s.info().clone()).collect();
    let mut calls = 0;
    let plan = Plan::new(&config, &infos, &mut || {
        calls += 1;
        found.clone()
    })?;
    assert!(calls <= 1);
    Ok((plan, calls))
}

/// A plan of a GPU run.
pub fn plan(dir: &Path, text: &str, sets: &[&str]) -> Plan {
    plan_with(dir, text, &[&[lane()], sets].concat(), Ok(found())).unwrap_or_else(|e| panic!("{e}")).0
}

/// Device and reason of a stage.
pub fn place<'p>(plan: &'p Plan, stage: &str) -> (&'p str, &'p str) {
    let found = plan.placement.iter().find(|p| p.name == stage);
    found.map(|p| (p.lane.name(), p.why.as_str())).unwrap_or_else(|| panic!("{stage} is placed"))
}

/// The stages of each flow.
pub fn flows(plan: &Plan) -> Vec<String> {
    let names = |s: &usize| plan.graph.steps[*s].stages.join("+");
    plan.flows.iter().map(|f| f.steps.iter().map(names).collect::<Vec<_>>().join(" ")).collect()
}
