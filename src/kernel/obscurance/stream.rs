//! Sweeps of boxes whose halos do not fit into memory: group after group of families, each with the column of keys that
//! its lines cross, read for it alone. Reads more than a box with halos where both fit, and holds a fraction of it.

use super::column::{self, Column};
use super::driver::{self, FRAMES};
use super::keys::{self, Code, Coded, Key, Volume};
use super::lines::Family;
use super::room::Sizes;
use super::sinks;
use super::tiles::{Pass, Supply, tile_of, tiles};
use super::wanted::LineCounts;
use super::{ObscuranceIo, Prepared, mark_missing};
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Region, Shape, View, ViewMut};
use crate::kernel::Context;
use crate::kernel::simd::Level;
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
    /// [`Prepared::sweep`] without colours, for a source that is fetched box by box: `src` covers the output box alone. The
    /// bits are the same.
    ///
    /// Panics if an extent does not fit its box, the output is not f32, or colours are asked for.
    ///
    /// # Errors
    /// The first of `fetch`.
    pub fn sweep_streamed<E>(
        &self,
        src: AnyView,
        dst_box: Region,
        volume: Region,
        io: ObscuranceIo,
        fetch: Fetch<E>,
        cx: &mut Context,
    ) -> Result<Streamed, E> {
        assert_eq!(src.shape(), dst_box.shape(), "src must cover the output box");
        assert!(volume.contains(&dst_box), "{volume:?} must contain {dst_box:?}");
        assert!(io.rgb.is_none(), "occluders' colours are not fetched");
        if dst_box.is_empty() {
            return Ok(Streamed { flat: true, lines: LineCounts::default() });
        }
        with_view!(AnyView, src, v => self.stream_typed(v, dst_box, volume, io, fetch, cx))
    }

    /// Bytes of scratch that [`Prepared::sweep_streamed`] takes at most, apart from [`Prepared::masked_bytes`].
    pub fn streamed_bytes(&self, dtype: DType, volume: Shape, dst: Shape, normal: bool) -> usize {
        let (sizes, slab) = self.streamed_sizes(volume, dst, normal);
        sizes.bytes(dtype.size(), false, normal) + (slab * dtype.size()).next_multiple_of(64)
    }

    /// Voxels that [`Prepared::sweep_streamed`] fetches for a box, apart from the box itself.
    pub fn streamed_voxels(&self, dst_box: Region, volume: Region, normal: bool) -> usize {
        let of_tile = |tile: Region| -> usize {
            let columns = driver::groups(&self.families).map(|group| Column::new(group, tile, volume));
            columns.map(|c| c.slabs().map(|s| s.voxels()).sum::<usize>()).sum()
        };
        tiles(dst_box, normal).map(of_tile).sum()
    }

    /// Voxels that [`Prepared::sweep_streamed`] fetches at once at most.
    pub fn slab_voxels(&self, volume: Shape, dst: Shape, normal: bool) -> usize {
        self.streamed_sizes(volume, dst, normal).1
    }

    fn streamed_sizes(&self, volume: Shape, dst: Shape, normal: bool) -> (Sizes, usize) {
        let tile = tile_of(dst, normal);
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

    fn stream_typed<T: Coded, E>(
        &self,
        src: View<T>,
        dst_box: Region,
        volume: Region,
        io: ObscuranceIo,
        fetch: Fetch<E>,
        cx: &mut Context,
    ) -> Result<Streamed, E> {
        let normal = io.normal.is_some();
        let (sizes, slab) = self.streamed_sizes(volume.shape(), dst_box.shape(), normal);
        let words = io.needed.map_or([0; 2], |_| self.mask_words(dst_box.shape()));
        let mask = io.needed.map_or(0, |_| self.masked_bytes(dst_box.shape()));
        let bytes = cx.scratch.take(sizes.bytes(size_of::<T>(), false, normal) + padded::<T>(slab) + mask);
        let (natural_mask, bytes) = cut::<u64>(bytes, words[0]);
        let (turned_mask, bytes) = cut::<u64>(bytes, words[1]);
        let (keys, bytes) = cut::<T::Key>(bytes, sizes.keys[0]);
        let (slab, bytes) = cut::<T>(bytes, slab);
        let (buffers, bytes) = sizes.buffers::<T::Key>(bytes);
        let (level, masks, counts) = (cx.level, [natural_mask, turned_mask], LineCounts::default());
        let code = Code::new(&self.params);
        let mut columns = Columns { level, src, dst_box, volume, code, fetch, keys, slab, least: T::Key::MAX };
        let mut pass = Pass { prepared: self, level, src_box: dst_box, dst_box, buffers, masks, counts, flat: true };
        pass.run(io, &mut columns, bytes)?;
        Ok(Streamed { flat: pass.flat, lines: pass.counts })
    }
}

/// Reads the column of each group.
struct Columns<'a, T: Coded, E> {
    level: Level,
    /// The output box.
    src: View<'a, T>,
    dst_box: Region,
    volume: Region,
    code: Code<'a, T>,
    fetch: Fetch<'a, E>,
    keys: &'a mut [T::Key],
    slab: &'a mut [T],
    /// Least key of the tile.
    least: T::Key,
}

impl<T: Coded, E> Supply<T::Key, E> for Columns<'_, T, E> {
    fn enter(&mut self, tile: Region) {
        let part = self.src.part(self.dst_box.offset_of(&tile), tile.shape());
        self.least = keys::least(self.level, part, self.code);
    }

    fn keys(&mut self, group: &[Family], tile: Region) -> Result<(Volume<'_, T::Key>, bool), E> {
        let column = Column::new(group, tile, self.volume);
        let mut most = T::Key::ZERO;
        for part in column.slabs() {
            let voxels = &mut self.slab[..part.voxels()];
            (self.fetch)(part, T::any(ViewMut::dense(voxels, part.shape())))?;
            let voxels = View::dense(voxels, part.shape());
            most = most.max(column.put(self.level, part, voxels, self.code, self.keys));
        }
        Ok((column.volume(self.keys), most > self.least))
    }

    fn mark_missing(&self, at: [i64; 3], row: &mut [f32]) {
        let [z, y, x] = self.dst_box.offset_of(&Region::new(at, at));
        mark_missing(&self.src.row_at(z, y)[x..], self.code.missing, row);
    }
}
