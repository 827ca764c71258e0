//! One run at a time writes an output: a lock on its work folder, which goes when the process does, however it ends.

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use super::{Sink, files};
use crate::store::os;
use crate::{Error, Result};

/// An output that no other run may write while this lives.
#[derive(Debug)]
pub struct Claim {
    dir: PathBuf,
    /// The work folder, locked; on a file system without locks, as it is.
    file: File,
}

impl Claim {
    /// Claims an output whose work folder exists. `Ok(None)` where there is none; `Err` holds the folder's name where
    /// another run has claimed it.
    pub fn existing(path: &Path) -> std::result::Result<Option<Claim>, PathBuf> {
        let dir = Sink::work_dir(path);
        let Ok(file) = os::open_folder(&dir) else { return Ok(None) };
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => Err(dir),
            Ok(()) | Err(TryLockError::Error(_)) => Ok(Some(Claim { dir, file })),
        }
    }

    /// Claims an output, making its work folder. `Ok(Err)` as [`Claim::existing`].
    pub fn make(path: &Path) -> Result<std::result::Result<Claim, PathBuf>> {
        let dir = Sink::work_dir(path);
        loop {
            files::ensure_dir(&dir, &mut BTreeSet::new())?;
            match Claim::existing(path) {
                Err(dir) => return Ok(Err(dir)),
                Ok(Some(claim)) if claim.holds() => return Ok(Ok(claim)),
                // Another run removed the folder in between.
                Ok(_) if !dir.is_dir() => continue,
                Ok(_) => return Err(Error::file(&dir, "cannot be opened")),
            }
        }
    }

    /// Whether the folder under that name is still the one that was claimed: `--overwrite` removes it.
    pub fn holds(&self) -> bool {
        os::is_at(&self.file, &self.dir)
    }
}

impl Drop for Claim {
    /// A folder in which nothing was begun goes; one that holds anything stays.
    fn drop(&mut self) {
        if self.holds() {
            let _ = fs::remove_dir(&self.dir);
        }
        // Said aloud: a child of this process that is not yet another program has the folder open, too, and would keep the lock.
        let _ = self.file.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_claim_keeps_others_out_until_it_goes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("o.zarr");
        assert!(Claim::existing(&path).unwrap().is_none());
        let claim = Claim::make(&path).unwrap().unwrap();
        assert!(claim.holds());
        assert_eq!(Claim::existing(&path).unwrap_err(), Sink::work_dir(&path));
        assert!(Claim::make(&path).unwrap().is_err());
        // Removed and made again, the folder is another one.
        fs::remove_dir(Sink::work_dir(&path)).unwrap();
        assert!(!claim.holds());
        let other = Claim::make(&path).unwrap().unwrap();
        drop(claim);
        assert!(Claim::make(&path).unwrap().is_err());
        drop(other);
        assert!(!Sink::work_dir(&path).exists(), "nothing was begun");
        fs::create_dir(Sink::work_dir(&path)).unwrap();
        fs::write(Sink::work_dir(&path).join("run.json"), "{}").unwrap();
        drop(Claim::existing(&path).unwrap().unwrap());
        let claim = Claim::existing(&path).unwrap().unwrap();
        let of_a_child = claim.file.try_clone().unwrap();
        drop(claim);
        assert!(Claim::existing(&path).unwrap().is_some());
        drop(of_a_child);
    }
}
