//! What another device needs for a sweep: lines and tables, voxels as codes, and sums to openness. All in the fixed point
//! of this kernel, so that the bits are the same.

use super::keys::{self, Code, Coded, with_key};
use super::lines::{self, Family};
use super::{ObscuranceParams, Prepared};
use crate::grid::{AnyView, DType, View};
use crate::with_view;

/// Parallel lines of one or two opposite directions.
#[derive(Clone, Copy)]
pub struct Lines<'a>(&'a Family);

impl<'a> Lines<'a> {
    /// Dominant axis, 0 = z.
    pub fn axis(&self) -> usize {
        self.0.axis
    }

    /// Planes in reach.
    pub fn reach(&self) -> usize {
        self.0.reach
    }

    /// Voxels per axis that a line may move within reach.
    pub fn halo(&self) -> [usize; 3] {
        self.0.halo()
    }

    /// Displacement along `axis` at the global index `plane` along the dominant axis.
    pub fn displacement(&self, axis: usize, plane: i64) -> i64 {
        lines::displacement(self.0.slope[axis], plane)
    }

    /// Contributions of the sense toward growing indices (0) or falling ones (1), if it is swept: entry `c` where the voxel
    /// after `c` free ones occludes, entry [`Self::reach`] where none does.
    pub fn table(&self, way: usize) -> Option<&'a [u32]> {
        self.0.senses[way].as_ref().map(|s| s.table.as_slice())
    }
}

/// Bytes of a voxel's code; `None` where codes have more than 32 bits.
pub fn code_bytes(dtype: DType) -> Option<usize> {
    (dtype != DType::F64).then_some(dtype.size())
}

impl Prepared {
    /// All lines, in the order in which the sweep visits them.
    pub fn lines(&self) -> impl ExactSizeIterator<Item = Lines<'_>> {
        self.families.iter().map(Lines)
    }

    /// Fills `out` with the codes of a piece of a row that starts at voxel `[z, y, x]` of `src`: unsigned little-endian
    /// integers of [`code_bytes`] in the order of density, 0 for a missing voxel. Returns the least and largest code of
    /// voxels that are not missing.
    ///
    /// Panics on f64, or if the row is too short.
    pub fn codes(&self, src: AnyView, [z, y, x]: [usize; 3], out: &mut [u8]) -> (u32, u32) {
        let params = &self.params;
        macro_rules! arms {
            ($($t:ident: $bytes:literal),*) => {
                match src {
                    $(AnyView::$t(v) => row::<_, $bytes>(&v.row_at(z, y)[x..], Code::new(params), out, |k| k.to_le_bytes()),)*
                    AnyView::F64(_) => panic!("codes of f64 have 64 bits"),
                }
            };
        }
        arms!(U8: 1, I8: 1, U16: 2, I16: 2, U32: 4, I32: 4, F32: 4)
    }

    /// Openness of a piece of a row from its sums of contributions: what [`Prepared::sweep`] writes for them. The piece
    /// starts at voxel `at` of `src`, whose missing voxels give NaN.
    pub fn finish(&self, sums: &[u32], src: AnyView, at: [usize; 3], row: &mut [f32]) {
        for (out, &sum) in row.iter_mut().zip(sums) {
            *out = (sum as f64 / self.total as f64) as f32;
        }
        fn gaps<T: Coded>(v: View<T>, [z, y, x]: [usize; 3], missing: Option<i64>, row: &mut [f32]) {
            let missing = keys::missing_of::<T>(missing);
            for (out, &v) in row.iter_mut().zip(&v.row_at(z, y)[x..]) {
                *out = if keys::is_missing(v, missing) { f32::NAN } else { *out };
            }
        }
        with_view!(AnyView, src, v => gaps(v, at, self.params.missing, row));
    }

    /// The sum of contributions where nothing occludes; fits 32 bits whatever the directions.
    pub fn total(&self) -> u32 {
        self.total as u32
    }

    /// What it was made of.
    pub fn params(&self) -> &ObscuranceParams {
        &self.params
    }
}

fn row<T: Coded, const BYTES: usize>(
    row: &[T],
    code: Code<T>,
    out: &mut [u8],
    bytes: impl Fn(T::Key) -> [u8; BYTES],
) -> (u32, u32)
where
    T::Key: Into<u32>,
{
    let (out, _) = out.as_chunks_mut::<BYTES>();
    let row = &row[..out.len()];
    with_key!(code, key => {
        out.iter_mut().zip(row).for_each(|(out, &v)| *out = bytes(key(v)));
        let (lo, hi) = keys::ends(row, &code, key);
        (lo.into(), hi.into())
    })
}
