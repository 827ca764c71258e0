//! Which voxels are asked for, and what became of the lines: those without one are not searched.

use std::ops::Range;

use super::contribute;
use super::keys::LANES;
use super::sinks::{Strip, Visit};
use crate::grid::{Region, View};

/// Lines of 64 lanes' strips, family by family, and those that were not searched.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LineCounts {
    pub total: u64,
    /// No voxel of theirs is needed.
    pub masked: u64,
    /// Nothing that they can see is greater than any of their voxels.
    pub open: u64,
}

impl std::ops::AddAssign for LineCounts {
    fn add_assign(&mut self, other: LineCounts) {
        self.total += other.total;
        self.masked += other.masked;
        self.open += other.open;
    }
}

/// Voxels of a tile in the order of a frame: 0 is not needed.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    data: &'a [u8],
    /// From one row to the next, and from one plane to the next.
    strides: [usize; 2],
}

impl<'a> Wanted<'a> {
    /// The tile's part of a mask.
    pub fn natural(mask: View<'a, u8>) -> Self {
        Wanted { data: mask.data, strides: [mask.row, mask.plane] }
    }

    /// The same with x and z exchanged, copied to `to`.
    pub fn turned(mask: View<u8>, to: &'a mut [u8]) -> Self {
        let [nz, ny, _] = mask.shape;
        for z in 0..nz {
            for y in 0..ny {
                for (x, v) in mask.row_at(z, y).iter().enumerate() {
                    to[(x * ny + y) * nz + z] = *v;
                }
            }
        }
        Wanted { data: to, strides: [nz, ny * nz] }
    }

    /// Lanes of a strip with a needed voxel, and the planes from the first such voxel to the last.
    pub fn look(&self, visit: &Visit, strip: &Strip) -> (u64, Range<usize>) {
        let mut live = [0u8; LANES];
        let (mut first, mut end) = (usize::MAX, 0);
        for piece in strip.pieces(visit) {
            let at = contribute::start(self.strides, strip, &piece);
            let (row, lane) = (piece.answers.start / LANES, piece.answers.start % LANES);
            let mut any = 0;
            for (live, &v) in live[lane..].iter_mut().zip(&self.data[at..at + piece.answers.len()]) {
                *live |= v;
                any |= v;
            }
            if any != 0 {
                (first, end) = (first.min(row), row + 1);
            }
        }
        let lanes = live.iter().enumerate().fold(0, |m, (lane, &v)| m | u64::from(v != 0) << lane);
        (lanes, strip.planes.start + first.min(end)..strip.planes.start + end)
    }
}

/// The least box of `tile` with all its needed voxels; `mask` covers `of`.
pub(super) fn shrink(tile: Region, mask: View<u8>, of: Region) -> Region {
    let mut least = Region::new(tile.hi, tile.lo);
    for z in tile.lo[0]..tile.hi[0] {
        for y in tile.lo[1]..tile.hi[1] {
            let x0 = (tile.lo[2] - of.lo[2]) as usize;
            let row = &mask.row_at((z - of.lo[0]) as usize, (y - of.lo[1]) as usize)[x0..][..tile.shape()[2]];
            let Some(first) = row.iter().position(|&v| v != 0) else { continue };
            let last = row.iter().rposition(|&v| v != 0).unwrap_or(first);
            let (lo, hi) = ([z, y, tile.lo[2] + first as i64], [z + 1, y + 1, tile.lo[2] + last as i64 + 1]);
            least.lo = std::array::from_fn(|a| least.lo[a].min(lo[a]));
            least.hi = std::array::from_fn(|a| least.hi[a].max(hi[a]));
        }
    }
    if least.is_empty() { Region::new(tile.lo, tile.lo) } else { least }
}
