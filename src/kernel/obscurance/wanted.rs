//! Which voxels are asked for, and what became of the lines: those without one are not searched.

use std::ops::Range;

use super::contribute;
use super::keys::{Key, LANES};
use super::scan::{Hit, Sheet, Spans};
use super::sinks::{Strip, Visit};
use crate::grid::{Region, Shape, View};

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

/// Rows of a strip at most: a tile's longest edge.
const ROWS: usize = 256;

/// Voxels of a tile in the order of a frame, a bit each.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    words: &'a [u64],
    /// Words of a row (one more than its bits fill, so that 64 bits can be read from anywhere), and rows of a plane.
    row: usize,
    plane: usize,
}

/// Words of the bits of a tile of these extents.
pub(super) fn words_of(n: Shape) -> usize {
    n[0] * n[1] * row_words(n[2])
}

fn row_words(bits: usize) -> usize {
    bits.div_ceil(64) + 1
}

impl<'a> Wanted<'a> {
    /// Bits of the tile's part of a mask, and the same with x and z exchanged if there is room for it.
    pub fn both(mask: View<u8>, natural: &'a mut [u64], turned: &'a mut [u64]) -> [Self; 2] {
        let [nz, ny, nx] = mask.shape;
        let (row, column) = (row_words(nx), row_words(nz));
        let natural = &mut natural[..words_of([nz, ny, nx])];
        let turned = if turned.is_empty() { turned } else { &mut turned[..words_of([nx, ny, nz])] };
        turned.fill(0);
        for (at, words) in natural.chunks_exact_mut(row).enumerate() {
            let (z, y) = (at / ny, at % ny);
            words.fill(0);
            for (word, voxels) in words.iter_mut().zip(mask.row_at(z, y).chunks(64)) {
                *word = voxels.iter().rev().fold(0, |w, &v| w << 1 | u64::from(v != 0));
            }
            if turned.is_empty() {
                continue;
            }
            for (i, word) in words.iter().enumerate() {
                for bit in bits(*word) {
                    turned[((64 * i + bit) * ny + y) * column + z / 64] |= 1 << (z % 64);
                }
            }
        }
        [Wanted { words: natural, row, plane: ny * row }, Wanted { words: turned, row: column, plane: ny * column }]
    }

    /// What a strip is asked for.
    pub fn look(&self, visit: &Visit, strip: &Strip) -> Look {
        let mut look = Look { rows: [0; ROWS], planes: 0..0, spans: [[0; 2]; LANES], live: 0, voxels: 0 };
        assert!(strip.planes.len() <= ROWS);
        let (mut first, mut end) = (usize::MAX, 0);
        for piece in strip.pieces(visit) {
            let at = contribute::start([0, 0], strip, &piece);
            let row = contribute::start([self.row, self.plane], strip, &piece) - at;
            let (word, shift) = (row + at / 64, at % 64);
            let window = self.words[word] >> shift | (self.words[word + 1] << 1) << (63 - shift);
            let (row, lane) = (piece.answers.start / LANES, piece.answers.start % LANES);
            let needed = (window & u64::MAX >> (64 - piece.answers.len())) << lane;
            look.rows[row] = needed;
            if needed == 0 {
                continue;
            }
            (first, end) = (first.min(row), row + 1);
            look.voxels += needed.count_ones() as usize;
            for lane in bits(needed & !look.live) {
                look.spans[lane][0] = row as u32;
            }
            look.live |= needed;
        }
        let first = first.min(end);
        let mut open = look.live;
        for row in (first..end).rev() {
            for lane in bits(look.rows[row] & open) {
                look.spans[lane] = [look.spans[lane][0] - first as u32, (row + 1 - first) as u32];
            }
            open &= !look.rows[row];
        }
        look.rows.copy_within(first..end, 0);
        look.planes = strip.planes.start + first..strip.planes.start + end;
        look
    }
}

/// What a strip is asked for.
pub(super) struct Look {
    /// Needed lanes of each of [`Look::planes`].
    rows: [u64; ROWS],
    /// From the first plane with a needed voxel to the last, counted from the source's first.
    pub planes: Range<usize>,
    /// From the first needed voxel of each lane to the last.
    pub spans: Spans,
    pub live: u64,
    pub voxels: usize,
}

impl Look {
    /// Needed lanes of each plane.
    pub fn rows(&self) -> &[u64] {
        &self.rows[..self.planes.len()]
    }

    /// Whether so few voxels are needed that walking from each is less work than a search of the lines: a step of a walk
    /// and sense meets a row that is not in the cache, a search takes its rows as they come. 2-core Zen 4 VM, AVX-512,
    /// 2026-11-26: see benches/results/obscurance.md.
    pub fn is_sparse(&self, reach: usize) -> bool {
        2 * self.voxels * reach.min(64) < 16 * self.planes.len()
    }
}

/// Places of the bits that are set.
fn bits(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = word.trailing_zeros() as usize;
        word &= word.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}

/// Answers of the needed voxels of a sheet one by one; all others are open. An empty slice of hits is a sense that is not
/// asked for.
pub(super) fn walk<K: Key, H: Hit>(
    sheet: Sheet<K>,
    rows: &[u64],
    queries: Range<usize>,
    reach: usize,
    hits: [&mut [H]; 2],
) {
    for (way, hits) in hits.into_iter().enumerate().filter(|(_, hits)| !hits.is_empty()) {
        hits.fill(H::of(reach));
        for ((row, query), hits) in rows.iter().zip(queries.clone()).zip(hits.chunks_exact_mut(LANES)) {
            let steps = reach.min(if way == 0 { sheet.planes.len() - 1 - query } else { query });
            for lane in bits(*row) {
                let key = |plane: usize| sheet.data[sheet.planes[plane] + lane];
                let greater = |j: &usize| key(if way == 0 { query + j } else { query - j }) > key(query);
                hits[lane] = (1..=steps).find(greater).map_or(H::of(reach), |j| H::of(j - 1));
            }
        }
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
