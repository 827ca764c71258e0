//! Cells of a map whose windows hold missing cells or infinities, made anew one by one.

use super::{Moments, TAPS};
use crate::grid::{Region, Shape};
use crate::kernel::simd::Level;
use crate::multiversion;

/// Cells of a level, where they lie in it, and which axes the next level halves.
pub(super) struct Fine<'a> {
    pub cells: &'a Moments,
    pub region: Region,
    pub volume: Shape,
    pub halve: [bool; 3],
}

/// Fine cells that a coarse one sees along a halved axis.
const EDGE: usize = 6;
/// Room for them along x: whole vectors.
const LANES: usize = 8;
const ROWS: usize = EDGE * EDGE;

/// The fine cells that a coarse one sees, by rows; what is missing or does not exist is 0 and not valid.
struct Block {
    mean: [[f64; LANES]; ROWS],
    variance: [[f64; LANES]; ROWS],
    valid: [[f64; LANES]; ROWS],
}

/// Weights along an axis of the first and the second blurred cell, and of the cell itself where the axis stays.
const WEIGHTS: [[f64; LANES]; 3] = [
    [TAPS[0], TAPS[1], TAPS[2], TAPS[3], TAPS[4], 0.0, 0.0, 0.0],
    [0.0, TAPS[0], TAPS[1], TAPS[2], TAPS[3], TAPS[4], 0.0, 0.0],
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
];

impl Fine<'_> {
    /// Makes those cells of `dst`, which covers `coarse` of the next level, anew that are not finite.
    pub fn mend(&self, level: Level, coarse: Region, dst: &mut Moments) {
        let mut block = Block { mean: [[0.0; 8]; ROWS], variance: [[0.0; 8]; ROWS], valid: [[0.0; 8]; ROWS] };
        for (i, cell) in coarse.iter().enumerate() {
            if dst.mean[i].is_finite() && dst.variance[i].is_finite() {
                continue;
            }
            let mut made = [f64::NAN; 2];
            if self.load(cell, &mut block) {
                pool_block(level, &block, self.kernels(cell), &mut made);
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

    /// Which of [`WEIGHTS`] make the blurred cells along each axis.
    fn kernels(&self, coarse: [i64; 3]) -> [&'static [[f64; LANES]]; 3] {
        let shape = self.blurred(coarse).shape();
        std::array::from_fn(|a| if self.halve[a] { &WEIGHTS[..shape[a]] } else { &WEIGHTS[2..] })
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
        block.valid = [[0.0; LANES]; ROWS];
        for (z, y) in rows() {
            let row = (to[0] + z) * EDGE + to[1] + y;
            let start = start(z, y);
            let (means, variances) = (&self.cells.mean[start..][..n[2]], &self.cells.variance[start..][..n[2]]);
            (block.mean[row], block.variance[row]) = ([0.0; LANES], [0.0; LANES]);
            for (x, (m, v)) in means.iter().zip(variances).enumerate() {
                if !m.is_nan() {
                    block.valid[row][to[2] + x] = 1.0;
                    (block.mean[row][to[2] + x], block.variance[row][to[2] + x]) = (*m, *v);
                }
            }
        }
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

multiversion! {
    /// A coarse cell from its block, in two passes over the taps of each blurred cell; not finite where an infinity is among them
    /// or a sum overflows. `kernels` has the weights of the blurred cells along z, y, x.
    fn pool_block[](block: &Block, kernels: [&[[f64; LANES]]; 3], out: &mut [f64; 2]) -> () = pool_block_inner;
}

#[inline(always)]
fn pool_block_inner(block: &Block, [along_z, along_y, along_x]: [&[[f64; LANES]]; 3], out: &mut [f64; 2]) {
    let mut found = [[0.0; 2]; 8];
    let mut count = 0;
    for wz in along_z {
        for wy in along_y {
            for wx in along_x {
                if let Some(blurred) = blur(block, [wz, wy, wx]) {
                    found[count] = blurred;
                    count += 1;
                }
            }
        }
    }
    *out = pool(|| found[..count].iter().map(|b| (1.0, *b))).unwrap_or([f64::NAN; 2]);
}

/// One blurred cell, relative to its first valid tap, so that constants stay what they are. `None` without any.
#[inline(always)]
fn blur(block: &Block, [wz, wy, wx]: [&[f64; LANES]; 3]) -> Option<[f64; 2]> {
    let mut pivot = None;
    for row in 0..ROWS {
        if wz[row / EDGE] * wy[row % EDGE] == 0.0 || pivot.is_some() {
            continue;
        }
        pivot = (0..LANES).find(|&l| wx[l] * block.valid[row][l] > 0.0).map(|l| block.mean[row][l]);
    }
    let pivot = pivot?;
    let (mut total, mut shift, mut spread) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
    for row in 0..ROWS {
        let w = wz[row / EDGE] * wy[row % EDGE];
        if w > 0.0 {
            for l in 0..LANES {
                let share = w * wx[l] * block.valid[row][l];
                total[l] += share;
                shift[l] += share * (block.mean[row][l] - pivot);
            }
        }
    }
    let total = sum(total);
    let mean = pivot + sum(shift) / total;
    for row in 0..ROWS {
        let w = wz[row / EDGE] * wy[row % EDGE];
        if w > 0.0 {
            for l in 0..LANES {
                let share = w * wx[l] * block.valid[row][l];
                let away = block.mean[row][l] - mean;
                spread[l] += share * (block.variance[row][l] + away * away);
            }
        }
    }
    Some([mean, sum(spread) / total])
}

#[inline(always)]
fn sum([a, b, c, d, e, f, g, h]: [f64; LANES]) -> f64 {
    ((a + b) + (c + d)) + ((e + f) + (g + h))
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

    /// Against the short way, for every halving, near and far from the ends, with a half of all cells missing.
    #[test]
    fn blocks_are_pooled_as_windows_are() {
        let volume = [7, 6, 9];
        let n: usize = volume.iter().product();
        let random = |i: usize, k: usize| ((i * 2654435761 + k * 40503) >> 7) % 1009;
        let mean: Vec<f64> =
            (0..n).map(|i| if random(i, 1) % 2 == 0 { f64::NAN } else { 1e6 + random(i, 2) as f64 }).collect();
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
                    let near = |a: f64, b: f64| (a - b).abs() <= 1e-12 * b.abs() || a.is_nan() && b.is_nan();
                    assert!(near(dst.mean[i], mean) && near(dst.variance[i], variance), "{halve:?} {level:?} {cell:?}");
                }
            }
        }
    }
}
