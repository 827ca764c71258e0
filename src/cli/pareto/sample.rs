//! Which bricks of a volume are judged: those whose hash is least, so that the choice depends on the seed and the lattice
//! alone, never on bricks of a run, threads or order, and a larger sample holds every smaller one.

use std::collections::BinaryHeap;

use serde_json::{Value, json};

use super::super::human;
use crate::config::Sample;
use crate::grid::hash::mix;
use crate::grid::{Region, Shape};

/// Edge of a judged brick: whole chunks of the outputs of a run.
pub const EDGE: usize = 64;
/// Bricks of an automatic sample: 134 million voxels, as many as a volume of 512^3.
const AUTO: u64 = 512;

/// What is judged of one lattice.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// The bricks in C order; `None`: every voxel of the volume.
    pub cells: Option<Vec<Region>>,
    pub voxels: u64,
    pub of_voxels: u64,
    pub of_bricks: u64,
    seed: u64,
}

/// Bricks per axis.
fn grid(shape: Shape) -> [u64; 3] {
    shape.map(|n| n.div_ceil(EDGE) as u64)
}

/// SplitMix64 of the seed and a brick's place in the grid.
fn hash(seed: u64, cell: [u64; 3]) -> u64 {
    cell.into_iter().chain([0]).fold(seed, |h, v| mix((h ^ v).wrapping_add(0x9e37_79b9_7f4a_7c15)))
}

impl Judged {
    pub fn choose(shape: Shape, sample: Sample, seed: u64) -> Judged {
        let grid = grid(shape);
        let of_bricks: u64 = grid.iter().product();
        let wanted = match sample {
            Sample::Auto => AUTO,
            Sample::All => of_bricks,
            Sample::Bricks(n) => n,
            Sample::Share(share) => ((of_bricks as f64 * share).ceil() as u64).max(1),
        };
        let of_voxels = shape.iter().map(|n| *n as u64).product();
        if wanted >= of_bricks {
            return Judged { cells: None, voxels: of_voxels, of_voxels, of_bricks, seed };
        }
        // The least hashes so far, the largest of them on top.
        let mut least: BinaryHeap<(u64, [u64; 3])> = BinaryHeap::new();
        for cell in (0..of_bricks).map(|i| [i / (grid[1] * grid[2]), i / grid[2] % grid[1], i % grid[2]]) {
            least.push((hash(seed, cell), cell));
            if least.len() as u64 > wanted {
                least.pop();
            }
        }
        let mut chosen: Vec<[u64; 3]> = least.into_iter().map(|c| c.1).collect();
        chosen.sort_unstable();
        let whole = Region::whole(shape);
        let cells: Vec<Region> =
            chosen.into_iter().map(|c| Region::of_cell(c.map(|v| v as i64), [0; 3], [EDGE; 3]).clip(&whole)).collect();
        let voxels = cells.iter().map(|c| c.voxels() as u64).sum();
        Judged { cells: Some(cells), voxels, of_voxels, of_bricks, seed }
    }

    /// Boxes of the input volume that the judged bricks of an output cover, whose cells are `scale` voxels each and which
    /// starts at `start`.
    pub fn boxes(&self, scale: Shape, start: [i64; 3]) -> Option<Vec<Region>> {
        let voxels = |c: &Region| {
            let at = |v: [i64; 3]| std::array::from_fn(|a| start[a] + v[a] * scale[a] as i64);
            Region::new(at(c.lo), at(c.hi))
        };
        self.cells.as_ref().map(|cells| cells.iter().map(voxels).collect())
    }

    pub fn json(&self) -> Value {
        let bricks = self.cells.as_ref().map_or(self.of_bricks, |c| c.len() as u64);
        json!({
            "voxels": self.voxels, "of_voxels": self.of_voxels, "bricks": bricks, "of_bricks": self.of_bricks,
            "brick": EDGE, "seed": self.seed,
        })
    }

    /// `2097152 of 134217728 voxels (8 of 512 bricks of 64^3, seed 0)`.
    pub fn text(&self) -> String {
        match &self.cells {
            None => format!("all {} voxels", self.voxels),
            Some(cells) => format!(
                "{} of {} voxels, {} % ({} of {} bricks of {EDGE}^3, seed {})",
                self.voxels,
                self.of_voxels,
                human::number(100.0 * self.voxels as f64 / self.of_voxels as f64),
                cells.len(),
                self.of_bricks,
                self.seed
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_fixed_by_its_seed_and_holds_every_smaller_one() {
        let shape = [300, 200, 1000];
        let cells = |n, seed| Judged::choose(shape, Sample::Bricks(n), seed).cells.unwrap();
        let (few, many) = (cells(7, 3), cells(40, 3));
        assert_eq!((few.len(), many.len()), (7, 40));
        assert!(few.iter().all(|c| many.contains(c)));
        assert_ne!(few, cells(7, 4));
        assert!(many.is_sorted_by_key(|c| c.lo), "in C order");
        let whole = Region::whole(shape);
        assert!(many.iter().all(|c| whole.contains(c) && c.lo.iter().all(|v| v % EDGE as i64 == 0)));
        assert!((0..40).all(|i| (0..i).all(|j| many[i] != many[j])));
        // The choice must never change between versions, or figures could not be repeated.
        assert_eq!(
            cells(3, 0).iter().map(|c| c.lo).collect::<Vec<_>>(),
            [[64, 64, 448], [128, 192, 512], [192, 64, 128]]
        );
    }

    #[test]
    fn bricks_are_drawn_evenly() {
        // Of 40 x 40 x 40 bricks a quarter: every half of the volume gets its half, within five deviations.
        let judged = Judged::choose([64 * 40; 3], Sample::Share(0.25), 1);
        let cells = judged.cells.as_ref().unwrap();
        assert_eq!(cells.len(), 16_000);
        for a in 0..3 {
            let low = cells.iter().filter(|c| c.lo[a] < 64 * 20).count() as f64;
            assert!((low - 8000.0).abs() < 5.0 * 55.0, "axis {a}: {low}");
        }
        assert_eq!((judged.voxels, judged.of_voxels), (16_000 << 18, 64_000 << 18));
    }

    #[test]
    fn small_volumes_are_judged_whole() {
        for sample in [Sample::Auto, Sample::All, Sample::Share(1.0), Sample::Bricks(27)] {
            let judged = Judged::choose([130, 130, 130], sample, 9);
            assert_eq!((judged.cells.as_ref(), judged.voxels), (None, 2_197_000), "{sample:?}");
        }
        assert_eq!(Judged::choose([64 * 9; 3], Sample::Auto, 9).cells.unwrap().len(), 512);
        // The least share is a brick, and clipped bricks count as they are.
        let one = Judged::choose([130, 130, 130], Sample::Share(1e-9), 9);
        assert_eq!(one.cells.as_ref().unwrap().len(), 1);
        assert_eq!(one.voxels, one.cells.as_ref().unwrap()[0].voxels() as u64);
        assert_eq!((one.json()["bricks"].as_u64(), one.json()["of_bricks"].as_u64()), (Some(1), Some(27)));
        assert!(one.text().contains("of 2197000 voxels"), "{}", one.text());
    }

    #[test]
    fn boxes_of_coarser_lattices_cover_their_voxels() {
        let judged = Judged::choose([130, 130, 70], Sample::Bricks(1), 2);
        let cell = judged.cells.as_ref().unwrap()[0];
        let b = judged.boxes([2, 2, 1], [5, 0, 7]).unwrap()[0];
        assert_eq!(b.lo, [5 + 2 * cell.lo[0], 2 * cell.lo[1], 7 + cell.lo[2]]);
        assert_eq!(b.voxels(), 4 * cell.voxels());
    }
}
