//! Where the arrays lie that tasks leave for an output's second phase.

use std::fs;
use std::path::{Path, PathBuf};

use super::files::Temps;
use crate::config::check::{resolved, work_folder};
use crate::{Error, Result};

/// Names the folder in the work folder, where it is another.
const POINTER: &str = "scratch.path";
/// What the names of those folders start with.
const PREFIX: &str = ".occlude-";

/// The folder of an output's arrays: its work folder, or one of their own in `scratch`. The work folder names that one, so that a
/// run that goes on (`begun`) finds it, whatever its config says.
///
/// # Errors
/// A folder cannot be made.
pub fn folder(output: &Path, scratch: Option<&Path>, begun: bool) -> Result<PathBuf> {
    let work = work_folder(output);
    if begun {
        return Ok(pointed(&work).unwrap_or(work));
    }
    remove(&work)?;
    let hash = blake3::hash(resolved(output).as_os_str().as_encoded_bytes()).to_hex();
    let own = scratch.map(|s| resolved(s).join(format!("{PREFIX}{}", &hash[..16])));
    // A name that is no text could not be read back.
    let Some(own) = own.filter(|p| p.to_str().is_some()) else { return Ok(work) };
    fs::create_dir_all(&own).map_err(|e| Error::file(&own, format!("cannot create scratch: {e}")))?;
    let text = own.to_string_lossy().into_owned().into_bytes();
    Temps::open(&work)?.write(&[(work.join(POINTER), text)])?;
    Ok(own)
}

fn pointed(work: &Path) -> Option<PathBuf> {
    fs::read_to_string(work.join(POINTER)).ok().map(PathBuf::from)
}

/// Removes the folder that a work folder names, and its name; never a link, nor anything that is not called like one.
pub fn remove(work: &Path) -> Result<()> {
    let Some(own) = pointed(work) else { return Ok(()) };
    let ours = own.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.starts_with(PREFIX));
    if ours && fs::symlink_metadata(&own).is_ok_and(|m| m.is_dir()) {
        fs::remove_dir_all(&own).map_err(|e| Error::file(&own, format!("cannot be removed: {e}")))?;
    }
    let pointer = work.join(POINTER);
    fs::remove_file(&pointer).map_err(|e| Error::file(&pointer, format!("cannot be removed: {e}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_is_found_again_and_goes() {
        let dir = tempfile::tempdir().unwrap();
        let (output, scratch, other) = (dir.path().join("o.zarr"), dir.path().join("s"), dir.path().join("t"));
        let work = work_folder(&output);
        fs::create_dir(&work).unwrap();
        assert_eq!(folder(&output, None, false).unwrap(), work);
        let own = folder(&output, Some(&scratch), false).unwrap();
        assert!(own.starts_with(resolved(&scratch)) && own.is_dir());
        for later in [None, Some(&*other)] {
            assert_eq!(folder(&output, later, true).unwrap(), own);
        }
        // Nothing to lose: the new place is taken and the old one is empty.
        let second = folder(&output, Some(&other), false).unwrap();
        assert!(second.is_dir() && !own.exists());
        remove(&work).unwrap();
        assert!(!second.exists() && other.is_dir() && !work.join(POINTER).exists());
        // A name that was tampered with costs nothing.
        fs::write(work.join(POINTER), scratch.to_str().unwrap()).unwrap();
        remove(&work).unwrap();
        assert!(scratch.is_dir());
    }
}
