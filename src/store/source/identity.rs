//! What makes an input the same input: facts that do not depend on where it lies.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::bytes;
use super::zarr::ZarrArray;
use crate::store::os::FileExt;
use crate::{Error, Result};

const SAMPLES: u64 = 16;
const SAMPLE_BYTES: u64 = 64 << 10;
/// Files of a stack that are sampled.
const SAMPLE_FILES: usize = 64;
/// Chunk files of an array that are sampled.
const SAMPLE_CHUNKS: u64 = 256;
const CHUNK_BYTES: usize = 4 << 10;

/// Size, header and samples of the file or files of a volume.
pub fn of_files(format: &str, header: &[u8], paths: &[PathBuf]) -> Result<Value> {
    let mut hasher = blake3::Hasher::new();
    let mut total = 0u64;
    for path in paths {
        let len = bytes::file_len(path)?;
        total = total.saturating_add(len);
        hasher.update(&len.to_le_bytes());
    }
    let every = paths.len().div_ceil(SAMPLE_FILES).max(1);
    let samples = if paths.len() > 1 { 1 } else { SAMPLES };
    for path in paths.iter().step_by(every) {
        sample(path, samples, &mut hasher)?;
    }
    Ok(json!({
        "format": format,
        "bytes": total,
        "files": paths.len(),
        "header": blake3::hash(header).to_hex().to_string(),
        "samples": hasher.finalize().to_hex().to_string(),
    }))
}

/// Blocks spread evenly over a file, the first and the last among them.
fn sample(path: &Path, samples: u64, hasher: &mut blake3::Hasher) -> Result<()> {
    let file = bytes::open_file(path)?;
    let len = file.metadata().map_err(|e| Error::file(path, e))?.len();
    let block = SAMPLE_BYTES.min(len);
    let mut buffer = vec![0; block as usize];
    for i in 0..samples {
        let at = ((len - block) as u128 * i as u128 / (samples - 1).max(1) as u128) as u64;
        file.read_exact_at(&mut buffer, at).map_err(|e| Error::file(path, e))?;
        hasher.update(&buffer);
    }
    Ok(())
}

/// Metadata, sizes and first bytes of chunk files spread evenly over the array.
pub fn of_zarr(format: &str, array: &ZarrArray) -> Result<Value> {
    let grid = array.outer_grid();
    let total = grid.iter().try_fold(1u64, |n, g| n.checked_mul(*g)).unwrap_or(u64::MAX);
    let mut hasher = blake3::Hasher::new();
    // Missing chunks count by being missing.
    let tries = total.min(SAMPLE_CHUNKS);
    for i in 0..tries {
        let mut flat = (total as u128 * i as u128 / tries as u128) as u64;
        let mut index = vec![0; grid.len()];
        for a in (0..grid.len()).rev() {
            (index[a], flat) = (flat % grid[a], flat / grid[a]);
        }
        let path = array.file_of(&index);
        let Ok(file) = File::open(&path) else {
            hasher.update(b"missing");
            continue;
        };
        let len = file.metadata().map_err(|e| Error::file(&path, e))?.len();
        hasher.update(&len.to_le_bytes());
        let mut head = vec![0; CHUNK_BYTES.min(len as usize)];
        file.read_exact_at(&mut head, 0).map_err(|e| Error::file(&path, e))?;
        hasher.update(&head);
    }
    Ok(json!({
        "format": format,
        "metadata": blake3::hash(&array.meta.text).to_hex().to_string(),
        "chunks": total,
        "samples": hasher.finalize().to_hex().to_string(),
    }))
}

/// Of an array in memory.
pub fn of_memory(bytes: &[u8]) -> Value {
    json!({ "format": "memory", "bytes": bytes.len(), "samples": blake3::hash(bytes).to_hex().to_string() })
}
