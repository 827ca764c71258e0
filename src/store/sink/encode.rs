//! One chunk of voxels to the bytes that are stored.

use std::borrow::Cow;
use std::sync::Mutex;

use zarrs::array::codec::ZstdCodec;
use zarrs::array::{BytesToBytesCodecTraits, CodecOptions};

use super::Encoded;
use crate::brick::Voxels;
use crate::config::Codec;
use crate::grid::{AnyView, DType, Shape, View, Voxel};
use crate::store::blosc;
use crate::{Error, Result, with_dtype, with_view};

/// Pads and compresses chunks. Buffers are kept for the next chunk.
#[derive(Debug)]
pub struct Encoder {
    codec: Codec,
    /// One voxel of the fill value, little-endian.
    fill: Vec<u8>,
    fill_is_nan: bool,
    buffers: Mutex<Vec<Vec<u8>>>,
    /// The voxel that filled a whole chunk last, and that chunk encoded.
    uniform: Mutex<Option<(Vec<u8>, Vec<u8>)>>,
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

/// The bytes of a dense box of this shape, where they are stored as this machine has them.
fn whole<T: Voxel>(v: View<'_, T>, chunk: Shape) -> Option<&[u8]> {
    let [nz, ny, nx] = v.shape;
    let dense = v.row == nx && v.plane == nx * ny && v.shape == chunk && cfg!(target_endian = "little");
    dense.then(|| bytemuck::cast_slice(&v.data[..nz * ny * nx]))
}

/// Appends voxels, little-endian.
fn append_le<T: Voxel>(row: &[T], out: &mut Vec<u8>) {
    let start = out.len();
    out.extend_from_slice(bytemuck::cast_slice(row));
    if cfg!(target_endian = "big") {
        out[start..].chunks_exact_mut(size_of::<T>()).for_each(<[u8]>::reverse);
    }
}

/// Appends `n` copies of a voxel. Volumes of one plane in chunks of 64 are mostly that: one by one they took five times as long
/// as all else.
fn append_repeated(voxel: &[u8], n: usize, out: &mut Vec<u8>) {
    let (start, len) = (out.len(), n * voxel.len());
    if voxel.iter().all(|b| *b == voxel[0]) {
        return out.resize(start + len, voxel[0]);
    }
    out.extend_from_slice(&voxel[..voxel.len().min(len)]);
    while out.len() < start + len {
        let there = out.len() - start;
        out.extend_from_within(start..start + there.min(len - there));
    }
}

/// The voxels with one NaN for all, if there is any: its sign and payload hang on the instructions that made it, and a box of
/// nothing else is stored as the fill value.
fn one_nan<T: Voxel>(v: View<T>) -> Option<Vec<T>> {
    #[allow(clippy::eq_op)] // only NaN differs from itself
    let is_nan = |v: &T| v != v;
    let rows = || (0..v.shape[0] * v.shape[1]).map(|r| v.row_at(r / v.shape[1], r % v.shape[1]));
    let any = T::DTYPE.is_float() && rows().any(|row| row.iter().fold(false, |any, v| any | is_nan(v)));
    let nan = T::from_f64(f64::NAN);
    any.then(|| rows().flatten().map(|v| if is_nan(v) { nan } else { *v }).collect())
}

impl Encoder {
    pub fn new(codec: Codec, dtype: DType, fill: f64) -> Encoder {
        Encoder {
            codec,
            fill: fill_bytes(dtype, fill),
            fill_is_nan: dtype.is_float() && fill.is_nan(),
            buffers: Mutex::default(),
            uniform: Mutex::default(),
            options: CodecOptions::default().with_concurrent_target(1),
        }
    }

    /// Pads to `chunk` with the fill value and compresses; [`Encoded::Empty`] if all voxels are the fill value.
    pub fn encode(&self, voxels: AnyView, chunk: Shape) -> Result<Encoded> {
        with_view!(AnyView, voxels, v => {
            if self.holds_only_fill(v) {
                return Ok(Encoded::Empty);
            }
            let one_nan = one_nan(v);
            let v = one_nan.as_ref().map_or(v, |voxels| View::dense(voxels, v.shape));
            let size = voxels.dtype().size();
            if self.codec != Codec::None
                && let Some(bytes) = whole(v, chunk)
            {
                return self.compress(bytes, size).map(Encoded::Bytes);
            }
            let mut raw = self.buffer();
            raw.clear();
            self.pad(v, chunk, &mut raw);
            if self.codec == Codec::None {
                return Ok(Encoded::Bytes(raw));
            }
            let encoded = self.compress(&raw, size);
            self.reuse(raw);
            encoded.map(Encoded::Bytes)
        })
    }

    /// As [`Encoder::encode`], of a whole chunk of one voxel.
    pub fn encode_uniform(&self, voxel: &Voxels, chunk: Shape) -> Result<Encoded> {
        let nan = voxel.at(0).is_nan();
        let bytes = fill_bytes(voxel.dtype(), voxel.at(0));
        if self.fill_is_nan && nan || bytes == self.fill {
            return Ok(Encoded::Empty);
        }
        let mut kept = self.uniform.lock().unwrap_or_else(|e| e.into_inner());
        if let Some((_, encoded)) = kept.as_ref().filter(|(of, _)| *of == bytes) {
            return Ok(Encoded::Bytes(encoded.clone()));
        }
        let mut raw = self.buffer();
        raw.clear();
        append_repeated(&bytes, chunk.iter().product(), &mut raw);
        if self.codec == Codec::None {
            return Ok(Encoded::Bytes(raw));
        }
        let encoded = self.compress(&raw, voxel.dtype().size());
        self.reuse(raw);
        encoded.map(|encoded| {
            *kept = Some((bytes, encoded.clone()));
            Encoded::Bytes(encoded)
        })
    }

    /// A buffer with whatever it held.
    fn buffer(&self) -> Vec<u8> {
        self.buffers.lock().unwrap_or_else(|e| e.into_inner()).pop().unwrap_or_default()
    }

    /// Takes back bytes that were written, for the next chunk.
    pub fn reuse(&self, bytes: Vec<u8>) {
        self.buffers.lock().unwrap_or_else(|e| e.into_inner()).push(bytes);
    }

    /// By bits, so that -0 is not lost; any NaN equals any other. The first voxel decides nearly always.
    fn holds_only_fill<T: Voxel>(&self, v: View<T>) -> bool {
        let [nz, ny, nx] = v.shape;
        let line = vec![T::from_le_slice(&self.fill); nx];
        let line: &[u8] = bytemuck::cast_slice(&line);
        let same = |row: &[T]| match self.fill_is_nan {
            true => row.iter().all(|v| v.to_f64().is_nan()),
            false => {
                bytemuck::bytes_of(&row[0]) == &line[..size_of::<T>()] && bytemuck::cast_slice::<_, u8>(row) == line
            }
        };
        nx == 0 || (0..nz).all(|z| (0..ny).all(|y| same(v.row_at(z, y))))
    }

    /// Voxels of a box of `chunk`, little-endian, the fill value where `v` does not reach.
    fn pad<T: Voxel>(&self, v: View<T>, chunk: Shape, out: &mut Vec<u8>) {
        let size = size_of::<T>();
        let [nz, ny, nx] = v.shape;
        let repeat = |out: &mut Vec<u8>, n: usize| append_repeated(&self.fill, n, out);
        out.reserve_exact(chunk.iter().product::<usize>() * size);
        if let Some(bytes) = whole(v, chunk) {
            return out.extend_from_slice(bytes);
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

    fn compress(&self, raw: &[u8], voxel: usize) -> Result<Vec<u8>> {
        let failed = |e: &dyn std::fmt::Display| Error::Failed(format!("a chunk cannot be compressed: {e}"));
        let mut bytes = match self.codec {
            Codec::None => Vec::new(),
            Codec::BloscLz4 => {
                let mut room = self.buffer();
                let bytes = blosc::compress(raw, voxel, &mut room);
                self.reuse(room);
                bytes.map_err(|e| failed(&e))?
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

#[cfg(test)]
mod tests {
    use super::*;

    fn encode<'a, T: Voxel>(fill: f64, data: &'a [T], view: fn(View<'a, T>) -> AnyView<'a>) -> Encoded {
        let encoder = Encoder::new(Codec::None, T::DTYPE, fill);
        encoder.encode(view(View::dense(data, [1, 1, data.len()])), [1, 1, 4]).unwrap()
    }

    #[test]
    fn only_chunks_of_the_fill_value_are_empty() {
        assert_eq!(encode(1.0, &[1u8, 1, 1], AnyView::U8), Encoded::Empty);
        assert_eq!(encode(1.0, &[1u8, 1, 2], AnyView::U8), Encoded::Bytes(vec![1, 1, 2, 1]));
        let negative_nan = f32::from_bits(f32::NAN.to_bits() | 1 << 31 | 5);
        assert_eq!(encode(f64::NAN, &[f32::NAN, negative_nan], AnyView::F32), Encoded::Empty);
        assert_ne!(encode(f64::NAN, &[f32::NAN, 0.0], AnyView::F32), Encoded::Empty);
        assert_ne!(encode(0.0, &[0.0f64, -0.0], AnyView::F64), Encoded::Empty, "-0 is not 0");
    }

    #[test]
    fn a_chunk_of_one_voxel_is_what_its_voxels_give() {
        let chunk = [3, 4, 5];
        for codec in [Codec::None, Codec::BloscLz4, Codec::Zstd(1)] {
            for dtype in [DType::U8, DType::U16, DType::F32, DType::F64] {
                for fill in [0.0, 3.0, f64::NAN].into_iter().filter(|f| dtype.is_float() || !f.is_nan()) {
                    let encoder = Encoder::new(codec, dtype, fill);
                    for value in [0.0, 3.0, 7.0, 7.0, -0.0, f64::NAN, 7.0] {
                        let voxel = Voxels::one(dtype, value);
                        let mut all = Voxels::zeroed(dtype, 60);
                        all.fill(voxel.at(0));
                        let expected = encoder.encode(all.view(chunk), chunk).unwrap();
                        assert_eq!(
                            encoder.encode_uniform(&voxel, chunk).unwrap(),
                            expected,
                            "{dtype} {value} {codec:?}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn repeated_voxels_are_whole() {
        for voxel in [&[7][..], &[0, 0], &[1, 2], &[0, 0, 192, 127], &[1, 2, 3, 4, 5, 6, 7, 8]] {
            for n in [0, 1, 2, 3, 7, 64, 1000] {
                let mut out = vec![9; 3];
                append_repeated(voxel, n, &mut out);
                assert_eq!(out, [vec![9; 3], voxel.repeat(n)].concat());
            }
        }
    }

    #[test]
    fn padding_follows_the_voxels_on_every_axis() {
        let data: Vec<u16> = (1..=2 * 2 * 3).collect();
        let encoder = Encoder::new(Codec::None, DType::U16, 9.0);
        let part = View::strided(&data, [1, 2, 2], 6, 3);
        let Encoded::Bytes(bytes) = encoder.encode(AnyView::U16(part), [2, 3, 3]).unwrap() else { panic!() };
        let codes: Vec<u16> = bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
        assert_eq!(codes, [1, 2, 9, 4, 5, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9]);
    }
}
