//! The plan as text and JSON: what `occlude plan` prints.

use std::fmt::Write;

use serde_json::{Value, json};

use super::brick::mib;
use super::decodes;
use super::graph::{Producer, Step, StepId};
use super::memory::planes_read;
use super::skips::{self, Known};
use super::{FlowPlan, Group, Placed, Plan, flows};
use crate::Result;
use crate::config::Config;
use crate::grid::Region;
use crate::kernel::reduce::planes;
use crate::store::{Source, open_inputs};

/// Opens the inputs' headers, plans, and describes the plan for people and for programs. Runs nothing.
pub fn explain(config: &Config) -> Result<(String, Value)> {
    let mut sources = open_inputs(config)?;
    let plan_of = |sources: &[Source]| {
        let infos: Vec<_> = sources.iter().map(|s| s.info().clone()).collect();
        let mut gpu = None;
        Plan::new(config, &infos, &mut || crate::gpu::find(config.run.device, &mut gpu))
    };
    let mut plan = plan_of(&sources)?;
    while let Some(input) = decodes::worth_unpacking(&plan) {
        sources[input].unpack_first();
        plan = plan_of(&sources)?;
    }
    for (input, source) in sources.iter_mut().enumerate() {
        source.narrow(planes_read(&plan, input));
    }
    let skips = plan.groups.iter().map(|g| skips::known(&plan, g, &sources)).collect::<Result<Vec<_>>>()?;
    Ok((text(config, &plan, &sources, &skips), describe(config, &plan, &sources, &skips)))
}

fn text(config: &Config, plan: &Plan, sources: &[Source], skips: &[Option<Known>]) -> String {
    let mut out = String::new();
    let w = &mut out;
    for (input, source) in config.inputs.iter().zip(sources) {
        let info = source.info();
        let unit = info.unit.as_deref().unwrap_or("unit unknown");
        let _ = writeln!(
            w,
            "input {}: {:?} {} voxels (z, y, x), spacing {:?} {unit}, {}",
            input.name, info.shape, info.dtype, info.spacing, info.format
        );
        if source.spool_bytes() > 0 {
            let _ = writeln!(w, "  unpacked once to scratch: {}", mib(source.spool_bytes()));
        }
    }
    for (s, step) in plan.graph.steps.iter().enumerate() {
        let Placed { lane, why, .. } = &plan.placement[s];
        let _ = writeln!(w, "step {s}: {} -> {} on {} ({why})", reads(plan, step), makes(plan, step), lane.name());
        let _ = writeln!(w, "  {}, reach {:?}, halo beyond the brick {:?}", step.kind.name(), step.reach, step.halo);
        if let Some(flow) = plan.flow_of(s) {
            let _ = writeln!(w, "  {}", flow_text(plan, &plan.flows[flow], s));
        }
        if plan.shares(s) {
            let _ = writeln!(w, "  CPU workers take bricks too while the GPU's slots are taken");
        }
        if step.stages.len() > 1 {
            let _ = writeln!(w, "  one pass for {}", step.stages.join(", "));
        }
    }
    for Placed { lane, why, .. } in (0..plan.outputs.len()).filter_map(|o| plan.map_placement(o)) {
        let _ = writeln!(w, "occlusion map on {} ({why})", lane.name());
    }
    for (group, known) in plan.groups.iter().zip(skips) {
        group_text(w, plan, group);
        skips_text(w, group, known.as_ref());
    }
    for output in &plan.outputs {
        let spec = &output.spec;
        let _ = writeln!(w, "output {}: {} as {}", spec.name, spec.path.display(), spec.dtype);
        for (d, level) in spec.pyramid.levels.iter().enumerate() {
            let _ = writeln!(
                w,
                "  level {d}: {:?} scale {:?} translation {:?}",
                level.shape, level.scale, level.translation
            );
        }
    }
    let (read, write) = traffic(plan, sources);
    let _ = writeln!(
        w,
        "reads {} of voxels, each counted once, and writes {}, both before compression; scratch {}",
        mib(read),
        mib(write),
        mib(scratch(plan, sources))
    );
    for warning in &plan.warnings {
        let _ = writeln!(w, "warning: {warning}");
    }
    out
}

fn group_text(w: &mut String, plan: &Plan, group: &Group) {
    let brick = &group.brick;
    let _ = writeln!(w, "brick {:?} voxels (z, y, x): {}", brick.shape, brick.why);
    let _ = writeln!(
        w,
        "  {} bricks in {} tasks of up to {:?}; {} each, {} in flight; {} of scratch per worker",
        group.brick_count(),
        group.task_count(),
        group.task,
        mib(brick.bytes),
        brick.in_flight,
        mib(brick.scratch)
    );
    let _ = writeln!(
        w,
        "  peak memory at most {} of {} (bricks {}, decoded chunks {}, open chunks{} {}, buffers kept for the next brick {})",
        mib(brick.peak(plan.workers)),
        mib(plan.memory),
        mib(brick.alive(plan.workers)),
        mib(brick.cache),
        if brick.slots > 0 { " and the GPU's slots" } else { "" },
        mib(brick.parked),
        mib(brick.waiting)
    );
    let _ = writeln!(w, "  read amplification {:.2}", brick.amplification);
    if brick.slots > 0 {
        let _ = writeln!(w, "  {} bricks at once on the GPU's way", plan.slots());
    }
    for step in group.steps.iter().map(|&s| &plan.graph.steps[s]) {
        let Some(wire) = step.streamed else { continue };
        let (stages, input) = (step.stages.join("+"), &plan.graph.wires[wire].name);
        let _ = writeln!(
            w,
            "  {stages} reads the columns of its lines in {input} while it runs, instead of a halo of {:?}",
            step.reach
        );
    }
    for &input in &group.inputs {
        let _ = writeln!(w, "  halo of {}: {:?}", plan.graph.wires[input].name, plan.graph.wires[input].halo);
    }
}

/// Share of all bricks that are known to be skipped.
fn skippable(plan: &Plan, skips: &[Option<Known>]) -> f64 {
    let skipped: u64 = skips.iter().flatten().map(Known::bricks).sum();
    skipped as f64 / plan.groups.iter().map(Group::brick_count).sum::<usize>() as f64
}

/// The part of the volume that lies outside `region`.
fn outside(group: &Group) -> f64 {
    1.0 - group.region.voxels() as f64 / group.shape.iter().product::<usize>() as f64
}

fn skips_text(w: &mut String, group: &Group, known: Option<&Known>) {
    let bricks = group.brick_count();
    let _ = match known {
        Some(k) => writeln!(
            w,
            "  known to be skipped without reading: {} of {bricks} bricks, {:.1} % (where: {}, missing chunks: {})",
            k.bricks(),
            100.0 * k.bricks() as f64 / bricks as f64,
            k.masked,
            k.missing
        ),
        None => writeln!(w, "  known to be skipped without reading: not worked out for {bricks} bricks"),
    };
    let outside = outside(group);
    if outside > 0.0 {
        let _ = writeln!(w, "  outside the region, not visited: {:.1} % of the volume", 100.0 * outside);
    }
}

/// With which steps one runs on the GPU, and what of it comes back.
fn flow_text(plan: &Plan, flow: &FlowPlan, step: StepId) -> String {
    let others: Vec<String> = flow.steps.iter().filter(|s| **s != step).map(ToString::to_string).collect();
    let with = if others.is_empty() { String::new() } else { format!(" with step {}", others.join(", ")) };
    let back: Vec<&str> = (plan.graph.steps[step].outputs.iter())
        .filter(|w| plan.groups.iter().any(|g| flows::voxels_come_back(plan, flow, g, **w)))
        .map(|w| plan.graph.wires[*w].name.as_str())
        .collect();
    let what = if back.is_empty() { "no voxels of it, only outputs' levels".into() } else { back.join(", ") };
    format!("on the GPU in one go{with}; comes back: {what}")
}

fn skips_json(group: &Group, known: Option<&Known>) -> Value {
    let outside = outside(group);
    let Some(k) = known else { return json!({ "share": null, "outside_region": outside }) };
    json!({
        "share": k.bricks() as f64 / group.brick_count() as f64, "bricks": k.bricks(),
        "causes": { "where": k.masked, "missing_chunk": k.missing }, "outside_region": outside,
    })
}

fn reads(plan: &Plan, step: &Step) -> String {
    let mut names: Vec<&str> = step.inputs.iter().map(|&w| plan.graph.wires[w].name.as_str()).collect();
    names.extend(step.mask.as_ref().map(|m| plan.graph.wires[m.wire].name.as_str()));
    names.join(", ")
}

fn makes(plan: &Plan, step: &Step) -> String {
    step.outputs.iter().map(|&w| plan.graph.wires[w].name.as_str()).collect::<Vec<_>>().join(", ")
}

/// Bytes of the inputs' voxels that bricks inside the region ask for, each once, and of all levels written, uncompressed.
fn traffic(plan: &Plan, sources: &[Source]) -> (u64, u64) {
    let mut asked = vec![0; sources.len()];
    for group in &plan.groups {
        for &w in &group.inputs {
            let Producer::Input(i) = plan.graph.wires[w].producer else { continue };
            let halo = plan.graph.wires[w].halo;
            let seen = group.region.grow(halo).clip(&Region::whole(group.shape)).voxels();
            let info = sources[i].info();
            asked[i] = asked[i].max((seen * info.components * info.dtype.size()) as u64);
        }
    }
    let written = |spec: &crate::store::SinkSpec| {
        let voxels: usize = spec.pyramid.levels.iter().map(|l| l.shape.iter().product::<usize>()).sum();
        (voxels * spec.components.unwrap_or(1) * spec.dtype.size()) as u64
    };
    (asked.iter().sum(), plan.outputs.iter().map(|o| written(&o.spec)).sum())
}

/// Bytes on disk of what tasks leave for the second phase: levels whose chunks several tasks share, and cells for the
/// levels beyond.
fn second_phase(plan: &Plan) -> u64 {
    let one = |group: &Group, o: usize| {
        let output = &plan.outputs[o];
        let (parts, deepest) = (output.spec.components.unwrap_or(1), output.brick_level());
        let voxels = |k: usize| output.level(k).map_or(0, |l| l.shape.iter().product::<usize>());
        let shared = (0..=deepest).filter(|&k| output.shared(k, group));
        let levels: usize = shared.map(|k| voxels(k) * parts * output.spec.dtype.size()).sum();
        let per_cell = if output.map.is_some() { 2 } else { parts * planes(output.reduce) };
        let beyond = if output.level_count() - 1 > deepest { deepest..output.level_count() } else { 0..0 };
        (levels + beyond.map(|k| voxels(k) * per_cell * size_of::<f64>()).sum::<usize>()) as u64
    };
    plan.groups.iter().flat_map(|g| g.outputs.iter().map(move |&o| one(g, o))).sum()
}

fn scratch(plan: &Plan, sources: &[Source]) -> u64 {
    sources.iter().map(Source::spool_bytes).sum::<u64>() + second_phase(plan)
}

fn describe(config: &Config, plan: &Plan, sources: &[Source], skips: &[Option<Known>]) -> Value {
    let (read, write) = traffic(plan, sources);
    let inputs: Vec<Value> = config
        .inputs
        .iter()
        .zip(sources)
        .map(|(input, source)| {
            let info = source.info();
            json!({
                "name": input.name, "shape": info.shape, "dtype": info.dtype.numpy_name(), "spacing": info.spacing,
                "unit": info.unit, "origin": info.origin, "format": info.format, "scratch_bytes": source.spool_bytes(),
            })
        })
        .collect();
    let steps: Vec<Value> = plan
        .graph
        .steps
        .iter()
        .zip(&plan.placement)
        .enumerate()
        .map(|(s, (step, placed))| {
            json!({
                "stages": step.stages, "kernel": step.kind.name(), "reads": reads(plan, step), "makes": makes(plan, step),
                "reach": step.reach, "halo": step.halo, "streamed": step.streamed.is_some(), "device": placed.lane.name(), "reason": placed.why,
                "gpu_flow": plan.flow_of(s),
            })
        })
        .collect();
    let groups: Vec<Value> = plan
        .groups
        .iter()
        .zip(skips)
        .map(|(g, known)| {
            json!({
                "skippable": skips_json(g, known.as_ref()),
                "shape": g.shape, "region": [g.region.lo, g.region.hi], "brick": g.brick.shape, "brick_why": g.brick.why,
                "brick_bytes": g.brick.bytes, "scratch_bytes": g.brick.scratch, "bricks_in_flight": g.brick.in_flight, "bricks": g.brick_count(),
                "tasks": g.task_count(), "task": g.task, "cache_bytes": g.brick.cache, "waiting_bytes": g.brick.waiting, "gpu_slots": g.brick.slots,
                "peak_memory_bytes": g.brick.peak(plan.workers), "read_amplification": g.brick.amplification,
            })
        })
        .collect();
    let outputs: Vec<Value> = plan
        .outputs
        .iter()
        .map(|o| {
            let levels: Vec<Value> = o
                .spec
                .pyramid
                .levels
                .iter()
                .map(|l| json!({ "shape": l.shape, "scale": l.scale, "translation": l.translation }))
                .collect();
            json!({ "name": o.spec.name, "path": o.spec.path.display().to_string(), "dtype": o.spec.dtype.numpy_name(), "levels": levels,
                    "chunk": o.spec.chunk, "shard": o.spec.shard, "fill": o.spec.fill.to_string() })
        })
        .collect();
    json!({
        "inputs": inputs,
        "steps": steps,
        "groups": groups,
        "outputs": outputs,
        "placement": plan.placement.iter().map(|p| (p.name.clone(), json!(p.lane.name()))).collect::<serde_json::Map<_, _>>(),
        "peak_memory_bytes": plan.groups.iter().flat_map(|g| [&g.brick].into_iter().chain(&g.prepass)).map(|b| b.peak(plan.workers)).max(),
        "memory_budget_bytes": plan.memory,
        "scratch_bytes": scratch(plan, sources),
        "read_amplification": plan.groups.iter().map(|g| g.brick.amplification).fold(0.0, f64::max),
        "bytes_to_read": read,
        "bytes_to_write": write,
        "tasks": plan.task_count(),
        "bricks": plan.groups.iter().map(Group::brick_count).sum::<usize>(),
        "skippable_share": skippable(plan, skips),
        "warnings": plan.warnings,
    })
}
