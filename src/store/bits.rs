//! Bits of bytes apart and together again: the bit shuffle of blosc for voxels of one byte, as every x86-64 level runs it. And bytes
//! of wider voxels together again.
//!
//! Byte `g` of plane `b` holds bit `b` of the voxels `8 g` to `8 g + 7`, the first in its lowest bit. The library that stores chunks
//! does one-byte voxels without vectors on the way back and with SSE2 on the way there: 2-core Zen 4 VM, AVX-512, 2026-11-27, a
//! fifth of the CPU time of a pyramid of a 1 GiB u8 Zarr.

use crate::kernel::simd::Level;
use crate::multiversion;

/// Voxels that go through registers together: eight words of eight voxels, eight times.
const STEP: usize = 512;

/// Eight words, eight times over: vectors of eight lanes. Loops over them are written out: what `array::map` calls is not compiled for
/// the level of its caller.
type Words = [[u64; 8]; 8];

/// The voxels of `src` by bit planes of `src.len() / 8` bytes. Lengths that eight does not divide are copied, as blosc does.
///
/// # Panics
/// If the lengths differ.
#[inline(always)]
fn apart(src: &[u8], dst: &mut [u8]) {
    assert_eq!(src.len(), dst.len());
    let plane = src.len() / 8;
    if !src.len().is_multiple_of(8) {
        return dst.copy_from_slice(src);
    }
    let (steps, rest) = src.as_chunks::<STEP>();
    for (i, step) in steps.iter().enumerate() {
        let (voxels, _) = step.as_chunks::<8>();
        let mut words: Words = [[0; 8]; 8];
        for (l, row) in words.iter_mut().enumerate() {
            for (j, word) in row.iter_mut().enumerate() {
                *word = transpose_bits(u64::from_le_bytes(voxels[8 * j + l]));
            }
        }
        transpose_bytes(&mut words);
        for (b, row) in words.iter().enumerate() {
            let at = b * plane + 64 * i;
            let (out, _) = dst[at..at + 64].as_chunks_mut::<8>();
            out.iter_mut().zip(row).for_each(|(out, word)| *out = word.to_le_bytes());
        }
    }
    for (g, voxels) in rest.as_chunks::<8>().0.iter().enumerate() {
        let bytes = transpose_bits(u64::from_le_bytes(*voxels)).to_le_bytes();
        bytes.iter().enumerate().for_each(|(b, byte)| dst[b * plane + 64 * steps.len() + g] = *byte);
    }
}

/// Undoes [`apart`].
///
/// # Panics
/// If the lengths differ.
#[inline(always)]
fn together(src: &[u8], dst: &mut [u8]) {
    assert_eq!(src.len(), dst.len());
    let plane = src.len() / 8;
    if !src.len().is_multiple_of(8) {
        return dst.copy_from_slice(src);
    }
    let (steps, rest) = dst.as_chunks_mut::<STEP>();
    let done = 64 * steps.len();
    for (i, step) in steps.iter_mut().enumerate() {
        let mut words: Words = [[0; 8]; 8];
        for (b, row) in words.iter_mut().enumerate() {
            let at = b * plane + 64 * i;
            let (bytes, _) = src[at..at + 64].as_chunks::<8>();
            row.iter_mut().zip(bytes).for_each(|(word, bytes)| *word = u64::from_le_bytes(*bytes));
        }
        transpose_bytes(&mut words);
        words.as_flattened_mut().iter_mut().for_each(|word| *word = transpose_bits(*word));
        let (voxels, _) = step.as_chunks_mut::<8>();
        for (l, row) in words.iter().enumerate() {
            (0..8).for_each(|j| voxels[8 * j + l] = row[j].to_le_bytes());
        }
    }
    for (g, voxels) in rest.as_chunks_mut::<8>().0.iter_mut().enumerate() {
        let bytes = std::array::from_fn(|b| src[b * plane + done + g]);
        *voxels = transpose_bits(u64::from_le_bytes(bytes)).to_le_bytes();
    }
}

/// Swaps bit `k` of byte `i` with bit `i` of byte `k` (Hacker's Delight, section 7-3).
#[inline(always)]
fn transpose_bits(x: u64) -> u64 {
    let swap = |x: u64, by: u32, mask: u64| {
        let t = (x ^ (x >> by)) & mask;
        x ^ t ^ (t << by)
    };
    let x = swap(x, 7, 0x00AA_00AA_00AA_00AA);
    let x = swap(x, 14, 0x0000_CCCC_0000_CCCC);
    swap(x, 28, 0x0000_0000_F0F0_F0F0)
}

/// Swaps byte `k` of row `i` with byte `i` of row `k`, lane by lane.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // two rows at a time
fn transpose_bytes(rows: &mut Words) {
    for (apart, by, mask) in [(4, 32, 0xFFFF_FFFF), (2, 16, 0x0000_FFFF_0000_FFFF), (1, 8, 0x00FF_00FF_00FF_00FF)] {
        for i in (0..8).filter(|i| i & apart == 0) {
            for lane in 0..8 {
                let (a, b) = (rows[i][lane], rows[i + apart][lane]);
                let t = ((a >> by) ^ b) & mask;
                rows[i][lane] = a ^ (t << by);
                rows[i + apart][lane] = b ^ t;
            }
        }
    }
}

/// Planes of bytes to words of `N` bytes, plane 0 the lowest.
///
/// # Panics
/// If there are not as many bytes as the words hold.
#[inline(always)]
fn words_inner<const N: usize>(planes: &[u8], words: &mut [[u8; N]]) {
    let n = words.len();
    assert_eq!(planes.len(), n * N);
    let planes: [&[u8]; N] = std::array::from_fn(|b| &planes[b * n..(b + 1) * n]);
    for (i, word) in words.iter_mut().enumerate() {
        // A sum of shifted bytes is what becomes vectors.
        let sum = (0..N).fold(0u64, |sum, b| sum | (planes[b][i] as u64) << (8 * b));
        word.copy_from_slice(&sum.to_le_bytes()[..N]);
    }
}

multiversion! {
    fn words[const N: usize](planes: &[u8], words: &mut [[u8; N]]) -> () = words_inner;
}

/// Undoes blosc's shuffle of voxels of 2, 4 or 8 bytes; others are copied, and so is what is beyond the last whole voxel.
///
/// # Panics
/// If the lengths differ.
pub fn join_bytes(level: Level, voxel: usize, src: &[u8], dst: &mut [u8]) {
    assert_eq!(src.len(), dst.len());
    let whole = if matches!(voxel, 2 | 4 | 8) { src.len() / voxel * voxel } else { 0 };
    let ((planes, rest), (voxels, tail)) = (src.split_at(whole), dst.split_at_mut(whole));
    tail.copy_from_slice(rest);
    match voxel {
        2 => words(level, planes, voxels.as_chunks_mut::<2>().0),
        4 => words(level, planes, voxels.as_chunks_mut::<4>().0),
        8 => words(level, planes, voxels.as_chunks_mut::<8>().0),
        _ => {}
    }
}

multiversion! {
    /// See [`apart`].
    pub fn shuffle[](src: &[u8], dst: &mut [u8]) -> () = apart;
}

multiversion! {
    /// See [`together`].
    pub fn unshuffle[](src: &[u8], dst: &mut [u8]) -> () = together;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bit by bit.
    fn reference(src: &[u8]) -> Vec<u8> {
        let plane = src.len() / 8;
        if !src.len().is_multiple_of(8) {
            return src.to_vec();
        }
        let mut out = vec![0; src.len()];
        for (v, byte) in src.iter().enumerate() {
            (0..8).for_each(|b| out[b * plane + v / 8] |= (byte >> b & 1) << (v % 8));
        }
        out
    }

    #[test]
    fn planes_are_those_of_the_definition_and_come_back() {
        let mut state = 7u64;
        let mut byte = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as u8
        };
        for len in [0, 1, 7, 8, 9, 64, 504, 512, 520, 1023, 1024, 4096 + 8, 5000] {
            let src: Vec<u8> = (0..len).map(|_| byte()).collect();
            for level in Level::available() {
                let (mut there, mut back) = (vec![1; len], vec![2; len]);
                shuffle(level, &src, &mut there);
                assert_eq!(there, reference(&src), "{len} {level:?}");
                unshuffle(level, &there, &mut back);
                assert_eq!(back, src, "{len} {level:?}");
            }
        }
    }

    #[test]
    fn bytes_of_a_voxel_come_together() {
        for (voxel, len) in [(2, 0), (2, 1), (2, 256), (2, 515), (4, 64), (4, 1027), (8, 512), (8, 1999), (3, 30)] {
            let src: Vec<u8> = (0..len).map(|i| (i * 37 % 251) as u8).collect();
            let plane = src.len() / voxel;
            let want: Vec<u8> = (0..src.len())
                .map(|i| if i < plane * voxel && voxel != 3 { src[i % voxel * plane + i / voxel] } else { src[i] })
                .collect();
            for level in Level::available() {
                let mut back = vec![1; src.len()];
                join_bytes(level, voxel, &src, &mut back);
                assert_eq!(back, want, "{voxel} {len} {level:?}");
            }
        }
    }
}
