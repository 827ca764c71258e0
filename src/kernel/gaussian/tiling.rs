//! How the output box is cut into tiles, what a tile holds between passes, and which of its rows are made once more.

use std::ops::Range;

use super::rows::LANES;
use crate::brick::scratch::padded;
use crate::grid::Shape;

/// Voxels of a tile along x.
pub(super) const WIDTH: usize = 64;
/// Bytes that the planes between the passes along y and z take, where that leaves rows enough. 2-core Zen 4 VM, AVX-512,
/// 2026-11-27, f32, ns per voxel, least of three by turns, with 512 KiB, 1 and 2 MiB: mean of sigma 1 2.8, 2.2, 2.5; variance of
/// sigma 3 17.9, 16.8, 14.7, for four times the scratch.
const RING_BYTES: usize = 512 << 10;
/// Least rows of a tile for each that its windows add at both sides, and that neighbours make once more. The same machine, day and
/// type, with 0, 1, 2 and 3: mean of sigma 10 47, 37, 27.5, 27.2; variance 170, 80, 67, 65; sigma 1 and 3 do not reach it.
const ROWS_PER_HALO: usize = 2;

/// Elements after which addresses meet in the sets of a first-level cache: a page of f32, two of f64. Planes that do not keep to
/// it took as long on that machine within its noise (variance of sigma 10 80 and 81), but hang on the size of a tile.
const PAGE: usize = 1024;

/// How the output box is cut, and what a tile holds between passes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tiling {
    /// Lanes of a row.
    pub width: usize,
    pub rows: usize,
    /// Planes of results made together, so that each plane of the ring is read fewer times.
    pub batch: usize,
    /// Planes of the ring, and elements from one to the next.
    pub slots: usize,
    pub pitch: usize,
    radius: [usize; 3],
}

impl Tiling {
    /// `cell` is the size of all numbers of a cell.
    pub fn new(src: Shape, dst: Shape, radius: [usize; 3], cell: usize) -> Tiling {
        let width = dst[2].min(WIDTH).next_multiple_of(LANES);
        let batch = radius[0].clamp(4, 16).min(dst[0]);
        let slots = (2 * radius[0] + batch).min(src[0]);
        let fit = RING_BYTES / (slots * width * cell);
        let rows = fit.max(2 * radius[1] * ROWS_PER_HALO).max(8).min(dst[1]);
        // tiles of one height
        let rows = dst[1].div_ceil(dst[1].div_ceil(rows));
        // the same row of all planes falls into sets of its own in the first-level cache
        let pitch = (rows * width).next_multiple_of(PAGE) + width;
        Tiling { width, rows, batch, slots, pitch, radius }
    }

    /// Lanes before the first of a source row, and of all of it.
    pub fn row(&self) -> [usize; 2] {
        let margin = self.radius[2].next_multiple_of(LANES);
        [margin, margin + self.width + self.radius[2].next_multiple_of(LANES)]
    }

    /// Elements of a field's buffers: a source row, a plane after the pass along x, the ring after that along y, a row of
    /// results.
    pub fn field(&self) -> [usize; 4] {
        [self.row()[1], (self.rows + 2 * self.radius[1]) * self.width, self.slots * self.pitch, self.width]
    }

    /// Bytes of scratch for `fields` numbers of `F` in a cell.
    pub fn bytes<F>(&self, fields: usize) -> usize {
        let table = |axis: usize, entries: usize| {
            let r = self.radius[axis];
            padded::<f64>(r + 1)
                + padded::<F>(entries * (r + 1))
                + padded::<u32>(2 * entries * r)
                + padded::<u32>(2 * entries)
        };
        let edges = padded::<F>((self.radius[2] + 1) * self.width) + 2 * padded::<F>(self.width);
        let tables = table(2, 1) + table(1, self.rows) + table(0, self.batch);
        fields * self.field().into_iter().map(padded::<F>).sum::<usize>() + tables + edges
    }
}

/// A part of the output box, no wider and no higher than a tile.
pub(super) struct Tile {
    pub z: Range<usize>,
    pub y: Range<usize>,
    pub x: Range<usize>,
}

/// Which rows of the output box, [`WIDTH`] voxels each, have voxels to be made once more.
pub(super) struct Wanted<'a> {
    flags: &'a mut [u8],
    dst: Shape,
}

impl<'a> Wanted<'a> {
    /// Flags that [`Wanted::new`] takes.
    pub fn len(dst: Shape) -> usize {
        dst[2].div_ceil(WIDTH) * dst[0] * dst[1]
    }

    /// None yet.
    pub fn new(flags: &'a mut [u8], dst: Shape) -> Wanted<'a> {
        flags.fill(0);
        Wanted { flags, dst }
    }

    pub fn any(&self) -> bool {
        self.flags.contains(&1)
    }

    fn place(&self, [z, y]: [usize; 2], x: usize) -> usize {
        (x / WIDTH * self.dst[0] + z) * self.dst[1] + y
    }

    /// Adds the row `[z, y]` from `x` on.
    pub fn add(&mut self, at: [usize; 2], x: usize) {
        let place = self.place(at, x);
        self.flags[place] = 1;
    }

    pub fn holds(&self, at: [usize; 2], x: usize) -> bool {
        self.flags[self.place(at, x)] != 0
    }

    /// The next planes of `tile` that hold such rows, cut to these rows; planes up to `slack` apart are taken together.
    pub fn next(&self, tile: &Tile, slack: usize) -> Option<Tile> {
        let rows = |z: usize| {
            let row = &self.flags[self.place([z, tile.y.start], tile.x.start)..][..tile.y.len()];
            let first = row.iter().position(|f| *f != 0)?;
            let last = row.iter().rposition(|f| *f != 0)?;
            Some(tile.y.start + first..tile.y.start + last + 1)
        };
        let mut found: Option<Tile> = None;
        for z in tile.z.clone() {
            if found.as_ref().is_some_and(|f| z - f.z.end > slack) {
                break;
            }
            let Some(y) = rows(z) else { continue };
            let part = found.get_or_insert(Tile { z: z..z, y: y.clone(), x: tile.x.clone() });
            part.z.end = z + 1;
            part.y = part.y.start.min(y.start)..part.y.end.max(y.end);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wanted_rows_are_found_once_and_near_ones_together() {
        let dst = [20, 6, 130];
        let mut flags = vec![9; Wanted::len(dst)];
        let mut wanted = Wanted::new(&mut flags, dst);
        assert!(!wanted.any());
        for (at, x) in [([1, 2], 64), ([3, 5], 64), ([9, 0], 100), ([4, 4], 0), ([19, 3], 129)] {
            wanted.add(at, x);
        }
        assert!(wanted.any() && wanted.holds([1, 2], 64) && !wanted.holds([1, 2], 0) && wanted.holds([9, 0], 127));
        let mut all = Tile { z: 0..20, y: 0..6, x: 64..128 };
        let mut found = Vec::new();
        while let Some(part) = wanted.next(&all, 3) {
            all.z.start = part.z.end;
            found.push((part.z, part.y));
        }
        assert_eq!(found, [(1..4, 2..6), (9..10, 0..1)]);
        let last = Tile { z: 0..20, y: 3..6, x: 128..130 };
        assert_eq!(wanted.next(&last, 0).map(|t| (t.z, t.y)), Some((19..20, 3..4)));
        assert!(wanted.next(&Tile { y: 0..3, ..last }, 0).is_none());
    }
}
