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
    index: Index,
}

/// First byte and length per inner chunk, little-endian; both all ones where it is not stored.
#[derive(Debug)]
enum Index {
    Held(Vec<u8>),
    /// Stays in the file, from this byte on, since it is large.
    InFile(u64),
}

const ENTRY: usize = 16;
const ABSENT: [u64; 2] = [u64::MAX; 2];

impl Shard {
    /// Reads and checks the index.
    pub fn open(path: PathBuf, file: File, len: u64, meta: &ShardMeta) -> Result<Shard> {
        let entries = meta.grid.iter().product::<u64>();
        let size = entries * 16 + if meta.index_crc { 4 } else { 0 };
        if len < size {
            return Err(Error::file(&path, format!("the shard has {len} bytes, its index alone needs {size}")));
        }
        let start = if meta.index_at_end { len - size } else { 0 };
        let read = |bytes: &mut [u8], at| file.read_exact_at(bytes, at).map_err(|e| Error::file(&path, e));
        // In blocks: the index of a shard that is large is not held even while its sum is made.
        let mut block = vec![0; (MOST_HELD.min(entries) as usize) * ENTRY];
        let (mut sum, mut at) = (0, 0);
        while at < entries * ENTRY as u64 && (meta.index_crc || entries <= MOST_HELD) {
            let n = (block.len() as u64).min(entries * ENTRY as u64 - at) as usize;
            read(&mut block[..n], start + at)?;
            sum = crc32c::crc32c_append(sum, &block[..n]);
            at += n as u64;
        }
        if meta.index_crc {
            let mut stored = [0; 4];
            read(&mut stored, start + at)?;
            if sum.to_le_bytes() != stored {
                return Err(Error::file(&path, "the shard's index is corrupt (its checksum is wrong)"));
            }
        }
        let index = if entries <= MOST_HELD { Index::Held(block) } else { Index::InFile(start) };
        Ok(Shard { path, file, len, index })
    }

    /// First byte and length of an inner chunk.
    fn entry(&self, entry: usize) -> Result<[u64; 2]> {
        let mut raw = [0; ENTRY];
        match &self.index {
            Index::Held(bytes) => raw.copy_from_slice(&bytes[entry * ENTRY..][..ENTRY]),
            Index::InFile(start) => {
                let at = start + (entry * ENTRY) as u64;
                self.file.read_exact_at(&mut raw, at).map_err(|e| Error::file(&self.path, e))?;
            }
        }
        let [first, second] = raw.as_chunks::<8>().0 else { unreachable!("an entry is two numbers") };
        Ok([u64::from_le_bytes(*first), u64::from_le_bytes(*second)])
    }

    /// Whether the index has an inner chunk. One that cannot be asked says so when it is read.
    pub fn holds(&self, entry: usize) -> bool {
        self.entry(entry).map_or(true, |entry| entry != ABSENT)
    }

    /// Bytes of memory of its index.
    fn held(&self) -> usize {
        match &self.index {
            Index::Held(bytes) => bytes.len(),
            Index::InFile(_) => 0,
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stored bytes of entry `entry`; `None` where it is not stored.
    pub fn read(&self, entry: usize, chunk: &[u64], most: u64) -> Result<Option<Vec<u8>>> {
        let [start, len] = self.entry(entry)?;
        if [start, len] == ABSENT {
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
/// Entries of an index that is held in memory: a file of 256^3 voxels in chunks of 8^3 has half as many.
const MOST_HELD: u64 = 1 << 16;
/// Bytes of all held indexes together, which no budget counts.
const MOST_BYTES: usize = 4 << 20;

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
        let bytes = |kept: &Kept| kept.values().flat_map(|(_, s)| s).map(|s| s.held()).sum::<usize>();
        while kept.1.len() > 1 && (kept.1.len() > MOST_SHARDS || bytes(&kept.1) > MOST_BYTES) {
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

    /// Large indexes stay in the file, with the same answers; a wrong sum is found in either.
    #[test]
    fn large_indexes_are_not_held() {
        let dir = tempfile::tempdir().unwrap();
        for entries in [9, MOST_HELD + 3] {
            let path = dir.path().join(entries.to_string());
            let mut bytes = b"abcd".to_vec();
            for entry in 0..entries {
                let [start, len] = if entry == entries - 2 { [1, 3] } else { ABSENT };
                bytes.extend(start.to_le_bytes().into_iter().chain(len.to_le_bytes()));
            }
            let sum = crc32c::crc32c(&bytes[4..]);
            bytes.extend(sum.to_le_bytes());
            let meta =
                ShardMeta { codecs: serde_json::Value::Null, index_at_end: true, index_crc: true, grid: vec![entries] };
            let open = |bytes: &[u8]| {
                std::fs::write(&path, bytes).unwrap();
                Shard::open(path.clone(), File::open(&path).unwrap(), bytes.len() as u64, &meta)
            };
            let shard = open(&bytes).unwrap();
            assert_eq!(shard.held() > 0, entries <= MOST_HELD);
            assert!(shard.holds(entries as usize - 2) && !shard.holds(entries as usize - 1) && !shard.holds(0));
            assert_eq!(shard.read(entries as usize - 2, &[0], 64).unwrap().unwrap(), b"bcd");
            assert_eq!(shard.read(1, &[0], 64).unwrap(), None);
            bytes[4 + 16 * 7] ^= 1;
            assert!(open(&bytes).unwrap_err().to_string().contains("checksum"));
        }
    }

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
