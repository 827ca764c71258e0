//! How the scratch of a sweep is cut up.

use super::driver::{Buffers, TOGETHER};
use super::keys::{Key, LANES};
#[cfg(target_arch = "x86_64")]
use super::wide;
use crate::brick::scratch::cut;

/// Elements of the parts of the scratch.
pub(super) struct Sizes {
    /// Padded copies: natural, and with x and z exchanged, or one in the place of both.
    pub keys: [usize; 2],
    /// Sums of a tile in both frames.
    pub sums: [usize; 2],
    /// Planes of a sheet.
    pub sheet: usize,
    /// Planes of a sheet that belong to the tile.
    pub queries: usize,
    /// Longest axis of the source.
    pub extent: usize,
}

impl Sizes {
    /// Bytes of scratch of the AVX-512 search.
    fn turned(&self, key: usize) -> usize {
        #[cfg(target_arch = "x86_64")]
        return wide::scratch_bytes(self.sheet, self.queries, key);
        #[cfg(not(target_arch = "x86_64"))]
        return 0 * key;
    }

    /// Bytes of all parts.
    pub fn bytes(&self, key: usize, colour: bool, normal: bool) -> usize {
        let line = |bytes: usize| bytes.next_multiple_of(64);
        line(self.keys[0] * key)
            + line(self.keys[1] * key)
            + line(self.sheet * LANES * key)
            + 2 * line(self.queries * LANES * 4)
            + line(self.sheet * 4)
            + line(self.sheet * size_of::<usize>())
            + line(self.turned(key))
            + (1 + TOGETHER) * line(self.extent * 4)
            + 2 * TOGETHER * line((self.extent + 1) * 4)
            + if normal { 0 } else { line(self.sums[0] * 4) + line(self.sums[1] * 4) }
            + (if normal { 2 } else { 0 } + if colour { 3 } else { 0 })
                * (line(self.sums[0] * 8) + line(self.sums[1] * 8))
    }

    /// Working memory of the driver, off the front of `bytes`.
    pub fn buffers<'a, K: Key>(&self, bytes: &'a mut [u8]) -> (Buffers<'a, K>, &'a mut [u8]) {
        let (sheet, bytes) = cut::<K>(bytes, self.sheet * LANES);
        let (hits, bytes) = cut_all::<u32, 2>(bytes, self.queries * LANES);
        let (stack, bytes) = cut::<u32>(bytes, self.sheet);
        let (starts, bytes) = cut::<usize>(bytes, self.sheet);
        let (turned, bytes) = cut::<u8>(bytes, self.turned(size_of::<K>()));
        let (shifts, bytes) = cut_all::<i32, { 1 + TOGETHER }>(bytes, self.extent);
        let (forward, bytes) = cut_all::<u32, TOGETHER>(bytes, self.extent + 1);
        let (backward, bytes) = cut_all::<u32, TOGETHER>(bytes, self.extent + 1);
        (Buffers { sheet, hits, stack, starts, turned, shifts, tables: [forward, backward] }, bytes)
    }
}

/// As [`cut`], several times.
pub(super) fn cut_all<T: bytemuck::Pod, const N: usize>(
    mut bytes: &mut [u8],
    len: usize,
) -> ([&mut [T]; N], &mut [u8]) {
    let parts = std::array::from_fn(|_| {
        let (part, rest) = cut(std::mem::take(&mut bytes), len);
        bytes = rest;
        part
    });
    (parts, bytes)
}
