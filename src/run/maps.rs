//! Occlusion maps inside a brick: the chain of levels with its own halo, from the source's voxels down.

use super::assemble::{Assembler, Item, Place, Target, TaskSlot, as_bytes};
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

/// Makes every level of the map that the brick owns; cells of the last one are kept for the levels beyond.
#[allow(clippy::too_many_arguments)]
pub fn assemble(
    assembler: &Assembler,
    index: usize,
    output: &OutputPlan,
    target: &Target,
    done: &Finished,
    slot: &TaskSlot,
    scratch: &mut Scratch,
    items: &mut Vec<Item>,
) -> Result<()> {
    let map = output.map.as_ref().expect("the caller saw a map");
    let last = output.brick_level();
    let mut cx = Context { level: assembler.level, scratch };
    if let Comp::Const(stored) = done.value(map.source).comps[0] {
        let moments = of_constant(assembler, map, stored);
        if stays(map, last, moments, &mut cx) {
            return uniform(assembler, index, output, target, moments, done.brick, slot, items);
        }
    }
    let mut boxes = chain_boxes(output, map, done.brick);
    let made = on_gpu(assembler, index, output, target, map, done)?;
    if made.is_some() {
        (0..=last).for_each(|k| boxes[k] = output.level_box(k, done.brick));
    }
    let base = || base_level(assembler, output, map, done, boxes[0]);
    if let Some(made) = made {
        if map.first == 0 {
            let moments = base();
            store(assembler, index, output, target, slot, 0, &moments, boxes[0], boxes[0], items)?;
            give_back(assembler.pool, moments);
        }
        for (k, codes) in (1..).zip(&made.codes) {
            for (component, voxels) in codes.iter().enumerate() {
                let place = Place { index, output, target, component, slot };
                assembler.put(&place, k, boxes[k], voxels.view(boxes[k].shape()), items)?;
            }
        }
        made.last.iter().for_each(|m| keep(target, m, boxes[last], boxes[last]));
        return Ok(());
    }
    // Where nobody stores level 0, it is never there as a whole.
    let (from, mut moments) =
        if map.by_blocks(last) { (1, level_1(assembler, output, map, done, boxes[1], &mut cx)) } else { (0, base()) };
    for k in from..=last {
        if k > from {
            let layout = &map.chain.levels;
            let mut coarse = room(assembler.pool, boxes[k]);
            coarsen(&moments, boxes[k - 1], layout[k - 1].shape, layout[k].halved, boxes[k], &mut coarse, &mut cx);
            give_back(assembler.pool, std::mem::replace(&mut moments, coarse));
        }
        let own = output.level_box(k, done.brick);
        if k >= map.first {
            store(assembler, index, output, target, slot, k, &moments, boxes[k], own, items)?;
        }
        if k == last {
            keep(target, &moments, boxes[k], own);
        }
    }
    give_back(assembler.pool, moments);
    Ok(())
}

/// Level 1 of the chain over `region`, block by block from level 0.
fn level_1(
    assembler: &Assembler,
    output: &OutputPlan,
    map: &MapPlan,
    done: &Finished,
    region: Region,
    cx: &mut Context,
) -> Moments {
    let (pool, layout) = (assembler.pool, &map.chain.levels);
    let mut made = room(pool, region);
    let [_, ny, nx] = region.shape();
    let cells = [MAP_BLOCK[0], MAP_BLOCK[1], nx.max(1)];
    for block in region.cells(region.lo, cells).iter().map(|i| Region::of_cell(i, region.lo, cells).clip(&region)) {
        let read = needed(block, layout[1].halved, layout[0].shape);
        let (fine, mut coarse) = (base_level(assembler, output, map, done, read), room(pool, block));
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

/// Room for the cells of a box.
fn room(pool: &Pool, region: Region) -> Moments {
    Moments { mean: pool.take_numbers(region.voxels()), variance: pool.take_numbers(region.voxels()) }
}

fn give_back(pool: &Pool, moments: Moments) {
    pool.put_numbers(moments.mean);
    pool.put_numbers(moments.variance);
}

/// Keeps cells of the last level that bricks make for the levels beyond.
fn keep(target: &Target, moments: &Moments, have: Region, own: Region) {
    let Some(spill) = &target.cells else { return };
    for (plane, values) in [&moments.mean, &moments.variance].into_iter().enumerate() {
        spill.write(plane, own, as_bytes(&dense(values, have, own)));
    }
}

/// The levels from 1 on over the brick's own cells, where the plan placed the map on the GPU and the brick is not constant.
fn on_gpu(
    assembler: &Assembler,
    index: usize,
    output: &OutputPlan,
    target: &Target,
    map: &MapPlan,
    done: &Finished,
) -> Result<Option<MapLevels>> {
    let plan = assembler.plan;
    let value = done.value(map.source);
    let gpu = assembler.gpu.filter(|_| plan.map_on_gpu(index) && matches!(value.comps[0], Comp::Voxels(_)));
    let Some((gpu, job)) = gpu.and_then(|g| Some((g, output.map_job(&plan.graph)?))) else { return Ok(None) };
    let origin = output.region.lo.map(|v| -v);
    let brick = done.brick.shift(origin);
    let codes = MapCodes {
        first: map.first,
        moments: map.moments.clone(),
        dtype: output.spec.dtype,
        mapping: output.mapping(0, target.range),
        affine: plan.graph.wires[map.source].affine,
        cells: target.cells.is_some(),
    };
    let read = job.boxes(brick)[0];
    let src = value.view(0, read.shift(output.region.lo));
    let made = gpu.occlusion_codes(src, read, &job, brick, &codes);
    let failed =
        |e| Error::Failed(format!("the occlusion map {} on the GPU: {e}; --resume continues", output.spec.name));
    made.map(Some).map_err(failed)
}

/// The box of each level, in its own cells, that the brick's levels need.
fn chain_boxes(output: &OutputPlan, map: &MapPlan, brick: Region) -> Vec<Region> {
    let last = output.brick_level();
    let mut boxes = vec![Region::new([0; 3], [0; 3]); last + 1];
    boxes[last] = output.level_box(last, brick);
    for k in (0..last).rev() {
        let layout = &map.chain.levels;
        let need = needed(boxes[k + 1], layout[k + 1].halved, layout[k].shape);
        boxes[k] = need.union(&output.level_box(k, brick));
    }
    boxes
}

/// Level 0 of the chain over `region` (counted from the output's start).
fn base_level(assembler: &Assembler, output: &OutputPlan, map: &MapPlan, done: &Finished, region: Region) -> Moments {
    let wire = &assembler.plan.graph.wires[map.source];
    let value = done.value(map.source);
    let part = region.shift(output.region.lo);
    let mut moments = room(assembler.pool, region);
    match &value.comps[0] {
        Comp::Voxels(_) => base(value.view(0, part), wire.affine, wire.missing, &mut moments),
        Comp::Const(v) => {
            let [mean, variance] = of_constant(assembler, map, *v);
            moments.mean.fill(mean);
            moments.variance.fill(variance);
        }
    }
    moments
}

/// Mean and variance of voxels of one stored value.
fn of_constant(assembler: &Assembler, map: &MapPlan, stored: f64) -> [f64; 2] {
    let wire = &assembler.plan.graph.wires[map.source];
    let missing = stored.is_nan() || wire.missing.is_some_and(|m| m as f64 == stored);
    if missing { [f64::NAN; 2] } else { [wire.affine.apply(stored), 0.0] }
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

/// Delivers a brick whose levels are all one constant.
#[allow(clippy::too_many_arguments)]
fn uniform(
    assembler: &Assembler,
    index: usize,
    output: &OutputPlan,
    target: &Target,
    moments: [f64; 2],
    brick: Region,
    slot: &TaskSlot,
    items: &mut Vec<Item>,
) -> Result<()> {
    let map = output.map.as_ref().expect("the caller saw a map");
    let spec = target.sink.spec();
    let fill = Voxels::one(spec.dtype, spec.fill);
    for k in map.first..=output.brick_level() {
        let own = output.level_box(k, brick);
        for (component, &which) in map.moments.iter().enumerate() {
            let place = Place { index, output, target, component, slot };
            let mut code = Voxels::zeroed(spec.dtype, 1);
            let value = [moments[which]];
            let view = AnyView::F64(View::dense(&value, [1; 3]));
            convert_at(assembler.level, view, assembler.mapping(&place), code.view_mut([1; 3]));
            if output.is_zarr() && code.as_bytes() == fill.as_bytes() {
                assembler.put_fill(&place, k, own, spec.fill, items)?;
                continue;
            }
            let mut voxels = assembler.pool.take(spec.dtype, own.voxels());
            voxels.fill(code.at(0));
            assembler.put(&place, k, own, voxels.view(own.shape()), items)?;
            assembler.pool.put(voxels);
        }
    }
    let own = output.level_box(output.brick_level(), brick);
    if let Some(spill) = &target.cells {
        for (plane, v) in moments.into_iter().enumerate() {
            spill.write(plane, own, as_bytes(&vec![v; own.voxels()]));
        }
    }
    Ok(())
}

/// Converts and puts the components of one level; `moments` cover `have`, of which `own` is stored.
#[allow(clippy::too_many_arguments)]
fn store(
    assembler: &Assembler,
    index: usize,
    output: &OutputPlan,
    target: &Target,
    slot: &TaskSlot,
    k: usize,
    moments: &Moments,
    have: Region,
    own: Region,
    items: &mut Vec<Item>,
) -> Result<()> {
    let map = output.map.as_ref().expect("the caller saw a map");
    for (component, &which) in map.moments.iter().enumerate() {
        let values = if which == 0 { &moments.mean } else { &moments.variance };
        let view = AnyView::F64(View::dense(values, have.shape()).part(have.offset_of(&own), own.shape()));
        let place = Place { index, output, target, component, slot };
        assembler.store_box(&place, k, own, view, items)?;
    }
    Ok(())
}

/// The part `own` of values that cover `have`, densely packed.
fn dense(values: &[f64], have: Region, own: Region) -> Vec<f64> {
    let view = View::dense(values, have.shape()).part(have.offset_of(&own), own.shape());
    let [nz, ny, _] = own.shape();
    (0..nz).flat_map(|z| (0..ny).flat_map(move |y| view.row_at(z, y).iter().copied())).collect()
}
