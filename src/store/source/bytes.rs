//! Bytes of input files: memory maps whose length is checked again at each use, and positioned header reads.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use memmap2::Mmap;

use crate::brick::Voxels;
use crate::store::os::{self, FileExt};
use crate::{Error, Result};

/// A whole file, mapped for reading.
#[derive(Debug)]
pub struct MappedFile {
    path: PathBuf,
    file: File,
    map: Mmap,
}

impl MappedFile {
    pub fn open(path: &Path) -> Result<MappedFile> {
        let file = open_file(path)?;
        MappedFile::of(path, file)
    }

    /// Maps an open file; `path` names it in errors.
    pub fn of(path: &Path, file: File) -> Result<MappedFile> {
        // SAFETY: the map is only ever read as bytes. Another process may change or shorten the file meanwhile: changed
        // bytes are merely other voxels, and `bytes` asks for the length before each use, so that a shortened file
        // becomes an error (one that shrinks in the very moment of a read is the one case left).
        let map = unsafe { Mmap::map(&file) }.map_err(|e| Error::file(path, format!("cannot be mapped: {e}")))?;
        Ok(MappedFile { path: path.to_path_buf(), file, map })
    }

    pub fn len(&self) -> u64 {
        self.map.len() as u64
    }

    /// The bytes, after a check that the file still has all of them.
    pub fn bytes(&self) -> Result<&[u8]> {
        let now = self.file.metadata().map_err(|e| Error::file(&self.path, e))?.len();
        if now < self.len() {
            let was = self.len();
            return Err(Error::file(&self.path, format!("shrank from {was} to {now} bytes while it was being read")));
        }
        Ok(&self.map)
    }

    /// Fills `into` from byte `from` on, without touching the map.
    pub fn read_at(&self, from: u64, into: &mut [u8]) -> Result<()> {
        self.file.read_exact_at(into, from).map_err(|e| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => {
                let (was, now) = (self.len(), self.file.metadata().map_or(0, |m| m.len()));
                Error::file(&self.path, format!("shrank from {was} to {now} bytes while it was being read"))
            }
            _ => Error::file(&self.path, format!("cannot be read: {e}")),
        })
    }

    /// Tells the system that the whole pages inside `start..end` will not be wanted soon.
    pub fn forget(&self, start: u64, end: u64) {
        const PAGE: u64 = 1 << 16; // a multiple of every page size in use
        let (start, end) = (start.div_ceil(PAGE) * PAGE, end.min(self.len()) / PAGE * PAGE);
        if end > start {
            os::forget(&self.map, start as usize, (end - start) as usize);
        }
    }
}

/// Where the bytes of a lattice lie.
#[derive(Debug)]
pub enum Files {
    /// A few files, mapped for as long as the source lives.
    Held(Vec<MappedFile>),
    /// Many files with their lengths: each is mapped while it is read, so that no limit on open files is met.
    OnDemand(Vec<(PathBuf, u64)>),
    /// An array in memory, in this machine's byte order.
    Memory(Voxels),
}

impl Files {
    /// See [`MappedFile::forget`]; does nothing where no map outlives a read.
    pub fn forget(&self, index: usize, start: u64, end: u64) {
        if let Files::Held(files) = self {
            files[index].forget(start, end);
        }
    }

    /// File `index`, where it stays open.
    pub fn held(&self, index: usize) -> Option<&MappedFile> {
        if let Files::Held(files) = self { files.get(index) } else { None }
    }

    /// Runs `f` on the bytes of file `index`.
    pub fn with_bytes<R>(&self, index: usize, f: impl FnOnce(&[u8]) -> Result<R>) -> Result<R> {
        match self {
            Files::Held(files) => f(files[index].bytes()?),
            Files::Memory(voxels) => f(voxels.as_bytes()),
            Files::OnDemand(files) => {
                let (path, len) = &files[index];
                let mapped = MappedFile::open(path)?;
                if mapped.len() != *len {
                    let now = mapped.len();
                    return Err(Error::file(
                        path,
                        format!("changed from {len} to {now} bytes while it was being read"),
                    ));
                }
                f(mapped.bytes()?)
            }
        }
    }
}

/// Opens a file for reading; the error names it.
pub fn open_file(path: &Path) -> Result<File> {
    let failed = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::NotFound => Error::file(path, "no such file"),
        _ => Error::file(path, format!("cannot be opened: {e}")),
    };
    // Before it is opened: a pipe would wait for somebody to write.
    let meta = std::fs::metadata(path).map_err(failed)?;
    if meta.is_dir() {
        return Err(Error::file(path, "is a folder; a file is expected here"));
    }
    if !meta.is_file() {
        return Err(Error::file(path, "neither a file nor a folder; a file is expected here"));
    }
    File::open(path).map_err(failed)
}

/// Bytes of a file.
pub fn file_len(path: &Path) -> Result<u64> {
    Ok(open_file(path)?.metadata().map_err(|e| Error::file(path, e))?.len())
}

/// Up to `most` bytes from the start of `reader`.
pub fn head(path: &Path, reader: &mut dyn Read, most: usize) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    reader.take(most as u64).read_to_end(&mut bytes).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
    Ok(bytes)
}

/// Up to `most` bytes from the start of a file.
pub fn file_head(path: &Path, most: usize) -> Result<Vec<u8>> {
    head(path, &mut open_file(path)?, most)
}
