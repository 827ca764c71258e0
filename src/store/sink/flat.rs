//! One file with all voxels: written in place under another name, moved when it is whole.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions};
use std::io::Read;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::encode::fill_bytes;
use super::existing::{self, META};
use super::files::{Temps, cannot_write, sync_dirs};
use super::header::header;
use super::{Encoded, SinkSpec};
use crate::grid::Region;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// Bytes at each end of a file that [`fingerprint`] reads.
const SAMPLE: u64 = 64 << 10;

/// A flat file being written.
#[derive(Debug)]
pub struct Flat {
    temps: Temps,
    work_dir: PathBuf,
    part: PathBuf,
    file: File,
    data_start: u64,
}

/// Length and hashed ends of a file: says whether it is still the one that was finished here.
pub fn fingerprint(path: &Path) -> std::io::Result<Value> {
    let mut file = File::open(path)?;
    let len = file.metadata()?.len();
    let mut hash = blake3::Hasher::new();
    let mut head = Vec::new();
    Read::by_ref(&mut file).take(SAMPLE).read_to_end(&mut head)?;
    hash.update(&head);
    let mut tail = vec![0; len.min(SAMPLE) as usize];
    file.read_exact_at(&mut tail, len - len.min(SAMPLE))?;
    hash.update(&tail);
    Ok(json!({ "bytes": len, "blake3_ends": hash.finalize().to_hex().to_string() }))
}

impl Flat {
    /// Makes the file at its full length (holes where nothing is written yet) with its header.
    pub fn create(spec: &SinkSpec, temps: Temps, work_dir: PathBuf, resume: bool) -> Result<Flat> {
        let part = existing::part_of(&spec.path);
        let head = header(spec, None);
        let voxels: usize = spec.array_shape(0).iter().product();
        let len = (head.len() + voxels * spec.dtype.size()) as u64;
        let open = |create: bool| {
            let file = OpenOptions::new().read(true).write(true).create(create).truncate(create).open(&part);
            file.map_err(|e| cannot_write(&spec.path, e))
        };
        if resume && existing::meta_of(&spec.path).is_some() {
            if !part.exists() && existing::is_finished_file(&spec.path) {
                // Finished before: what is done again is done under the other name.
                fs::rename(&spec.path, &part).map_err(|e| cannot_write(&spec.path, e))?;
            }
            let held = fs::metadata(&part).map(|m| m.len()).unwrap_or(0);
            if held != len {
                let message = format!(
                    "the unfinished output is gone or was changed ({held} bytes, expected {len}); start again with --overwrite"
                );
                return Err(Error::file(&part, message));
            }
            return Ok(Flat { file: open(false)?, temps, work_dir, part, data_start: head.len() as u64 });
        }
        let file = open(true)?;
        file.set_len(len).map_err(|e| cannot_write(&spec.path, e))?;
        file.write_all_at(&head, 0).and_then(|()| file.sync_all()).map_err(|e| cannot_write(&spec.path, e))?;
        let flat = Flat { file, temps, work_dir, part, data_start: head.len() as u64 };
        flat.write_meta(json!({ "format": format!("{:?}", spec.format), "complete": false }))?;
        Ok(flat)
    }

    fn write_meta(&self, meta: Value) -> Result<()> {
        self.temps.write(&[(self.work_dir.join(META), serde_json::to_vec_pretty(&meta).unwrap_or_default())])
    }

    /// Writes a box, row by row or in longer runs where rows join. Returns the bytes written.
    pub fn put(&self, spec: &SinkSpec, component: usize, region: Region, chunk: &Encoded) -> Result<u64> {
        let [nz, ny, nx] = spec.pyramid.levels[0].shape;
        let (size, n) = (spec.dtype.size(), region.shape());
        // Runs of voxels that follow each other both in the file and in the box.
        let rows = if n[2] == nx { n[1] } else { 1 };
        // A volume of one row per plane has full planes only where its rows are full.
        let planes = if n[2] == nx && n[1] == ny { n[0] } else { 1 };
        let run = planes * rows * n[2] * size;
        let bytes = match chunk {
            Encoded::Bytes(bytes) => Cow::Borrowed(&bytes[..]),
            Encoded::Empty => {
                let fill = fill_bytes(spec.dtype, spec.fill);
                if fill.iter().all(|b| *b == 0) {
                    return Ok(0); // a hole reads as zeros
                }
                Cow::Owned(fill.repeat(region.voxels()))
            }
        };
        if bytes.len() != region.voxels() * size {
            return Err(Error::Failed(format!("{} bytes for the box {region:?} of {}", bytes.len(), spec.name)));
        }
        let starts = (0..n[0]).step_by(planes).flat_map(|z| (0..n[1]).step_by(rows).map(move |y| (z, y)));
        for (i, (z, y)) in starts.enumerate() {
            let at = [region.lo[0] as usize + z, region.lo[1] as usize + y, region.lo[2] as usize];
            let voxel = ((component * nz + at[0]) * ny + at[1]) * nx + at[2];
            let offset = self.data_start + (voxel * size) as u64;
            let written = self.file.write_all_at(&bytes[i * run..(i + 1) * run], offset);
            written.map_err(|e| cannot_write(&spec.path, e))?;
        }
        Ok(bytes.len() as u64)
    }

    pub fn commit(&self, spec: &SinkSpec) -> Result<()> {
        self.file.sync_data().map_err(|e| cannot_write(&spec.path, e))
    }

    /// Completes the header, keeps the attributes in the work folder and gives the file its name.
    pub fn finish(&self, spec: &SinkSpec, occlude: &Value) -> Result<()> {
        let head = header(spec, Some(occlude));
        self.file
            .write_all_at(&head, 0)
            .and_then(|()| self.file.sync_all())
            .map_err(|e| cannot_write(&spec.path, e))?;
        let print = fingerprint(&self.part).map_err(|e| Error::file(&self.part, format!("cannot be read: {e}")))?;
        self.write_meta(json!({
            "format": format!("{:?}", spec.format),
            "complete": true,
            "file": print,
            "shape": spec.array_shape(0),
            "dtype": spec.dtype.name(),
            "occlude": occlude,
        }))?;
        fs::rename(&self.part, &spec.path).map_err(|e| cannot_write(&spec.path, e))?;
        sync_dirs(&BTreeSet::from([spec.path.parent().unwrap_or(Path::new("")).to_path_buf()]))
    }
}
