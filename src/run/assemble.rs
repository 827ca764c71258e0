//! From a finished brick to encoded chunks: conversion, levels while the voxels are hot, and chunks that wait for their
//! last part.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::compute::Finished;
use super::flows::Ready;
use super::maps::Chain;
use super::steps::MaskValue;
use super::value::{Comp, Value};
use crate::Result;
use crate::brick::{Pool, Scratch, Voxels, gather};
use crate::gpu::Gpu;
use crate::grid::{AnyView, Region, View};
use crate::kernel::convert::{Mapping, convert_at};
use crate::kernel::reduce::{Cells, Level0, planes};
use crate::kernel::simd::Level;
use crate::kernel::{Context, pointwise};
use crate::plan::graph::{Producer, WireId};
use crate::plan::{Group, OutputPlan, Plan};
use crate::store::sink::Encoded;
use crate::store::{Sink, Spill};

/// One encoded chunk on its way to a writer.
#[derive(Debug)]
pub struct Item {
    /// Index into the plan's outputs.
    pub output: usize,
    pub dataset: usize,
    pub component: usize,
    pub region: Region,
    pub chunk: Encoded,
}

/// An output being assembled.
#[derive(Debug)]
pub struct Target {
    pub sink: Sink,
    /// By level of the chain: rounded voxels of levels whose files several tasks share.
    pub levels: Vec<Option<Spill>>,
    /// Unrounded cells of the last level that bricks make, for the levels beyond.
    pub cells: Option<Spill>,
    /// The folder of both.
    pub scratch: PathBuf,
    /// Values that map to 0 and the largest code.
    pub range: Option<[f64; 2]>,
}

/// A task in progress.
#[derive(Debug)]
pub struct TaskSlot {
    /// Number over all groups.
    pub number: usize,
    pub region: Region,
    /// Bricks not yet written.
    pub left: AtomicUsize,
    open: Mutex<HashMap<ChunkKey, Open>>,
}

/// Output, level, component, chunk index.
pub(super) type ChunkKey = (usize, usize, usize, [i64; 3]);

/// A chunk that waits for its last part.
#[derive(Debug)]
struct Open {
    voxels: Voxels,
    region: Region,
    left: usize,
}

impl TaskSlot {
    pub fn new(number: usize, region: Region, bricks: usize) -> TaskSlot {
        TaskSlot { number, region, left: AtomicUsize::new(bricks), open: Mutex::default() }
    }

    /// Counts one written brick; true for the last.
    pub fn written(&self) -> bool {
        self.left.fetch_sub(1, Ordering::AcqRel) == 1
    }
}

/// Assembles the bricks of one group.
pub struct Assembler<'a> {
    pub plan: &'a Plan,
    pub group: &'a Group,
    /// By output of the plan; `None` for outputs that are finished already.
    pub targets: &'a [Option<Target>],
    pub pool: &'a Pool,
    pub level: Level,
    /// Makes the occlusion maps that the plan placed on it.
    pub gpu: Option<&'a Gpu>,
}

/// Where the parts of one component go.
pub struct Place<'a> {
    pub index: usize,
    pub output: &'a OutputPlan,
    pub target: &'a Target,
    pub component: usize,
    pub slot: &'a TaskSlot,
}

impl Assembler<'_> {
    /// Encoded chunks that this brick completes, over all outputs and levels.
    pub fn assemble(&self, done: &Finished, slot: &TaskSlot, scratch: &mut Scratch) -> Result<Vec<Item>> {
        let mut items = Vec::new();
        for &index in &self.group.outputs {
            let (output, Some(target)) = (&self.plan.outputs[index], &self.targets[index]) else { continue };
            if let Some(map) = &output.map {
                let chain = Chain { assembler: self, index, output, map, target, done, slot };
                chain.assemble(scratch, &mut items)?;
                continue;
            }
            for (component, &(wire, comp)) in output.parts.iter().enumerate() {
                let place = Place { index, output, target, component, slot };
                if let Some(ready) = done.ready(index, component) {
                    self.ready(&place, ready, done.brick, &mut items)?;
                    continue;
                }
                if !self.uniform(&place, wire, comp, done, scratch, &mut items)? {
                    self.component(&place, wire, comp, done, scratch, &mut items)?;
                }
            }
        }
        Ok(items)
    }

    fn component(
        &self,
        place: &Place,
        wire: WireId,
        comp: usize,
        done: &Finished,
        scratch: &mut Scratch,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let value = self.scaled(wire, comp, done);
        let view = value.view();
        self.store_level(place, 0, done.brick, view, items)?;
        if place.output.level_count() > 1 {
            let mean = match place.output.means.get(place.component) {
                Some(&Some(mean)) if place.output.reduce == crate::stage::Reduce::Moments => {
                    Some(self.scaled(mean, comp, done))
                }
                _ => None,
            };
            let needed = self.needed(wire, done);
            let src = Level0 {
                value: view,
                mean: mean.as_ref().map(|m| m.view()),
                needed: needed.as_ref().map(|m| View::dense(m, done.brick.shape())),
            };
            self.levels(place, src, done.brick, scratch, items)?;
            mean.into_iter().for_each(|m| m.recycle(self.pool));
        }
        value.recycle(self.pool);
        Ok(())
    }

    /// Levels that were made where the voxels were.
    fn ready(&self, place: &Place, ready: &Ready, brick: Region, items: &mut Vec<Item>) -> Result<()> {
        for (k, voxels) in ready.levels.iter().enumerate() {
            let region = place.output.level_box(k, brick);
            self.put(place, k, region, voxels.view(region.shape()), items)?;
        }
        self.spill(place, brick, &ready.cells);
        Ok(())
    }

    /// Keeps the numbers of cells for the levels beyond.
    pub(super) fn spill(&self, place: &Place, brick: Region, numbers: &[f64]) {
        let Some(spill) = &place.target.cells else { return };
        let k = place.output.brick_level();
        let region = place.output.level_box(k, brick);
        for (p, plane) in numbers.chunks_exact(region.voxels()).enumerate() {
            spill.write(place.component * planes(place.output.reduce) + p, region, bytemuck::cast_slice(plane));
        }
    }

    /// Levels 1 to the last that bricks make; cells of that one are kept for the levels beyond.
    fn levels(
        &self,
        place: &Place,
        src: Level0,
        brick: Region,
        scratch: &mut Scratch,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let output = place.output;
        let mut cx = Context { level: self.level, scratch };
        let mut cells = Cells::default();
        for k in 1..=output.brick_level() {
            let halved = output.level(k).expect("level exists").halved;
            // Every level in a buffer of its own length: one that is cut for a coarser level would be cleared for the next brick.
            let fine = std::mem::replace(&mut cells, self.room(output, k, brick));
            if k == 1 {
                cells.first(output.reduce, output.is_std, src, halved, &mut cx);
            } else {
                cells.next_from(&fine, halved, &mut cx);
            }
            self.put_cells(fine);
            let mut rounded = self.pool.take(output.spec.dtype, cells.shape.iter().product());
            cells.write([0; 3], self.mapping(place), rounded.view_mut(cells.shape), &mut cx);
            self.put(place, k, output.level_box(k, brick), rounded.view(cells.shape), items)?;
            self.pool.put(rounded);
        }
        if place.target.cells.is_some() {
            let mut data = Vec::new();
            cells.store(&mut data);
            self.spill(place, brick, &data);
        }
        self.put_cells(cells);
        Ok(())
    }

    /// Gives back what [`Assembler::room`] took.
    fn put_cells(&self, cells: Cells) {
        let numbers = [cells.value, cells.inner, cells.between];
        numbers.into_iter().filter(|n| n.capacity() > 0).for_each(|n| self.pool.put_numbers(n));
    }

    /// Room for the cells of level `k` over a brick.
    fn room(&self, output: &OutputPlan, k: usize, brick: Region) -> Cells {
        let (n, moments) = (output.level_box(k, brick).voxels(), output.reduce == crate::stage::Reduce::Moments);
        let spread = || if moments { self.pool.take_numbers(n) } else { Vec::new() };
        Cells { value: self.pool.take_numbers(n), inner: spread(), between: spread(), ..Cells::default() }
    }

    pub fn mapping(&self, place: &Place) -> Mapping {
        place.output.mapping(place.component, place.target.range)
    }

    /// Converts unrounded values to the output's type and puts them.
    pub fn store_level(
        &self,
        place: &Place,
        k: usize,
        brick: Region,
        view: AnyView,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let region = place.output.level_box(k, brick);
        self.store_box(place, k, region, view, items)
    }

    /// As [`Self::store_level`], for a box of the level's own cells.
    pub fn store_box(
        &self,
        place: &Place,
        k: usize,
        region: Region,
        view: AnyView,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let spec = &place.output.spec;
        if view.dtype() == spec.dtype && place.target.range.is_none() {
            return self.put(place, k, region, view, items);
        }
        if self.in_chunks(place, k) {
            return self.put_chunks(place, k, region, view, Some(self.mapping(place)), items);
        }
        let converted = self.converted(place, view, self.mapping(place));
        let result = self.put(place, k, region, converted.view(region.shape()), items);
        self.pool.put(converted);
        result
    }

    fn converted(&self, place: &Place, view: AnyView, mapping: Mapping) -> Voxels {
        let shape = view.shape();
        let mut converted = self.pool.take(place.output.spec.dtype, shape.iter().product());
        convert_at(self.level, view, mapping, converted.view_mut(shape));
        converted
    }

    /// Whether voxels of a level go to chunks that are encoded here.
    pub(super) fn in_chunks(&self, place: &Place, k: usize) -> bool {
        place.output.is_zarr() && place.target.levels[k].is_none()
    }

    /// Hands voxels of the output's type to their chunks: whole ones are encoded at once, parts wait for the rest.
    pub fn put(&self, place: &Place, k: usize, region: Region, view: AnyView, items: &mut Vec<Item>) -> Result<()> {
        if self.in_chunks(place, k) {
            return self.put_chunks(place, k, region, view, None, items);
        }
        if let Some(spill) = &place.target.levels[k] {
            let mut dense = self.pool.take(view.dtype(), region.voxels());
            gather::copy_common(view, region, dense.view_mut(region.shape()), region);
            spill.write(place.component, region, dense.as_bytes());
            self.pool.put(dense);
            return Ok(());
        }
        let dataset = k - place.output.first_level();
        let chunk = place.target.sink.encode(dataset, region, view)?;
        items.push(Item { output: place.index, dataset, component: place.component, region, chunk });
        Ok(())
    }

    /// As [`Assembler::put`]; with a mapping each chunk is converted by itself, and encoded while the cache has it.
    fn put_chunks(
        &self,
        place: &Place,
        k: usize,
        region: Region,
        view: AnyView,
        mapping: Option<Mapping>,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let (output, sink) = (place.output, &place.target.sink);
        let dataset = k - output.first_level();
        let mut push = |region: Region, voxels: AnyView| -> Result<()> {
            let chunk = sink.encode(dataset, region, voxels)?;
            items.push(Item { output: place.index, dataset, component: place.component, region, chunk });
            Ok(())
        };
        let whole = Region::whole(output.level(k).expect("level exists").shape);
        for index in region.cells([0; 3], output.spec.chunk).iter() {
            let chunk = Region::of_cell(index, [0; 3], output.spec.chunk).clip(&whole);
            let part = chunk.clip(&region);
            let piece = view.part(region.offset_of(&part), part.shape());
            let converted = mapping.map(|m| self.converted(place, piece, m));
            let piece = converted.as_ref().map_or(piece, |c| c.view(part.shape()));
            if part == chunk {
                push(chunk, piece)?;
            } else if let Some(full) = self.park(place, (place.index, k, place.component, index), chunk, part, piece) {
                push(chunk, full.view(chunk.shape()))?;
                self.pool.put(full);
            }
            converted.into_iter().for_each(|c| self.pool.put(c));
        }
        Ok(())
    }

    /// Adds a part to an open chunk; returns it when that was the last.
    pub(super) fn park(
        &self,
        place: &Place,
        key: ChunkKey,
        chunk: Region,
        region: Region,
        view: AnyView,
    ) -> Option<Voxels> {
        let mut open = place.slot.open.lock().unwrap_or_else(|e| e.into_inner());
        let entry = open.entry(key).or_insert_with(|| Open {
            voxels: self.pool.take(view.dtype(), chunk.voxels()),
            region: chunk,
            left: chunk.voxels(),
        });
        gather::copy_common(view, region, entry.voxels.view_mut(entry.region.shape()), entry.region);
        entry.left -= region.clip(&chunk).voxels();
        if entry.left > 0 {
            return None;
        }
        open.remove(&key).map(|o| o.voxels)
    }

    /// A wire's component over the brick: stored values where they are the values, else scaled, missing voxels NaN.
    fn scaled<'d>(&self, wire: WireId, comp: usize, done: &'d Finished) -> Scaled<'d> {
        let value = done.value(wire);
        let wire = &self.plan.graph.wires[wire];
        let len = done.brick.voxels();
        if let Comp::Const(v) = value.comps[comp] {
            let missing = wire.missing == Some(v as i64) && wire.missing.is_some();
            let (dtype, v) = match wire.scaled_dtype() {
                d if d == wire.dtype && wire.affine.is_identity() => (d, if missing { f64::NAN } else { v }),
                d => (d, if missing { f64::NAN } else { wire.affine.apply(v) }),
            };
            let mut buffer = self.pool.take(dtype, len);
            buffer.fill(v);
            return Scaled::Owned(buffer, done.brick);
        }
        if wire.scaled_dtype() == wire.dtype && wire.affine.is_identity() {
            return Scaled::Borrowed(value, comp, done.brick);
        }
        let mut buffer = self.pool.take(wire.scaled_dtype(), len);
        pointwise::scale(value.view(comp, done.brick), wire.affine, wire.missing, buffer.view_mut(done.brick.shape()));
        Scaled::Owned(buffer, done.brick)
    }

    /// The brick's part of the mask of the stage that made a wire; `None` = every voxel is needed.
    fn needed(&self, wire: WireId, done: &Finished) -> Option<Vec<u8>> {
        let Producer::Step(step) = self.plan.graph.wires[wire].producer else { return None };
        match done.mask(step)? {
            MaskValue::All => None,
            MaskValue::None => Some(vec![0; done.brick.voxels()]),
            MaskValue::Some(mask) => {
                let region = done.value(wire).region;
                let mut part = vec![0; done.brick.voxels()];
                let dst = crate::grid::ViewMut::dense(&mut part, done.brick.shape());
                gather::copy(View::dense(mask, region.shape()), region, dst, done.brick);
                Some(part)
            }
        }
    }
}

enum Scaled<'a> {
    Borrowed(&'a Value, usize, Region),
    Owned(Voxels, Region),
}

impl Scaled<'_> {
    fn view(&self) -> AnyView<'_> {
        match self {
            Scaled::Borrowed(value, comp, region) => value.view(*comp, *region),
            Scaled::Owned(voxels, region) => voxels.view(region.shape()),
        }
    }

    fn recycle(self, pool: &Pool) {
        if let Scaled::Owned(voxels, _) = self {
            pool.put(voxels);
        }
    }
}
