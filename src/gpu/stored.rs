//! How voxels lie in buffers of the device: bytes, signs, and rows of whole words.

use crate::grid::DType;

/// Bytes of a voxel that is uploaded as it is stored, and whether it is two's complement; `None` for types without kernels
/// that read them so.
pub fn packed(dtype: DType) -> Option<(usize, bool)> {
    match dtype {
        DType::U8 => Some((1, false)),
        DType::I8 => Some((1, true)),
        DType::U16 => Some((2, false)),
        DType::I16 => Some((2, true)),
        _ => None,
    }
}

/// Voxels from row to row of packed voxels of so many bytes: whole words, and whole fours, since passes over windows take four
/// columns at once.
pub fn pitch(extent: usize, voxel: usize) -> usize {
    if voxel == 4 { extent } else { extent.next_multiple_of(4) }
}

/// How voxels are uploaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stored {
    /// Bytes: 1, 2 or 4.
    pub voxel: usize,
    /// Two's complement.
    pub signed: bool,
    /// f32.
    pub real: bool,
}

impl Stored {
    pub fn dtype(self) -> DType {
        match (self.real, self.voxel, self.signed) {
            (true, ..) => DType::F32,
            (_, 1, false) => DType::U8,
            (_, 1, true) => DType::I8,
            (_, _, false) => DType::U16,
            (_, _, true) => DType::I16,
        }
    }
}

/// As [`packed`], with f32.
pub fn stored(dtype: DType) -> Option<Stored> {
    match dtype {
        DType::F32 => Some(Stored { voxel: 4, signed: false, real: true }),
        _ => packed(dtype).map(|(voxel, signed)| Stored { voxel, signed, real: false }),
    }
}
