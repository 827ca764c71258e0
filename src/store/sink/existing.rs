//! What stands at an output's path, and how to remove what this program wrote there, nothing else.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::{Sink, files, flat, waiting};
use crate::{Error, Result};

/// Marker in the work folder.
pub const META: &str = "meta.json";

/// A flat file that is not whole yet.
const PART: &str = "data.part";

/// Files and folders that sinks make in the work folder.
const WORK_FILES: [&str; 2] = [PART, META];

/// What stands at a path.
#[derive(Debug, Clone, PartialEq)]
pub enum Existing {
    None,
    /// An output of this program; `occlude` is what its attribute says.
    Ours {
        complete: bool,
        occlude: Option<Value>,
    },
    /// Anything else.
    Foreign,
}

fn read_json(path: &Path) -> Option<Value> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

/// Where a flat file lies until it is whole.
pub fn part_of(path: &Path) -> PathBuf {
    Sink::work_dir(path).join(PART)
}

/// The marker of an output's work folder.
pub fn meta_of(path: &Path) -> Option<Value> {
    read_json(&Sink::work_dir(path).join(META))
}

/// Whether the file at `path` is the one that the marker says was finished.
pub fn is_finished_file(path: &Path) -> bool {
    let Some(meta) = meta_of(path) else { return false };
    meta["complete"] == true && flat::fingerprint(path).is_ok_and(|print| print == meta["file"])
}

/// Attributes of a Zarr group of either version.
fn group_attributes(path: &Path) -> Option<Value> {
    if let Some(mut group) = read_json(&path.join("zarr.json")) {
        return Some(group["attributes"].take());
    }
    read_json(&path.join(".zattrs"))
}

/// Looks at `path`. Symbolic links are followed for `path` itself only.
pub fn existing(path: &Path) -> Existing {
    let meta = meta_of(path);
    let unfinished = Existing::Ours { complete: false, occlude: None };
    match fs::metadata(path) {
        Err(_) if fs::symlink_metadata(path).is_ok() => Existing::Foreign,
        // Finished once and since deleted by hand: nothing is left to continue.
        Err(_) if meta.as_ref().is_some_and(|m| m["complete"] == true) && !part_of(path).exists() => Existing::None,
        Err(_) if meta.is_some() => unfinished,
        Err(_) => Existing::None,
        Ok(m) if m.is_dir() => match group_attributes(path).map(|mut a| a["occlude"].take()) {
            Some(occlude @ Value::Object(_)) => {
                Existing::Ours { complete: occlude["complete"] == true, occlude: Some(occlude) }
            }
            _ => {
                // Killed between making the folder and its attributes, or between removing these and the folder.
                let is_group = |e: io::Result<fs::DirEntry>| e.is_ok_and(|e| e.file_name() == ".zgroup");
                let bare = fs::read_dir(path).is_ok_and(|mut entries| entries.all(is_group));
                if bare && meta.is_some() { unfinished } else { Existing::Foreign }
            }
        },
        Ok(_) if is_finished_file(path) => {
            let occlude = meta.map(|mut m| m["occlude"].take());
            Existing::Ours { complete: true, occlude: occlude.filter(Value::is_object) }
        }
        Ok(_) => Existing::Foreign,
    }
}

fn gone(path: &Path, result: io::Result<()>) -> Result<()> {
    match result {
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(Error::file(path, format!("cannot be removed: {e}"))),
        _ => Ok(()),
    }
}

fn remove_file(path: &Path) -> Result<()> {
    gone(path, fs::remove_file(path))
}

/// Removes a folder if nothing is left in it.
fn remove_if_empty(path: &Path) {
    let _ = fs::remove_dir(path);
}

fn is_number(name: &std::ffi::OsStr) -> bool {
    name.to_str().is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
}

/// Removes files with numbers for names, through at most `depth` levels of folders with numbers for names. Links are
/// neither followed nor removed.
fn remove_keys(dir: &Path, depth: usize) -> Result<()> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(e) => return gone(dir, Err(e)),
    };
    for entry in entries.flatten().filter(|e| is_number(&e.file_name())) {
        match entry.file_type() {
            Ok(t) if t.is_dir() && depth > 0 => {
                remove_keys(&entry.path(), depth - 1)?;
                remove_if_empty(&entry.path());
            }
            Ok(t) if t.is_file() => remove_file(&entry.path())?,
            _ => {}
        }
    }
    Ok(())
}

fn is_real_dir(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|m| m.is_dir())
}

/// Deletes what this program wrote at `path` and beside it; strangers' files in a Zarr group and the folders that hold
/// them stay. Refuses what it did not write.
pub fn remove_ours(path: &Path) -> Result<()> {
    match existing(path) {
        // At most the marker of what was deleted by hand.
        Existing::None if meta_of(path).is_some() => return remove_work_dir(&Sink::work_dir(path)),
        Existing::None => return Ok(()),
        Existing::Foreign => {
            let message = "was not written by this program (or was changed since) and is left alone; \
                           move it away or choose another output path";
            return Err(Error::file(path, message));
        }
        Existing::Ours { .. } => {}
    }
    if path.is_dir() {
        remove_group(path)?;
    } else {
        remove_file(path)?;
    }
    remove_work_dir(&Sink::work_dir(path))
}

/// Takes back that a group is complete, and leaves a marker in its work folder, before anything of it goes; where that cannot be
/// written, nothing can be removed.
fn mark_unfinished(path: &Path) -> Result<()> {
    let work = Sink::work_dir(path);
    if meta_of(path).is_none() {
        files::Temps::open(&work)?.write(&[(work.join(META), br#"{"complete":false}"#.to_vec())])?;
    }
    for (name, at) in [("zarr.json", "/attributes/occlude"), (".zattrs", "/occlude")] {
        let file = path.join(name);
        let Some(mut group) = read_json(&file) else { continue };
        let Some(occlude) = group.pointer_mut(at).and_then(Value::as_object_mut) else { continue };
        if occlude.remove("complete").is_some() {
            let temps = files::Temps::open(&work)?;
            temps.write(&[(file, group.to_string().into_bytes())])?;
        }
    }
    Ok(())
}

/// Arrays first, the group's metadata last: killed halfway, the rest is still known as ours, and as unfinished.
fn remove_group(path: &Path) -> Result<()> {
    mark_unfinished(path)?;
    let attributes = group_attributes(path).unwrap_or_default();
    let image = if attributes["ome"].is_object() { &attributes["ome"] } else { &attributes };
    let datasets = image["multiscales"][0]["datasets"].as_array().cloned().unwrap_or_default();
    let names = datasets.iter().filter_map(|d| d["path"].as_str()).filter(|p| is_number(p.as_ref()));
    for array in names.map(|n| path.join(n)).filter(|a| is_real_dir(a)) {
        if is_real_dir(&array.join("c")) {
            remove_keys(&array.join("c"), 3)?;
            remove_if_empty(&array.join("c"));
        }
        remove_keys(&array, 3)?;
        for name in ["zarr.json", ".zarray", ".zattrs"] {
            remove_file(&array.join(name))?;
        }
        remove_if_empty(&array);
    }
    for name in [".zgroup", ".zattrs", "zarr.json"] {
        remove_file(&path.join(name))?;
    }
    remove_if_empty(path);
    Ok(())
}

/// Removes the sink's own files from a work folder, then the folder if nothing is left.
fn clear_work_dir(dir: &Path) -> Result<()> {
    if is_real_dir(&dir.join("tmp")) {
        gone(dir, fs::remove_dir_all(dir.join("tmp")))?;
    }
    WORK_FILES.iter().try_for_each(|name| remove_file(&dir.join(name)))
}

/// Removes a work folder with all that it holds (journals of the run among it); never a link.
pub fn remove_work_dir(dir: &Path) -> Result<()> {
    if !is_real_dir(dir) {
        return Ok(());
    }
    waiting::remove(dir)?;
    clear_work_dir(dir)?;
    gone(dir, fs::remove_dir_all(dir))
}
