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
    /// `chunk` holds the level or no axis can be halved. `stride` keeps the translation of level 0.
    pub fn new(
        shape: Shape,
        spacing: [f64; 3],
        origin: [f64; 3],
        chunk: Shape,
        count: Option<usize>,
        stride: bool,
    ) -> Pyramid {
        let _ = (shape, spacing, origin, chunk, count, stride);
        todo!()
    }
}
