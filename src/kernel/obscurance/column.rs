//! Columns: the keys that the lines of a group of families cross within reach of a tile.
//!
//! A box with halos on all sides holds many times what one direction needs: its lines leave a tile in a slanted column.
//! Rows of a column are counted by the line that meets them, so that the slant costs no memory, and it is filled slab by
//! slab along the lines, so that no more than a slab of voxels stands beside it.

use std::ops::Range;

use super::driver::{self, FRAMES, in_frame};
use super::keys::{self, Code, Coded, Key, LANES, Volume, put_row, with_key};
use super::lines::{Family, displacement};
use crate::grid::{Region, Shape, View};
use crate::kernel::simd::Level;
use crate::multiversion;

/// Planes of a slab: as many as chunks mostly have, and a cache line of those along x.
pub(super) const SLAB: usize = 64;

/// The column of one group of families (see [`driver::groups`]) and one tile.
pub(super) struct Column<'a> {
    group: &'a [Family],
    perm: [usize; 3],
    /// Frame axis along which the lines run, and the one along which the column slants.
    axes: [usize; 2],
    /// In frame order.
    tile: Region,
    /// What has keys, in frame order: the planes in reach, all rows of the volume, the lanes in reach.
    pub region: Region,
    /// Planes in reach on either side.
    reach: i64,
    /// First line, counted where it meets the plane 0, and their number.
    first: i64,
    rows: usize,
}

/// Largest sizes of the column of a tile of these extents, wherever it stands: elements of the column, voxels of a slab,
/// and planes.
pub(super) fn most(group: &[Family], tile: Shape, volume: Shape) -> [usize; 3] {
    let perm = FRAMES[driver::frame_of(&group[0])];
    let [a, b] = driver::axes(&group[0]);
    let (tile, volume) = (perm.map(|x| tile[x]), perm.map(|x| volume[x]));
    let (reach, side) = reaches(group, perm[2]);
    let reach = reach.min(volume[a]);
    let slope = group[0].slope[perm[b]].abs();
    let planes = (tile[a] + 2 * reach).min(volume[a]);
    let rows = tile[b] + (slope * tile[a] as f64) as usize + 2;
    let lanes = (tile[2] + 2 * side).min(volume[2]);
    let slanted = slope * (2 * reach).min(tile[a] + SLAB) as f64;
    let slab = SLAB.min(planes) * (tile[b] + slanted as usize + 4).min(volume[b]) * lanes;
    [LANES + planes * strides(rows, lanes)[0], slab, planes]
}

/// Planes in reach of a group, and the voxels that its lines move along an axis within them.
fn reaches(group: &[Family], axis: usize) -> (usize, usize) {
    let most = |of: &dyn Fn(&Family) -> usize| group.iter().map(of).max().unwrap_or(0);
    (most(&|f| f.reach), most(&|f| f.halo()[axis]))
}

/// Elements from plane to plane and from row to row; see [`super::keys`] for what stands between rows.
fn strides(rows: usize, lanes: usize) -> [usize; 2] {
    let row = (lanes + LANES).next_multiple_of(16);
    let plane = row * rows;
    [if plane.is_multiple_of(1024) { plane + 64 } else { plane }, row]
}

impl<'a> Column<'a> {
    /// `tile` and `volume` in natural order.
    pub fn new(group: &'a [Family], tile: Region, volume: Region) -> Self {
        let perm = FRAMES[driver::frame_of(&group[0])];
        let axes = driver::axes(&group[0]);
        let [a, b] = axes;
        let (tile, volume) = (in_frame(tile, perm), in_frame(volume, perm));
        let (reach, side) = reaches(group, perm[2]);
        let mut halo = [0; 3];
        (halo[a], halo[2]) = (reach, side);
        let mut region = tile.grow(halo).clip(&volume);
        (region.lo[b], region.hi[b]) = (volume.lo[b], volume.hi[b]);
        let mut column = Column { group, perm, axes, tile, region, reach: reach as i64, first: 0, rows: 0 };
        let lines = column.lines(tile.lo[a]..tile.hi[a]);
        column.first = lines.start;
        column.rows = (lines.end - lines.start) as usize;
        column
    }

    /// Displacement along the slant.
    fn shift(&self, plane: i64) -> i64 {
        displacement(self.group[0].slope[self.perm[self.axes[1]]], plane)
    }

    /// Lines that are inside the tile at one of these of its planes.
    fn lines(&self, planes: Range<i64>) -> Range<i64> {
        let b = self.axes[1];
        let ends = [self.shift(planes.start), self.shift(planes.end - 1)];
        self.tile.lo[b] - ends[0].max(ends[1])..self.tile.hi[b] - ends[0].min(ends[1])
    }

    /// Lines that look at a plane.
    fn lines_at(&self, plane: i64) -> Range<i64> {
        let a = self.axes[0];
        self.lines((plane - self.reach).max(self.tile.lo[a])..(plane + self.reach + 1).min(self.tile.hi[a]))
    }

    fn strides(&self) -> [usize; 2] {
        strides(self.rows, self.region.shape()[2])
    }

    /// The keys, filled slab by slab with [`Self::put`].
    pub fn volume<'k, K: Key>(&self, keys: &'k [K]) -> Volume<'k, K> {
        let [plane, row] = self.strides();
        let mut strides = [row; 2];
        strides[self.axes[0]] = plane;
        Volume::sheared(keys, strides, self.region, self.first)
    }

    /// Boxes of voxels that fill the column, in natural order. Along the lines they end where a chunk may.
    pub fn slabs(&self) -> impl Iterator<Item = Region> {
        let [a, b] = self.axes;
        let Region { lo, hi } = self.region;
        let (first, last) = (lo[a].div_euclid(SLAB as i64), (hi[a] - 1).div_euclid(SLAB as i64));
        (first..=last).filter_map(move |slab| {
            let mut part = self.region;
            part.lo[a] = lo[a].max(slab * SLAB as i64);
            part.hi[a] = hi[a].min((slab + 1) * SLAB as i64);
            let (mut from, mut to) = (i64::MAX, i64::MIN);
            for plane in part.lo[a]..part.hi[a] {
                let (lines, shift) = (self.lines_at(plane), self.shift(plane));
                (from, to) = (from.min(lines.start + shift), to.max(lines.end + shift));
            }
            (part.lo[b], part.hi[b]) = (from.max(lo[b]), to.min(hi[b]));
            (!part.is_empty()).then(|| in_frame(part, self.perm))
        })
    }

    /// Puts the keys of one of [`Self::slabs`] into place, and returns the greatest.
    pub fn put<T: Coded>(
        &self,
        level: Level,
        slab: Region,
        src: View<T>,
        code: Code<T>,
        keys: &mut [T::Key],
    ) -> T::Key {
        assert_eq!(src.shape, slab.shape());
        keys[..LANES].fill(T::Key::ZERO);
        let part = in_frame(slab, self.perm);
        let [a, b] = self.axes;
        let mut planes = [Plane::default(); SLAB];
        let count = (part.hi[a] - part.lo[a]) as usize;
        let [stride, row] = self.strides();
        for (plane, at) in planes[..count].iter_mut().zip(part.lo[a]..) {
            let (lines, shift) = (self.lines_at(at), self.shift(at));
            let rows = (lines.start + shift).max(part.lo[b])..(lines.end + shift).min(part.hi[b]);
            let first = LANES + (at - self.region.lo[a]) as usize * stride;
            *plane = Plane {
                rows: [rows.start - part.lo[b], rows.end - part.lo[b]].map(|r| r.max(0) as usize),
                // The place of the slab's first row, which may stand before the column.
                start: first as i64 + (part.lo[b] - shift - self.first) * row as i64,
            };
        }
        match self.perm[2] {
            2 => natural(level, src, a, &planes[..count], row, code, keys),
            _ => turned(level, src, &planes[..count], row, code, keys),
        }
    }
}

/// One plane of a slab: the rows of the slab that are wanted, and where the slab's first row would stand.
#[derive(Clone, Copy, Default)]
struct Plane {
    rows: [usize; 2],
    start: i64,
}

multiversion! {
    /// Planes along z (`axis` 0) or y.
    fn natural['a, 'r, T: Coded](
        src: View<'a, T>, axis: usize, planes: &[Plane], row: usize, code: Code<'r, T>, out: &mut [T::Key],
    ) -> T::Key = put_natural;
}
multiversion! {
    /// Planes along x, lanes along z.
    fn turned['a, 'r, T: Coded](
        src: View<'a, T>, planes: &[Plane], row: usize, code: Code<'r, T>, out: &mut [T::Key],
    ) -> T::Key = put_turned;
}

#[inline(always)]
fn put_natural<T: Coded>(
    src: View<T>,
    axis: usize,
    planes: &[Plane],
    row: usize,
    code: Code<T>,
    out: &mut [T::Key],
) -> T::Key {
    let mut most = T::Key::ZERO;
    let width = src.shape[2];
    for (i, plane) in planes.iter().enumerate() {
        for j in plane.rows[0]..plane.rows[1] {
            let from = if axis == 0 { src.row_at(i, j) } else { src.row_at(j, i) };
            let start = (plane.start + (j * row) as i64) as usize;
            let (before, rest) = out[start - LANES..start - LANES + row + LANES].split_at_mut(LANES);
            before.fill(T::Key::ZERO);
            most = with_key!(code, key => put_row(from, key, rest, most));
            rest[width..].fill(T::Key::ZERO);
        }
    }
    most
}

#[inline(always)]
fn put_turned<T: Coded>(src: View<T>, planes: &[Plane], row: usize, code: Code<T>, out: &mut [T::Key]) -> T::Key {
    let mut most = T::Key::ZERO;
    let nz = src.shape[0];
    keys::turn_rows(src, code, |[z0, y, x0], [tz, tx], tile| {
        for (from, plane) in tile.iter().zip(&planes[x0..][..tx]) {
            if !(plane.rows[0]..plane.rows[1]).contains(&y) {
                continue;
            }
            let start = (plane.start + (y * row) as i64) as usize;
            if z0 == 0 {
                out[start - LANES..start].fill(T::Key::ZERO);
            }
            out[start + z0..][..tz].copy_from_slice(&from[..tz]);
            if z0 + tz == nz {
                out[start + nz..start + row].fill(T::Key::ZERO);
            }
            most = from[..tz].iter().fold(most, |m, k| m.max(*k));
        }
    });
    most
}
