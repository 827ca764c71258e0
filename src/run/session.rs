//! A run as library calls: open, `run_task(i)` in any order, finish.

mod streaming;

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::Instant;

use serde_json::{Value, json};

use super::assemble::{Assembler, Item, Target, TaskSlot};
use super::commits::Commits;
use super::compute::Finished;
use super::journal::{self, Journal};
use super::metrics::Metrics;
use super::options::{Progress, RunOptions};
use super::outputs::{self, Start};
use super::program::Program;
use super::report::{self, Report};
use super::steps::Engine;
use super::stream::{Stations, Work};
use super::trace::Trace;
use super::unpack::unpack;
use super::{planned, second, windows};
use crate::brick::{Pool, Scratch};
use crate::config::{Config, config_hash};
use crate::gpu::Gpu;
use crate::grid::{Region, order::morton};
use crate::plan::{Group, Plan, decodes, parked};
use crate::store::sink::Claim;
use crate::store::{Source, VolumeInfo, changed_by, named_files, open_inputs};
use crate::{Error, Result};

/// One run, opened.
pub struct Session<'a> {
    config: &'a Config,
    options: &'a RunOptions,
    progress: &'a dyn Progress,
    plan: Plan,
    gpu: Option<Gpu>,
    infos: Vec<VolumeInfo>,
    identities: Vec<Value>,
    hash: String,
    sources: Vec<Source>,
    /// By output; `None` for those that were complete when the run was opened.
    targets: Vec<Option<Target>>,
    journal: Option<Journal>,
    /// Kept until the session ends: no other run may write the outputs.
    _claims: Vec<Option<Claim>>,
    done: Vec<AtomicBool>,
    globals: Vec<Vec<f64>>,
    threads: rayon::ThreadPool,
    pool: Pool,
    metrics: Metrics,
    trace: Trace,
    /// When progress was told last, in ms.
    last_tick: AtomicU64,
    /// Whose bricks the GPU's slots were made for.
    last_group: AtomicUsize,
}

fn is_done(task: &AtomicBool) -> bool {
    task.load(Ordering::Acquire)
}

impl<'a> Session<'a> {
    /// Plans, unpacks inputs where needed, runs the pre-passes, opens the outputs.
    pub fn open(config: &'a Config, options: &'a RunOptions, progress: &'a dyn Progress) -> Result<Session<'a>> {
        let sources = open_inputs(config)?;
        let named = named_files(config, &sources);
        for path in [&options.trace, &options.report].into_iter().flatten() {
            if let Some(file) = changed_by(&named, path) {
                let message = format!(
                    "would be written over {}, which is read for an input; expected another file",
                    file.display()
                );
                return Err(Error::Config { file: Some(path.clone()), line: None, key: String::new(), message });
            }
        }
        Session::open_with(config, sources, options, progress)
    }

    /// As [`Session::open`], on sources of the caller's (arrays in memory, for instance): one per input of the config, in
    /// its order.
    pub fn open_with(
        config: &'a Config,
        mut sources: Vec<Source>,
        options: &'a RunOptions,
        progress: &'a dyn Progress,
    ) -> Result<Session<'a>> {
        if sources.len() != config.inputs.len() {
            return Err(Error::Failed(format!("{} sources for {} inputs", sources.len(), config.inputs.len())));
        }
        let (mut infos, mut plan, mut gpu) = planned::plan_and_gpu(config, &sources, options.resume)?;
        while let Some(input) = decodes::worth_unpacking(&plan) {
            sources[input].unpack_first();
            drop(gpu);
            (infos, plan, gpu) = planned::plan_and_gpu(config, &sources, options.resume)?;
        }
        plan.warnings.iter().for_each(|w| progress.note(w));
        plan.gpu_note(config).iter().for_each(|n| progress.note(n));
        let identities = sources.iter().map(Source::identity).collect::<Result<Vec<_>>>()?;
        let hash = config_hash(config);
        let mut header = journal::header(&hash, &identities, plan.task_count(), &json!(plan.held), &[]);
        header["reasons"] = planned::reasons(&plan);
        let mut claims = outputs::claim_begun(config, &plan)?;
        let metrics = Metrics::new(plan.graph.steps.len(), plan.flows.len());
        if options.overwrite {
            // Before the old result goes: a broken input must not cost it.
            outputs::refuse_foreigners(config, &plan)?;
            unpack(&mut sources, &plan, config, options, progress, &metrics)?;
        }
        let start = outputs::start(config, &plan, &header, options.resume, options.overwrite)?;
        if start != Start::Complete {
            outputs::claim_all(config, &plan, &mut claims)?;
        }
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(plan.workers)
            .thread_name(|i| format!("compute-{i}"))
            .build()
            .map_err(|e| Error::Failed(format!("cannot start {} threads: {e}", plan.workers)))?;
        let tasks = plan.task_count();
        let mut session = Session {
            config,
            options,
            progress,
            metrics,
            targets: plan.outputs.iter().map(|_| None).collect(),
            plan,
            gpu,
            infos,
            identities,
            hash,
            sources,
            journal: None,
            _claims: claims,
            done: (0..tasks).map(|_| AtomicBool::new(false)).collect(),
            globals: Vec::new(),
            threads,
            pool: Pool::default(),
            trace: Trace::new(options.trace.is_some()),
            last_tick: AtomicU64::new(0),
            last_group: AtomicUsize::new(usize::MAX),
        };
        session.prepare(start, header)?;
        session.plan.groups.iter().for_each(|g| session.count_resumed(g));
        Ok(session)
    }

    fn prepare(&mut self, start: Start, mut header: Value) -> Result<()> {
        let resume = match start {
            Start::Complete => {
                self.done.iter_mut().for_each(|d| *d = true.into());
                journal::remove(&outputs::journal_dir(&self.plan));
                return self.plan.outputs.iter().try_for_each(|o| o.spec.forget_work());
            }
            Start::Afresh => false,
            Start::Resume { done, globals } => {
                for task in done {
                    if let Some(flag) = self.done.get_mut(task) {
                        *flag = true.into();
                    }
                }
                self.globals = globals;
                true
            }
        };
        let open = !self.done.iter().all(is_done) || self.globals.len() < self.plan.prepasses.len();
        if open && !self.options.overwrite {
            unpack(&mut self.sources, &self.plan, self.config, self.options, self.progress, &self.metrics)?;
        }
        for id in self.globals.len()..self.plan.prepasses.len() {
            let found = self.prepass(id)?;
            self.globals.push(found);
        }
        header["globals"] = journal::header("", &[], 0, &Value::Null, &self.globals)["globals"].clone();
        for g in 0..self.plan.groups.len() {
            let scratch = self.config.run.scratch.as_deref();
            for &o in &self.plan.groups[g].outputs {
                if !resume || !outputs::is_complete(&self.plan, o, &header) {
                    let group = &self.plan.groups[g];
                    let begun = self.done[group.first_task..][..group.task_count()].iter().any(is_done);
                    let target = outputs::open_target(&self.plan, group, o, &self.globals, scratch, resume, begun)?;
                    self.targets[o] = Some(target);
                } else if o + 1 < self.plan.outputs.len() {
                    // The last one's folder holds the journal.
                    self.plan.outputs[o].spec.forget_work()?;
                }
            }
            let group = &self.plan.groups[g];
            if group.outputs.iter().all(|&o| self.targets[o].is_none()) {
                self.done[group.first_task..][..group.task_count()].iter_mut().for_each(|d| *d = true.into());
            }
        }
        self.journal = Some(Journal::open(&outputs::journal_dir(&self.plan), &header, resume)?);
        Ok(())
    }

    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    pub fn task_count(&self) -> usize {
        self.done.len()
    }

    /// Tasks that are not done, in visiting order: along a Morton curve in each group.
    pub fn open_tasks(&self) -> Vec<usize> {
        let mut tasks = Vec::new();
        for group in &self.plan.groups {
            let mut own: Vec<usize> = (0..group.task_count()).collect();
            own.sort_by_key(|&t| {
                let [_, ny, nx] = group.tasks;
                morton([t / (ny * nx), t / nx % ny, t % nx].map(|v| v as i64))
            });
            tasks.extend(own.into_iter().map(|t| t + group.first_task).filter(|&t| !is_done(&self.done[t])));
        }
        tasks
    }

    /// Runs one task by number; one that is done already is not done again. Disjoint from every other task.
    pub fn run_task(&self, task: usize) -> Result<()> {
        self.run_tasks(&[task])
    }

    /// Streams the bricks of those of these tasks that are not done, group by group, marking each task as it finishes.
    ///
    /// # Errors
    /// There is no such task, or one failed.
    pub fn run_tasks(&self, tasks: &[usize]) -> Result<()> {
        if let Some(task) = tasks.iter().find(|t| **t >= self.done.len()) {
            return Err(Error::Failed(format!("there is no task {task} among {}", self.done.len())));
        }
        let open: Vec<usize> = tasks.iter().copied().filter(|&t| !is_done(&self.done[t])).collect();
        self.run_bricks(&open, None)
    }

    /// Streams only the bricks that meet one of these boxes of the volume. No task counts as done, and what was written is
    /// there to be read: whole chunks that the boxes cover. Outputs of one task per file want `shard = "none"`.
    pub fn run_boxes(&self, boxes: &[Region]) -> Result<()> {
        self.run_bricks(&self.open_tasks(), Some(boxes))
    }

    fn run_bricks(&self, tasks: &[usize], only: Option<&[Region]>) -> Result<()> {
        for (g, group) in self.plan.groups.iter().enumerate() {
            let own = |t: &usize| (group.first_task..group.first_task + group.task_count()).contains(t);
            let mine: Vec<usize> = tasks.iter().copied().filter(own).collect();
            if !mine.is_empty() {
                self.stream_group(g, &mine, only)?;
            }
        }
        Ok(())
    }

    /// Counts what an earlier run did.
    fn count_resumed(&self, group: &Group) {
        for t in 0..group.task_count() {
            if is_done(&self.done[group.first_task + t]) {
                let region = group.task_region(t);
                self.metrics.resumed(group.bricks(region).len() as u64, region.voxels() as u64);
            }
        }
    }

    fn stream_group(&self, g: usize, tasks: &[usize], only: Option<&[Region]>) -> Result<()> {
        let group = &self.plan.groups[g];
        if let Some(gpu) = self.gpu.as_ref().filter(|_| self.last_group.swap(g, Ordering::Relaxed) != g) {
            gpu.let_go();
        }
        let program = Program::of_group(&self.plan, group);
        let engine = self.engine();
        let mut work = Vec::new();
        let mut slots = Vec::new();
        for &task in tasks {
            let region = group.task_region(task - group.first_task);
            let mut bricks = group.bricks(region);
            if let Some(boxes) = only {
                bricks.retain(|brick| boxes.iter().any(|b| !b.clip(brick).is_empty()));
            }
            slots.push(TaskSlot::new(task, region, bricks.len()));
            work.extend(bricks.into_iter().map(|brick| Work { brick, slot: slots.len() - 1 }));
        }
        let (targets, pool, level, gpu) = (&self.targets[..], &self.pool, engine.level, self.gpu.as_ref());
        let assembler = Assembler { plan: &self.plan, group, targets, pool, level, gpu };
        let deliver =
            |done: &Finished, work: Work, scratch: &mut Scratch| assembler.assemble(done, &slots[work.slot], scratch);
        let commits = Commits::default();
        let commit = |tasks: &[(usize, Region)]| self.commit(group, tasks, only.is_none());
        let write = |work: Work, items: Vec<Item>| {
            let slot = &slots[work.slot];
            if self.write(slot, items)? {
                commits.add(slot.number, slot.region);
            }
            commits.settle_due(commit)
        };
        let total: u64 = self.plan.groups.iter().map(|g| g.brick_count() as u64).sum();
        let tick = || {
            let (bricks, voxels) = self.metrics.done();
            self.tick(&group.brick, [voxels, self.plan.voxels(), bricks, total], "compute");
        };
        // From here the rate counts.
        let (bricks, voxels) = self.metrics.done();
        self.progress.update(voxels, self.plan.voxels(), bricks, total, "compute");
        let stations = Stations { deliver: &deliver, write: &write, tick: &tick };
        let streamed = self.stream(&engine, &program, &group.brick, &work, &self.metrics, &stations);
        // What was finished is kept, whatever ended the stream; the first error is the one to tell.
        streamed.and(commits.settle(commit))
    }

    fn engine(&self) -> Engine<'_> {
        let mut engine = Engine::new(&self.plan, &self.pool, self.gpu.as_ref(), &self.metrics, !self.options.no_skip);
        engine.globals = self.globals.clone();
        engine
    }

    /// Stores a brick's chunks; true after the last brick of a task.
    fn write(&self, slot: &TaskSlot, items: Vec<Item>) -> Result<bool> {
        for item in items {
            let target = self.targets[item.output].as_ref().expect("bricks go to open outputs");
            let bytes = target.sink.put(item.dataset, item.component, item.region, item.chunk)?;
            self.metrics.bytes_written(bytes);
        }
        Ok(slot.written())
    }

    /// Makes tasks durable, and marks them where they are `whole`: those before one that fails, too.
    fn commit(&self, group: &Group, tasks: &[(usize, Region)], whole: bool) -> Result<()> {
        let start = Instant::now();
        let durable = |region: Region| {
            let open = group.outputs.iter().filter_map(|&o| Some((&self.plan.outputs[o], self.targets[o].as_ref()?)));
            open.into_iter().try_for_each(|(output, target)| outputs::commit_task(group, output, target, region))
        };
        let mut numbers = Vec::new();
        let mut failed = Ok(());
        for &(task, region) in tasks {
            failed = durable(region);
            if failed.is_err() {
                break;
            }
            numbers.push(task);
        }
        if let Some(journal) = self.journal.as_ref().filter(|_| whole && !numbers.is_empty()) {
            journal.done(&numbers)?;
            numbers.iter().for_each(|&t| self.done[t].store(true, Ordering::Release));
        }
        self.trace.span("commit", start, &[("tasks", format!("{numbers:?}"))]);
        failed
    }

    /// Before each chunk of the second phase.
    fn tick_levels(&self, done: u64, all: u64) {
        if self.is_due(false) {
            self.metrics.sample_memory();
            self.progress.update(done, all, 0, 0, "levels");
        }
    }

    /// Whether to tell progress: ten times a second, by one thread, and at the last brick.
    fn is_due(&self, last_brick: bool) -> bool {
        let now = (self.metrics.seconds() * 1e3) as u64;
        let last = self.last_tick.load(Ordering::Relaxed);
        let due = now >= last + 100 || last_brick;
        due && self.last_tick.compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed).is_ok()
    }

    /// The second phase and the attributes; then the outputs are complete. The trace is written whatever happens.
    pub fn finish(mut self) -> Result<Report> {
        let (finished, traced) = (self.finish_outputs(), self.write_trace());
        finished.and(traced)?;
        self.metrics.sample_memory();
        Ok(self.report())
    }

    /// Writes the trace of what was done so far, where one is asked for.
    pub fn write_trace(&self) -> Result<()> {
        self.options.trace.as_ref().map_or(Ok(()), |path| self.trace.write(path))
    }

    fn finish_outputs(&mut self) -> Result<()> {
        let open = self.done.iter().filter(|d| !is_done(d)).count();
        if open > 0 {
            return Err(Error::Failed(format!("{open} of {} tasks are not done", self.done.len())));
        }
        let start = Instant::now();
        let unfinished = self.plan.outputs.iter().zip(&self.targets);
        let all: usize = unfinished.filter_map(|(o, t)| Some(second::voxels(o, t.as_ref()?))).sum();
        let done = AtomicU64::new(0);
        self.pool.trim(0);
        for o in 0..self.plan.outputs.len() {
            let Some(target) = self.targets[o].take() else { continue };
            let output = &self.plan.outputs[o];
            let lanes = parked::chunks_at_once(&self.plan, output);
            let before = |chunk: Region| {
                self.options.cancel.check()?;
                let earlier = done.fetch_add(chunk.voxels() as u64, Ordering::Relaxed);
                self.tick_levels(earlier, all as u64);
                Ok(())
            };
            let bytes = second::finish_levels(output, &target, (&self.threads, lanes), &before)?;
            self.metrics.bytes_written(bytes);
            let attributes = outputs::attributes(
                self.config,
                &self.plan,
                o,
                &self.infos,
                &self.identities,
                &self.hash,
                target.range,
            );
            let windows = windows::of_output(output);
            let Target { sink, levels, cells, .. } = target;
            // Their files go with the work folder, after the output says that it is complete: a kill in between must find them.
            drop((levels, cells));
            sink.finish(&attributes, &windows)?;
        }
        if let Some(journal) = self.journal.take() {
            drop(journal);
            journal::remove(&outputs::journal_dir(&self.plan));
        }
        self.trace.span("finish", start, &[]);
        Ok(())
    }

    /// What was done so far.
    pub fn report(&self) -> Report {
        let mut report = Report::default();
        self.metrics.fill(&mut report, self.plan.voxels());
        report.bricks.total = self.plan.groups.iter().map(|g| g.brick_count() as u64).sum();
        report.memory_budget_bytes = self.plan.memory;
        report.stages = report::stages(&self.plan, &self.metrics);
        report.byte_identity_waived = self.plan.waives_byte_identity();
        report.placement = self.plan.placement.iter().map(|p| (p.name.clone(), p.lane.name().into())).collect();
        report
    }

    /// Destroys the GPU's device, as a driver reset would. For tests.
    #[doc(hidden)]
    pub fn lose_gpu(&self, for_good: bool) {
        if let Some(gpu) = &self.gpu {
            gpu.lose(for_good);
        }
    }
}
