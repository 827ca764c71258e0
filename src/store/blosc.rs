//! Chunks in blosc's container. The library packs and unpacks; bits of one-byte voxels are shuffled here, several times as fast,
//! with the same bytes as result, and bytes of wider ones are joined on their way to where they belong.

use zarrs::array::codec::bytes_to_bytes::blosc::{
    BloscCompressionLevel, BloscCompressor, BloscShuffleMode, blosc_compress_bytes, blosc_decompress_bytes,
    blosc_validate,
};

use super::bits;
use crate::kernel::simd::Level;

/// Compression level, SPEC section 6.
pub const LEVEL: u8 = 5;

/// Bytes that the library packs together at that level where voxels have one byte.
const BLOCK: usize = 128 << 10;

/// Larger chunks are left to the library: budgets leave no room for one more copy of them.
const LARGEST: usize = 16 << 20;

/// Bytes of the container's header.
const HEADER: usize = 16;
/// Place of its flags.
const FLAGS: usize = 2;
/// Flag: bytes were shuffled.
const BYTES_SHUFFLED: u8 = 1;
/// Flag: what follows is a plain copy.
const COPIED: u8 = 2;
/// Flag: bits were shuffled.
const BITS_SHUFFLED: u8 = 4;

/// A number of the header.
fn number(bytes: &[u8], at: usize) -> Option<usize> {
    bytes.get(at..at + 4)?.first_chunk().map(|b| u32::from_le_bytes(*b) as usize)
}

/// Packs by LZ4 behind a shuffle, of bits for voxels of one byte. `shuffled` is room for them, as it was left.
///
/// # Errors
/// What the library says.
pub fn compress(raw: &[u8], voxel: usize, shuffled: &mut Vec<u8>) -> Result<Vec<u8>, String> {
    if voxel > 1 {
        return pack(raw, BloscShuffleMode::Shuffle, voxel);
    }
    if raw.len() > LARGEST {
        return pack(raw, BloscShuffleMode::BitShuffle, voxel);
    }
    if shuffled.len() < raw.len() {
        shuffled.resize(raw.len(), 0);
    }
    let shuffled = &mut shuffled[..raw.len()];
    let level = Level::detect();
    raw.chunks(BLOCK).zip(shuffled.chunks_mut(BLOCK)).for_each(|(from, to)| bits::shuffle(level, from, to));
    let mut bytes = pack(shuffled, BloscShuffleMode::NoShuffle, voxel)?;
    // What cannot be packed is stored as it was given, and another block would be another shuffle.
    if bytes[FLAGS] & (BYTES_SHUFFLED | COPIED | BITS_SHUFFLED) != 0 || number(&bytes, 8) != Some(BLOCK.min(raw.len()))
    {
        return pack(raw, BloscShuffleMode::BitShuffle, voxel);
    }
    bytes[FLAGS] |= BITS_SHUFFLED;
    Ok(bytes)
}

fn pack(raw: &[u8], shuffle: BloscShuffleMode, voxel: usize) -> Result<Vec<u8>, String> {
    let level = BloscCompressionLevel::try_from(LEVEL).map_err(|e| e.to_string())?;
    blosc_compress_bytes(raw, level, shuffle, voxel, BloscCompressor::LZ4, 0, 1).map_err(|e| e.to_string())
}

/// Unpacks voxels of so many bytes that were shuffled, by bits if they have one byte, else by bytes, into `dst`, and lets go of the
/// container before `dst` is written: three times a chunk is more than budgets leave beside them. False, and nothing done, for any
/// other container.
///
/// # Errors
/// Broken bytes, or bytes of another number of voxels.
pub fn decompress(bytes: &mut Vec<u8>, voxel: usize, dst: &mut [u8]) -> Result<bool, String> {
    let shuffled = if voxel == 1 { BITS_SHUFFLED } else { BYTES_SHUFFLED };
    if bytes.len() < HEADER
        || bytes[FLAGS] & (BYTES_SHUFFLED | COPIED | BITS_SHUFFLED) != shuffled
        || bytes[3] as usize != voxel
    {
        return Ok(false);
    }
    let declared = blosc_validate(bytes).ok_or("blosc encoded value is invalid")?;
    let block = number(bytes, 8).filter(|n| *n > 0).ok_or("blosc encoded value has blocks of 0 bytes")?;
    if declared != dst.len() {
        return Err(format!("it expands to {declared} bytes, the metadata say {}", dst.len()));
    }
    bytes[FLAGS] &= !shuffled;
    let unpacked = blosc_decompress_bytes(&std::mem::take(bytes), declared, 1).map_err(|e| e.to_string())?;
    if unpacked.len() != dst.len() {
        return Err(format!("it expands to {} bytes, the metadata say {}", unpacked.len(), dst.len()));
    }
    let level = Level::detect();
    for (from, to) in unpacked.chunks(block).zip(dst.chunks_mut(block)) {
        match voxel {
            1 => bits::unshuffle(level, from, to),
            _ => bits::join_bytes(level, voxel, from, to),
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of `bits` bits beside runs, as chunks have them.
    fn voxels(len: usize, bits: u32) -> Vec<u8> {
        let mut state = 88172645463325252u64;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 20) as u8
        };
        (0..len).map(|i| if i / 700 % 3 == 0 && bits < 8 { 9 } else { next() & ((1u16 << bits) - 1) as u8 }).collect()
    }

    #[test]
    fn bytes_are_those_of_the_library_and_come_back() {
        let mut room = Vec::new();
        for len in [1, 5, 127, 128, 1000, 4096, 65_536 - 8, 100_003, 131_072, 131_080, 262_144, 300_001, 1 << 20] {
            for bits in [0, 1, 4, 7, 8] {
                let raw = voxels(len, bits);
                let mut ours = compress(&raw, 1, &mut room).unwrap();
                let theirs = pack(&raw, BloscShuffleMode::BitShuffle, 1).unwrap();
                assert_eq!(ours, theirs, "{len} {bits}");
                let mut back = vec![1; len];
                let unpacked = decompress(&mut ours, 1, &mut back).unwrap();
                assert_eq!(unpacked, theirs[FLAGS] & COPIED == 0, "{len} {bits}");
                if unpacked {
                    assert_eq!(back, raw, "{len} {bits}");
                } else {
                    assert_eq!(ours, theirs, "left as it was");
                }
            }
        }
    }

    #[test]
    fn blocks_of_other_sizes_and_other_shuffles_are_known() {
        let raw = voxels(100_000, 3);
        for (level, block) in [(1, 0), (5, 4096), (5, 10_007), (9, 0)] {
            let level = BloscCompressionLevel::try_from(level).unwrap();
            let packed = |shuffle, voxel| {
                blosc_compress_bytes(&raw, level, shuffle, voxel, BloscCompressor::LZ4, block, 1).unwrap()
            };
            let mut back = vec![0; raw.len()];
            assert!(decompress(&mut packed(BloscShuffleMode::BitShuffle, 1), 1, &mut back).unwrap());
            assert_eq!(back, raw, "{block}");
            for (shuffle, voxel) in
                [(BloscShuffleMode::Shuffle, 1), (BloscShuffleMode::NoShuffle, 1), (BloscShuffleMode::BitShuffle, 2)]
            {
                assert!(!decompress(&mut packed(shuffle, voxel), 1, &mut back).unwrap());
            }
        }
    }

    #[test]
    fn bytes_of_wider_voxels_come_back() {
        for (voxel, len) in [(2, 1 << 19), (2, 100_002), (4, 262_148), (8, 80_000), (4, 1002), (2, 1)] {
            let raw = voxels(len, 4);
            for block in [0, 4096, 10_006] {
                let level = BloscCompressionLevel::try_from(5).unwrap();
                let lz4 = BloscCompressor::LZ4;
                let mut packed =
                    blosc_compress_bytes(&raw, level, BloscShuffleMode::Shuffle, voxel, lz4, block, 1).unwrap();
                let mut back = vec![0; len];
                let copied = packed[FLAGS] & COPIED != 0;
                assert_eq!(
                    decompress(&mut packed.clone(), voxel, &mut back).unwrap(),
                    !copied,
                    "{voxel} {len} {block}"
                );
                assert!(copied || back == raw, "{voxel} {len} {block}");
                assert!(!decompress(&mut packed.clone(), 2 * voxel, &mut back).unwrap());
                assert!(copied || decompress(&mut packed, voxel, &mut back[1..]).is_err());
            }
        }
    }

    #[test]
    fn broken_bytes_are_refused() {
        let raw = voxels(100_000, 3);
        let whole = compress(&raw, 1, &mut Vec::new()).unwrap();
        let mut back = vec![0; raw.len()];
        assert!(!decompress(&mut whole[..15].to_vec(), 1, &mut back).unwrap());
        assert!(decompress(&mut whole[..whole.len() - 1].to_vec(), 1, &mut back).is_err());
        assert!(decompress(&mut whole.clone(), 1, &mut back[1..]).is_err());
        for (at, value) in [(4, 1), (8, 0), (11, 255), (12, 0), (16, 255), (19, 255), (24, 255), (27, 127)] {
            let mut bytes = whole.clone();
            bytes[at] = value;
            if at == 8 {
                bytes[8..12].fill(0);
            }
            assert!(decompress(&mut bytes, 1, &mut back).is_err(), "byte {at}");
        }
    }
}
