//! Scratch arrays on disk: what tasks leave for the second phase. Mapped, so that small boxes cost no system call; the
//! room is reserved first, so that a full disk is an error at the start and not a fault in the middle.

use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU8, AtomicU16, AtomicU32, AtomicU64, Ordering::Relaxed};

use memmap2::MmapRaw;

use super::os;
use crate::grid::{Region, Shape};
use crate::{Error, Result};

/// Reserves a file's room, or leaves it as it was: a file system may hand out all that it has before it says that this is too little.
fn reserve(file: &File, path: &Path, bytes: u64) -> std::io::Result<()> {
    let had = file.metadata()?.len();
    let free = path.parent().and_then(os::free_bytes).unwrap_or(u64::MAX);
    let reserved = match bytes.saturating_sub(had) {
        more if more > free => {
            let why = format!("the file system has room for {free} bytes more");
            Err(std::io::Error::new(std::io::ErrorKind::StorageFull, why))
        }
        _ => os::reserve(file, bytes),
    };
    reserved.inspect_err(|_| {
        let _ = if had == 0 { std::fs::remove_file(path) } else { file.set_len(had) };
    })
}

/// Bytes of an array's file, which is never empty.
fn file_bytes(path: &Path, shape: Shape, planes: usize, item: usize) -> Result<u64> {
    let bytes = shape.iter().try_fold(planes * item, |n, &s| n.checked_mul(s));
    bytes.map(|n| n.max(1) as u64).ok_or_else(|| Error::file(path, "the scratch array is too large"))
}

/// What a mapping is read and written in: tasks share an array, and nothing but atomics may be shared that is written.
trait Word {
    fn put(&self, bytes: &[u8]);
    fn get(&self, bytes: &mut [u8]);
}
macro_rules! word {
    ($($atomic:ty: $plain:ty),*) => {$(
        impl Word for $atomic {
            fn put(&self, bytes: &[u8]) {
                self.store(<$plain>::from_ne_bytes(bytes.try_into().expect("one word")), Relaxed);
            }
            fn get(&self, bytes: &mut [u8]) {
                bytes.copy_from_slice(&self.load(Relaxed).to_ne_bytes());
            }
        }
    )*};
}
word!(AtomicU8: u8, AtomicU16: u16, AtomicU32: u32, AtomicU64: u64);

/// Does the same with a part of a mapping in words of the item's size.
macro_rules! with_words {
    ($spill:expr, $offset:expr, $bytes:expr, $words:ident => $do:expr) => {
        match $spill.word() {
            8 => {
                let $words = $spill.words::<AtomicU64>($offset, $bytes);
                $do
            }
            4 => {
                let $words = $spill.words::<AtomicU32>($offset, $bytes);
                $do
            }
            2 => {
                let $words = $spill.words::<AtomicU16>($offset, $bytes);
                $do
            }
            _ => {
                let $words = $spill.words::<AtomicU8>($offset, $bytes);
                $do
            }
        }
    };
}

/// `planes` dense arrays of one shape and item size, one after the other, in a file.
#[derive(Debug)]
pub struct Spill {
    path: PathBuf,
    file: File,
    map: MmapRaw,
    pub shape: Shape,
    planes: usize,
    item: usize,
}

impl Spill {
    /// Opens an array that an earlier run filled in part.
    ///
    /// # Errors
    /// It is not there, or of another size.
    pub fn reopen(path: &Path, shape: Shape, planes: usize, item: usize) -> Result<Spill> {
        let wanted = file_bytes(path, shape, planes, item)?;
        match std::fs::metadata(path) {
            Ok(m) if m.is_file() && m.len() == wanted => Spill::open(path, shape, planes, item),
            _ => {
                let message = "what the finished tasks left here for later levels is gone or was changed; --overwrite starts afresh";
                Err(Error::file(path, message))
            }
        }
    }

    /// Opens or creates the array. An existing file of the right size keeps its contents.
    pub fn open(path: &Path, shape: Shape, planes: usize, item: usize) -> Result<Spill> {
        let fail = |what: &str, e: std::io::Error| Error::file(path, format!("cannot {what} scratch: {e}"));
        let bytes = file_bytes(path, shape, planes, item)?;
        if let Some(dir) = path.parent() {
            std::fs::create_dir_all(dir).map_err(|e| fail("create the folder of", e))?;
        }
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .map_err(|e| fail("open", e))?;
        reserve(&file, path, bytes).map_err(|e| fail(&format!("reserve {bytes} bytes of"), e))?;
        let map = MmapRaw::map_raw(&file).map_err(|e| fail("map", e))?;
        Ok(Spill { path: path.to_path_buf(), file, map, shape, planes, item })
    }

    /// Writes the voxels of `region` of one plane; `bytes` are dense. Panics if extents disagree.
    pub fn write(&self, plane: usize, region: Region, bytes: &[u8]) {
        assert_eq!(bytes.len(), region.voxels() * self.item);
        let row = region.shape()[2] * self.item;
        for (i, offset) in self.rows(plane, region).enumerate() {
            let from = &bytes[i * row..][..row];
            with_words!(self, offset, row, words => words.iter().zip(from.chunks_exact(self.word())).for_each(|(w, b)| w.put(b)));
        }
    }

    /// Reads the voxels of `region` of one plane into `out`, dense; those that somebody writes meanwhile are old or new.
    pub fn read(&self, plane: usize, region: Region, out: &mut [u8]) {
        assert_eq!(out.len(), region.voxels() * self.item);
        let row = region.shape()[2] * self.item;
        for (i, offset) in self.rows(plane, region).enumerate() {
            let to = &mut out[i * row..][..row];
            with_words!(self, offset, row, words => words.iter().zip(to.chunks_exact_mut(self.word())).for_each(|(w, b)| w.get(b)));
        }
    }

    /// Bytes that are stored at once.
    fn word(&self) -> usize {
        if [2, 4, 8].contains(&self.item) { self.item } else { 1 }
    }

    /// Part of the mapping, as words.
    fn words<W: Word>(&self, offset: usize, bytes: usize) -> &[W] {
        let size = size_of::<W>();
        assert!(offset + bytes <= self.map.len() && offset.is_multiple_of(size) && bytes.is_multiple_of(size));
        // SAFETY: the part lies inside the mapping, which starts at a page (so the words are aligned), lives as long as `self` and
        // is touched by this process through atomics alone; any bytes are an integer.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().add(offset).cast(), bytes / size) }
    }

    /// Makes what was written durable.
    pub fn flush(&self) -> Result<()> {
        self.map.flush().map_err(|e| Error::file(&self.path, format!("cannot write scratch: {e}")))?;
        self.file.sync_data().map_err(|e| Error::file(&self.path, format!("cannot write scratch: {e}")))
    }

    fn rows(&self, plane: usize, region: Region) -> impl Iterator<Item = usize> + use<> {
        assert!(
            plane < self.planes && Region::whole(self.shape).contains(&region),
            "{region:?} outside {:?}",
            self.shape
        );
        let ([nz, ny, nx], item) = (self.shape, self.item);
        let lines = Region::new(region.lo, [region.hi[0], region.hi[1], region.lo[2] + 1]);
        lines.iter().map(move |[z, y, x]| (((plane * nz + z as usize) * ny + y as usize) * nx + x as usize) * item)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_come_back_after_reopening() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cells");
        let region = Region::new([1, 0, 2], [3, 2, 4]);
        let bytes: Vec<u8> = (0..16).collect();
        let spill = Spill::open(&path, [3, 2, 5], 2, 2).unwrap();
        spill.write(1, region, &bytes);
        spill.flush().unwrap();
        drop(spill);
        assert!(
            Spill::reopen(&path, [3, 2, 6], 2, 2).is_err()
                && Spill::reopen(&dir.path().join("x"), [1; 3], 1, 1).is_err()
        );
        let again = Spill::reopen(&path, [3, 2, 5], 2, 2).unwrap();
        let mut out = vec![9; 16];
        again.read(1, region, &mut out);
        assert_eq!(out, bytes);
        again.read(0, region, &mut out);
        assert_eq!(out, [0; 16]);
    }

    #[test]
    fn items_of_every_size_come_back() {
        let dir = tempfile::tempdir().unwrap();
        for item in [1, 2, 3, 4, 8] {
            let spill = Spill::open(&dir.path().join(item.to_string()), [3, 5, 7], 2, item).unwrap();
            let region = Region::new([0, 1, 2], [3, 4, 7]);
            let bytes: Vec<u8> = (0..region.voxels() * item).map(|i| (i * 37) as u8).collect();
            spill.write(1, region, &bytes);
            let mut out = vec![0; bytes.len()];
            spill.read(1, region, &mut out);
            assert_eq!(out, bytes);
            let one = Region::new([2, 3, 6], [3, 4, 7]);
            spill.read(1, one, &mut out[..item]);
            assert_eq!(out[..item], bytes[bytes.len() - item..]);
        }
    }

    #[test]
    fn what_does_not_fit_leaves_the_disk_as_it_was() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cells");
        let huge = [1 << 20, 1 << 20, 1 << 8];
        let error = Spill::open(&path, huge, 2, 8).unwrap_err().to_string();
        assert!(error.contains("cells") && error.contains("has room for"), "{error}");
        assert!(!path.exists());
        Spill::open(&path, [3, 2, 5], 2, 2).unwrap().write(0, Region::whole([1, 1, 2]), &[1, 2, 3, 4]);
        assert!(Spill::open(&path, huge, 2, 8).is_err());
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 120);
        let mut out = vec![9; 4];
        Spill::open(&path, [3, 2, 5], 2, 2).unwrap().read(0, Region::whole([1, 1, 2]), &mut out);
        assert_eq!(out, [1, 2, 3, 4]);
    }
}
