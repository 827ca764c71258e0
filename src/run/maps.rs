//! Occlusion maps inside a brick: the chain of levels with its own halo, from the source's voxels down.

use super::assemble::{Assembler, Item, Place, Target, TaskSlot};
use super::compute::Finished;
use super::value::Comp;
use crate::brick::{Pool, Scratch, Voxels};
use crate::gpu::MapLevels;
use crate::gpu::maps::MapCodes;
use crate::grid::{AnyView, Region, View};
use crate::kernel::Context;
use crate::kernel::convert::convert_at;
use crate::kernel::occlusion_map::{Moments, base, coarsen, needed};
use crate::plan::{MAP_BLOCK, MapPlan, OutputPlan};
use crate::{Error, Result};

/// A brick of an occlusion map on its way to the files of a task.
pub struct Chain<'a> {
    pub assembler: &'a Assembler<'a>,
    /// Of the output in the plan.
    pub index: usize,
    pub output: &'a OutputPlan,
    pub map: &'a MapPlan,
    pub target: &'a Target,
    pub done: &'a Finished,
    pub slot: &'a TaskSlot,
}

impl Chain<'_> {
    /// Makes every level of the map that the brick owns; cells of the last one are kept for the levels beyond.
    pub fn assemble(&self, scratch: &mut Scratch, items: &mut Vec<Item>) -> Result<()> {
        let last = self.output.brick_level();
        let mut cx = Context { level: self.assembler.level, scratch };
        if let Comp::Const(stored) = self.done.value(self.map.source).comps[0] {
            let moments = self.of_constant(stored);
            if stays(self.map, last, moments, &mut cx) {
                return self.uniform(moments, items);
            }
        }
        match self.on_gpu()? {
            Some(made) => self.put_codes(&made, last, items),
            None => self.by_cpu(last, &mut cx, items),
        }
    }

    /// What the GPU made of the brick's own cells, and level 0 where it is stored.
    fn put_codes(&self, made: &MapLevels, last: usize, items: &mut Vec<Item>) -> Result<()> {
        let own = |k| self.output.level_box(k, self.done.brick);
        if self.map.first == 0 {
            let moments = self.base_level(own(0));
            self.store(0, &moments, own(0), items)?;
            give_back(self.assembler.pool, moments);
        }
        for (k, codes) in (1..).zip(&made.codes) {
            for (component, voxels) in codes.iter().enumerate() {
                self.assembler.put(&self.place(component), k, own(k), voxels.view(own(k).shape()), items)?;
            }
        }
        made.last.iter().for_each(|m| self.keep(m, own(last)));
        Ok(())
    }

    fn by_cpu(&self, last: usize, cx: &mut Context, items: &mut Vec<Item>) -> Result<()> {
        let (pool, layout) = (self.assembler.pool, &self.map.chain.levels);
        let boxes = self.boxes(last);
        // Where nobody stores level 0, it is never there as a whole.
        let (from, mut moments) =
            if self.map.by_blocks(last) { (1, self.level_1(boxes[1], cx)) } else { (0, self.base_level(boxes[0])) };
        for k in from..=last {
            if k > from {
                let mut coarse = room(pool, boxes[k]);
                coarsen(&moments, boxes[k - 1], layout[k - 1].shape, layout[k].halved, boxes[k], &mut coarse, cx);
                give_back(pool, std::mem::replace(&mut moments, coarse));
            }
            if k >= self.map.first {
                self.store(k, &moments, boxes[k], items)?;
            }
            if k == last {
                self.keep(&moments, boxes[k]);
            }
        }
        give_back(pool, moments);
        Ok(())
    }

    /// Level 1 of the chain over `region`, block by block from level 0.
    fn level_1(&self, region: Region, cx: &mut Context) -> Moments {
        let (pool, layout) = (self.assembler.pool, &self.map.chain.levels);
        let mut made = room(pool, region);
        let [_, ny, nx] = region.shape();
        let cells = [MAP_BLOCK[0], MAP_BLOCK[1], nx.max(1)];
        for block in region.cells(region.lo, cells).iter().map(|i| Region::of_cell(i, region.lo, cells).clip(&region)) {
            let read = needed(block, layout[1].halved, layout[0].shape);
            let (fine, mut coarse) = (self.base_level(read), room(pool, block));
            coarsen(&fine, read, layout[0].shape, layout[1].halved, block, &mut coarse, cx);
            // Whole rows, which lie one after the other in both.
            let ([z, y, _], rows) = (region.offset_of(&block), block.shape()[1] * nx);
            for k in 0..block.shape()[0] {
                let (to, from) = (((z + k) * ny + y) * nx, k * rows);
                made.mean[to..to + rows].copy_from_slice(&coarse.mean[from..from + rows]);
                made.variance[to..to + rows].copy_from_slice(&coarse.variance[from..from + rows]);
            }
            give_back(pool, fine);
            give_back(pool, coarse);
        }
        made
    }

    fn place(&self, component: usize) -> Place<'_> {
        Place { index: self.index, output: self.output, target: self.target, component, slot: self.slot }
    }

    /// Converts and puts the brick's own part of one level; `moments` cover `have`.
    fn store(&self, k: usize, moments: &Moments, have: Region, items: &mut Vec<Item>) -> Result<()> {
        let own = self.output.level_box(k, self.done.brick);
        for (component, &which) in self.map.moments.iter().enumerate() {
            let values = if which == 0 { &moments.mean } else { &moments.variance };
            let view = AnyView::F64(View::dense(values, have.shape()).part(have.offset_of(&own), own.shape()));
            self.assembler.store_box(&self.place(component), k, own, view, items)?;
        }
        Ok(())
    }

    /// Keeps the brick's own cells of the last level that bricks make for the levels beyond; `moments` cover `have`.
    fn keep(&self, moments: &Moments, have: Region) {
        let Some(spill) = &self.target.cells else { return };
        let own = self.output.level_box(self.output.brick_level(), self.done.brick);
        for (plane, values) in [&moments.mean, &moments.variance].into_iter().enumerate() {
            spill.write(plane, own, bytemuck::cast_slice(&dense(values, have, own)));
        }
    }

    /// The levels from 1 on over the brick's own cells, where the plan placed the map on the GPU and the brick is not constant.
    fn on_gpu(&self) -> Result<Option<MapLevels>> {
        let (plan, output, map) = (self.assembler.plan, self.output, self.map);
        let value = self.done.value(map.source);
        let voxels = matches!(value.comps[0], Comp::Voxels(_));
        let gpu = self.assembler.gpu.filter(|_| plan.map_on_gpu(self.index) && voxels);
        let Some((gpu, job)) = gpu.and_then(|g| Some((g, output.map_job(&plan.graph)?))) else { return Ok(None) };
        let brick = self.done.brick.shift(output.region.lo.map(|v| -v));
        let codes = MapCodes {
            first: map.first,
            moments: map.moments.clone(),
            dtype: output.spec.dtype,
            mapping: output.mapping(0, self.target.range),
            affine: plan.graph.wires[map.source].affine,
            cells: self.target.cells.is_some(),
        };
        let read = job.boxes(brick)[0];
        let src = value.view(0, read.shift(output.region.lo));
        let made = gpu.occlusion_codes(src, read, &job, brick, &codes);
        let failed =
            |e| Error::Failed(format!("the occlusion map {} on the GPU: {e}; --resume continues", output.spec.name));
        made.map(Some).map_err(failed)
    }

    /// The box of each level, in its own cells, that the brick's levels need.
    fn boxes(&self, last: usize) -> Vec<Region> {
        let own = |k| self.output.level_box(k, self.done.brick);
        let layout = &self.map.chain.levels;
        let mut boxes = vec![own(last); last + 1];
        for k in (0..last).rev() {
            boxes[k] = needed(boxes[k + 1], layout[k + 1].halved, layout[k].shape).union(&own(k));
        }
        boxes
    }

    /// Level 0 of the chain over `region` (counted from the output's start).
    fn base_level(&self, region: Region) -> Moments {
        let wire = &self.assembler.plan.graph.wires[self.map.source];
        let value = self.done.value(self.map.source);
        let part = region.shift(self.output.region.lo);
        let mut moments = room(self.assembler.pool, region);
        match &value.comps[0] {
            Comp::Voxels(_) => base(value.view(0, part), wire.affine, wire.missing, &mut moments),
            Comp::Const(v) => {
                let [mean, variance] = self.of_constant(*v);
                moments.mean.fill(mean);
                moments.variance.fill(variance);
            }
        }
        moments
    }

    /// Mean and variance of voxels of one stored value.
    fn of_constant(&self, stored: f64) -> [f64; 2] {
        let wire = &self.assembler.plan.graph.wires[self.map.source];
        let missing = stored.is_nan() || wire.missing.is_some_and(|m| m as f64 == stored);
        if missing { [f64::NAN; 2] } else { [wire.affine.apply(stored), 0.0] }
    }

    /// Delivers a brick whose levels are all one constant.
    fn uniform(&self, moments: [f64; 2], items: &mut Vec<Item>) -> Result<()> {
        let (assembler, output, spec) = (self.assembler, self.output, self.target.sink.spec());
        let own = |k| output.level_box(k, self.done.brick);
        for k in self.map.first..=output.brick_level() {
            for (component, &which) in self.map.moments.iter().enumerate() {
                let place = self.place(component);
                let mut code = Voxels::zeroed(spec.dtype, 1);
                let value = [moments[which]];
                let view = AnyView::F64(View::dense(&value, [1; 3]));
                convert_at(assembler.level, view, assembler.mapping(&place), code.view_mut([1; 3]));
                assembler.put_uniform(&place, k, own(k), &code, items)?;
            }
        }
        if let Some(spill) = &self.target.cells {
            let own = own(output.brick_level());
            for (plane, v) in moments.into_iter().enumerate() {
                spill.write(plane, own, bytemuck::cast_slice(&vec![v; own.voxels()]));
            }
        }
        Ok(())
    }
}

/// Room for the cells of a box.
fn room(pool: &Pool, region: Region) -> Moments {
    Moments { mean: pool.take_numbers(region.voxels()), variance: pool.take_numbers(region.voxels()) }
}

fn give_back(pool: &Pool, moments: Moments) {
    pool.put_numbers(moments.mean);
    pool.put_numbers(moments.variance);
}

/// Whether every level of a constant is that constant, bit for bit: asked of the kernel on volumes as small as have all the ends
/// that the level's own has.
fn stays(map: &MapPlan, last: usize, [mean, variance]: [f64; 2], cx: &mut Context) -> bool {
    let same = |values: &[f64], v: f64| values.iter().all(|w| w.to_bits() == v.to_bits() || w.is_nan() && v.is_nan());
    (1..=last).all(|k| {
        let small = map.chain.levels[k - 1].shape.map(|n| n.min(8 + n % 2));
        let halved = map.chain.levels[k].halved;
        let coarse: [usize; 3] = std::array::from_fn(|a| if halved[a] { small[a].div_ceil(2) } else { small[a] });
        let n = small.iter().product();
        let fine = Moments { mean: vec![mean; n], variance: vec![variance; n] };
        let mut made = Moments::default();
        coarsen(&fine, Region::whole(small), small, halved, Region::whole(coarse), &mut made, cx);
        same(&made.mean, mean) && same(&made.variance, variance)
    })
}

/// The part `own` of values that cover `have`, densely packed.
fn dense(values: &[f64], have: Region, own: Region) -> Vec<f64> {
    let view = View::dense(values, have.shape()).part(have.offset_of(&own), own.shape());
    let [nz, ny, _] = own.shape();
    (0..nz).flat_map(|z| (0..ny).flat_map(move |y| view.row_at(z, y).iter().copied())).collect()
}
