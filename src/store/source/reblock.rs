//! Compressed or tiled TIFF pages, decoded once into plain planes in scratch.

use std::fs::File;
use std::path::{Path, PathBuf};

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
    pub width: usize,
    pub height: usize,
    pub dtype: DType,
    /// The decoder turns white-is-zero values around; stored values are wanted.
    pub invert: bool,
}

impl Reblock {
    fn plane(&self) -> u64 {
        (self.width as u64 * self.height as u64).saturating_mul(self.dtype.size() as u64)
    }

    /// Bytes of all planes.
    pub fn bytes(&self) -> u64 {
        self.plane().saturating_mul(self.pages.len() as u64)
    }

    /// Decodes each strip or tile once into a nameless file in `scratch`.
    pub fn run(&self, paths: &[PathBuf], scratch: &Path, progress: Progress) -> Result<File> {
        let out = nameless(scratch, self.bytes())?;
        // In the order of the files, so that each directory is walked once.
        let mut order: Vec<usize> = (0..self.pages.len()).collect();
        order.sort_by_key(|i| self.pages[*i]);
        let mut open: Option<(u32, u32, Reader)> = None;
        let mut buffers = [Vec::new(), Vec::new()];
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
            self.page(path, decoder, image as usize, &mut buffers, &mut |offset, bytes| {
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
        [band, chunk]: &mut [Vec<u8>; 2],
        put: &mut dyn FnMut(u64, &[u8]) -> Result<()>,
    ) -> Result<()> {
        let (width, size) = (self.width, self.dtype.size());
        if decoder.dimensions().ok() != Some((width as u32, self.height as u32)) {
            return Err(broken(path, image, "its size changed since it was opened"));
        }
        let have = super::bytes::file_len(path)?;
        let (cw, ch) = decoder.chunk_dimensions();
        let (cw, ch) = ((cw as usize).min(width).max(1), (ch as usize).clamp(1, self.height));
        let across = match decoder.get_chunk_type() {
            tiff::decoder::ChunkType::Strip => 1,
            tiff::decoder::ChunkType::Tile => width.div_ceil(decoder.chunk_dimensions().0.max(1) as usize),
        };
        // No codec here expands 4096-fold: a size that would need it is a lie, not worth allocating.
        let most = MOST_CHUNK.min((have as usize).saturating_mul(4096));
        let bytes =
            width.checked_mul(ch).and_then(|n| n.checked_mul(size)).filter(|n| *n <= most).ok_or_else(|| {
                broken(
                    path,
                    image,
                    format!("a row of its strips or tiles is more than the {most} bytes that are believed"),
                )
            })?;
        for (b, y) in (0..self.height).step_by(ch).enumerate() {
            let rows = ch.min(self.height - y);
            for i in 0..across {
                let (x, index) = (i * cw, (b * across + i) as u32);
                let failed = |e| broken(path, image, format!("strip or tile {index}: {e}"));
                let len = decoder.image_chunk_buffer_layout(index).map_err(failed)?.len;
                let w = if across == 1 { width } else { cw.min(width - x) };
                if len != w * rows * size {
                    let text = format!("strip or tile {index} holds {len} bytes, {} are expected", w * rows * size);
                    return Err(broken(path, image, text));
                }
                chunk.resize(len, 0);
                decoder.read_chunk_bytes(index, chunk).map_err(failed)?;
                let data = &chunk[..];
                if across == 1 && !self.invert {
                    put((y * width * size) as u64, data)?;
                    continue;
                }
                band.resize(bytes, 0);
                for (r, row) in data.chunks_exact(w * size).enumerate() {
                    band[(r * width + x) * size..][..w * size].copy_from_slice(row);
                }
            }
            if across > 1 || self.invert {
                let rows = &mut band[..rows * width * size];
                if self.invert {
                    rows.iter_mut().for_each(|v| *v = !*v);
                }
                put((y * width * size) as u64, rows)?;
            }
        }
        Ok(())
    }
}
