//! Volumes that can be read: anything that reports a lattice and fills a box of it.

use std::path::Path;

use super::VolumeInfo;
use crate::Result;
use crate::brick::Voxels;
use crate::config::Input;
use crate::grid::{AnyViewMut, Region};

/// An open volume. Reading needs only `&self` and is safe from several threads.
#[derive(Debug)]
pub struct Source {
    info: VolumeInfo,
}

/// Outcome of [`Source::read_chunk`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ChunkRead {
    /// The chunk is not stored: every voxel has this stored value.
    Missing(f64),
    /// Decoded; so many bytes were read from storage.
    Data { stored_bytes: u64 },
}

impl Source {
    /// Opens a volume and reads its header, nothing more.
    pub fn open(input: &Input) -> Result<Source> {
        let _ = input;
        todo!()
    }

    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    /// Bytes of scratch disk that [`Source::prepare`] needs (0 for sources that are read in place).
    pub fn spool_bytes(&self) -> u64 {
        todo!()
    }

    /// Makes the voxels addressable: unpacks gzip or re-blocks compressed planes once, streaming, into `scratch`
    /// (an existing folder). `progress` is told the bytes done and may return false to stop.
    pub fn prepare(&mut self, scratch: &Path, progress: &dyn Fn(u64) -> bool) -> Result<()> {
        let _ = (scratch, progress);
        todo!()
    }

    /// Fills `dst` (shape and stored type of the box) with stored values; float nodata becomes NaN. Returns the bytes read
    /// from storage. For sources without chunks (`info().chunk` is `None`).
    pub fn read(&self, component: usize, region: Region, dst: AnyViewMut) -> Result<u64> {
        let _ = (component, region, dst);
        todo!()
    }

    /// Decodes one whole chunk (edge chunks have the full chunk shape; voxels beyond the volume are undefined) into `dst`,
    /// which has the stored type and one chunk's voxels. Float nodata becomes NaN.
    pub fn read_chunk(&self, component: usize, chunk: [i64; 3], dst: &mut Voxels) -> Result<ChunkRead> {
        let _ = (component, chunk, dst);
        todo!()
    }

    /// The pages of this box will not be wanted again soon.
    pub fn release(&self, region: Region) {
        let _ = region;
    }

    /// Size, metadata and hashed samples: changes when the input does.
    pub fn identity(&self) -> Result<serde_json::Value> {
        todo!()
    }
}
