//! Sweeps of boxes whose halos do not fit into memory: group after group of families, each with the column of keys that
//! its lines cross, read for it alone. Reads more than a box with halos where both fit, and holds a fraction of it.

use super::column::{self, Column};
use super::driver::{self, FRAMES};
use super::keys::{self, Coded, Key};
use super::room::{Sizes, carve};
use super::sinks::{self, OpenSum};
use super::wanted::{self, LineCounts, Wanted};
use super::{Prepared, f32_view, mark_missing, tile_of};
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Region, Shape, View, ViewMut};
use crate::kernel::Context;
use crate::with_view;

/// Fills a view with the voxels of a box of the source.
pub type Fetch<'a, E> = &'a mut dyn FnMut(Region, AnyViewMut) -> Result<(), E>;

/// What a streamed sweep found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Streamed {
    /// Nothing in reach is greater than any voxel.
    pub flat: bool,
    pub lines: LineCounts,
}

impl Prepared {
    /// [`Prepared::sweep`] of openness without weights per voxel, for a source that is fetched box by box: `src` covers
    /// the output box alone. The bits are the same.
    ///
    /// Panics if an extent does not fit its box, or the output is not f32.
    ///
    /// # Errors
    /// The first of `fetch`.
    #[allow(clippy::too_many_arguments)]
    pub fn sweep_streamed<E>(
        &self,
        src: AnyView,
        dst_box: Region,
        volume: Region,
        needed: Option<View<u8>>,
        openness: AnyViewMut,
        fetch: Fetch<E>,
        cx: &mut Context,
    ) -> Result<Streamed, E> {
        assert_eq!(src.shape(), dst_box.shape(), "src must cover the output box");
        assert!(volume.contains(&dst_box), "{volume:?} must contain {dst_box:?}");
        if dst_box.is_empty() {
            return Ok(Streamed { flat: true, lines: LineCounts::default() });
        }
        with_view!(AnyView, src, v => self.stream_typed(v, dst_box, volume, needed, f32_view(openness), fetch, cx))
    }

    /// Bytes of scratch that [`Prepared::sweep_streamed`] takes at most.
    pub fn streamed_bytes(&self, dtype: DType, volume: Shape, dst: Shape) -> usize {
        let (sizes, slab) = self.streamed_sizes(volume, dst);
        sizes.bytes(dtype.size(), false, false) + (slab * dtype.size()).next_multiple_of(64)
    }

    /// Voxels that [`Prepared::sweep_streamed`] fetches for a box, apart from the box itself.
    pub fn streamed_voxels(&self, dst_box: Region, volume: Region) -> usize {
        let tiles = dst_box.cells(dst_box.lo, tile_of(dst_box.shape(), false));
        let tile = |cell| Region::of_cell(cell, dst_box.lo, tile_of(dst_box.shape(), false)).clip(&dst_box);
        let of_tile = |tile: Region| -> usize {
            let columns = driver::groups(&self.families).map(|group| Column::new(group, tile, volume));
            columns.map(|c| c.slabs().map(|s| s.voxels()).sum::<usize>()).sum()
        };
        tiles.iter().map(|cell| of_tile(tile(cell))).sum()
    }

    fn streamed_sizes(&self, volume: Shape, dst: Shape) -> (Sizes, usize) {
        let tile = tile_of(dst, false);
        let most = driver::groups(&self.families).map(|group| column::most(group, tile, volume));
        let [keys, slab, planes] = most.fold([0; 3], |m, s| std::array::from_fn(|i| m[i].max(s[i])));
        let sizes = Sizes {
            keys: [keys, 0],
            sums: FRAMES.map(|frame| sinks::sums_len(tile, frame)),
            sheet: planes,
            queries: tile.into_iter().max().unwrap_or(0),
            extent: planes,
        };
        (sizes, slab)
    }

    #[allow(clippy::too_many_arguments)]
    fn stream_typed<T: Coded, E>(
        &self,
        src: View<T>,
        dst_box: Region,
        volume: Region,
        needed: Option<View<u8>>,
        mut openness: ViewMut<f32>,
        fetch: Fetch<E>,
        cx: &mut Context,
    ) -> Result<Streamed, E> {
        let (sizes, slab) = self.streamed_sizes(volume.shape(), dst_box.shape());
        let words = needed.map_or([0; 2], |_| self.mask_words(dst_box.shape()));
        let mask = needed.map_or(0, |_| self.masked_bytes(dst_box.shape()));
        let bytes = cx.scratch.take(sizes.bytes(size_of::<T>(), false, false) + padded::<T>(slab) + mask);
        let (natural_mask, bytes) = carve::<u64>(bytes, words[0]);
        let (turned_mask, bytes) = carve::<u64>(bytes, words[1]);
        let (keys, bytes) = carve::<T::Key>(bytes, sizes.keys[0]);
        let (slab, bytes) = cut::<T>(bytes, slab);
        let (mut buffers, bytes) = sizes.buffers::<T::Key>(bytes);
        let (natural, bytes) = carve::<u32>(bytes, sizes.sums[0]);
        let (turned, _) = carve::<u32>(bytes, sizes.sums[1]);

        let missing = keys::missing_of::<T>(self.params.missing);
        let code = keys::Code { missing, flipped: self.params.flipped };
        let extents = tile_of(dst_box.shape(), false);
        let (mut flat, mut lines) = (true, LineCounts::default());
        for cell in dst_box.cells(dst_box.lo, extents).iter() {
            let tile = Region::of_cell(cell, dst_box.lo, extents).clip(&dst_box);
            let tile = needed.map_or(tile, |mask| wanted::shrink(tile, mask, dst_box));
            if tile.is_empty() {
                continue;
            }
            let needed = needed.map(|mask| mask.part(dst_box.offset_of(&tile), tile.shape()));
            let wanted = needed.map(|needed| Wanted::both(needed, natural_mask, turned_mask));
            let own = src.part(dst_box.offset_of(&tile), tile.shape());
            let least = keys::least(cx.level, own, code);
            let mut sums = OpenSum { level: cx.level, sums: [&mut *natural, &mut *turned], tile };
            sums.clear();
            let (mut open, mut swept) = (0, false);
            for group in driver::groups(&self.families) {
                let column = Column::new(group, tile, volume);
                let mut most = T::Key::ZERO;
                for part in column.slabs() {
                    let voxels = &mut slab[..part.voxels()];
                    fetch(part, T::any(ViewMut::dense(voxels, part.shape())))?;
                    most = most.max(column.put(cx.level, part, View::dense(voxels, part.shape()), code, keys));
                }
                if most <= least {
                    // Nothing in reach is greater than any voxel of the tile.
                    open += group.iter().map(|family| family.open()).sum::<u64>();
                    continue;
                }
                swept = true;
                let (volume, wanted) = (column.volume(keys), wanted.map(|w| w[driver::frame_of(&group[0])]));
                lines +=
                    driver::sweep_group(cx.level, group, usize::MAX, volume, tile, wanted, &mut buffers, &mut sums);
            }
            if swept {
                sums.merge();
                flat = false;
            }
            let at = dst_box.offset_of(&tile);
            let [nz, ny, nx] = tile.shape();
            for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
                let row = &mut openness.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
                sums.openness([z, y], open, self.total, row);
                mark_missing(&own.row_at(z, y)[..nx], missing, row);
            }
        }
        Ok(Streamed { flat, lines })
    }
}
