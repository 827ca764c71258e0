//! Compressed or tiled TIFF pages, decoded once into plain planes in scratch.

use std::fs::File;
use std::path::{Path, PathBuf};

use ::tiff::TiffResult;
use ::tiff::decoder::{ChunkType, DecodingResult};

use super::spool::{Progress, nameless};
use super::tiff::{MOST_CHUNK, Reader, broken, reader};
use crate::grid::DType;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// Pages to decode, in the order of the planes that they become (native byte order).
#[derive(Debug, Clone, PartialEq)]
pub struct Reblock {
    /// File and image in it.
    pub pages: Vec<(u32, u32)>,
    /// Planes to decode; the others stay holes.
    pub wanted: Vec<usize>,
    pub width: usize,
    pub height: usize,
    pub dtype: DType,
    /// The decoder turns white-is-zero values around; stored values are wanted.
    pub invert: bool,
}

/// Kept from page to page.
struct Buffers {
    strip: Vec<u8>,
    tile: DecodingResult,
}

impl Buffers {
    /// One strip or tile as rows of `pitch` bytes, those of a tile with what sticks out of the page on the right: asked for
    /// the page's part alone, the decoder reads row by row, and its LZW then takes the end of the data for a missing end
    /// code (tiff 0.11.3 with weezl 0.1.12: no progress is reported where the last codes were read before).
    fn decode(&mut self, decoder: &mut Reader, index: u32, pitch: usize, rows: usize) -> TiffResult<&[u8]> {
        match decoder.get_chunk_type() {
            ChunkType::Strip => {
                self.strip.resize(pitch * rows, 0);
                decoder.read_chunk_bytes(index, &mut self.strip)?;
                Ok(&self.strip)
            }
            ChunkType::Tile => {
                decoder.read_chunk_to_buffer(&mut self.tile, index, pitch)?;
                Ok(bytes_of(&self.tile))
            }
        }
    }
}

fn bytes_of(decoded: &DecodingResult) -> &[u8] {
    use bytemuck::cast_slice;
    match decoded {
        DecodingResult::U8(v) => v,
        DecodingResult::U16(v) => cast_slice(v),
        DecodingResult::U32(v) => cast_slice(v),
        DecodingResult::U64(v) => cast_slice(v),
        // Halves are no type that pages have here.
        DecodingResult::F16(_) => &[],
        DecodingResult::F32(v) => cast_slice(v),
        DecodingResult::F64(v) => cast_slice(v),
        DecodingResult::I8(v) => cast_slice(v),
        DecodingResult::I16(v) => cast_slice(v),
        DecodingResult::I32(v) => cast_slice(v),
        DecodingResult::I64(v) => cast_slice(v),
    }
}

impl Reblock {
    fn plane(&self) -> u64 {
        (self.width as u64 * self.height as u64).saturating_mul(self.dtype.size() as u64)
    }

    /// Bytes of all planes to decode.
    pub fn bytes(&self) -> u64 {
        self.plane().saturating_mul(self.wanted.len() as u64)
    }

    /// Decodes each strip or tile once into a nameless file in `scratch`.
    pub fn run(&self, paths: &[PathBuf], scratch: &Path, progress: Progress) -> Result<File> {
        let out = nameless(scratch, self.bytes())?;
        // In the order of the files, so that each directory is walked once.
        let mut order = self.wanted.clone();
        order.sort_by_key(|i| self.pages[*i]);
        let mut open: Option<(u32, u32, Reader)> = None;
        let mut band = Vec::new();
        let mut buffers = Buffers { strip: Vec::new(), tile: DecodingResult::U8(Vec::new()) };
        for (done, plane) in order.into_iter().enumerate() {
            let (file, image) = self.pages[plane];
            let path = &paths[file as usize];
            if open.as_ref().is_none_or(|(f, at, _)| *f != file || *at > image) {
                open = Some((file, 0, reader(path, MOST_CHUNK)?));
            }
            let Some((_, at, decoder)) = &mut open else { continue };
            while *at < image {
                decoder.next_image().map_err(|e| broken(path, *at as usize, e))?;
                *at += 1;
            }
            let start = plane as u64 * self.plane();
            self.page(path, decoder, image as usize, &mut band, &mut buffers, &mut |offset, bytes| {
                out.write_all_at(bytes, start + offset).map_err(|e| Error::file(scratch, format!("scratch: {e}")))
            })?;
            if !progress((done as u64 + 1) * self.plane()) {
                return Err(Error::Interrupted);
            }
        }
        Ok(out)
    }

    /// Decodes one page band by band: `put` gets the byte offset in the plane and whole rows.
    fn page(
        &self,
        path: &Path,
        decoder: &mut Reader,
        image: usize,
        band: &mut Vec<u8>,
        buffers: &mut Buffers,
        put: &mut dyn FnMut(u64, &[u8]) -> Result<()>,
    ) -> Result<()> {
        let (width, size) = (self.width, self.dtype.size());
        if decoder.dimensions().ok() != Some((width as u32, self.height as u32)) {
            return Err(broken(path, image, "its size changed since it was opened"));
        }
        let have = super::bytes::file_len(path)?;
        let (cw, ch) = decoder.chunk_dimensions();
        let ch = (ch as usize).clamp(1, self.height);
        // Voxels from row to row of what is decoded: a tile is wider than the page where it sticks out.
        let pitch = match decoder.get_chunk_type() {
            ChunkType::Strip => width,
            ChunkType::Tile => (cw as usize).max(1),
        };
        let across = width.div_ceil(pitch);
        // No codec here expands 4096-fold: a size that would need it is a lie, not worth allocating.
        let most = MOST_CHUNK.min((have as usize).saturating_mul(4096));
        let row = |voxels: usize| voxels.checked_mul(ch).and_then(|n| n.checked_mul(size)).filter(|n| *n <= most);
        let (Some(bytes), Some(_)) = (row(width), row(pitch)) else {
            let text = format!("a row of its strips or tiles is more than the {most} bytes that are believed");
            return Err(broken(path, image, text));
        };
        for (b, y) in (0..self.height).step_by(ch).enumerate() {
            let rows = ch.min(self.height - y);
            band.resize(bytes, 0);
            for i in 0..across {
                let (x, index) = (i * pitch, (b * across + i) as u32);
                let failed = |e| broken(path, image, format!("strip or tile {index}: {e}"));
                let len = decoder.image_chunk_buffer_layout(index).map_err(failed)?.len;
                let w = pitch.min(width - x);
                if len != w * rows * size {
                    let text = format!("strip or tile {index} holds {len} bytes, {} are expected", w * rows * size);
                    return Err(broken(path, image, text));
                }
                let data = buffers.decode(decoder, index, pitch * size, rows).map_err(failed)?;
                if data.len() < pitch * rows * size {
                    return Err(broken(path, image, format!("strip or tile {index} holds {} bytes", data.len())));
                }
                let data = &data[..pitch * rows * size];
                for (r, row) in data.chunks_exact(pitch * size).enumerate() {
                    band[(r * width + x) * size..][..w * size].copy_from_slice(&row[..w * size]);
                }
            }
            let rows = &mut band[..rows * width * size];
            if self.invert {
                rows.iter_mut().for_each(|v| *v = !*v);
            }
            put((y * width * size) as u64, rows)?;
        }
        Ok(())
    }
}
