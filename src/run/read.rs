//! Fills a brick's inputs, halos included, from sources: plain rows or cached chunks. Masks that hang on inputs are
//! looked at first, so that what no mask needs is not read.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Instant;

use super::cache::{Chunk, ChunkCache, Future, Uses};
use super::metrics::Metrics;
use super::program::Program;
use super::steps::{Engine, MaskValue};
use super::value::{Comp, Value, common_value, copy_into};
use crate::Result;
use crate::brick::{Scratch, gather};
use crate::grid::{AnyViewMut, Region};
use crate::plan::graph::{Producer, StepId, WireId};
use crate::plan::memory::wire_box;
use crate::store::Source;

/// A brick with its inputs.
#[derive(Debug)]
pub struct Loaded {
    pub brick: Region,
    /// By wire.
    pub values: Vec<Option<Value>>,
    /// Masks known so far, by step.
    pub masks: Vec<(StepId, MaskValue)>,
    /// Every input that was read turned out missing from storage.
    pub all_missing: bool,
}

/// Why a box is read.
#[derive(Debug, Clone, Copy)]
enum Why {
    /// It is the brick's input.
    Brick,
    /// A mask looks at it first.
    Mask,
    /// So do steps while they run, nobody knows how often.
    Fetched,
}

/// Reads for one stream.
pub struct Reader<'a> {
    pub engine: &'a Engine<'a>,
    pub program: &'a Program,
    /// By the config's input index.
    pub sources: &'a [Source],
    pub cache: &'a ChunkCache,
    /// By the config's input index, for chunked sources.
    pub uses: Vec<Option<Uses>>,
    pub metrics: &'a Metrics,
}

impl Reader<'_> {
    /// Reads the brick at `place` in the stream's order. `scratch` is for masks.
    pub fn read(&self, brick: Region, place: u32, scratch: &mut Scratch) -> Result<Loaded> {
        let start = Instant::now();
        let plan = self.engine.plan;
        let volume = Region::whole(self.program.volume);
        let mut loaded = Loaded {
            brick,
            values: (0..plan.graph.wires.len()).map(|_| None).collect(),
            masks: Vec::new(),
            all_missing: true,
        };
        let mut off = Vec::new();
        for &s in &self.program.steps {
            let Some(mask) = &plan.graph.steps[s].mask else { continue };
            let Producer::Input(input) = plan.graph.wires[mask.wire].producer else { continue };
            let region = self.program.step_box(plan, s, brick);
            let known = match self.program.same_mask(plan, s, brick, &loaded.masks) {
                Some(known) => known,
                None => {
                    let wanted = region.grow(mask.reach).clip(&volume);
                    let (mut value, _) = self.input(input, mask.wire, wanted, place, Why::Mask)?;
                    self.metrics.gathered(wanted.voxels() as u64);
                    let known = self.engine.mask(mask, &mut value, region, volume, scratch);
                    value.recycle(self.engine.pool);
                    known
                }
            };
            if matches!(known, MaskValue::None) && self.engine.skip {
                off.push(s);
            }
            loaded.masks.push((s, known));
        }
        let needed = self.program.needed(plan, &off);
        for &(wire, halo) in &self.program.inputs {
            if !needed[wire] {
                continue;
            }
            let Producer::Input(input) = plan.graph.wires[wire].producer else { continue };
            let region = wire_box(brick, halo, self.program.volume);
            let fetched = self.program.steps.iter().any(|&s| plan.graph.steps[s].streamed == Some(wire));
            let why = if fetched { Why::Fetched } else { Why::Brick };
            let (value, missing) = self.input(input, wire, region, place, why)?;
            self.metrics.gathered(region.voxels() as u64);
            loaded.all_missing &= missing;
            loaded.values[wire] = Some(value);
        }
        self.metrics.read_ns.fetch_add(start.elapsed().as_nanos() as u64, Relaxed);
        Ok(loaded)
    }

    /// All components of an input over a box, and whether nothing of it is stored.
    fn input(&self, input: usize, wire: WireId, region: Region, place: u32, why: Why) -> Result<(Value, bool)> {
        let wire = &self.engine.plan.graph.wires[wire];
        let mut all_missing = true;
        let comps = (0..wire.components)
            .map(|c| {
                let (comp, missing) = match &self.uses[input] {
                    Some(uses) => self.chunked(input, c, region, uses, place, why)?,
                    None => self.plain(input, c, region)?,
                };
                all_missing &= missing;
                Ok(match comp {
                    Comp::Voxels(v) if self.engine.skip => match common_value(v.view(region.shape())) {
                        Some(value) => {
                            self.engine.pool.put(v);
                            Comp::Const(value)
                        }
                        None => Comp::Voxels(v),
                    },
                    comp => comp,
                })
            })
            .collect::<Result<Vec<_>>>()?;
        Ok((Value { dtype: wire.dtype, region, comps }, all_missing))
    }

    /// Reads a box of an input with one component; true if something of it is stored.
    pub fn fetch(&self, wire: WireId, region: Region, mut dst: AnyViewMut) -> Result<bool> {
        let start = Instant::now();
        let Producer::Input(input) = self.engine.plan.graph.wires[wire].producer else {
            unreachable!("steps fetch inputs")
        };
        let source = &self.sources[input];
        let mut stored = false;
        match &self.uses[input] {
            None => {
                self.metrics.bytes_read(source.read_again(0, region, dst)?);
                stored = source.absent_box(0, region).is_none();
            }
            Some(uses) => {
                let shape = source.info().chunk.expect("a chunked source");
                for index in uses.chunks(region).iter() {
                    let key = (input, 0, index);
                    let chunk_box = Region::of_cell(index, [0; 3], shape);
                    match self.cache.get(source, key, Future::UNKNOWN, self.engine.pool, self.metrics)? {
                        Chunk::Missing(value) => gather::fill_common(value, chunk_box, dst.reborrow(), region),
                        Chunk::Decoded(voxels) => {
                            gather::copy_common(voxels.view(shape), chunk_box, dst.reborrow(), region);
                            stored = true;
                        }
                    }
                }
            }
        }
        self.metrics.gathered(region.voxels() as u64);
        self.metrics.read_ns.fetch_add(start.elapsed().as_nanos() as u64, Relaxed);
        Ok(stored)
    }

    fn plain(&self, input: usize, comp: usize, region: Region) -> Result<(Comp, bool)> {
        let source = &self.sources[input];
        if let Some(value) = source.absent_box(comp, region).filter(|_| self.engine.skip) {
            return Ok((Comp::Const(value), true));
        }
        let mut voxels = self.engine.pool.take(source.info().dtype, region.voxels());
        let bytes = source.read(comp, region, voxels.view_mut(region.shape()))?;
        self.metrics.bytes_read(bytes);
        Ok((Comp::Voxels(voxels), false))
    }

    fn chunked(
        &self,
        input: usize,
        comp: usize,
        region: Region,
        uses: &Uses,
        place: u32,
        why: Why,
    ) -> Result<(Comp, bool)> {
        let source = &self.sources[input];
        let info = source.info();
        let shape = info.chunk.expect("a chunked source");
        let cells = uses.chunks(region);
        let mut target = None;
        let mut common: Option<f64> = None;
        for index in cells.iter() {
            let future = match why {
                Why::Brick => uses.of(index, place),
                Why::Mask => Future { uses: None, next: place, now: place },
                Why::Fetched => Future { now: place, ..Future::UNKNOWN },
            };
            let chunk = self.cache.get(source, (input, comp, index), future, self.engine.pool, self.metrics)?;
            let chunk_box = Region::of_cell(index, [0; 3], shape);
            if let (Chunk::Missing(value), None) = (&chunk, &target)
                && self.engine.skip
                && (common.is_none() || common.is_some_and(|c| c.to_bits() == value.to_bits()))
            {
                common = Some(*value);
                continue;
            }
            let dst = target.get_or_insert_with(|| {
                let mut buffer = self.engine.pool.take(info.dtype, region.voxels());
                if let Some(value) = common {
                    buffer.fill(value);
                }
                buffer
            });
            match chunk {
                Chunk::Missing(value) => gather::fill_common(value, chunk_box, dst.view_mut(region.shape()), region),
                Chunk::Decoded(voxels) => {
                    copy_into(voxels.view(shape), chunk_box, dst, region);
                    // The cache let go of it, and no other brick holds it: the next chunk takes its place, still warm.
                    if let Ok(voxels) = Arc::try_unwrap(voxels) {
                        self.engine.pool.adopt(voxels);
                    }
                }
            }
        }
        Ok(match (target, common) {
            (Some(voxels), _) => (Comp::Voxels(voxels), false),
            (None, Some(value)) => (Comp::Const(value), true),
            (None, None) => unreachable!("a brick's box is not empty"),
        })
    }
}
