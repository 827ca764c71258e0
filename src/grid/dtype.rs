//! Element types of stored volumes and of the arrays between stages.

use std::fmt;

/// The eight element types that volumes may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    F32,
    F64,
}

impl DType {
    pub const ALL: [DType; 8] =
        [DType::U8, DType::I8, DType::U16, DType::I16, DType::U32, DType::I32, DType::F32, DType::F64];

    /// Bytes of one voxel.
    pub fn size(self) -> usize {
        match self {
            DType::U8 | DType::I8 => 1,
            DType::U16 | DType::I16 => 2,
            DType::U32 | DType::I32 | DType::F32 => 4,
            DType::F64 => 8,
        }
    }

    /// Short name as the configuration spells it: `u8`, `f32`, ...
    pub fn name(self) -> &'static str {
        match self {
            DType::U8 => "u8",
            DType::I8 => "i8",
            DType::U16 => "u16",
            DType::I16 => "i16",
            DType::U32 => "u32",
            DType::I32 => "i32",
            DType::F32 => "f32",
            DType::F64 => "f64",
        }
    }

    /// Name as NumPy and Zarr v3 spell it: `uint8`, `float32`, ...
    pub fn numpy_name(self) -> &'static str {
        match self {
            DType::U8 => "uint8",
            DType::I8 => "int8",
            DType::U16 => "uint16",
            DType::I16 => "int16",
            DType::U32 => "uint32",
            DType::I32 => "int32",
            DType::F32 => "float32",
            DType::F64 => "float64",
        }
    }

    /// Either spelling.
    pub fn parse(text: &str) -> Option<DType> {
        DType::ALL.into_iter().find(|d| d.name() == text || d.numpy_name() == text)
    }

    pub fn is_float(self) -> bool {
        matches!(self, DType::F32 | DType::F64)
    }

    /// Type of everything but min and max between stages: f64 for u32, i32 and f64 inputs, else f32 (SPEC section 3, Types).
    pub fn result(self) -> DType {
        match self {
            DType::U32 | DType::I32 | DType::F64 => DType::F64,
            _ => DType::F32,
        }
    }

    /// Least and largest finite value.
    pub fn range(self) -> (f64, f64) {
        match self {
            DType::U8 => (0.0, u8::MAX as f64),
            DType::I8 => (i8::MIN as f64, i8::MAX as f64),
            DType::U16 => (0.0, u16::MAX as f64),
            DType::I16 => (i16::MIN as f64, i16::MAX as f64),
            DType::U32 => (0.0, u32::MAX as f64),
            DType::I32 => (i32::MIN as f64, i32::MAX as f64),
            DType::F32 => (f32::MIN as f64, f32::MAX as f64),
            DType::F64 => (f64::MIN, f64::MAX),
        }
    }
}

impl fmt::Display for DType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A Rust type that a volume may hold. All bit patterns are valid values.
pub trait Voxel: bytemuck::Pod + Default + PartialOrd + Send + Sync + fmt::Debug {
    const DTYPE: DType;
    fn to_f64(self) -> f64;
    /// Nearest value, ties to even, saturating; NaN gives 0 for integers.
    fn from_f64(v: f64) -> Self;
    fn from_le_slice(bytes: &[u8]) -> Self;
    fn from_be_slice(bytes: &[u8]) -> Self;
}

macro_rules! voxel {
    ($($t:ty, $d:ident, $from:expr;)*) => {$(
        impl Voxel for $t {
            const DTYPE: DType = DType::$d;
            #[inline(always)]
            fn to_f64(self) -> f64 { self as f64 }
            #[inline(always)]
            fn from_f64(v: f64) -> Self { ($from)(v) as $t }
            #[inline(always)]
            fn from_le_slice(b: &[u8]) -> Self { <$t>::from_le_bytes(b.try_into().unwrap()) }
            #[inline(always)]
            fn from_be_slice(b: &[u8]) -> Self { <$t>::from_be_bytes(b.try_into().unwrap()) }
        }
    )*};
}
voxel! {
    u8, U8, f64::round_ties_even; i8, I8, f64::round_ties_even; u16, U16, f64::round_ties_even;
    i16, I16, f64::round_ties_even; u32, U32, f64::round_ties_even; i32, I32, f64::round_ties_even;
    f32, F32, std::convert::identity; f64, F64, std::convert::identity;
}

/// Runs `$body` with `$T` bound to the Rust type of a [`DType`] value.
#[macro_export]
macro_rules! with_dtype {
    ($d:expr, $T:ident => $body:expr) => {
        match $d {
            $crate::grid::DType::U8 => {
                type $T = u8;
                $body
            }
            $crate::grid::DType::I8 => {
                type $T = i8;
                $body
            }
            $crate::grid::DType::U16 => {
                type $T = u16;
                $body
            }
            $crate::grid::DType::I16 => {
                type $T = i16;
                $body
            }
            $crate::grid::DType::U32 => {
                type $T = u32;
                $body
            }
            $crate::grid::DType::I32 => {
                type $T = i32;
                $body
            }
            $crate::grid::DType::F32 => {
                type $T = f32;
                $body
            }
            $crate::grid::DType::F64 => {
                type $T = f64;
                $body
            }
        }
    };
}
