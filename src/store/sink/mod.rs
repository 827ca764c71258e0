//! Volumes that are written: chunk by chunk, committed by rename, finished with their attributes.

pub mod claim;
mod encode;
pub mod existing;
mod files;
mod flat;
mod header;
mod metadata;
mod nifti;
pub mod waiting;
mod zarr;

use std::path::{Path, PathBuf};

use super::Pyramid;
use super::info::Orientation;
use crate::brick::Voxels;
use crate::config::{Codec, OutputFormat};
use crate::grid::{AnyView, DType, Region, Shape};
use crate::{Error, Result};
pub use claim::Claim;
pub use encode::fill_bytes;
pub use existing::{Existing, existing, remove_ours};

/// What an output is; made by the planner.
#[derive(Debug, Clone, PartialEq)]
pub struct SinkSpec {
    pub name: String,
    pub path: PathBuf,
    pub format: OutputFormat,
    pub dtype: DType,
    /// Value that skipped bricks hold, as stored; the arrays' `fill_value`.
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

impl SinkSpec {
    /// Whether files are Zarr shards (Zarr v2 has none, whatever `shard` says).
    pub fn is_sharded(&self) -> bool {
        self.format == OutputFormat::OmeZarr05 && self.shard.is_some()
    }

    /// Voxels of one stored file of a Zarr level: its shard, or its chunk.
    pub fn file_shape(&self) -> Shape {
        self.shard.filter(|_| self.is_sharded()).unwrap_or(self.chunk)
    }

    pub fn is_zarr(&self) -> bool {
        matches!(self.format, OutputFormat::OmeZarr05 | OutputFormat::OmeZarr04)
    }

    /// Whether a direction matrix says more than spacings: an orientation, or an origin that is not 0.
    fn needs_space(&self) -> bool {
        self.orientation.is_some() || self.pyramid.levels[0].translation != [0.0; 3]
    }

    /// World position of cell `[x, y, z, 1]` of level 0 of this output, in `unit`s: the input's matrix moved to
    /// `region_start` and scaled to the cells; without orientation, scale and translation alone.
    fn placed_matrix(&self) -> [[f64; 4]; 3] {
        let level = &self.pyramid.levels[0];
        let Some(orientation) = &self.orientation else {
            let [[sz, sy, sx], [tz, ty, tx]] = [level.scale, level.translation];
            return [[sx, 0.0, 0.0, tx], [0.0, sy, 0.0, ty], [0.0, 0.0, sz, tz]];
        };
        let m = orientation.matrix;
        let mut out = m;
        for a in 0..3 {
            let (zyx, norm) = (2 - a, orientation.step(a));
            // The spacing of the configuration may differ from the file's; equal ones keep their digits.
            let factor = level.factor[zyx] as f64;
            let given = level.scale[zyx] / factor;
            let rescale = if norm > 0.0 && (given / norm - 1.0).abs() > 1e-6 { given / norm } else { 1.0 };
            let first = self.region_start[zyx] as f64 + (factor - 1.0) / 2.0;
            for r in 0..3 {
                let step = m[r][a] * rescale;
                out[r][3] += step * first;
                out[r][a] = step * factor;
            }
        }
        out
    }
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
    encoder: encode::Encoder,
    files: Files,
}

impl SinkSpec {
    /// Removes the work folder of a complete output, where a kill came between the last word and the tidying. Flat files keep
    /// theirs: it says whose they are.
    pub fn forget_work(&self) -> Result<()> {
        if self.is_zarr() { existing::remove_work_dir(&Sink::work_dir(&self.path)) } else { Ok(()) }
    }
}

#[derive(Debug)]
enum Files {
    Zarr(Box<zarr::Zarr>),
    Flat(Box<flat::Flat>),
}

impl Sink {
    /// Folder beside the output that marks it as this program's and holds what is unfinished.
    pub fn work_dir(path: &Path) -> PathBuf {
        crate::config::check::work_folder(path)
    }

    /// Starts an output: makes folders and metadata (without `complete`). With `resume`, keeps what is committed and drops
    /// what is half-done (stale temporaries). The caller has refused or removed what stood there ([`existing()`]).
    pub fn create(spec: SinkSpec, resume: bool) -> Result<Sink> {
        check(&spec)?;
        let work_dir = Sink::work_dir(&spec.path);
        let temps = files::Temps::open(&work_dir)?;
        let codec = if spec.is_zarr() { spec.codec } else { Codec::None };
        let encoder = encode::Encoder::new(codec, spec.dtype, spec.fill);
        let files = if spec.is_zarr() {
            // The marker first: whatever is found later is then known as ours.
            let marker = b"{ \"format\": \"zarr\", \"complete\": false }\n".to_vec();
            temps.write(&[(work_dir.join(existing::META), marker)])?;
            Files::Zarr(Box::new(zarr::Zarr::create(&spec, temps)?))
        } else {
            Files::Flat(Box::new(flat::Flat::create(&spec, temps, work_dir, resume)?))
        };
        Ok(Sink { spec, encoder, files })
    }

    pub fn spec(&self) -> &SinkSpec {
        &self.spec
    }

    /// Encodes one chunk (flat formats: any box) of a level: `region` is in that level's voxels and already clipped to its
    /// shape; edge chunks are padded with the fill value here. `voxels` has the spec's dtype and the region's shape.
    /// A chunk of the fill value alone is [`Encoded::Empty`].
    pub fn encode(&self, level: usize, region: Region, voxels: AnyView) -> Result<Encoded> {
        self.check_region(level, region)?;
        if voxels.dtype() != self.spec.dtype || voxels.shape() != region.shape() {
            let (dtype, shape) = (voxels.dtype(), voxels.shape());
            return Err(Error::Failed(format!("{}: voxels of {dtype} {shape:?} for {region:?}", self.spec.name)));
        }
        let padded = if self.spec.is_zarr() { self.spec.chunk } else { region.shape() };
        self.encoder.encode(voxels, padded)
    }

    /// As [`Self::encode`], of a whole chunk of one voxel of the spec's dtype.
    pub fn encode_uniform(&self, voxel: &Voxels) -> Result<Encoded> {
        self.encoder.encode_uniform(voxel, self.spec.chunk)
    }

    /// Stores an encoded chunk under a temporary name (in its open shard, chunk file or flat file). Returns bytes written.
    /// [`Encoded::Empty`] must be put, too, for flat formats, which have no other way to know the fill value.
    pub fn put(&self, level: usize, component: usize, region: Region, chunk: Encoded) -> Result<u64> {
        self.check_region(level, region)?;
        if component >= self.spec.components.unwrap_or(1) {
            return Err(Error::Failed(format!("{}: there is no component {component}", self.spec.name)));
        }
        match &self.files {
            Files::Zarr(zarr) => zarr.put(&self.spec, level, component, region, chunk),
            Files::Flat(flat) => {
                let written = flat.put(&self.spec, component, region, &chunk);
                if let Encoded::Bytes(bytes) = chunk {
                    self.encoder.reuse(bytes);
                }
                written
            }
        }
    }

    /// Makes everything put inside `region` of `level` (whole shards, all components) durable under its final name.
    /// Idempotent. A shard in which every chunk is empty is not written.
    pub fn commit(&self, level: usize, region: Region) -> Result<()> {
        match &self.files {
            Files::Zarr(zarr) => zarr.commit(&self.spec, level, region),
            Files::Flat(flat) => flat.commit(&self.spec),
        }
    }

    /// Writes the final attributes (`complete: true` among them), moves a flat file to its final name. `omero_windows` has
    /// the display range of each component.
    pub fn finish(&self, occlude: &serde_json::Value, omero_windows: &[[f64; 2]]) -> Result<()> {
        match &self.files {
            Files::Zarr(zarr) => {
                zarr.finish(&self.spec, occlude, omero_windows)?;
                self.spec.forget_work()
            }
            Files::Flat(flat) => flat.finish(&self.spec, occlude),
        }
    }

    /// A region must be one chunk of its level, clipped (flat: any box inside level 0).
    fn check_region(&self, level: usize, region: Region) -> Result<()> {
        let wrong = |why: &str| Error::Failed(format!("{}: box {region:?} of level {level} {why}", self.spec.name));
        let Some(layout) = self.spec.pyramid.levels.get(level) else { return Err(wrong("is of no level")) };
        let whole = Region::whole(layout.shape);
        if region.is_empty() || !whole.contains(&region) {
            return Err(wrong("does not lie in the volume"));
        }
        if !self.spec.is_zarr() {
            return if level == 0 { Ok(()) } else { Err(wrong("has no place in a flat file")) };
        }
        let chunk = Region::of_cell(region.cells([0; 3], self.spec.chunk).lo, [0; 3], self.spec.chunk);
        if chunk.clip(&whole) == region { Ok(()) } else { Err(wrong("is not one chunk")) }
    }
}

/// Largest chunk that blosc can hold, bytes.
const LARGEST_CHUNK: usize = i32::MAX as usize - 16;

/// Most chunks in a shard: its index takes 16 bytes of memory for each.
const MOST_CHUNKS: usize = 1 << 24;

/// Refuses layouts that no file could have.
fn check(spec: &SinkSpec) -> Result<()> {
    let key = |what: &str| format!("output.{}.{what}", spec.name);
    let chunk = spec.chunk;
    if spec.is_zarr() && chunk.contains(&0) {
        return Err(Error::config(key("chunk"), format!("{chunk:?} has an axis of 0 voxels; expected 1 or more")));
    }
    let voxels = chunk.iter().try_fold(spec.dtype.size(), |n, c| n.checked_mul(*c));
    if spec.is_zarr() && voxels.is_none_or(|bytes| bytes > LARGEST_CHUNK) {
        let message = format!("{chunk:?} of {} is too large; expected at most {LARGEST_CHUNK} bytes", spec.dtype);
        return Err(Error::config(key("chunk"), message));
    }
    if let Some(shard) = spec.shard.filter(|_| spec.is_sharded())
        && (0..3).any(|a| shard[a] == 0 || shard[a] % chunk[a] != 0)
    {
        let message = format!("{shard:?} is not a multiple of chunk {chunk:?}; expected a multiple, or \"none\"");
        return Err(Error::config(key("shard"), message));
    }
    let shape = spec.file_shape();
    let chunks = (0..3).try_fold(1, |n: usize, a| n.checked_mul(shape[a] / chunk[a].max(1)));
    if spec.is_sharded() && chunks.is_none_or(|n| n > MOST_CHUNKS) {
        let message = format!("{shape:?} holds too many chunks of {chunk:?}; expected at most {MOST_CHUNKS}");
        return Err(Error::config(key("shard"), message));
    }
    if spec.components == Some(0) || spec.pyramid.levels.iter().any(|l| l.shape.contains(&0)) {
        return Err(Error::Failed(format!("output {} has no voxels", spec.name)));
    }
    Ok(())
}
