//! Volumes that are written: chunk by chunk, committed by rename, finished with their attributes.

use std::path::PathBuf;

use super::Pyramid;
use super::info::Orientation;
use crate::Result;
use crate::config::{Codec, OutputFormat};
use crate::grid::{AnyView, DType, Region, Shape};

/// What an output is; made by the planner.
#[derive(Debug, Clone, PartialEq)]
pub struct SinkSpec {
    pub name: String,
    pub path: PathBuf,
    pub format: OutputFormat,
    pub dtype: DType,
    /// Value that skipped bricks hold; the arrays' `fill_value`.
    pub fill: f64,
    pub pyramid: Pyramid,
    /// Leading axis `c`; `None` for a scalar array without that axis.
    pub components: Option<usize>,
    pub component_names: Vec<String>,
    pub chunk: Shape,
    pub shard: Option<Shape>,
    pub codec: Codec,
    pub unit: Option<String>,
    pub orientation: Option<Orientation>,
    /// First voxel of the output in the input volume (`run.region`), for orientation.
    pub region_start: [i64; 3],
    /// Reduction named in the multiscale metadata (`mean`, `gaussian`, ...).
    pub reduce_name: String,
}

/// A chunk ready to be stored.
#[derive(Debug, Clone, PartialEq)]
pub enum Encoded {
    /// Holds only the fill value: nothing is stored.
    Empty,
    Bytes(Vec<u8>),
}

impl Encoded {
    pub fn len(&self) -> usize {
        match self {
            Encoded::Empty => 0,
            Encoded::Bytes(b) => b.len(),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// An output being written. All methods need only `&self` and are safe from several threads.
#[derive(Debug)]
pub struct Sink {
    spec: SinkSpec,
}

impl Sink {
    /// Folder beside the output that marks it as this program's and holds what is unfinished.
    pub fn work_dir(path: &std::path::Path) -> PathBuf {
        let mut name = path.file_name().unwrap_or_default().to_os_string();
        name.push(".occlude");
        path.with_file_name(name)
    }

    /// Starts an output: makes folders and metadata (without `complete`). With `resume`, keeps what is committed and drops
    /// what is half-done (stale temporaries).
    pub fn create(spec: SinkSpec, resume: bool) -> Result<Sink> {
        let _ = (&spec, resume);
        todo!()
    }

    pub fn spec(&self) -> &SinkSpec {
        &self.spec
    }

    /// Encodes one chunk (flat formats: any box) of a level: `region` is in that level's voxels and already clipped to its
    /// shape; edge chunks are padded with the fill value here. `voxels` has the spec's dtype and the region's shape.
    pub fn encode(&self, level: usize, region: Region, voxels: AnyView) -> Result<Encoded> {
        let _ = (level, region, voxels);
        todo!()
    }

    /// Stores an encoded chunk under a temporary name (in its open shard, chunk file or flat file). Returns bytes written.
    pub fn put(&self, level: usize, component: usize, region: Region, chunk: Encoded) -> Result<u64> {
        let _ = (level, component, region, chunk);
        todo!()
    }

    /// Makes everything put inside `region` of `level` (whole shards) durable under its final name. Idempotent.
    pub fn commit(&self, level: usize, region: Region) -> Result<()> {
        let _ = (level, region);
        todo!()
    }

    /// Writes the final attributes (`complete: true` among them), moves a flat file to its final name.
    pub fn finish(&self, occlude: &serde_json::Value, omero_windows: &[[f64; 2]]) -> Result<()> {
        let _ = (occlude, omero_windows);
        todo!()
    }
}
