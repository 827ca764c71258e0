//! One chunk of voxels to the bytes that are stored.

use std::borrow::Cow;
use std::sync::Mutex;

use zarrs::array::codec::ZstdCodec;
use zarrs::array::codec::bytes_to_bytes::blosc::{
    BloscCompressionLevel, BloscCompressor, BloscShuffleMode, blosc_compress_bytes,
};
use zarrs::array::{BytesToBytesCodecTraits, CodecOptions};

use super::Encoded;
use crate::config::Codec;
use crate::grid::{AnyView, DType, Shape, View, Voxel};
use crate::{Error, Result, with_dtype, with_view};

/// Compression level of blosc, SPEC section 6.
pub const BLOSC_LEVEL: u8 = 5;

/// Pads and compresses chunks. Buffers are kept for the next chunk.
#[derive(Debug)]
pub struct Encoder {
    codec: Codec,
    /// One voxel of the fill value, little-endian.
    fill: Vec<u8>,
    fill_is_nan: bool,
    buffers: Mutex<Vec<Vec<u8>>>,
    options: CodecOptions,
}

/// The fill value as one little-endian voxel.
pub fn fill_bytes(dtype: DType, fill: f64) -> Vec<u8> {
    fn bytes<T: Voxel>(v: T) -> Vec<u8> {
        let mut out = Vec::new();
        append_le(&[v], &mut out);
        out
    }
    with_dtype!(dtype, T => bytes(T::from_f64(fill)))
}

/// Appends voxels, little-endian.
pub fn append_le<T: Voxel>(row: &[T], out: &mut Vec<u8>) {
    // SAFETY: `Voxel` is implemented for primitive numbers only, which have no padding.
    let bytes = unsafe { std::slice::from_raw_parts(row.as_ptr().cast::<u8>(), size_of_val(row)) };
    out.extend_from_slice(bytes);
    if cfg!(target_endian = "big") {
        let start = out.len() - bytes.len();
        out[start..].chunks_exact_mut(size_of::<T>()).for_each(<[u8]>::reverse);
    }
}

impl Encoder {
    pub fn new(codec: Codec, dtype: DType, fill: f64) -> Encoder {
        Encoder {
            codec,
            fill: fill_bytes(dtype, fill),
            fill_is_nan: dtype.is_float() && fill.is_nan(),
            buffers: Mutex::default(),
            options: CodecOptions::default().with_concurrent_target(1),
        }
    }

    /// Pads to `chunk` with the fill value and compresses; [`Encoded::Empty`] if all voxels are the fill value.
    pub fn encode(&self, voxels: AnyView, chunk: Shape) -> Result<Encoded> {
        with_view!(AnyView, voxels, v => {
            if self.holds_only_fill(v) {
                return Ok(Encoded::Empty);
            }
            let mut raw = self.buffers.lock().unwrap_or_else(|e| e.into_inner()).pop().unwrap_or_default();
            raw.clear();
            self.pad(v, chunk, &mut raw);
            let encoded = self.compress(&raw, v.data);
            if self.codec == Codec::None {
                return Ok(Encoded::Bytes(raw));
            }
            self.buffers.lock().unwrap_or_else(|e| e.into_inner()).push(raw);
            encoded.map(Encoded::Bytes)
        })
    }

    fn holds_only_fill<T: Voxel>(&self, v: View<T>) -> bool {
        let fill = T::from_le_slice(&self.fill);
        let mut line = Vec::new();
        append_le(&vec![fill; v.shape[2]], &mut line);
        let mut bytes = Vec::with_capacity(line.len());
        let same = |row: &[T]| {
            if self.fill_is_nan {
                return row.iter().all(|v| v.to_f64().is_nan());
            }
            // By bits, so that -0 is not lost; the first voxel decides nearly always.
            bytes.clear();
            append_le(&row[..1], &mut bytes);
            if bytes != self.fill {
                return false;
            }
            bytes.clear();
            append_le(row, &mut bytes);
            bytes == line
        };
        let mut same = same;
        let [nz, ny, nx] = v.shape;
        nx == 0 || (0..nz).all(|z| (0..ny).all(|y| same(v.row_at(z, y))))
    }

    /// Voxels of a box of `chunk`, little-endian, the fill value where `v` does not reach.
    fn pad<T: Voxel>(&self, v: View<T>, chunk: Shape, out: &mut Vec<u8>) {
        let size = size_of::<T>();
        let [nz, ny, nx] = v.shape;
        let repeat = |out: &mut Vec<u8>, n: usize| (0..n).for_each(|_| out.extend_from_slice(&self.fill));
        out.reserve_exact(chunk.iter().product::<usize>() * size);
        if v.row == nx && v.plane == nx * ny && v.shape == chunk {
            return append_le(&v.data[..nz * ny * nx], out);
        }
        for z in 0..nz {
            for y in 0..ny {
                append_le(v.row_at(z, y), out);
                repeat(out, chunk[2] - nx);
            }
            repeat(out, (chunk[1] - ny) * chunk[2]);
        }
        repeat(out, (chunk[0] - nz) * chunk[1] * chunk[2]);
    }

    fn compress<T: Voxel>(&self, raw: &[u8], _: &[T]) -> Result<Vec<u8>> {
        let failed = |e: &dyn std::fmt::Display| Error::Failed(format!("a chunk cannot be compressed: {e}"));
        let mut bytes = match self.codec {
            Codec::None => Vec::new(),
            Codec::BloscLz4 => {
                let level = BloscCompressionLevel::try_from(BLOSC_LEVEL).map_err(|e| failed(&e))?;
                let shuffle =
                    if size_of::<T>() == 1 { BloscShuffleMode::BitShuffle } else { BloscShuffleMode::Shuffle };
                let lz4 = BloscCompressor::LZ4;
                blosc_compress_bytes(raw, level, shuffle, size_of::<T>(), lz4, 0, 1).map_err(|e| failed(&e))?
            }
            Codec::Zstd(level) => {
                let encoded = ZstdCodec::new(level, false).encode(Cow::Borrowed(raw), &self.options);
                encoded.map_err(|e| failed(&e))?.into_owned()
            }
        };
        // The codec reserved room for the worst case; queues count what is held.
        bytes.shrink_to_fit();
        Ok(bytes)
    }
}
