//! Shards of Zarr v3: their indexes, kept for the ones in use, and the checks that keep lying data harmless.

use std::collections::HashMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::zarr_meta::ShardMeta;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// An open shard: its file and its index.
#[derive(Debug)]
pub struct Shard {
    path: PathBuf,
    file: File,
    len: u64,
    /// First byte and length per inner chunk; both all ones where it is not stored.
    index: Vec<[u64; 2]>,
}

impl Shard {
    /// Reads and checks the index.
    pub fn open(path: PathBuf, file: File, len: u64, meta: &ShardMeta) -> Result<Shard> {
        let entries = meta.grid.iter().product::<u64>();
        let size = entries * 16 + if meta.index_crc { 4 } else { 0 };
        if len < size {
            return Err(Error::file(&path, format!("the shard has {len} bytes, its index alone needs {size}")));
        }
        let mut bytes = vec![0; size as usize];
        let at = if meta.index_at_end { len - size } else { 0 };
        file.read_exact_at(&mut bytes, at).map_err(|e| Error::file(&path, e))?;
        if meta.index_crc {
            let sum = bytes.split_off(bytes.len() - 4);
            if crc32c::crc32c(&bytes).to_le_bytes() != sum[..] {
                return Err(Error::file(&path, "the shard's index is corrupt (its checksum is wrong)"));
            }
        }
        let number = |b: &[u8; 8]| u64::from_le_bytes(*b);
        let index = bytes.as_chunks::<8>().0.as_chunks::<2>().0.iter().map(|[a, b]| [number(a), number(b)]).collect();
        Ok(Shard { path, file, len, index })
    }

    /// Whether the index has an inner chunk.
    pub fn holds(&self, entry: usize) -> bool {
        self.index[entry] != [u64::MAX; 2]
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stored bytes of entry `entry`; `None` where it is not stored.
    pub fn read(&self, entry: usize, chunk: &[u64], most: u64) -> Result<Option<Vec<u8>>> {
        let [start, len] = self.index[entry];
        if start == u64::MAX && len == u64::MAX {
            return Ok(None);
        }
        if start.checked_add(len).is_none_or(|end| end > self.len) || len > most {
            let text = format!(
                "chunk {chunk:?}: the index puts {len} bytes at byte {start} of {}; the shard is corrupt",
                self.len
            );
            return Err(Error::file(&self.path, text));
        }
        let mut bytes = vec![0; len as usize];
        let failed = |e| Error::file(&self.path, format!("chunk {chunk:?}: {e}"));
        self.file.read_exact_at(&mut bytes, start).map_err(failed)?;
        Ok(Some(bytes))
    }
}

/// Shards whose files stay open.
const MOST_SHARDS: usize = 64;
/// Entries of all kept indexes together (16 bytes each).
const MOST_ENTRIES: usize = 4 << 20;

type Kept = HashMap<Vec<u64>, (u64, Option<Arc<Shard>>)>;

/// The shards used last. Missing ones are remembered as missing.
#[derive(Debug, Default)]
pub struct Shards {
    kept: Mutex<(u64, Kept)>,
}

impl Shards {
    /// The shard `outer`, opened by `open` where it is not kept.
    pub fn get(&self, outer: &[u64], open: impl FnOnce() -> Result<Option<Shard>>) -> Result<Option<Arc<Shard>>> {
        {
            let mut kept = self.kept.lock().unwrap_or_else(|e| e.into_inner());
            kept.0 += 1;
            let now = kept.0;
            if let Some((used, shard)) = kept.1.get_mut(outer) {
                *used = now;
                return Ok(shard.clone());
            }
        }
        // Opened without the lock: two threads may both do it, which is harmless.
        let shard = open()?.map(Arc::new);
        let mut kept = self.kept.lock().unwrap_or_else(|e| e.into_inner());
        let now = kept.0;
        kept.1.insert(outer.to_vec(), (now, shard.clone()));
        let entries = |kept: &Kept| kept.values().flat_map(|(_, s)| s).map(|s| s.index.len()).sum::<usize>();
        while kept.1.len() > 1 && (kept.1.len() > MOST_SHARDS || entries(&kept.1) > MOST_ENTRIES) {
            let oldest = kept.1.iter().min_by_key(|(_, (used, _))| *used).map(|(k, _)| k.clone());
            if let Some(oldest) = oldest {
                kept.1.remove(&oldest);
            }
        }
        Ok(shard)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_shard_is_dropped() {
        let shards = Shards::default();
        let opened = std::cell::Cell::new(0);
        let open = || {
            opened.set(opened.get() + 1);
            Ok(None)
        };
        for i in 0..MOST_SHARDS as u64 {
            shards.get(&[i], open).unwrap();
        }
        shards.get(&[0], open).unwrap();
        assert_eq!(opened.get(), MOST_SHARDS);
        shards.get(&[1000], open).unwrap(); // drops 1, not 0
        shards.get(&[0], open).unwrap();
        assert_eq!(opened.get(), MOST_SHARDS + 1);
        shards.get(&[1], open).unwrap();
        assert_eq!(opened.get(), MOST_SHARDS + 2);
    }
}
