//! Voxels as unsigned keys in the order of their density, in a padded copy that every line can read without a test.

use super::ObscuranceParams;
use super::ranks::Ranks;
use crate::grid::{AnyViewMut, Region, Shape, View, ViewMut, Voxel};
use crate::multiversion;

/// Lines that are swept together, and zeros around every row of a [`Volume`].
pub(super) const LANES: usize = 64;

/// An unsigned integer that orders voxels by density. 0 is what nobody can be less than: missing voxels and everything
/// outside get it, so that lines pass through them.
pub(super) trait Key: bytemuck::Pod + Ord + Default + Send + Sync {
    const ZERO: Self;
    const MAX: Self;
    fn not(self) -> Self;
    fn of_rank(rank: u16) -> Self;
    fn index(self) -> usize;
}

macro_rules! key {
    ($($t:ty),*) => {$(
        impl Key for $t {
            const ZERO: Self = 0;
            const MAX: Self = <$t>::MAX;
            #[inline(always)]
            fn not(self) -> Self { !self }
            #[inline(always)]
            fn of_rank(rank: u16) -> Self { rank as $t }
            #[inline(always)]
            fn index(self) -> usize { self as usize }
        }
    )*};
}
key!(u8, u16, u32, u64);

/// Element types with an order-preserving map to a [`Key`].
pub(super) trait Coded: Voxel {
    type Key: Key;
    /// Strictly increasing; equal only for equal values (-0.0 equals 0.0). NaN must be asked for before.
    fn code(self) -> Self::Key;
    /// A view without its type.
    fn any(view: ViewMut<Self>) -> AnyViewMut;
}

macro_rules! coded {
    ($($t:ty: $d:ident => $k:ty, $v:ident => $code:expr;)*) => {$(
        impl Coded for $t {
            type Key = $k;
            #[inline(always)]
            fn code(self) -> $k { let $v = self; $code }
            fn any(view: ViewMut<$t>) -> AnyViewMut { AnyViewMut::$d(view) }
        }
    )*};
}
coded! {
    u8: U8 => u8, v => v;
    i8: I8 => u8, v => v as u8 ^ 0x80;
    u16: U16 => u16, v => v;
    i16: I16 => u16, v => v as u16 ^ 0x8000;
    u32: U32 => u32, v => v;
    i32: I32 => u32, v => v as u32 ^ 0x8000_0000;
    f32: F32 => u32, v => {
        let bits = (v + 0.0).to_bits();
        bits ^ ((bits as i32 >> 31) as u32 | 0x8000_0000)
    };
    f64: F64 => u64, v => {
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
    /// Elements from one index to the next along the first two axes.
    strides: [usize; 2],
    /// Global indices, in frame order.
    pub region: Region,
    /// Set where rows are counted by the line that meets them, from this one on; see [`super::column`].
    pub sheared: Option<i64>,
}

impl<'a, K: Key> Volume<'a, K> {
    pub fn new(data: &'a [K], region: Region) -> Self {
        let (row, plane) = strides(region.shape());
        assert!(data.len() >= padded_len(region.shape()), "padded copy is too short");
        Volume { data, strides: [plane, row], region, sheared: None }
    }

    /// Rows counted by their lines from `first` on. `region` is what has voxels; [`LANES`] zeros stand at 0 and around
    /// every row.
    pub fn sheared(data: &'a [K], strides: [usize; 2], region: Region, first: i64) -> Self {
        Volume { data, strides, region, sheared: Some(first) }
    }

    /// All keys; the first [`LANES`] are zeros, and so are those around every row.
    pub fn data(&self) -> &'a [K] {
        self.data
    }

    /// Place in [`Self::data`] of the [`LANES`] keys at `[i, j, k..]` counted from the corner of the box; `i` and `j`
    /// inside it, `-LANES <= k <= n`.
    #[inline(always)]
    pub fn start(&self, i: usize, j: usize, k: i64) -> usize {
        ((i * self.strides[0] + j * self.strides[1] + LANES) as i64 + k) as usize
    }
}

/// The map from voxels of a volume to keys.
#[derive(Clone, Copy)]
pub(super) struct Code<'a, T> {
    pub missing: Option<T>,
    pub flipped: bool,
    /// What is compared in the place of the codes, if anything.
    pub ranks: Option<&'a Ranks>,
}

impl<'a, T: Coded> Code<'a, T> {
    pub fn new(params: &'a ObscuranceParams) -> Self {
        let ranks = params.ranks.as_ref();
        assert!(ranks.is_none_or(|r| r.of::<T>()), "ranks of another type than {}", T::DTYPE);
        Code { missing: missing_of(params.missing), flipped: params.flipped, ranks }
    }

    #[inline(always)]
    pub fn is_missing(&self, v: T) -> bool {
        is_missing(v, self.missing)
    }

    /// The key of a voxel whose code ranks so.
    #[inline(always)]
    pub fn key(&self, v: T, rank: impl Fn(T::Key) -> T::Key) -> T::Key {
        match (self.is_missing(v), self.flipped) {
            (true, _) => T::Key::ZERO,
            (false, true) => rank(v.code()).not(),
            (false, false) => rank(v.code()),
        }
    }
}

/// Evaluates `$body` with `$key` as the map from a voxel to its key: one loop for codes and one for ranks, so that neither
/// asks which it is voxel by voxel.
macro_rules! with_key {
    ($code:expr, $key:ident => $body:expr) => {
        match $code.ranks {
            None => {
                let $key = |v| $code.key(v, |code| code);
                $body
            }
            Some(ranks) => {
                let $key = |v| $code.key(v, |code| ranks.of_code(code));
                $body
            }
        }
    };
}
pub(super) use with_key;

/// The least and the greatest key of a row's voxels that are not missing; the greatest and the least possible ones if
/// there are none.
#[inline(always)]
pub(super) fn ends<T: Coded>(row: &[T], code: &Code<T>, key: impl Fn(T) -> T::Key) -> (T::Key, T::Key) {
    row.iter().fold((T::Key::MAX, T::Key::ZERO), |(lo, hi), &v| {
        let k = key(v);
        (lo.min(if code.is_missing(v) { T::Key::MAX } else { k }), hi.max(k))
    })
}

#[inline(always)]
fn least_of<T: Coded>(of: View<T>, code: Code<T>) -> T::Key {
    let rows = (0..of.shape[0]).flat_map(|z| (0..of.shape[1]).map(move |y| of.row_at(z, y)));
    with_key!(code, key => rows.fold(T::Key::MAX, |least, row| least.min(ends(row, &code, key).0)))
}

multiversion! {
    /// Fills a padded copy in natural order and returns the greatest key.
    pub(super) fn encode['a, 'r, T: Coded](src: View<'a, T>, code: Code<'r, T>, out: &mut [T::Key]) -> T::Key = natural;
}
multiversion! {
    /// Fills a padded copy in `[x, y, z]` order.
    pub(super) fn encode_turned['a, 'r, T: Coded](src: View<'a, T>, code: Code<'r, T>, out: &mut [T::Key]) -> () = turned;
}
multiversion! {
    /// Least key of the voxels of a box that are not missing, the greatest possible one if there are none.
    pub(super) fn least['a, 'r, T: Coded](of: View<'a, T>, code: Code<'r, T>) -> T::Key = least_of;
}

/// Writes the keys of a row, and returns the greatest of them and `most`.
#[inline(always)]
pub(super) fn put_row<T: Coded>(row: &[T], key: impl Fn(T) -> T::Key, out: &mut [T::Key], mut most: T::Key) -> T::Key {
    for (to, &v) in out.iter_mut().zip(row) {
        *to = key(v);
        most = most.max(*to);
    }
    most
}

#[inline(always)]
fn natural<T: Coded>(src: View<T>, code: Code<T>, out: &mut [T::Key]) -> T::Key {
    let (row, plane) = strides(src.shape);
    let mut most = T::Key::ZERO;
    let [nz, ny, nx] = src.shape;
    // Each row with the zeros before it, so that the copy is written once.
    let mut written = 0;
    for z in 0..nz {
        for y in 0..ny {
            let start = LANES + z * plane + y * row;
            out[written..start].fill(T::Key::ZERO);
            let to = &mut out[start..][..nx];
            most = with_key!(code, key => put_row(src.row_at(z, y), key, to, most));
            written = start + nx;
        }
    }
    out[written..].fill(T::Key::ZERO);
    most
}

/// A tile's part of a row along z, in the order `[x, z]`: what [`turn_rows`] hands on.
pub(super) type Turned<K> = [[K; TURN]; 16];
/// Voxels along z that are turned together.
pub(super) const TURN: usize = 64;

/// Keys with x and z exchanged: calls `put` with `[z0, y, x0]`, the number of voxels along z and x, and up to 16 rows along
/// z, for pieces that cover the source.
#[inline(always)]
pub(super) fn turn_rows<T: Coded>(
    src: View<T>,
    code: Code<T>,
    mut put: impl FnMut([usize; 3], [usize; 2], &Turned<T::Key>),
) {
    let [nz, ny, nx] = src.shape;
    for y in 0..ny {
        for z0 in (0..nz).step_by(TURN) {
            let tz = TURN.min(nz - z0);
            for x0 in (0..nx).step_by(16) {
                let tx = 16.min(nx - x0);
                let mut tile = [[T::Key::ZERO; TURN]; 16];
                for z in 0..tz {
                    let row = &src.row_at(z0 + z, y)[x0..][..tx];
                    with_key!(code, key => tile.iter_mut().zip(row).for_each(|(to, &v)| to[z] = key(v)));
                }
                put([z0, y, x0], [tz, tx], &tile);
            }
        }
    }
}

#[inline(always)]
fn turned<T: Coded>(src: View<T>, code: Code<T>, out: &mut [T::Key]) {
    let [nz, ny, nx] = src.shape;
    let (row, plane) = strides([nx, ny, nz]);
    out.fill(T::Key::ZERO);
    turn_rows(src, code, |[z0, y, x0], [tz, tx], tile| {
        for (x, from) in tile[..tx].iter().enumerate() {
            out[LANES + (x0 + x) * plane + y * row + z0..][..tz].copy_from_slice(&from[..tz]);
        }
    });
}
