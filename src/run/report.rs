//! What a run did: the JSON of `--report`.

use std::collections::BTreeMap;

use serde::Serialize;

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// Wall time.
    pub seconds: f64,
    /// Level-0 voxels of the region, once, however many outputs there are.
    pub voxels: u64,
    pub voxels_per_second: f64,
    pub bricks: BrickCounts,
    /// Bytes read from the inputs' storage.
    pub bytes_read: u64,
    pub bytes_written: u64,
    /// Voxels gathered for bricks, halos included, per voxel of the region.
    pub read_amplification: f64,
    pub memory_budget_bytes: u64,
    pub peak_memory_bytes: u64,
    pub stages: Vec<StageReport>,
    /// Seconds that threads waited, by what for (`read`, `write`, `budget`, ...).
    pub waits: BTreeMap<String, f64>,
    /// Stage to device (`cpu`, `gpu`).
    pub placement: BTreeMap<String, String>,
    /// `lanes = "mixed"` let a float stage's bricks go to either lane: bytes may depend on which took them.
    pub byte_identity_waived: bool,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct BrickCounts {
    pub total: u64,
    pub computed: u64,
    /// Found finished by an earlier run.
    pub resumed: u64,
    /// Not computed, by cause.
    pub skipped: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct StageReport {
    pub name: String,
    /// Time in its kernels, summed over threads.
    pub seconds: f64,
    pub device: String,
    /// Why it ran there.
    pub reason: String,
    pub voxels: u64,
    /// Of a stage on the GPU: bricks that CPU workers took while all of its slots were taken.
    pub bricks_on_cpu: u64,
    /// Of a sweep: its lines in strips of bricks (`total`), and those of them that were not searched: without a needed voxel
    /// (`where`), or with nothing greater in reach (`open`).
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub lines: BTreeMap<String, u64>,
}
