//! The tiles of an output box: what is summed in each, group after group of families, and how it is written. Knows not
//! where the keys come from.

use super::driver::{self, Buffers, FRAMES};
use super::keys::{Key, Volume};
use super::lines::Family;
use super::sinks::{self, OpenSum, Sink};
use super::wanted::{self, LineCounts, Wanted};
use super::weighted::{self, WeightedSum};
use super::{ObscuranceIo, Prepared, f32_view};
use crate::brick::scratch::cut;
use crate::grid::{Region, Shape, View};
use crate::kernel::simd::Level;

/// Output voxels whose sums are kept at once, `[z, y, x]`. Long lines waste less on halos than sums gain from a nearer
/// cache: 2-core Zen 4 VM, AVX-512, 2026-11-26, u8, 42 directions, distance 64, bricks with halos of 64: `[256, 128, 256]`
/// in one tile 0.76 ns per voxel and direction, `[128, 256, 256]` in two tiles 1.08. A sweep of one tile keeps one copy of
/// the keys, so that 256^3 takes the bytes of two tiles of half the size.
const TILE: Shape = [256; 3];
/// The same for sums of 64 bits, of which there are up to five.
const WEIGHTED_TILE: Shape = [128, 128, 256];

/// Extents of a tile of an output box.
pub(super) fn tile_of(dst: Shape, weighted: bool) -> Shape {
    let most = if weighted { WEIGHTED_TILE } else { TILE };
    std::array::from_fn(|a| most[a].min(dst[a]))
}

/// Tiles of an output box, in the order in which they are swept.
pub(super) fn tiles(dst_box: Region, weighted: bool) -> impl Iterator<Item = Region> {
    let extents = tile_of(dst_box.shape(), weighted);
    let cells = dst_box.cells(dst_box.lo, extents).iter();
    cells.map(move |cell| Region::of_cell(cell, dst_box.lo, extents).clip(&dst_box))
}

/// Where a pass finds the keys of its tiles.
pub(super) trait Supply<K, E> {
    /// Told of each tile before its lines are swept.
    fn enter(&mut self, tile: Region);

    /// Keys that the lines of a group through the tile meet, and whether any of them is greater than some voxel of it.
    fn keys(&mut self, group: &[Family], tile: Region) -> Result<(Volume<'_, K>, bool), E>;

    /// NaN where a voxel of the row that starts at `at` is missing.
    fn mark_missing(&self, at: [i64; 3], row: &mut [f32]);
}

/// One sweep of one brick.
pub(super) struct Pass<'a, K> {
    pub prepared: &'a Prepared,
    pub level: Level,
    /// What colours cover.
    pub src_box: Region,
    pub dst_box: Region,
    pub buffers: Buffers<'a, K>,
    /// For the needed voxels of a tile in both frames.
    pub masks: [&'a mut [u64]; 2],
    pub counts: LineCounts,
    /// So far nothing was greater than anything.
    pub flat: bool,
}

impl<K: Key> Pass<'_, K> {
    /// `bytes` has room for the sums of a tile.
    ///
    /// # Errors
    /// The first of the supply.
    pub fn run<E>(&mut self, io: ObscuranceIo, supply: &mut impl Supply<K, E>, bytes: &mut [u8]) -> Result<(), E> {
        let ObscuranceIo { colour, normal, needed, openness, rgb } = io;
        let mut openness = openness.map(f32_view);
        let mut rgb = rgb.map(|views| views.map(f32_view));
        assert!(rgb.is_none() || colour.is_some(), "rgb needs colours");
        let fast = openness.is_some() && normal.is_none();
        let weighted = rgb.is_some() || normal.is_some();
        let dst_box = self.dst_box;
        for tile in tiles(dst_box, weighted) {
            let tile = needed.map_or(tile, |mask| wanted::shrink(tile, mask, dst_box));
            if tile.is_empty() {
                continue;
            }
            supply.enter(tile);
            let needed = needed.map(|mask| mask.part(dst_box.offset_of(&tile), tile.shape()));
            let lens = FRAMES.map(|frame| sinks::sums_len(tile.shape(), frame));
            let used = |yes: bool| if yes { lens } else { [0; 2] };
            let (natural, rest) = cut::<u32>(&mut *bytes, used(fast)[0]);
            let (turned, rest) = cut::<u32>(rest, used(fast)[1]);
            let (weights, rest) = weighted::pair(rest, used(normal.is_some()));
            let (open, rest) = weighted::pair(rest, used(normal.is_some()));
            let (red, rest) = weighted::pair(rest, used(rgb.is_some()));
            let (green, rest) = weighted::pair(rest, used(rgb.is_some()));
            let (blue, _) = weighted::pair(rest, used(rgb.is_some()));
            let mut fast_sum = OpenSum { level: self.level, sums: [natural, turned], tile };
            fast_sum.clear();
            let mut wide_sum = WeightedSum {
                level: self.level,
                tile,
                dst_box,
                src_box: self.src_box,
                normal,
                flipped: self.prepared.params.flipped,
                uniform: self.prepared.uniform,
                weights,
                open,
                ambient: self.prepared.params.ambient,
                colour: colour.filter(|_| rgb.is_some()),
                rgb: [red, green, blue],
            };
            wide_sum.clear();
            // What is open without a look.
            let mut open = 0;
            match (fast, weighted) {
                (true, false) => open = self.sweep_tile(tile, needed, supply, &mut fast_sum, true)?,
                (false, true) => _ = self.sweep_tile(tile, needed, supply, &mut wide_sum, false)?,
                (true, true) => {
                    let mut both = (fast_sum, wide_sum);
                    self.sweep_tile(tile, needed, supply, &mut both, false)?;
                    (fast_sum, wide_sum) = both;
                }
                (false, false) => return Ok(()),
            }
            let total = self.prepared.total;
            if fast && open < total {
                fast_sum.merge();
            }
            wide_sum.merge();
            let [nz, ny, nx] = tile.shape();
            let at = dst_box.offset_of(&tile);
            for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
                let first = [tile.lo[0] + z as i64, tile.lo[1] + y as i64, tile.lo[2]];
                if let Some(out) = &mut openness {
                    let row = &mut out.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
                    match fast {
                        true => fast_sum.openness([z, y], open, total, row),
                        false => wide_sum.openness([z, y], row),
                    }
                    supply.mark_missing(first, row);
                }
                for (c, out) in rgb.iter_mut().flatten().enumerate() {
                    let row = &mut out.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
                    wide_sum.colour_of([z, y], c, row);
                    supply.mark_missing(first, row);
                }
            }
        }
        Ok(())
    }

    /// Sweeps all groups over a tile. With `leave`, those that nothing can occlude are left out, and the sum of what they
    /// would contribute to every voxel is returned.
    fn sweep_tile<E>(
        &mut self,
        tile: Region,
        needed: Option<View<u8>>,
        supply: &mut impl Supply<K, E>,
        sink: &mut impl Sink,
        leave: bool,
    ) -> Result<u64, E> {
        let Pass { masks: [natural, turned], counts, flat, .. } = self;
        let wanted = needed.map(|needed| Wanted::both(needed, natural, turned));
        let mut open = 0;
        for group in driver::groups(&self.prepared.families) {
            let (volume, busy) = supply.keys(group, tile)?;
            *flat &= !busy;
            if !busy && leave {
                open += group.iter().map(|family| family.open()).sum::<u64>();
                continue;
            }
            *counts += driver::sweep_group(
                self.level,
                group,
                if busy { usize::MAX } else { 0 },
                volume,
                tile,
                wanted.map(|w| w[driver::frame_of(&group[0])]),
                &mut self.buffers,
                sink,
            );
        }
        Ok(open)
    }
}
