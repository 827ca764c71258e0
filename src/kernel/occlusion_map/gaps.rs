//! Cells of a map whose windows hold missing cells or infinities, made anew one by one.
//!
//! A blurred cell is the sum of its taps' values over that of their weights, and both sums part into axes. They are taken
//! relative to one valid cell that the coarse cell sees, its pivot, so that constants stay what they are. Nothing cancels
//! either: the pivot counts at least 1/32768 in the coarse cell (1/4096 in a blurred one, of eight), so that the mean square
//! from it is at most 32769 times the variance, which is right to 1e-11.

use super::{Moments, TAPS};
use crate::grid::{Region, Shape};
use crate::kernel::lanes::{F64x8, LANES};
use crate::kernel::simd::Level;
use crate::on_lanes;

/// Cells of a level, where they lie in it, and which axes the next level halves.
pub(super) struct Fine<'a> {
    pub cells: &'a Moments,
    pub region: Region,
    pub volume: Shape,
    pub halve: [bool; 3],
}

/// Fine cells that a coarse one sees along a halved axis.
const EDGE: usize = 6;
const ROWS: usize = EDGE * EDGE;

/// The fine cells that a coarse one sees, by rows of whole vectors; the mean of what is missing or does not exist is NaN.
struct Block {
    mean: [[f64; LANES]; ROWS],
    variance: [[f64; LANES]; ROWS],
    /// The mean of a valid cell.
    pivot: f64,
    halve: [bool; 3],
    /// How many blurred cells the coarse one covers along each axis.
    covers: [usize; 3],
}

impl Fine<'_> {
    /// Makes those cells of `dst`, which covers `coarse` of the next level, anew that are not finite.
    pub fn mend(&self, level: Level, coarse: Region, dst: &mut Moments) {
        let rows = [[0.0; LANES]; ROWS];
        let mut block = Block { mean: rows, variance: rows, pivot: 0.0, halve: self.halve, covers: [0; 3] };
        for (i, cell) in coarse.iter().enumerate() {
            if dst.mean[i].is_finite() && dst.variance[i].is_finite() {
                continue;
            }
            let mut made = [f64::NAN; 2];
            if self.load(cell, &mut block) {
                pool_block(level, &block, &mut made);
                if !(made[0].is_finite() && made[1].is_finite()) {
                    made = self.pool_valid(cell);
                }
            }
            [dst.mean[i], dst.variance[i]] = made;
        }
    }

    /// First blurred cell along each axis, and the end of those that exist; of an axis that stays, the cell itself.
    fn blurred(&self, coarse: [i64; 3]) -> Region {
        let first: [i64; 3] = std::array::from_fn(|a| if self.halve[a] { 2 * coarse[a] } else { coarse[a] });
        let end = |a: usize| (first[a] + 1 + i64::from(self.halve[a])).min(self.volume[a] as i64);
        Region::new(first, std::array::from_fn(end))
    }

    fn reach(&self) -> [usize; 3] {
        self.halve.map(|h| 2 * usize::from(h))
    }

    /// Loads what a coarse cell sees; false where nothing of it is valid.
    fn load(&self, coarse: [i64; 3], block: &mut Block) -> bool {
        let blurred = self.blurred(coarse);
        let window = blurred.grow(self.reach()).clip(&Region::whole(self.volume));
        let (shape, n) = (self.region.shape(), window.shape());
        // The window's place in the block, which starts where the taps of the first blurred cell do, and among the fine cells.
        let reach = self.reach().map(|r| r as i64);
        let to: [usize; 3] = std::array::from_fn(|a| (window.lo[a] - (blurred.lo[a] - reach[a])) as usize);
        let from = self.region.offset_of(&window);
        let rows = || (0..n[0]).flat_map(|z| (0..n[1]).map(move |y| (z, y)));
        let start = |z: usize, y: usize| ((from[0] + z) * shape[1] + from[1] + y) * shape[2] + from[2];
        if rows().all(|(z, y)| self.cells.mean[start(z, y)..][..n[2]].iter().fold(true, |all, m| all & m.is_nan())) {
            return false;
        }
        if n != [EDGE; 3] {
            block.mean = [[f64::NAN; LANES]; ROWS];
        }
        for (z, y) in rows() {
            let (row, start) = ((to[0] + z) * EDGE + to[1] + y, start(z, y));
            block.mean[row][to[2]..][..n[2]].copy_from_slice(&self.cells.mean[start..][..n[2]]);
            block.variance[row][to[2]..][..n[2]].copy_from_slice(&self.cells.variance[start..][..n[2]]);
        }
        block.covers = blurred.shape();
        block.pivot = block.choose_pivot();
        true
    }

    /// Mean and variance of a cell; NaN means where it is missing.
    fn at(&self, cell: [i64; 3]) -> [f64; 2] {
        let (shape, at) = (self.region.shape(), std::array::from_fn(|a| (cell[a] - self.region.lo[a]) as usize));
        let [z, y, x]: [usize; 3] = at;
        let i = (z * shape[1] + y) * shape[2] + x;
        [self.cells.mean[i], self.cells.variance[i]]
    }

    /// The cell `coarse` of the next level over the valid cells of its windows: each blurred cell that it covers by its taps, then
    /// those that have any, alike. NaN where there is none. What [`pool_block`] must make, short; and what makes infinities.
    fn pool_valid(&self, coarse: [i64; 3]) -> [f64; 2] {
        let blurred = self.blurred(coarse).iter().filter_map(|b| {
            let taps = Region::new(b, b.map(|i| i + 1)).grow(self.reach()).clip(&Region::whole(self.volume));
            pool(|| {
                taps.iter().map(|cell| {
                    let weight = |a: usize| if self.halve[a] { TAPS[(cell[a] - b[a] + 2) as usize] } else { 1.0 };
                    ((0..3).map(weight).product(), self.at(cell))
                })
            })
        });
        let mut found = [[0.0; 2]; 8];
        let count = blurred.zip(&mut found).map(|(b, to)| *to = b).count();
        pool(|| found[..count].iter().map(|b| (1.0, *b))).unwrap_or([f64::NAN; 2])
    }
}

impl Block {
    /// A valid cell among those that the coarse cell covers, which weigh most, else any; there is one.
    fn choose_pivot(&self) -> f64 {
        let [z, y, x] = self.halve.map(|h| if h { [2, 3] } else { [0, 0] });
        let rows = z.map(|z| y.map(|y| z * EDGE + y));
        let mut covered = rows.as_flattened().iter().flat_map(|row| x.map(|x| self.mean[*row][x]));
        let near = covered.find(|m| !m.is_nan());
        let any = || self.mean.iter().flat_map(|row| &row[..EDGE]).copied().find(|m| !m.is_nan());
        near.or_else(any).unwrap_or(0.0)
    }
}

on_lanes! {
    /// A coarse cell from its block; not finite where an infinity is among its cells or a sum overflows.
    fn pool_block[](block: &Block, out: &mut [f64; 2]) = pool_block_inner[];
}

/// Numbers of a cell: whether it is valid, its mean from the pivot on, its mean square from there.
const FIELDS: usize = 3;

#[inline(always)]
#[allow(clippy::needless_range_loop)] // places in the block, whatever is there
fn pool_block_inner<V: F64x8>(block: &Block, out: &mut [f64; 2]) {
    let zero = V::splat(0.0);
    let pivot = V::splat(block.pivot);
    let [halve_z, halve_y, halve_x] = block.halve;
    // by field and blurred cell along z, rows along y
    let mut planes = [[[zero; EDGE]; 2]; FIELDS];
    for y in 0..if halve_y { EDGE } else { 1 } {
        let mut column = [[zero; EDGE]; FIELDS];
        for z in 0..if halve_z { EDGE } else { 1 } {
            let row = z * EDGE + y;
            // SAFETY: eight values each.
            let (mean, own) = unsafe { (V::load(block.mean[row].as_ptr()), V::load(block.variance[row].as_ptr())) };
            let [mean, valid] = mean.present();
            let away = mean.minus(pivot);
            column[0][z] = valid;
            column[1][z] = away.where_positive(valid);
            column[2][z] = own.plus(away.times(away)).where_positive(valid);
        }
        for f in 0..FIELDS {
            [planes[f][0][y], planes[f][1][y]] = blurred(&column[f], halve_z);
        }
    }
    let mut rows = [zero; 4 * FIELDS];
    for f in 0..FIELDS {
        for z in 0..2 {
            [rows[4 * f + 2 * z], rows[4 * f + 2 * z + 1]] = blurred(&planes[f][z], halve_y);
        }
    }
    // what lies along x becomes rows
    let [a, b, c, d, e, f, g, h, i, j, k, l] = rows;
    let [m, n, o, p, q, r, ..] = V::turn([a, b, c, d, e, f, g, h]);
    let firsts = blurred(&[m, n, o, p, q, r], halve_x);
    let [m, n, o, p, q, r, ..] = V::turn([i, j, k, l, zero, zero, zero, zero]);
    let seconds = blurred(&[m, n, o, p, q, r], halve_x);
    let mut sums = [[[0.0; LANES]; 2]; 2];
    for x in 0..2 {
        // SAFETY: eight values each.
        unsafe {
            firsts[x].store(sums[x][0].as_mut_ptr());
            seconds[x].store(sums[x][1].as_mut_ptr());
        }
    }
    *out = pool_blurred(&sums, block);
}

/// Sums over the taps of both blurred cells of a halved axis; of an axis that stays, the cell itself.
#[inline(always)]
fn blurred<V: F64x8>(&[a, b, c, d, e, f]: &[V; EDGE], halve: bool) -> [V; 2] {
    if !halve {
        return [a, V::splat(0.0)];
    }
    let [_, four, six, ..] = TAPS;
    let (four, six) = (V::splat(four), V::splat(six));
    let first = a.plus(e).plus(four.times(b.plus(d))).plus(six.times(c));
    let second = b.plus(f).plus(four.times(c.plus(e))).plus(six.times(d));
    [first, second]
}

/// The mean and variance of the blurred cells that exist and are valid, all alike: by x, sums of weights and of means (by z
/// and y), then of squares.
#[inline(always)]
fn pool_blurred(sums: &[[[f64; LANES]; 2]; 2], block: &Block) -> [f64; 2] {
    let (mut count, mut mean, mut square) = (0.0, 0.0, 0.0);
    for z in 0..block.covers[0] {
        for y in 0..block.covers[1] {
            for [first, second] in &sums[..block.covers[2]] {
                let at = 2 * z + y;
                if first[at] > 0.0 {
                    count += 1.0;
                    mean += first[4 + at] / first[at];
                    square += second[at] / first[at];
                }
            }
        }
    }
    let mean = mean / count;
    let variance = square / count - mean * mean;
    [block.pivot + mean, if variance < 0.0 { 0.0 } else { variance }]
}

/// Mean and variance of weighted cells that are valid; `None` where none is. Relative to the first of them, so that constants stay
/// what they are, except where an infinity stands.
fn pool<I: Iterator<Item = (f64, [f64; 2])>>(cells: impl Fn() -> I) -> Option<[f64; 2]> {
    let valid = || cells().filter(|(_, [m, _])| !m.is_nan());
    let (_, [pivot, _]) = valid().next()?;
    let total: f64 = valid().map(|(w, _)| w).sum();
    let mut mean = pivot + valid().map(|(w, [m, _])| w * (m - pivot)).sum::<f64>() / total;
    if !mean.is_finite() {
        mean = valid().map(|(w, [m, _])| w * m).sum::<f64>() / total;
    }
    // a NaN variance beside a mean is what an infinity left
    let spread = valid().map(|(w, [m, v])| w * (v + (m - mean) * (m - mean))).sum::<f64>() / total;
    Some([mean, spread])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the short way, for every halving, near and far from the ends, with a half of all cells missing; the second time
    /// some cells stand a million off.
    #[test]
    fn blocks_are_pooled_as_windows_are() {
        for (far, tolerance) in [(0.0, 1e-12), (1e6, 1e-11)] {
            pooled_as_windows(far, tolerance);
        }
    }

    fn pooled_as_windows(far: f64, tolerance: f64) {
        let volume = [7, 6, 9];
        let n: usize = volume.iter().product();
        let random = |i: usize, k: usize| ((i * 2654435761 + k * 40503) >> 7) % 1009;
        let step = |i: usize| if random(i, 5) % 16 == 0 { far } else { 0.0 };
        let mean: Vec<f64> = (0..n)
            .map(|i| if random(i, 1) % 2 == 0 { f64::NAN } else { 1e6 + random(i, 2) as f64 + step(i) })
            .collect();
        let variance: Vec<f64> =
            (0..n).map(|i| if mean[i].is_nan() { f64::NAN } else { random(i, 3) as f64 }).collect();
        let cells = Moments { mean, variance };
        for halve in [[true; 3], [true, false, true], [false, true, false]] {
            let fine = Fine { cells: &cells, region: Region::whole(volume), volume, halve };
            let coarse: Shape = std::array::from_fn(|a| if halve[a] { volume[a].div_ceil(2) } else { volume[a] });
            let coarse = Region::whole(coarse);
            for level in Level::available() {
                let mut dst =
                    Moments { mean: vec![f64::NAN; coarse.voxels()], variance: vec![f64::NAN; coarse.voxels()] };
                fine.mend(level, coarse, &mut dst);
                for (i, cell) in coarse.iter().enumerate() {
                    let [mean, variance] = fine.pool_valid(cell);
                    let near = |a: f64, b: f64| (a - b).abs() <= tolerance * b.abs() || a.is_nan() && b.is_nan();
                    assert!(near(dst.mean[i], mean) && near(dst.variance[i], variance), "{halve:?} {level:?} {cell:?}");
                }
            }
        }
    }
}
