//! The second phase: levels whose files several tasks share, and levels coarser than bricks make. Everything is read from
//! scratch, chunk by chunk, so memory does not grow with the volume.

use rayon::prelude::*;

use super::assemble::Target;
use crate::Result;
use crate::brick::{Scratch, Voxels};
use crate::grid::{AnyView, DType, Region, View};
use crate::kernel::Context;
use crate::kernel::convert::convert_at;
use crate::kernel::occlusion_map::{Moments, coarsen, needed};
use crate::kernel::reduce::{Cells, planes};
use crate::kernel::simd::Level;
use crate::plan::OutputPlan;
use crate::store::Spill;

/// Told of the box of a chunk before it is made.
type Before<'a> = &'a (dyn Fn(Region) -> Result<()> + Sync);

/// Finishes all levels of one output, so many chunks at a time. Idempotent: a second phase that was killed or cancelled is simply
/// done again. `before` hears of every chunk, [`voxels`] of them together, and its error stops the phase.
pub fn finish_levels(
    output: &OutputPlan,
    target: &Target,
    (pool, lanes): (&rayon::ThreadPool, usize),
    before: Before,
) -> Result<u64> {
    pool.install(|| {
        let mut bytes = 0;
        for k in output.first_level()..=output.brick_level() {
            if let Some(spill) = &target.levels[k] {
                bytes += shared_level(output, target, spill, k, lanes, before)?;
            }
        }
        let mut fine = None;
        for k in output.brick_level() + 1..output.level_count() {
            let spill = fine.as_ref().or(target.cells.as_ref()).expect("cells were kept for the levels beyond");
            let (written, next) = coarse_level(output, target, spill, (k, lanes), before)?;
            bytes += written;
            fine = Some(next);
        }
        Ok(bytes)
    })
}

/// Voxels that the second phase makes of an output, each component and map counted once.
pub fn voxels(output: &OutputPlan, target: &Target) -> usize {
    let of = |k: usize| output.level(k).expect("level exists").shape.iter().product::<usize>();
    let shared = (output.first_level()..=output.brick_level()).filter(|&k| target.levels[k].is_some());
    let coarse = output.brick_level() + 1..output.level_count();
    components(output) * shared.map(of).sum::<usize>() + coarse.map(of).sum::<usize>()
}

/// Boxes of the chunks of level `k`.
fn chunks(output: &OutputPlan, k: usize) -> Vec<Region> {
    let whole = Region::whole(output.level(k).expect("level exists").shape);
    let cells = whole.cells([0; 3], output.spec.chunk);
    cells.iter().map(|i| Region::of_cell(i, [0; 3], output.spec.chunk).clip(&whole)).collect()
}

fn components(output: &OutputPlan) -> usize {
    output.spec.components.unwrap_or(1)
}

/// Encodes a level whose rounded voxels tasks left in scratch.
fn shared_level(
    output: &OutputPlan,
    target: &Target,
    spill: &Spill,
    k: usize,
    lanes: usize,
    before: Before,
) -> Result<u64> {
    let dataset = k - output.first_level();
    let one = |&(component, region): &(usize, Region)| {
        before(region)?;
        let mut voxels = Voxels::zeroed(output.spec.dtype, region.voxels());
        spill.read(component, region, voxels.as_bytes_mut());
        let chunk = target.sink.encode(dataset, region, voxels.view(region.shape()))?;
        target.sink.put(dataset, component, region, chunk)
    };
    let all: Vec<(usize, Region)> =
        (0..components(output)).flat_map(|c| chunks(output, k).into_iter().map(move |r| (c, r))).collect();
    let bytes = in_lanes(&all, lanes, one)?;
    target.sink.commit(dataset, Region::whole(output.level(k).expect("level exists").shape))?;
    Ok(bytes)
}

/// Does so many at a time, each of which holds its chunk; returns the bytes written.
fn in_lanes<T: Sync>(all: &[T], lanes: usize, one: impl Fn(&T) -> Result<u64> + Sync) -> Result<u64> {
    let lane = |first: usize| all.iter().skip(first).step_by(lanes).try_fold(0, |bytes, item| Ok(bytes + one(item)?));
    (0..lanes).into_par_iter().map(lane).try_reduce(|| 0, |a, b| Ok(a + b))
}

/// Makes level `k` from the cells of level `k - 1`; returns the bytes written and the cells of level `k`.
fn coarse_level(
    output: &OutputPlan,
    target: &Target,
    fine: &Spill,
    (k, lanes): (usize, usize),
    before: Before,
) -> Result<(u64, Spill)> {
    let layout = output.level(k).expect("level exists");
    let per_component = if output.map.is_some() { 2 } else { components(output) * planes(output.reduce) };
    let next = Spill::open(&target.scratch.join(format!("cells.{k}")), layout.shape, per_component, size_of::<f64>())?;
    let bytes = in_lanes(&chunks(output, k), lanes, |&region| {
        before(region)?;
        match output.map {
            Some(_) => map_chunk(output, target, fine, &next, k, region),
            None => cells_chunk(output, target, fine, &next, k, region),
        }
    })?;
    target.sink.commit(k - output.first_level(), Region::whole(layout.shape))?;
    Ok((bytes, next))
}

fn read_plane(spill: &Spill, plane: usize, region: Region) -> Vec<f64> {
    read_planes(spill, plane..plane + 1, region)
}

/// Planes of a box, one after the other.
fn read_planes(spill: &Spill, planes: std::ops::Range<usize>, region: Region) -> Vec<f64> {
    let mut voxels = Voxels::zeroed(DType::F64, planes.len() * region.voxels());
    let one = region.voxels() * size_of::<f64>();
    for (plane, bytes) in planes.zip(voxels.as_bytes_mut().chunks_exact_mut(one)) {
        spill.read(plane, region, bytes);
    }
    match voxels {
        Voxels::F64(v) => v,
        _ => unreachable!("made as f64"),
    }
}

/// Cells below that are turned into cells at a time: a chunk has many, and made in one go they leave every cache and, of wide
/// chunks, the budget, on one thread where a level has one chunk. 2-core Zen 4 VM, AVX-512, 2026-11-27: the end of a pyramid of
/// 1024^3 voxels, of which 64^3 cells from 128^3 are most, takes 68 ms by slabs and 174 in one go (146 of them for these cells).
const AT_ONCE: usize = 1 << 15;

/// One chunk, all components, of reduced cells.
fn cells_chunk(
    output: &OutputPlan,
    target: &Target,
    fine: &Spill,
    next: &Spill,
    k: usize,
    region: Region,
) -> Result<u64> {
    let slabs = slabs(region, AT_ONCE / 8, 1);
    let mut bytes = 0;
    for component in 0..components(output) {
        let mut rounded = Voxels::zeroed(output.spec.dtype, region.voxels());
        let mut left = rounded.as_bytes_mut();
        let parts: Vec<(Region, &mut [u8])> = (slabs.iter())
            .map(|&slab| (slab, left.split_off_mut(..slab.voxels() * output.spec.dtype.size()).expect("slabs fill it")))
            .collect();
        parts.into_par_iter().for_each_init(Room::default, |room, (slab, dst)| {
            dst.copy_from_slice(cells_slab(output, target, [fine, next], k, component, slab, room).as_bytes());
        });
        bytes += store(output, target, k, component, region, &rounded)?;
    }
    Ok(bytes)
}

/// A region cut into whole planes, or rows of one plane, of about so many cells, in memory order; at least `least` planes and
/// rows, where there are as many.
fn slabs(region: Region, cells: usize, least: usize) -> Vec<Region> {
    let [nz, ny, nx] = region.shape();
    let planes = (cells / (ny * nx)).clamp(least, nz.max(least));
    let rows = if planes * ny * nx > cells { (cells / (planes * nx)).clamp(least, ny.max(least)) } else { ny };
    let cut = |a: usize, n: usize| {
        (region.lo[a]..region.hi[a]).step_by(n).map(move |lo| (lo, (lo + n as i64).min(region.hi[a])))
    };
    let slab = |(z, y): ((i64, i64), (i64, i64))| Region::new([z.0, y.0, region.lo[2]], [z.1, y.1, region.hi[2]]);
    cut(0, planes).flat_map(|z| cut(1, rows).map(move |y| slab((z, y)))).collect()
}

/// What a thread needs for slabs of cells.
#[derive(Default)]
struct Room {
    scratch: Scratch,
    source: Cells,
    cells: Cells,
    stored: Vec<f64>,
}

/// Cells of a slab of level `k`: kept for the next level, and rounded.
fn cells_slab(
    output: &OutputPlan,
    target: &Target,
    [fine, next]: [&Spill; 2],
    k: usize,
    component: usize,
    slab: Region,
    room: &mut Room,
) -> Voxels {
    let (layout, below) = (output.level(k).expect("level exists"), output.level(k - 1).expect("level exists"));
    let step: [i64; 3] = layout.halved.map(|h| 1 + i64::from(h));
    let scaled = |v: [i64; 3]| std::array::from_fn(|a| v[a] * step[a]);
    let children = Region::new(scaled(slab.lo), scaled(slab.hi)).clip(&Region::whole(below.shape));
    let level_0 = output.region.shape();
    let extent = std::array::from_fn(|a| {
        let f = below.factor[a];
        (children.hi[a] as usize * f).min(level_0[a]) - children.lo[a] as usize * f
    });
    let Room { scratch, source, cells, stored } = room;
    let mut cx = Context { level: Level::detect(), scratch };
    let n_planes = planes(output.reduce);
    let first = component * n_planes;
    let data = read_planes(fine, first..first + n_planes, children);
    source.load(output.reduce, output.is_std, below.factor, extent, &data);
    cells.next_from(source, layout.halved, &mut cx);
    let mut rounded = Voxels::zeroed(output.spec.dtype, slab.voxels());
    cells.write([0; 3], output.mapping(component, target.range), rounded.view_mut(slab.shape()), &mut cx);
    stored.clear();
    cells.store(stored);
    for (p, plane) in stored.chunks_exact(slab.voxels()).enumerate() {
        next.write(first + p, slab, bytemuck::cast_slice(plane));
    }
    rounded
}

/// Cells of an occlusion map that are made at a time: with their surroundings a chunk of 64^3 would take 36 MiB on every thread.
const MAP_CELLS: usize = 1 << 15;

/// One chunk of an occlusion map's chain.
fn map_chunk(
    output: &OutputPlan,
    target: &Target,
    fine: &Spill,
    next: &Spill,
    k: usize,
    region: Region,
) -> Result<u64> {
    let map = output.map.as_ref().expect("the caller saw a map");
    let (layout, below) = (&map.chain.levels[k], &map.chain.levels[k - 1]);
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let mut made = Moments::default();
    let mut rounded: Vec<Voxels> =
        map.moments.iter().map(|_| Voxels::zeroed(output.spec.dtype, region.voxels())).collect();
    // Two cells on every side are seen by each slab.
    for slab in slabs(region, MAP_CELLS, 4) {
        let from = needed(slab, layout.halved, below.shape);
        let source = Moments { mean: read_plane(fine, 0, from), variance: read_plane(fine, 1, from) };
        coarsen(&source, from, below.shape, layout.halved, slab, &mut made, &mut cx);
        for ((component, &which), rounded) in map.moments.iter().enumerate().zip(&mut rounded) {
            let values = if which == 0 { &made.mean } else { &made.variance };
            let view = AnyView::F64(View::dense(values, slab.shape()));
            let part = rounded.view_mut(region.shape()).part(region.offset_of(&slab), slab.shape());
            convert_at(Level::detect(), view, output.mapping(component, target.range), part);
        }
        for (plane, values) in [&made.mean, &made.variance].into_iter().enumerate() {
            next.write(plane, slab, bytemuck::cast_slice(values));
        }
    }
    let mut bytes = 0;
    for (component, rounded) in rounded.iter().enumerate() {
        bytes += store(output, target, k, component, region, rounded)?;
    }
    Ok(bytes)
}

fn store(
    output: &OutputPlan,
    target: &Target,
    k: usize,
    component: usize,
    region: Region,
    voxels: &Voxels,
) -> Result<u64> {
    let dataset = k - output.first_level();
    let chunk = target.sink.encode(dataset, region, voxels.view(region.shape()))?;
    target.sink.put(dataset, component, region, chunk)
}
