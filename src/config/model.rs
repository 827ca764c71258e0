//! The typed configuration, as the user meant it: names checked, units still as given (the planner knows the spacing).

use std::path::{Path, PathBuf};

use crate::grid::{Border, DType};
use crate::stage::{
    CombineKind, DirectionSet, DirectionWeights, GradientWeight, Method, Reduce, Rho, Ties, TransferPoint, WindowMode,
};

/// One run.
#[derive(Debug, Clone)]
pub struct Config {
    /// The file it came from; paths in it are relative to its folder and are already resolved here.
    pub file: PathBuf,
    /// The text with `--set` applied, as provenance for outputs.
    pub text: String,
    pub run: Run,
    pub inputs: Vec<Input>,
    pub stages: Vec<StageNode>,
    pub outputs: Vec<Output>,
    pub pareto: Option<super::Pareto>,
}

/// Where a thing stands in the config: names it in errors.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Place {
    /// Dotted key, e.g. `stage.ao`.
    pub key: String,
    pub line: Option<usize>,
    /// Lines of its keys, where they are given in the file.
    pub lines: Vec<(String, usize)>,
}

impl Place {
    /// A config error at `key` of this thing (`""`: at the thing itself). The file is added by [`crate::Error::located`].
    pub fn error(&self, key: &str, message: impl std::fmt::Display) -> crate::Error {
        let line = self.line_of(key);
        let dotted = if key.is_empty() { self.key.clone() } else { format!("{}.{key}", self.key) };
        crate::Error::Config { file: None, line, key: dotted, message: message.to_string() }
    }

    /// The line of one of its keys, else its own.
    pub fn line_of(&self, key: &str) -> Option<usize> {
        self.lines.iter().find(|(k, _)| k == key).map(|(_, line)| *line).or(self.line)
    }
}

#[derive(Debug, Clone)]
pub struct Run {
    /// Ceiling in bytes.
    pub memory: u64,
    /// 0 = all cores.
    pub threads: usize,
    pub device: Device,
    /// `None` = auto; else voxels `[z, y, x]`.
    pub brick: Option<[usize; 3]>,
    /// `None` = all; else `[[z0, z1], [y0, y1], [x0, x1]]`.
    pub region: Option<[[u64; 2]; 3]>,
    /// `None` = beside the output.
    pub scratch: Option<PathBuf>,
    pub lanes: Lanes,
    pub place: Place,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Device {
    #[default]
    Auto,
    Cpu,
    Gpu,
    /// A software adapter, asked for by name (`gpu:software`).
    GpuSoftware,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Lanes {
    #[default]
    Pure,
    Mixed,
}

#[derive(Debug, Clone)]
pub struct Input {
    pub name: String,
    pub place: Place,
    pub kind: InputKind,
    pub level: usize,
    /// Array name inside a Zarr group.
    pub array: Option<String>,
    pub channel: Select,
    pub time: Select,
    /// Overrides of what the file says.
    pub spacing: Option<[f64; 3]>,
    pub unit: Option<String>,
    pub origin: Option<[f64; 3]>,
    pub slope: Option<f64>,
    pub intercept: Option<f64>,
    /// Stored value of missing voxels.
    pub nodata: Option<f64>,
}

#[derive(Debug, Clone)]
pub enum InputKind {
    /// A file or folder; `raw` describes headerless data (`format = "raw"`).
    Path { path: PathBuf, raw: Option<RawFormat> },
    /// A synthetic field by name (`synthetic = "sphere"`), its shape, dtype and seed.
    Synthetic { field: String, shape: [usize; 3], dtype: DType, seed: u64 },
}

impl InputKind {
    /// The file or folder; a synthetic field has none.
    pub fn path(&self) -> Option<&Path> {
        match self {
            InputKind::Path { path, .. } => Some(path),
            InputKind::Synthetic { .. } => None,
        }
    }
}

/// Headerless voxels, x fastest.
#[derive(Debug, Clone, PartialEq)]
pub struct RawFormat {
    pub shape: [usize; 3],
    pub dtype: DType,
    pub big_endian: bool,
    /// Bytes before the first voxel.
    pub offset: u64,
    /// Bytes after the last voxel are allowed (`trailing = "ignore"`).
    pub trailing_ignore: bool,
    /// Volumes of this shape, one after the other.
    pub components: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Select {
    Index(usize),
    All,
}

/// `name` or `name.channel`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Ref {
    pub name: String,
    pub channel: Option<String>,
}

/// A length per axis.
#[derive(Debug, Clone, PartialEq)]
pub enum Length {
    /// Voxels of each axis, `[z, y, x]`.
    Voxels([f64; 3]),
    /// One physical length for all axes, e.g. `"2.5 mm"`.
    Physical { value: f64, unit: String },
}

#[derive(Debug, Clone)]
pub struct StageNode {
    pub name: String,
    pub place: Place,
    pub op: Op,
    pub border: Border,
    pub where_: Option<Where>,
    /// Value of voxels that `where` excludes; `None` = 1 for openness, 0 otherwise.
    pub fill: Option<f64>,
}

/// Which voxels the scene needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Where {
    pub input: Ref,
    pub rule: WhereRule,
}

#[derive(Debug, Clone, PartialEq)]
pub enum WhereRule {
    /// `min <= v <= max`, scaled units.
    Range { min: Option<f64>, max: Option<f64> },
    /// Within `band` voxels of the finest axis of an isosurface crossing.
    Iso { iso: Vec<f64>, band: f64 },
}

/// Shape of an occlusion window as the config names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AoRegion {
    #[default]
    Box,
    EqualVolume,
    Ball,
}

#[derive(Debug, Clone)]
pub enum Op {
    Box {
        input: Ref,
        radius: Length,
    },
    Gaussian {
        input: Ref,
        sigma: Length,
    },
    OcclusionMap {
        input: Ref,
        start_level: usize,
    },
    AmbientOcclusion {
        input: Ref,
        radius: Length,
        method: Method,
        ties: Ties,
        region: AoRegion,
        solid_low: bool,
        /// Quantile levels; read by [`Method::Levels`].
        level_count: usize,
    },
    Obscurance(ObscuranceOp),
    Transfer {
        input: Ref,
        points: Vec<TransferPoint>,
    },
    Window {
        input: Ref,
        low: f64,
        high: f64,
        mode: WindowMode,
    },
    OpacityModulation {
        input: Ref,
        by: Ref,
        rule: Modulation,
    },
    Gradient {
        input: Ref,
        size: usize,
        weight: GradientWeight,
    },
    Saliency {
        input: Ref,
        size: usize,
        weight: GradientWeight,
        scale_max: bool,
    },
    AmbientLight {
        input: Ref,
        rgb: Ref,
        k: f64,
    },
    Combine {
        inputs: Vec<Ref>,
        kind: CombineKind,
    },
}

#[derive(Debug, Clone)]
pub struct ObscuranceOp {
    pub input: Ref,
    pub directions: usize,
    pub set: DirectionSet,
    pub rho: Rho,
    /// A scalar in voxels of the finest axis (all three entries equal), or physical.
    pub max_distance: Length,
    pub weights: DirectionWeights,
    pub weight_by_normal: bool,
    pub colour: Option<Ref>,
    /// Linear RGB where nothing occludes.
    pub ambient: [f64; 3],
    pub solid_low: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Modulation {
    /// A 4.2: opacity times `min(by / sigma_max2, 1)`.
    Variance { sigma_max2: f64 },
    /// B 5.2: opacity times saliency, 0 below `threshold`, times `gain`, clamped to [0, 1].
    Saliency { threshold: f64, gain: f64 },
}

#[derive(Debug, Clone)]
pub struct Output {
    pub name: String,
    pub place: Place,
    pub path: PathBuf,
    pub format: OutputFormat,
    /// One or several channels; several make a leading axis `c`.
    pub from: Vec<Ref>,
    /// `None` = native (openness: u8).
    pub dtype: Option<OutputDType>,
    pub range: OutputRange,
    pub chunk: [usize; 3],
    /// `None` = `"none"`: every chunk is a file.
    pub shard: Option<[usize; 3]>,
    pub codec: Codec,
    /// `None` = auto; else the number of levels, level 0 counted.
    pub levels: Option<usize>,
    /// `None` = by channel (`mean`).
    pub reduce: Option<Reduce>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputDType {
    Native,
    U8,
    U16,
    F32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OutputRange {
    /// Not given: openness uses [0, 1].
    Unset,
    Fixed([f64; 2]),
    /// Two-phase: the channel's least and largest value.
    Auto,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputFormat {
    /// OME-Zarr 0.5 on Zarr v3.
    OmeZarr05,
    /// OME-Zarr 0.4 on Zarr v2.
    OmeZarr04,
    Nrrd,
    Nifti,
    Npy,
    Raw,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    BloscLz4,
    Zstd(i32),
    None,
}
