//! Chunks and shards of a Zarr array on disk.
//!
//! A shard grows in a temporary file, chunk by chunk in any order, while its index is kept in memory; only encoded bytes
//! leave memory, so any number of shards may be open. Committing appends the index and renames. Without shards a chunk is
//! a shard of one chunk without an index.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

use serde_json::Value;

use super::files::{Temps, cannot_write, sync_dirs, sync_files};
use super::{Encoded, SinkSpec, metadata};
use crate::config::OutputFormat;
use crate::grid::Region;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// File handles that an output keeps open at once: more shards than that are reopened as needed.
const OPEN_FILES: usize = 64;

/// Files that are synced together when many are committed.
const COMMIT_BATCH: usize = 64;

/// Offset and length of a chunk that is not stored.
const MISSING: [u64; 2] = [u64::MAX; 2];

/// Level, component and grid position of one file.
type Key = (usize, usize, [i64; 3]);

/// A file that is being filled.
#[derive(Debug, Default)]
struct Part {
    temp: Option<PathBuf>,
    len: u64,
    /// Offset and length of every inner chunk, C order.
    index: Vec<[u64; 2]>,
}

/// The files of one Zarr output.
#[derive(Debug)]
pub struct Zarr {
    root: PathBuf,
    temps: Temps,
    parts: Mutex<HashMap<Key, Arc<Mutex<Part>>>>,
    files: Mutex<VecDeque<(PathBuf, Arc<File>)>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|e| e.into_inner())
}

fn json_bytes(value: &Value) -> Vec<u8> {
    let mut bytes = serde_json::to_vec_pretty(value).unwrap_or_default();
    bytes.push(b'\n');
    bytes
}

/// The group's metadata files.
fn group_files(spec: &SinkSpec, occlude: Option<&Value>, windows: &[[f64; 2]]) -> Vec<(PathBuf, Vec<u8>)> {
    let attributes = metadata::group_attributes(spec, occlude, windows);
    if spec.format == OutputFormat::OmeZarr04 {
        let group = b"{\n  \"zarr_format\": 2\n}\n".to_vec();
        // The attributes first: by them a folder is known as this program's.
        return vec![(spec.path.join(".zattrs"), json_bytes(&attributes)), (spec.path.join(".zgroup"), group)];
    }
    vec![(spec.path.join("zarr.json"), json_bytes(&metadata::group_v3(attributes)))]
}

impl Zarr {
    /// Makes folders and metadata.
    pub fn create(spec: &SinkSpec, temps: Temps) -> Result<Zarr> {
        let zarr = Zarr { root: spec.path.clone(), temps, parts: Mutex::default(), files: Mutex::default() };
        // The group first: whatever is found below it is then known as this program's.
        let mut files = group_files(spec, None, &[]);
        for level in 0..spec.pyramid.levels.len() {
            let dir = zarr.root.join(level.to_string());
            if spec.format == OutputFormat::OmeZarr04 {
                files.push((dir.join(".zattrs"), json_bytes(&metadata::array_attributes_v2(spec))));
                files.push((dir.join(".zarray"), json_bytes(&metadata::array_v2(spec, level))));
            } else {
                files.push((dir.join("zarr.json"), json_bytes(&metadata::array_v3(spec, level))));
            }
        }
        zarr.temps.write(&files)?;
        Ok(zarr)
    }

    /// `LEVEL/c/[c/]z/y/x`, without the letter `c` for Zarr v2.
    fn path_of(&self, spec: &SinkSpec, (level, component, cell): Key) -> PathBuf {
        let mut path = self.root.join(level.to_string());
        if spec.format != OutputFormat::OmeZarr04 {
            path.push("c");
        }
        if spec.components.is_some() {
            path.push(component.to_string());
        }
        cell.iter().for_each(|i| path.push(i.to_string()));
        path
    }

    /// Appends a chunk to its file. Returns the bytes written.
    pub fn put(&self, spec: &SinkSpec, level: usize, component: usize, region: Region, chunk: Encoded) -> Result<u64> {
        let file_shape = spec.file_shape();
        let cell = region.cells([0; 3], file_shape).lo;
        let key = (level, component, cell);
        let per: [usize; 3] = std::array::from_fn(|a| file_shape[a] / spec.chunk[a]);
        let inner: [usize; 3] = std::array::from_fn(|a| (region.lo[a] / spec.chunk[a] as i64) as usize % per[a]);
        let slot = (inner[0] * per[1] + inner[1]) * per[2] + inner[2];
        let part = Arc::clone(lock(&self.parts).entry(key).or_default());
        let path = self.path_of(spec, key);
        let mut locked = lock(&part);
        if locked.index.is_empty() {
            locked.index = vec![MISSING; per.iter().product()];
        }
        let Encoded::Bytes(bytes) = chunk else {
            locked.index[slot] = MISSING;
            return Ok(0);
        };
        if locked.temp.is_none() {
            let (temp, file) = self.temps.create(&path)?;
            self.keep_open(&temp, Arc::new(file));
            locked.temp = Some(temp);
        }
        // A file without index is its chunk: a second put starts over.
        let offset = if spec.is_sharded() { locked.len } else { 0 };
        let file = self.open(locked.temp.as_deref().unwrap_or(Path::new("")), &path)?;
        if offset == 0 && locked.len > 0 {
            file.set_len(0).map_err(|e| cannot_write(&path, e))?;
        }
        let n = bytes.len() as u64;
        locked.len = offset + n;
        locked.index[slot] = [offset, n];
        drop(locked); // the room is reserved: others may append while this one writes
        let written = file.write_all_at(&bytes, offset);
        if let Err(e) = written {
            lock(&part).index[slot] = MISSING;
            let of = |a: usize| region.lo[a] / spec.chunk[a] as i64;
            let chunk = format!("chunk {level}/{}/{}/{}", of(0), of(1), of(2));
            return Err(match cannot_write(&path, e) {
                Error::File { path, message } => Error::File { path, message: format!("{chunk} {message}") },
                other => other,
            });
        }
        Ok(n)
    }

    /// Finishes every file of `level` that `region` touches, for all components.
    pub fn commit(&self, spec: &SinkSpec, level: usize, region: Region) -> Result<()> {
        let cells = || region.cells([0; 3], spec.file_shape()).iter();
        let keys: Vec<Key> =
            (0..spec.components.unwrap_or(1)).flat_map(|c| cells().map(move |cell| (level, c, cell))).collect();
        // All are written, then all synced, then all renamed, a batch at a time, so that handles stay few.
        for batch in keys.chunks(COMMIT_BATCH) {
            let mut ready = Vec::new();
            let mut handles = Vec::new();
            for &key in batch {
                let Some(part) = lock(&self.parts).get(&key).map(Arc::clone) else { continue };
                let path = self.path_of(spec, key);
                if let Some((temp, file)) = self.close(spec, &lock(&part), &path)? {
                    ready.push((temp, path));
                    handles.push(file);
                }
            }
            sync_files(&handles, |i| ready[i].1.clone())?;
            let mut folders = BTreeSet::new();
            for (temp, path) in &ready {
                self.temps.publish(temp, path, &mut folders)?;
            }
            sync_dirs(&folders)?;
            let mut parts = lock(&self.parts);
            batch.iter().for_each(|key| drop(parts.remove(key)));
        }
        Ok(())
    }

    /// Writes the index. `None` where every chunk is missing: then there is no file.
    fn close(&self, spec: &SinkSpec, part: &Part, path: &Path) -> Result<Option<(PathBuf, Arc<File>)>> {
        let Some(temp) = &part.temp else { return Ok(None) };
        let file = self.open(temp, path)?;
        lock(&self.files).retain(|(p, _)| p != temp);
        if part.index.iter().all(|c| *c == MISSING) {
            std::fs::remove_file(temp).map_err(|e| cannot_write(path, e))?;
            return Ok(None);
        }
        if spec.is_sharded() {
            let mut index: Vec<u8> = part.index.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
            index.extend(crc32c::crc32c(&index).to_le_bytes());
            file.write_all_at(&index, part.len).map_err(|e| cannot_write(path, e))?;
        }
        Ok(Some((temp.clone(), file)))
    }

    fn keep_open(&self, temp: &Path, file: Arc<File>) {
        let mut files = lock(&self.files);
        if files.len() >= OPEN_FILES {
            files.pop_front();
        }
        files.push_back((temp.to_path_buf(), file));
    }

    /// The handle of a temporary, reopened if it was closed.
    fn open(&self, temp: &Path, path: &Path) -> Result<Arc<File>> {
        if let Some((_, file)) = lock(&self.files).iter().find(|(p, _)| p == temp) {
            return Ok(Arc::clone(file));
        }
        let file = OpenOptions::new().read(true).write(true).open(temp).map_err(|e| cannot_write(path, e))?;
        let file = Arc::new(file);
        self.keep_open(temp, Arc::clone(&file));
        Ok(file)
    }

    /// Writes the final attributes. Refuses while chunks are stored that nobody committed.
    pub fn finish(&self, spec: &SinkSpec, occlude: &Value, windows: &[[f64; 2]]) -> Result<()> {
        let parts = lock(&self.parts);
        if let Some(key) = parts.iter().find(|(_, p)| lock(p).temp.is_some()).map(|(key, _)| *key) {
            let path = self.path_of(spec, key);
            return Err(Error::file(path, "was written but not committed; the output is not complete"));
        }
        drop(parts);
        self.temps.write(&group_files(spec, Some(occlude), windows))
    }
}
