//! How a run is carried out, apart from what it computes, and whom it tells.

use std::path::PathBuf;

use super::Cancel;

/// Choices of one invocation; none of them changes a voxel.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Continue what an earlier run left; start afresh where there is nothing.
    pub resume: bool,
    /// Delete existing outputs of this program first.
    pub overwrite: bool,
    /// Compute also what could be skipped; the bytes are the same.
    pub no_skip: bool,
    /// Chrome/Perfetto trace to write.
    pub trace: Option<PathBuf>,
    /// Where the caller is going to write the report.
    pub report: Option<PathBuf>,
    pub cancel: Cancel,
}

/// Told how far a run is. Called from any thread, some ten times a second; while unpacking after every mebibyte.
pub trait Progress: Sync {
    /// Level-0 voxels and bricks that are done, of all that there are to do; `phase` names what goes on: `unpack`
    /// (bytes), `pre-pass`, `compute`, `levels` (voxels of the levels that bricks do not make).
    fn update(&self, done_voxels: u64, total_voxels: u64, bricks_done: u64, bricks_total: u64, phase: &str);
    /// Something that the user should know, once.
    fn note(&self, text: &str);
}

/// Tells nobody.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn update(&self, _: u64, _: u64, _: u64, _: u64, _: &str) {}
    fn note(&self, _: &str) {}
}
