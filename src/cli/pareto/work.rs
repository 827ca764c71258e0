//! The folder for the volumes of a command: made and marked by it, so that nothing of anybody else's is written over or taken away.

use std::fs::{self, File};
use std::path::PathBuf;

use crate::config::check::resolved;
use crate::config::{Config, Pareto};
use crate::{Error, Result};

/// Its name, in the folder of the results.
const NAME: &str = "volumes";
/// By this file a folder is known as an earlier command's.
const MARK: &str = ".occlude-pareto";

/// Taken away at the end, whatever that is, unless volumes are kept.
pub struct Work {
    pub path: PathBuf,
    keep: bool,
    /// Locked: one command at a time works here.
    _mark: File,
}

impl Work {
    /// Makes the folder, in place of an earlier command's.
    ///
    /// # Errors
    /// What stands there is not an earlier command's, is in use, or is read by the config.
    pub fn make(job: &Pareto, config: &Config) -> Result<Work> {
        let path = job.folder.join(NAME);
        let refused = |why: &str| {
            job.place.error("folder", format!("{} {why}", path.display())).located(&config.file, job.place.line)
        };
        let real = resolved(&path);
        if config.inputs.iter().filter_map(|i| i.kind.path()).any(|input| resolved(input).starts_with(&real)) {
            return Err(refused("holds an input of the config, and what it holds is replaced; give another folder"));
        }
        let mark = path.join(MARK);
        if fs::symlink_metadata(&path).is_ok() {
            let Ok(old) = File::open(&mark) else {
                return Err(refused(
                    "is in the way and was not made by this command; move it away, or give another folder",
                ));
            };
            if old.try_lock().is_err() {
                return Err(refused("is in use by another command; wait until that has ended, or give another folder"));
            }
            fs::remove_dir_all(&path).map_err(|e| Error::file(&path, format!("cannot be removed: {e}")))?;
        }
        let made = fs::create_dir_all(&path).and_then(|()| File::create(&mark));
        let file = made.map_err(|e| refused(&format!("cannot be made: {e}")))?;
        // Only just made: nobody else holds it, but where a file system has no locks.
        let _ = file.try_lock();
        Ok(Work { path, keep: job.keep, _mark: file })
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        if !self.keep {
            let _ = fs::remove_dir_all(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn config(dir: &Path, more: &str) -> Config {
        let text = format!(
            "[input.v]\nsynthetic = 'noise'\nshape = [4, 4, 4]\ndtype = 'u8'\n{more}[stage.s]\nop = 'box'\ninput = 'v'\nradius = 1\n\
             [output.o]\npath = 'o.npy'\nfrom = 's'\n[pareto]\nstage = 's'\nvary = {{ radius = [1, 2] }}\nfolder = '.'\n"
        );
        let file = dir.join("p.toml");
        fs::write(&file, text).unwrap();
        crate::config::load(&file, &[]).unwrap()
    }

    #[test]
    fn strangers_folders_stay_and_ones_own_are_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let config = config(dir.path(), "");
        let job = config.pareto.as_ref().unwrap();
        let work = Work::make(job, &config).unwrap();
        assert!(work.path.join(MARK).is_file());
        assert!(Work::make(job, &config).err().unwrap().to_string().contains("in use"));
        drop(work);
        assert!(!dir.path().join(NAME).exists());
        let mut kept = Work::make(job, &config).unwrap();
        kept.keep = true;
        fs::write(kept.path.join("run0.zarr"), "x").unwrap();
        drop(kept);
        assert!(!Work::make(job, &config).unwrap().path.join("run0.zarr").exists());
        fs::create_dir(dir.path().join(NAME)).unwrap();
        fs::write(dir.path().join(NAME).join("mine"), "x").unwrap();
        let message = Work::make(job, &config).err().unwrap().to_string();
        assert!(message.contains("pareto.folder") && message.contains("not made by this command"), "{message}");
        assert!(dir.path().join(NAME).join("mine").exists());
    }

    #[test]
    fn an_input_inside_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let config = config(dir.path(), "[input.w]\npath = 'volumes/w.npy'\n");
        let message = Work::make(config.pareto.as_ref().unwrap(), &config).err().unwrap().to_string();
        assert!(message.contains("holds an input"), "{message}");
    }
}
