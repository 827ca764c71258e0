//! Bricks of one value in every level: chunks of the output's fill value are not stored, others are all the same, so no voxel is made
//! for them.

use super::assemble::{Assembler, Item, Place};
use super::compute::Finished;
use super::steps::MaskValue;
use super::value::Comp;
use crate::Result;
use crate::brick::{Scratch, Voxels};
use crate::grid::{DType, Region};
use crate::kernel::Context;
use crate::kernel::convert::convert_at;
use crate::kernel::reduce::Cells;
use crate::plan::graph::{Producer, WireId};
use crate::stage::Reduce;
use crate::store::sink::{Encoded, fill_bytes};

impl Assembler<'_> {
    /// Delivers a component whose voxels, and the cells of its levels, all become one; false, and nothing is done, for any other.
    pub(super) fn uniform(
        &self,
        place: &Place,
        wire: WireId,
        comp: usize,
        done: &Finished,
        scratch: &mut Scratch,
        items: &mut Vec<Item>,
    ) -> Result<bool> {
        let (output, spec) = (place.output, place.target.sink.spec());
        let Some((value, excluded)) = self.only_value(wire, comp, done) else { return Ok(false) };
        // Moments of equal values may not be 0, and sums of f64 may round.
        let one = value.at(0);
        let rounds = value.dtype() == DType::F64 && one != 0.0 && !one.is_nan();
        if !output.is_zarr() || output.reduce == Reduce::Moments || rounds || one.is_infinite() {
            return Ok(false);
        }
        let mut cx = Context { level: self.level, scratch };
        let (mut code, mut cells) = (Voxels::zeroed(spec.dtype, 1), Cells::default());
        convert_at(self.level, value.view([1; 3]), self.mapping(place), code.view_mut([1; 3]));
        let mut coarse = code.clone();
        cells.uniform(output.reduce, [1; 3], [1; 3], one, excluded);
        cells.write([0; 3], self.mapping(place), coarse.view_mut([1; 3]), &mut cx);
        if fill_bytes(spec.dtype, code.at(0)) != fill_bytes(spec.dtype, coarse.at(0)) {
            return Ok(false);
        }
        for k in 0..=output.brick_level() {
            self.put_uniform(place, k, output.level_box(k, done.brick), &code, items)?;
        }
        if place.target.cells.is_some() {
            let deepest = output.level(output.brick_level()).expect("level exists");
            cells.uniform(output.reduce, deepest.factor, done.brick.shape(), one, excluded);
            let mut numbers = Vec::new();
            cells.store(&mut numbers);
            self.spill(place, done.brick, &numbers);
        }
        Ok(true)
    }

    /// The value, as one voxel of its scaled type, of a component that has only one, and whether `where` excluded all voxels.
    fn only_value(&self, wire: WireId, comp: usize, done: &Finished) -> Option<(Voxels, bool)> {
        let Comp::Const(stored) = done.value(wire).comps[comp] else { return None };
        let wire = &self.plan.graph.wires[wire];
        let mask = match wire.producer {
            Producer::Step(step) => done.mask(step),
            _ => None,
        };
        let excluded = match mask {
            None | Some(MaskValue::All) => false,
            Some(MaskValue::None) => true,
            Some(MaskValue::Some(_)) => return None,
        };
        if wire.missing.is_some_and(|missing| missing as f64 == stored) {
            return None;
        }
        let dtype = wire.scaled_dtype();
        let plain = dtype == wire.dtype && wire.affine.is_identity();
        let value = if plain { stored } else { wire.affine.apply(stored) };
        Some((Voxels::one(dtype, value), excluded))
    }

    /// As [`Assembler::put`], of a box of one voxel of the output's type.
    pub(super) fn put_uniform(
        &self,
        place: &Place,
        k: usize,
        region: Region,
        voxel: &Voxels,
        items: &mut Vec<Item>,
    ) -> Result<()> {
        let (output, sink) = (place.output, &place.target.sink);
        let dataset = k - output.first_level();
        let whole = Region::whole(output.level(k).expect("level exists").shape);
        let mut push = |region: Region, chunk: Encoded| {
            items.push(Item { output: place.index, dataset, component: place.component, region, chunk });
        };
        // Made only for chunks at the volume's end and for those that wait for the rest, which other bricks have.
        let mut filled = None;
        let mut voxels = || {
            let mut buffer = self.pool.take(output.spec.dtype, region.voxels());
            buffer.fill(voxel.at(0));
            buffer
        };
        if !self.in_chunks(place, k) {
            let view = filled.get_or_insert_with(voxels).view(region.shape());
            self.put(place, k, region, view, items)?;
        } else {
            let encoded = sink.encode_uniform(voxel)?;
            for index in region.cells([0; 3], output.spec.chunk).iter() {
                let cell = Region::of_cell(index, [0; 3], output.spec.chunk);
                let chunk = cell.clip(&whole);
                if region.contains(&cell) || encoded == Encoded::Empty && region.contains(&chunk) {
                    push(chunk, encoded.clone());
                    continue;
                }
                let part = chunk.clip(&region);
                let view = filled.get_or_insert_with(&mut voxels).view(region.shape());
                let piece = view.part(region.offset_of(&part), part.shape());
                if part == chunk {
                    push(chunk, sink.encode(dataset, chunk, piece)?);
                } else if let Some(full) =
                    self.park(place, (place.index, k, place.component, index), chunk, part, piece)
                {
                    push(chunk, sink.encode(dataset, chunk, full.view(chunk.shape()))?);
                    self.pool.put(full);
                }
            }
        }
        filled.into_iter().for_each(|v| self.pool.put(v));
        Ok(())
    }
}
