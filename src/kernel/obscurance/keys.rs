//! Voxels as unsigned keys in the order of their density, in a padded copy that every line can read without a test.

use crate::grid::{Region, Shape, View, Voxel};

/// Lines that are swept together, and zeros around every row of a [`Volume`].
pub(super) const LANES: usize = 64;

/// An unsigned integer that orders voxels by density. 0 is what nobody can be less than: missing voxels and everything
/// outside get it, so that lines pass through them.
pub(super) trait Key: Plain + Ord + Default + Send + Sync + 'static {
    const ZERO: Self;
    const MAX: Self;
    fn not(self) -> Self;
}

macro_rules! key {
    ($($t:ty),*) => {$(
        // SAFETY: a primitive integer.
        unsafe impl Plain for $t {}
        impl Key for $t {
            const ZERO: Self = 0;
            const MAX: Self = <$t>::MAX;
            #[inline(always)]
            fn not(self) -> Self { !self }
        }
    )*};
}
key!(u8, u16, u32, u64);

/// Integers: every bit pattern is a value.
///
/// # Safety
/// Only types without padding and invalid bit patterns may be `Plain`.
pub(super) unsafe trait Plain: Copy {}
// SAFETY: primitive integers.
unsafe impl Plain for i32 {}
// SAFETY: as above.
unsafe impl Plain for i64 {}
// SAFETY: as above.
unsafe impl Plain for usize {}

/// Element types with an order-preserving map to a [`Key`].
pub(super) trait Coded: Voxel {
    type Key: Key;
    /// Strictly increasing; equal only for equal values (-0.0 equals 0.0). NaN must be asked for before.
    fn code(self) -> Self::Key;
}

macro_rules! coded {
    ($($t:ty => $k:ty, $v:ident => $code:expr;)*) => {$(
        impl Coded for $t {
            type Key = $k;
            #[inline(always)]
            fn code(self) -> $k { let $v = self; $code }
        }
    )*};
}
coded! {
    u8 => u8, v => v;
    i8 => u8, v => v as u8 ^ 0x80;
    u16 => u16, v => v;
    i16 => u16, v => v as u16 ^ 0x8000;
    u32 => u32, v => v;
    i32 => u32, v => v as u32 ^ 0x8000_0000;
    f32 => u32, v => {
        let bits = (v + 0.0).to_bits();
        bits ^ ((bits as i32 >> 31) as u32 | 0x8000_0000)
    };
    f64 => u64, v => {
        let bits = (v + 0.0).to_bits();
        bits ^ ((bits as i64 >> 63) as u64 | 1 << 63)
    };
}

/// Which voxels are missing: NaN, or the stored value `missing` of integer types.
#[inline(always)]
pub(super) fn is_missing<T: Voxel>(v: T, missing: Option<T>) -> bool {
    v.partial_cmp(&v).is_none() || missing == Some(v)
}

/// The stored value that marks missing voxels, if `T` can hold it.
pub(super) fn missing_of<T: Voxel>(missing: Option<i64>) -> Option<T> {
    let value = missing.filter(|_| !T::DTYPE.is_float())?;
    let (lo, hi) = T::DTYPE.range();
    (lo..=hi).contains(&(value as f64)).then(|| T::from_f64(value as f64))
}

/// Elements of a padded copy of `shape`.
pub(super) fn padded_len(shape: Shape) -> usize {
    let (row, plane) = strides(shape);
    LANES + (shape[0] * plane).max(shape[1] * row)
}

/// Row and plane strides: [`LANES`] zeros after each row (which also stand before the next), and planes that do not fall
/// into the same cache sets.
fn strides(shape: Shape) -> (usize, usize) {
    let row = shape[2].next_multiple_of(64) + LANES;
    let plane = row * shape[1];
    (row, if plane.is_multiple_of(1024) { plane + 64 } else { plane })
}

/// Keys of a box, padded with zeros along the last axis. Axes are in frame order: `[z, y, x]` or `[x, y, z]`.
#[derive(Clone, Copy)]
pub(super) struct Volume<'a, K> {
    data: &'a [K],
    row: usize,
    plane: usize,
    /// Global indices, in frame order.
    pub region: Region,
}

impl<'a, K: Key> Volume<'a, K> {
    pub fn new(data: &'a [K], region: Region) -> Self {
        let (row, plane) = strides(region.shape());
        assert!(data.len() >= padded_len(region.shape()), "padded copy is too short");
        Volume { data, row, plane, region }
    }

    /// All keys; the first [`LANES`] are zeros, and so are those around every row.
    pub fn data(&self) -> &'a [K] {
        self.data
    }

    /// Place in [`Self::data`] of the [`LANES`] keys at `[i, j, k..]` counted from the corner of the box; `i` and `j`
    /// inside it, `-LANES <= k <= n`.
    #[inline(always)]
    pub fn start(&self, i: usize, j: usize, k: i64) -> usize {
        ((i * self.plane + j * self.row + LANES) as i64 + k) as usize
    }
}

/// Fills a padded copy in natural order and returns the least and largest key of voxels that are not missing.
pub(super) fn encode<T: Coded>(
    src: View<T>,
    missing: Option<i64>,
    flipped: bool,
    out: &mut [T::Key],
) -> (T::Key, T::Key) {
    let (row, plane) = strides(src.shape);
    let missing = missing_of::<T>(missing);
    let (mut lo, mut hi) = (T::Key::MAX, T::Key::ZERO);
    out.fill(T::Key::ZERO);
    for z in 0..src.shape[0] {
        for y in 0..src.shape[1] {
            let to = &mut out[LANES + z * plane + y * row..][..src.shape[2]];
            for (to, &v) in to.iter_mut().zip(src.row_at(z, y)) {
                let gone = is_missing(v, missing);
                let key = if flipped { v.code().not() } else { v.code() };
                lo = lo.min(if gone { T::Key::MAX } else { key });
                *to = if gone { T::Key::ZERO } else { key };
                hi = hi.max(*to);
            }
        }
    }
    (lo, hi)
}

/// Fills a padded copy in `[x, y, z]` order from one in natural order.
pub(super) fn swap<K: Key>(src: &[K], shape: Shape, out: &mut [K]) {
    const TILE: usize = 16;
    let swapped = [shape[2], shape[1], shape[0]];
    let ((row, plane), (to_row, to_plane)) = (strides(shape), strides(swapped));
    out.fill(K::ZERO);
    for y in 0..shape[1] {
        for z0 in (0..shape[0]).step_by(TILE) {
            let nz = TILE.min(shape[0] - z0);
            for x0 in (0..shape[2]).step_by(TILE) {
                let nx = TILE.min(shape[2] - x0);
                let mut tile = [[K::ZERO; TILE]; TILE];
                for z in 0..nz {
                    let from = &src[LANES + (z0 + z) * plane + y * row + x0..][..nx];
                    tile[z][..nx].copy_from_slice(from);
                }
                for x in 0..nx {
                    let to = &mut out[LANES + (x0 + x) * to_plane + y * to_row + z0..][..nz];
                    for (to, from) in to.iter_mut().zip(&tile) {
                        *to = from[x];
                    }
                }
            }
        }
    }
}
