//! Bricks of a session through streams: those of a pre-pass, and what all streams share.

use super::Session;
use crate::Result;
use crate::brick::Scratch;
use crate::grid::Region;
use crate::grid::order::morton;
use crate::plan::BrickChoice;
use crate::run::assemble::Item;
use crate::run::cache::{ChunkCache, Uses};
use crate::run::compute::Finished;
use crate::run::metrics::Metrics;
use crate::run::prepass::Finder;
use crate::run::program::Program;
use crate::run::read::Reader;
use crate::run::steps::Engine;
use crate::run::stream::{Stations, Stream, Work};

impl Session<'_> {
    /// What a pre-pass finds over the whole volume.
    pub(super) fn prepass(&self, id: usize) -> Result<Vec<f64>> {
        let prepass = &self.plan.prepasses[id];
        let lattice = &self.plan.graph.lattices[self.plan.graph.wires[prepass.wires[0]].lattice];
        let group = self.plan.groups.iter().find(|g| g.shape == lattice.shape).unwrap_or(&self.plan.groups[0]);
        let brick = group.prepass.as_ref().unwrap_or(&group.brick);
        let program = Program::of_prepass(&self.plan, prepass, lattice.shape);
        let engine = self.engine();
        let whole = Region::whole(lattice.shape);
        let mut cells: Vec<[i64; 3]> = whole.cells([0; 3], brick.shape).iter().collect();
        cells.sort_by_key(|c| morton(*c));
        let bricks = cells.into_iter().map(|c| Region::of_cell(c, [0; 3], brick.shape).clip(&whole));
        let work: Vec<Work> = bricks.map(|brick| Work { brick, slot: 0 }).collect();
        let found = Finder::new(&self.plan, prepass, lattice.shape);
        let deliver = |done: &Finished, _: Work, _: &mut Scratch| {
            found.add(&self.plan, &prepass.wires, done);
            Ok(Vec::new())
        };
        let metrics = Metrics::new(self.plan.graph.steps.len(), self.plan.flows.len());
        let tick = || {
            let (bricks, voxels) = metrics.done();
            self.tick(
                brick,
                [voxels, lattice.shape.iter().product::<usize>() as u64, bricks, work.len() as u64],
                "pre-pass",
            );
        };
        let stations = Stations { deliver: &deliver, write: &|_, _| Ok(()), tick: &tick };
        self.stream(&engine, &program, brick, &work, &metrics, &stations)?;
        self.metrics.absorb(&metrics);
        Ok(found.result(prepass.kind))
    }

    pub(super) fn stream(
        &self,
        engine: &Engine,
        program: &Program,
        brick: &BrickChoice,
        work: &[Work],
        metrics: &Metrics,
        stations: &Stations<Vec<Item>>,
    ) -> Result<()> {
        let cache = ChunkCache::new(brick.cache);
        self.pool.bound((brick.bytes * brick.in_flight as u64 + brick.waiting) as usize);
        let reader =
            Reader { engine, program, sources: &self.sources, cache: &cache, uses: self.uses(program, work), metrics };
        let stream = Stream {
            reader: &reader,
            work,
            brick_bytes: brick.bytes,
            budget: brick.bytes * brick.in_flight as u64,
            brick_voxels: brick.shape.iter().map(|&n| n as u64).product(),
            threads: self.plan.workers,
            pool: &self.threads,
            metrics,
            trace: &self.trace,
            cancel: &self.options.cancel,
            stations,
        };
        stream.run()
    }

    /// By which of the work ahead each chunk of each chunked input will be read.
    fn uses(&self, program: &Program, work: &[Work]) -> Vec<Option<Uses>> {
        let by_input = |input: usize| {
            let chunk = self.infos[input].chunk?;
            let halo = program.inputs.iter().find_map(|&(w, halo)| {
                (self.plan.graph.wires[w].producer == crate::plan::graph::Producer::Input(input)).then_some(halo)
            })?;
            let volume = self.infos[input].shape;
            let grown: Vec<Region> =
                work.iter().map(|w| crate::plan::memory::wire_box(w.brick, halo, volume)).collect();
            Some(Uses::new(&grown, chunk))
        };
        (0..self.sources.len()).map(by_input).collect()
    }

    /// Ten times a second, between bricks: pages of mapped inputs behind the front are let go, the pool is kept small, progress
    /// is told.
    pub(super) fn tick(&self, brick: &BrickChoice, [voxels, of_voxels, bricks, of_bricks]: [u64; 4], phase: &str) {
        if self.is_due(bricks == of_bricks) {
            self.pool.trim((brick.bytes * brick.in_flight as u64 / 2) as usize);
            for source in &self.sources {
                source.release(Region::whole(source.info().shape));
            }
            self.progress.update(voxels, of_voxels, bricks, of_bricks, phase);
        }
    }
}
