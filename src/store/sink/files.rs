//! Files that appear whole or not at all: unique temporaries, rename, sync.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{Error, Result};

/// The error of writing what will be `path`; a full disk is named as such.
pub fn cannot_write(path: &Path, error: io::Error) -> Error {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Error::file(
            path,
            format!(
                "cannot be written: no room left on the device ({error}); what was finished is kept, make room and --resume"
            ),
        ),
        _ => Error::file(path, format!("cannot be written: {error}")),
    }
}

/// Makes entries of a folder (new names, renames) durable.
pub fn sync_dir(dir: &Path) -> Result<()> {
    let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
    File::open(dir).and_then(|d| d.sync_all()).map_err(|e| cannot_write(dir, e))
}

/// Makes a folder and those above it, durably.
pub fn ensure_dir(dir: &Path) -> Result<()> {
    if dir.as_os_str().is_empty() || dir.is_dir() {
        return Ok(());
    }
    let parent = dir.parent().unwrap_or(Path::new(""));
    ensure_dir(parent)?;
    match fs::create_dir(dir) {
        Ok(()) => sync_dir(parent),
        // Another thread was faster.
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists && dir.is_dir() => Ok(()),
        Err(e) => Err(cannot_write(dir, e)),
    }
}

/// A folder of temporaries on the file system of the output, each with a name that was never used before.
#[derive(Debug)]
pub struct Temps {
    dir: PathBuf,
    stem: String,
    next: AtomicU64,
}

impl Temps {
    /// Makes the folder `tmp` in a work folder and removes what an earlier process left in it.
    pub fn open(work_dir: &Path) -> Result<Temps> {
        let dir = work_dir.join("tmp");
        ensure_dir(&dir)?;
        let entries = fs::read_dir(&dir).map_err(|e| Error::file(&dir, format!("cannot be listed: {e}")))?;
        for entry in entries.flatten() {
            if entry.file_type().is_ok_and(|t| t.is_file()) {
                fs::remove_file(entry.path())
                    .map_err(|e| Error::file(entry.path(), format!("cannot be removed: {e}")))?;
            }
        }
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        let stem = format!("{}-{:x}", std::process::id(), since.as_nanos());
        Ok(Temps { dir, stem, next: AtomicU64::new(0) })
    }

    /// A new, empty file and its path.
    pub fn create(&self, for_path: &Path) -> Result<(PathBuf, File)> {
        let n = self.next.fetch_add(1, Ordering::Relaxed);
        let path = self.dir.join(format!("{}-{n}", self.stem));
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&path);
        file.map(|f| (path, f)).map_err(|e| cannot_write(for_path, e))
    }

    /// Gives a synced temporary its final name. The caller syncs the folder ([`sync_dir`]).
    pub fn publish(&self, temp: &Path, path: &Path) -> Result<()> {
        if let Some(parent) = path.parent() {
            ensure_dir(parent)?;
        }
        fs::rename(temp, path).map_err(|e| cannot_write(path, e))
    }

    /// Writes a whole file under a temporary name, then gives it its own, durably.
    pub fn write(&self, path: &Path, bytes: &[u8]) -> Result<()> {
        let (temp, mut file) = self.create(path)?;
        let written = file.write_all(bytes).and_then(|()| file.sync_all());
        if let Err(e) = written {
            let _ = fs::remove_file(&temp);
            return Err(cannot_write(path, e));
        }
        self.publish(&temp, path)?;
        sync_dir(path.parent().unwrap_or(Path::new("")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_replaces_and_leaves_no_temporary_and_stale_ones_are_swept() {
        let folder = tempfile::tempdir().unwrap();
        let work = folder.path().join("a.zarr.occlude");
        fs::create_dir_all(work.join("tmp")).unwrap();
        fs::write(work.join("tmp/77-left"), "half").unwrap();
        let temps = Temps::open(&work).unwrap();
        let path = folder.path().join("deep/er/file.json");
        temps.write(&path, b"one").unwrap();
        temps.write(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(work.join("tmp")).unwrap().count(), 0);
    }

    #[test]
    fn failures_name_the_final_path() {
        let folder = tempfile::tempdir().unwrap();
        let temps = Temps::open(&folder.path().join("w")).unwrap();
        fs::write(folder.path().join("plain"), "x").unwrap();
        let path = folder.path().join("plain/below");
        let error = temps.write(&path, b"data").unwrap_err().to_string();
        assert!(error.contains("plain"), "{error}");
        let full = cannot_write(&path, io::Error::from_raw_os_error(libc::ENOSPC)).to_string();
        assert!(full.contains("no room left") && full.contains("below"), "{full}");
    }
}
