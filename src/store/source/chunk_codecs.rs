//! Codecs of a Zarr chunk that are unpacked here, with a bound, and numcodecs' names for those that the library knows by others.

use std::ops::RangeInclusive;

use serde_json::{Value, json};

use super::spool::Packing;

/// What a message about a codec ends with.
pub const READ: &str = "; codecs that are read: blosc, zstd, gzip, zlib, lz4 and bz2 of numcodecs, crc32c of Zarr v3, adler32, fletcher32, \
     shuffle, transpose and shards of them";

/// An outer codec of a chunk that is unpacked here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChunkPacking {
    Stream(Packing),
    /// One block of LZ4 behind its unpacked size, 4 bytes little-endian, as numcodecs stores it.
    Lz4,
    /// Frames need not say how large they are, and the library that decodes the rest would believe them.
    Zstd,
    /// Four bytes behind the others.
    Crc32c,
}

impl ChunkPacking {
    /// By the name in the metadata, with or without numcodecs' prefix.
    pub fn named(name: &str) -> Option<ChunkPacking> {
        match name.strip_prefix("numcodecs.").unwrap_or(name) {
            "gzip" => Some(ChunkPacking::Stream(Packing::Gzip)),
            "zlib" => Some(ChunkPacking::Stream(Packing::Zlib)),
            "bz2" => Some(ChunkPacking::Stream(Packing::Bzip2)),
            "lz4" => Some(ChunkPacking::Lz4),
            "zstd" => Some(ChunkPacking::Zstd),
            _ => None,
        }
    }

    /// Unpacks a chunk that should expand to `want` bytes, and no more than a byte beyond that.
    ///
    /// # Errors
    /// Broken data, or data that expand to more; says so without the file's name.
    pub fn unpack(self, packed: &[u8], want: u64) -> Result<Vec<u8>, String> {
        match self {
            ChunkPacking::Stream(packing) => packing.unpack(packed, want),
            ChunkPacking::Lz4 => lz4(packed, want),
            ChunkPacking::Zstd => zstd(packed, want),
            ChunkPacking::Crc32c => checked(packed).map(<[u8]>::to_vec),
        }
    }
}

/// All that fits into `want` bytes, from one frame or more.
fn zstd(packed: &[u8], want: u64) -> Result<Vec<u8>, String> {
    let room = usize::try_from(want).map_err(|_| format!("{want} bytes are more than this machine can address"))?;
    zstd::bulk::decompress(packed, room).map_err(|e| match e.to_string() {
        text if text.contains("too small") => {
            format!("the zstd data expand to more than the {want} bytes that the metadata say")
        }
        text => format!("the zstd data are broken: {text}"),
    })
}

fn checked(packed: &[u8]) -> Result<&[u8], String> {
    let (body, sum) = packed.split_last_chunk().ok_or("the checksum is cut off")?;
    match crc32c::crc32c(body).to_le_bytes() == *sum {
        true => Ok(body),
        false => Err("its checksum (crc32c) is wrong".into()),
    }
}

fn lz4(packed: &[u8], want: u64) -> Result<Vec<u8>, String> {
    let (size, block) = packed.split_first_chunk().ok_or("the lz4 data are cut off")?;
    let size = u32::from_le_bytes(*size);
    if size as u64 > want {
        return Err(format!("the lz4 data expand to {size} bytes, more than the {want} bytes that the metadata say"));
    }
    lz4_flex::block::decompress(block, size as usize).map_err(|e| format!("the lz4 data are broken: {e}"))
}

/// Takes those codecs off the end of a list of v3 codecs that are unpacked here, the outermost first, and gives the others the
/// names of Zarr v3. A checksum is taken only with what it stands around.
pub fn take_outermost(codecs: &mut Value) -> Vec<ChunkPacking> {
    let mut taken = Vec::new();
    let Some(list) = codecs.as_array_mut() else { return taken };
    let named = |codec: Option<&Value>| codec.and_then(|c| ChunkPacking::named(codec_name(c)));
    while let Some(last) = list.last() {
        let inside = list.len().checked_sub(2).and_then(|i| named(list.get(i)));
        let packing = match codec_name(last) {
            "crc32c" => inside.map(|_| ChunkPacking::Crc32c),
            name => ChunkPacking::named(name),
        };
        let Some(packing) = packing else { break };
        taken.push(packing);
        list.pop();
    }
    list.iter_mut().for_each(rename);
    taken
}

/// Name of a v3 codec.
pub fn codec_name(codec: &Value) -> &str {
    codec.as_str().or_else(|| codec["name"].as_str()).unwrap_or("")
}

/// numcodecs' wrappers of codecs of Zarr v3 store the same bytes, whose headers say how they were packed: the settings of the
/// encoder, which the two write differently, do not matter to a reader.
fn rename(codec: &mut Value) {
    let settings = match codec_name(codec) {
        "numcodecs.zstd" => json!({ "level": 0, "checksum": false }),
        "numcodecs.blosc" => {
            json!({ "cname": "lz4", "clevel": 5, "shuffle": "noshuffle", "typesize": 1, "blocksize": 0 })
        }
        _ => return,
    };
    let name = codec_name(codec).trim_start_matches("numcodecs.").to_string();
    *codec = json!({ "name": name, "configuration": settings });
}

/// Bytes that the outermost packing of a chunk may hold: those of its voxels (`want`), or up to `most` where codecs inside it
/// make sizes of their own.
pub fn unpacked_bytes(codecs: &[String], want: u64, most: u64) -> RangeInclusive<u64> {
    let keep_size = ["bytes", "transpose", "crc32c", "shuffle", "numcodecs.shuffle"];
    let sizing = codecs.iter().filter(|c| !keep_size.contains(&c.as_str())).count();
    if sizing > 1 { 0..=most } else { want..=want }
}

/// Refuses packed chunks whose own header declares another size than may be, before they are unpacked. Only the outermost codec
/// can be asked, and only where it records a size.
pub fn check_declared(bytes: &[u8], may_be: &RangeInclusive<u64>, codecs: &[String]) -> Result<(), String> {
    let mut outer = codecs.iter().rev().map(|c| c.rsplit(['.', '/']).next().unwrap_or(""));
    let (mut codec, mut body) = (outer.next().unwrap_or(""), bytes);
    if codec == "crc32c" {
        codec = outer.next().unwrap_or("");
        body = body.get(..body.len().saturating_sub(4)).unwrap_or(&[]);
    }
    let declared = match codec {
        "blosc" => body.get(4..8).and_then(|b| b.first_chunk()).map(|b| u32::from_le_bytes(*b) as u64),
        "zstd" => zstd_size(body),
        _ => None,
    };
    match declared {
        Some(n) if !may_be.contains(&n) => {
            let least = if may_be.start() < may_be.end() { "at most " } else { "" };
            Err(format!("it says that it expands to {n} bytes, the metadata say {least}{}", may_be.end()))
        }
        _ => Ok(()),
    }
}

/// Content size in the header of a zstd frame, where it is recorded.
fn zstd_size(body: &[u8]) -> Option<u64> {
    if body.get(..4)? != [0x28, 0xB5, 0x2F, 0xFD] {
        return None;
    }
    let descriptor = *body.get(4)?;
    let single = descriptor & 0x20 != 0;
    let window = !single as usize;
    let dictionary = [0, 1, 2, 4][(descriptor & 3) as usize];
    let at = 5 + window + dictionary;
    let number = |n: usize| -> Option<u64> {
        let mut raw = [0; 8];
        raw[..n].copy_from_slice(body.get(at..at + n)?);
        Some(u64::from_le_bytes(raw))
    };
    match descriptor >> 6 {
        0 if single => number(1),
        0 => None,
        1 => Some(number(2)? + 256),
        2 => number(4),
        _ => number(8),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lz4_is_bounded_by_what_the_metadata_say() {
        let packed = lz4_flex::block::compress_prepend_size(&[7; 1000]);
        assert_eq!(ChunkPacking::Lz4.unpack(&packed, 1000).unwrap(), [7; 1000]);
        assert!(ChunkPacking::Lz4.unpack(&packed, 999).unwrap_err().contains("more than the 999"));
        assert!(ChunkPacking::Lz4.unpack(&packed[..packed.len() - 1], 1000).unwrap_err().contains("broken"));
        assert!(ChunkPacking::Lz4.unpack(&packed[..3], 1000).unwrap_err().contains("cut off"));
        // A block that makes more than its size says.
        let mut lying = packed.clone();
        lying[..4].copy_from_slice(&10u32.to_le_bytes());
        assert!(ChunkPacking::Lz4.unpack(&lying, 1000).is_err());
    }

    #[test]
    fn only_the_outermost_codec_is_taken() {
        let mut codecs = json!([{ "name": "bytes" }, { "name": "numcodecs.blosc", "configuration": { "shuffle": 1 } }]);
        assert_eq!(take_outermost(&mut codecs), []);
        assert_eq!(codec_name(&codecs[1]), "blosc");
        let mut codecs = json!([{ "name": "bytes" }, { "name": "gzip" }, { "name": "numcodecs.bz2" }]);
        assert_eq!(take_outermost(&mut codecs), [Packing::Bzip2, Packing::Gzip].map(ChunkPacking::Stream));
        assert_eq!(codecs.as_array().unwrap().len(), 1);
        let mut codecs = json!([{ "name": "bytes" }, { "name": "zstd" }, { "name": "crc32c" }]);
        assert_eq!(take_outermost(&mut codecs), [ChunkPacking::Crc32c, ChunkPacking::Zstd]);
        let mut codecs = json!([{ "name": "bytes" }, { "name": "blosc" }, { "name": "crc32c" }]);
        assert_eq!(take_outermost(&mut codecs), []);
    }

    #[test]
    fn zstd_that_hides_its_size_is_bounded() {
        // Blocks of one byte each, run 128 KiB long, in a frame that does not say how many there are.
        let block = |last: u32| [&((131072u32 << 3) | (1 << 1) | last).to_le_bytes()[..3], &[7]].concat();
        let frame = |n: usize| [vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, 0x38], block(0).repeat(n - 1), block(1)].concat();
        assert_eq!(ChunkPacking::Zstd.unpack(&frame(3), 3 << 17).unwrap(), vec![7; 3 << 17]);
        assert!(ChunkPacking::Zstd.unpack(&frame(24_000), 4096).unwrap_err().contains("more than the 4096"));
        assert!(ChunkPacking::Zstd.unpack(&frame(3)[..9], 3 << 17).unwrap_err().contains("broken"));
        let sum = crc32c::crc32c(b"abc").to_le_bytes();
        assert_eq!(ChunkPacking::Crc32c.unpack(&[b"abc", &sum[..]].concat(), 3).unwrap(), b"abc");
        assert!(ChunkPacking::Crc32c.unpack(&[b"abd", &sum[..]].concat(), 3).is_err());
        assert!(ChunkPacking::Crc32c.unpack(b"ab", 3).is_err());
    }

    #[test]
    fn a_declared_size_that_differs_is_refused_before_unpacking() {
        let blosc: &[String] = &["bytes".into(), "blosc".into()];
        let mut header = vec![2, 1, 1, 1];
        header.extend(64u32.to_le_bytes());
        assert!(check_declared(&header, &(64..=64), blosc).is_ok());
        assert!(check_declared(&header, &(65..=65), blosc).unwrap_err().contains("64 bytes"));
        // A zstd frame of one segment with a 4-byte content size of 3 GiB.
        let mut zstd = vec![0x28, 0xB5, 0x2F, 0xFD, 0xA0];
        zstd.extend((3u32 << 30).to_le_bytes());
        zstd.extend([0; 4]); // where the checksum would be
        assert!(check_declared(&zstd, &(4096..=4096), &["bytes".into(), "zstd".into(), "crc32c".into()]).is_err());
    }
}
