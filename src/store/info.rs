//! What a stored volume is, apart from its voxels.

use crate::grid::{Affine, DType, Shape};

/// Facts about one volume, in `[z, y, x]` order. A 2-D image is `[1, y, x]`.
#[derive(Debug, Clone, PartialEq)]
pub struct VolumeInfo {
    pub shape: Shape,
    pub dtype: DType,
    /// Voxel size per axis in `unit`; 1 where the file says nothing. Always positive and finite.
    pub spacing: [f64; 3],
    /// UDUNITS name (`millimeter`, `micrometer`, ...); `None` where unknown, which forbids physical lengths.
    pub unit: Option<String>,
    /// Physical position of voxel 0 (see SPEC section 6: 0 where the direction matrix is not diagonal and positive).
    pub origin: [f64; 3],
    /// The file's own orientation, kept for NRRD and NIfTI outputs and recorded elsewhere.
    pub orientation: Option<Orientation>,
    /// Stored to scaled values.
    pub affine: Affine,
    /// Stored value of missing voxels.
    pub nodata: Option<f64>,
    /// Components (channels read with `"all"`); 1 for a scalar volume.
    pub components: usize,
    pub component_names: Vec<String>,
    /// Points in time that the file holds; one is read where `time` is not `"all"`.
    pub times: usize,
    /// Storage chunks, `[z, y, x]`; `None` for formats that are read by plain rows.
    pub chunk: Option<Shape>,
    /// How the file stores it, for people: `NIfTI-1, gzip`, `Zarr v3, blosc`, ...
    pub format: String,
    /// What may surprise whoever reads it as z, y, x.
    pub warnings: Vec<String>,
}

/// Direction matrix and space of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Orientation {
    /// World position = `matrix * [x, y, z, 1]` (three rows, x fastest first, as files have it), in `unit`s.
    pub matrix: [[f64; 4]; 3],
    /// Axes convention: `RAS` or `LPS` (what +x, +y, +z of the world mean), or the file's own word.
    pub space: String,
}

impl Orientation {
    /// From voxel to voxel along a column's axis (0: x).
    pub fn step(&self, column: usize) -> f64 {
        self.matrix.iter().map(|row| row[column] * row[column]).sum::<f64>().sqrt()
    }

    /// Which way `up` a picture is turned whose rows go along `axis` (0: z): toward the head (`'S'`) or the front (`'A'`) of
    /// a body, with whether the index grows that way. `None` where rows go from side to side or the space is no body's.
    pub fn upward(&self, axis: usize) -> Option<(char, bool)> {
        let column = 2 - axis;
        let row = (0..3).max_by(|&a, &b| self.matrix[a][column].abs().total_cmp(&self.matrix[b][column].abs()))?;
        let grows = self.matrix[row][column] > 0.0;
        match (self.space.as_str(), row) {
            ("RAS" | "LPS", 2) => Some(('S', grows)),
            ("RAS", 1) => Some(('A', grows)),
            ("LPS", 1) => Some(('A', !grows)),
            _ => None,
        }
    }

    /// Origin `[z, y, x]` where the matrix is diagonal and positive (to rounding).
    pub fn straight_origin(&self) -> Option<[f64; 3]> {
        let m = &self.matrix;
        let straight = (0..3).all(|r| {
            let least = 1e-6 * m[r][r];
            m[r][r] > 0.0 && (0..3).all(|c| c == r || m[r][c].abs() <= least)
        });
        straight.then(|| [m[2][3], m[1][3], m[0][3]])
    }
}

impl VolumeInfo {
    /// A scalar volume of which only shape and type are known.
    pub fn plain(shape: Shape, dtype: DType, format: impl Into<String>) -> VolumeInfo {
        VolumeInfo {
            shape,
            dtype,
            spacing: [1.0; 3],
            unit: None,
            origin: [0.0; 3],
            orientation: None,
            affine: Affine::IDENTITY,
            nodata: None,
            components: 1,
            component_names: Vec::new(),
            times: 1,
            chunk: None,
            format: format.into(),
            warnings: Vec::new(),
        }
    }

    /// Total voxels of one component.
    pub fn voxels(&self) -> usize {
        self.shape.iter().product()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_is_toward_head_or_front() {
        let of = |diagonal: [f64; 3], space: &str| {
            let mut matrix = [[0.0; 4]; 3];
            (0..3).for_each(|a| matrix[a][a] = diagonal[a]);
            let o = Orientation { matrix, space: space.into() };
            [0, 1, 2].map(|axis| o.upward(axis))
        };
        assert_eq!(of([1.0, 1.0, 1.0], "RAS"), [Some(('S', true)), Some(('A', true)), None]);
        assert_eq!(of([-1.0, -2.0, -1.0], "RAS"), [Some(('S', false)), Some(('A', false)), None]);
        assert_eq!(of([1.0, 1.0, 1.0], "LPS"), [Some(('S', true)), Some(('A', false)), None]);
        assert_eq!(of([1.0, 1.0, 1.0], "scanner-xyz"), [None; 3]);
        // Sagittal storage: z of the file goes to the left, y to the head.
        let matrix = [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.9, 0.1, 0.0]];
        let o = Orientation { matrix, space: "RAS".into() };
        assert_eq!([0, 1, 2].map(|axis| o.upward(axis)), [None, Some(('S', true)), Some(('A', true))]);
    }
}
