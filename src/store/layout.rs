//! Levels of a pyramid: shapes, factors, physical placement.

use crate::grid::Shape;

/// One level.
#[derive(Debug, Clone, PartialEq)]
pub struct LevelLayout {
    pub shape: Shape,
    /// Level-0 voxels per cell and axis (a power of two).
    pub factor: [usize; 3],
    /// Which axes the step from the level before halved (all false at level 0).
    pub halved: [bool; 3],
    /// Physical size of a cell.
    pub scale: [f64; 3],
    /// Physical position of the centre of cell 0.
    pub translation: [f64; 3],
}

/// All levels of one output, fine to coarse.
#[derive(Debug, Clone, PartialEq)]
pub struct Pyramid {
    pub levels: Vec<LevelLayout>,
}

impl Pyramid {
    /// Levels by the rule of SPEC section 3: each halves every axis of size over 1 whose spacing is less than twice
    /// (times 1 - 1e-9) the finest spacing among the axes of size over 1; odd sizes round up. `count` of `None`: until one
    /// `chunk` holds the level or no axis can be halved; a count that no axis allows ends there, too. `stride` keeps the
    /// translation of level 0.
    pub fn new(
        shape: Shape,
        spacing: [f64; 3],
        origin: [f64; 3],
        chunk: Shape,
        count: Option<usize>,
        stride: bool,
    ) -> Pyramid {
        Pyramid::starting_at(0, shape, spacing, origin, chunk, count, stride)
    }

    /// Like [`Pyramid::new`], but dataset 0 is level `start` (the occlusion map): factors, scales and translations still
    /// refer to level 0, and `count` counts from `start`. Where the volume has no such level, its last one is dataset 0.
    pub fn starting_at(
        start: usize,
        shape: Shape,
        spacing: [f64; 3],
        origin: [f64; 3],
        chunk: Shape,
        count: Option<usize>,
        stride: bool,
    ) -> Pyramid {
        let place = |factor: [usize; 3], a: usize| {
            let shift = if stride { 0.0 } else { spacing[a] * (factor[a] - 1) as f64 / 2.0 };
            origin[a] + shift
        };
        let level = |shape: Shape, factor: [usize; 3], halved: [bool; 3]| LevelLayout {
            shape,
            factor,
            halved,
            scale: std::array::from_fn(|a| spacing[a] * factor[a] as f64),
            translation: std::array::from_fn(|a| place(factor, a)),
        };
        let mut levels = vec![level(shape, [1; 3], [false; 3])];
        loop {
            let last = &levels[levels.len() - 1];
            let halved = halving(last.shape, last.scale);
            let enough = match count {
                Some(count) => levels.len() >= start.saturating_add(count.max(1)),
                None => levels.len() > start && (0..3).all(|a| last.shape[a] <= chunk[a]),
            };
            if enough || halved == [false; 3] {
                break;
            }
            let halve = |n: usize, a: usize| if halved[a] { n.div_ceil(2) } else { n };
            let factor = std::array::from_fn(|a| last.factor[a] << usize::from(halved[a]));
            let shape = std::array::from_fn(|a| halve(last.shape[a], a));
            levels.push(level(shape, factor, halved));
        }
        Pyramid { levels }.skip(start)
    }

    /// Without the first `n` levels (at least one stays). The others keep their factor, scale, translation and `halved`.
    pub fn skip(mut self, n: usize) -> Pyramid {
        self.levels.drain(..n.min(self.levels.len() - 1));
        self
    }
}

/// Which axes the step to the next level halves (SPEC section 3).
pub fn halving(shape: Shape, spacing: [f64; 3]) -> [bool; 3] {
    let finest = (0..3).filter(|&a| shape[a] > 1).map(|a| spacing[a]).fold(f64::INFINITY, f64::min);
    std::array::from_fn(|a| shape[a] > 1 && spacing[a] < 2.0 * finest * (1.0 - 1e-9))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes(p: &Pyramid) -> Vec<Shape> {
        p.levels.iter().map(|l| l.shape).collect()
    }

    #[test]
    fn isotropic_volumes_halve_all_axes_and_round_up() {
        let p = Pyramid::new([129, 130, 131], [0.5; 3], [10.0, 0.0, -3.0], [64; 3], None, false);
        assert_eq!(shapes(&p), [[129, 130, 131], [65, 65, 66], [33, 33, 33]]);
        let coarse = &p.levels[2];
        assert_eq!((coarse.factor, coarse.halved), ([4; 3], [true; 3]));
        assert_eq!((coarse.scale, coarse.translation), ([2.0; 3], [10.75, 0.75, -2.25]));
        assert_eq!(p.levels[0].halved, [false; 3]);
    }

    #[test]
    fn coarse_axes_wait_until_the_others_caught_up() {
        // z is exactly twice as coarse: not halved at first; then all three are equal.
        let p = Pyramid::new([100, 400, 400], [2.0, 1.0, 1.0], [0.0; 3], [64; 3], None, false);
        assert_eq!(shapes(&p)[1..], [[100, 200, 200], [50, 100, 100], [25, 50, 50]]);
        let below = Pyramid::new([100, 400, 400], [2.0 * (1.0 - 1e-8), 1.0, 1.0], [0.0; 3], [64; 3], Some(2), false);
        assert_eq!(below.levels[1].shape, [50, 200, 200], "just under twice is halved");
        let within = Pyramid::new([100, 400, 400], [2.0 * (1.0 - 1e-10), 1.0, 1.0], [0.0; 3], [64; 3], Some(2), false);
        assert_eq!(within.levels[1].shape, [100, 200, 200], "a rounding error under twice counts as twice");
    }

    #[test]
    fn axes_of_one_voxel_do_not_hold_the_others_back() {
        let p = Pyramid::new([1, 300, 200], [0.001, 1.0, 1.0], [0.0; 3], [64; 3], None, false);
        assert_eq!(shapes(&p), [[1, 300, 200], [1, 150, 100], [1, 75, 50], [1, 38, 25]]);
        assert_eq!(p.levels[3].translation, [0.0, 3.5, 3.5]);
    }

    #[test]
    fn counts_are_kept_and_end_where_nothing_can_be_halved() {
        let of = |count| Pyramid::new([4, 1, 3], [1.0; 3], [0.0; 3], [64; 3], count, true);
        assert_eq!(of(None).levels.len(), 1, "one chunk holds it");
        assert_eq!(of(Some(0)).levels.len(), 1);
        assert_eq!(of(Some(2)).levels.len(), 2);
        assert_eq!(shapes(&of(Some(usize::MAX))), [[4, 1, 3], [2, 1, 2], [1, 1, 1]]);
        assert!(of(Some(3)).levels.iter().all(|l| l.translation == [0.0; 3]), "stride keeps the first voxel's centre");
    }

    #[test]
    fn a_later_start_keeps_true_placement() {
        let p = Pyramid::starting_at(1, [100, 101, 102], [1.0; 3], [0.0; 3], [64; 3], None, false);
        assert_eq!(shapes(&p), [[50, 51, 51]]);
        assert_eq!((p.levels[0].factor, p.levels[0].translation), ([2; 3], [0.5; 3]));
        assert_eq!(p, Pyramid::new([100, 101, 102], [1.0; 3], [0.0; 3], [64; 3], None, false).skip(1));
        let counted = Pyramid::starting_at(1, [100, 101, 102], [1.0; 3], [0.0; 3], [64; 3], Some(3), false);
        assert_eq!(counted.levels.len(), 3);
        let small = Pyramid::starting_at(1, [10, 10, 10], [1.0; 3], [0.0; 3], [64; 3], None, false);
        assert_eq!(shapes(&small), [[5, 5, 5]], "the start level exists although one chunk holds level 0");
        let one = Pyramid::starting_at(1, [1, 1, 1], [1.0; 3], [0.0; 3], [64; 3], None, false);
        assert_eq!(shapes(&one), [[1, 1, 1]]);
    }
}
