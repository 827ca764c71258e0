//! Every key of the configuration, once: type, default, meaning. Unknown-key refusal, defaults, messages, the JSON
//! Schema and the test of `configs/reference.toml` all read this table.

use super::kinds::Kind;

/// Table that a key belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Section {
    Run,
    Input,
    /// A stage whose `op` is among the key's `ops`.
    Stage,
    Output,
    /// The inline table `where` of a stage.
    Where,
    Pareto,
}

/// What stands where a key is not given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Default {
    /// This value, as TOML.
    Toml(&'static str),
    /// Must be given.
    Required,
    /// Nothing; the text says what that means.
    Absent(&'static str),
}

/// One key.
#[derive(Debug)]
pub struct Key {
    pub section: Section,
    pub name: &'static str,
    /// Stages that take it; empty outside [`Section::Stage`] and for keys of every stage.
    pub ops: &'static [&'static str],
    pub kind: Kind,
    pub default: Default,
    pub doc: &'static str,
}

/// Every stage, by the value of its `op`.
pub const OPS: [&str; 12] = [
    "box",
    "gaussian",
    "occlusion_map",
    "ambient_occlusion",
    "obscurance",
    "transfer",
    "window",
    "opacity_modulation",
    "gradient",
    "saliency",
    "ambient_light",
    "combine",
];

/// Channels of a stage, the main one first; empty for an unknown `op`.
pub fn op_channels(op: &str) -> &'static [&'static str] {
    match op {
        "box" => &["mean", "min", "max", "variance", "std", "moment2"],
        "gaussian" | "occlusion_map" => &["mean", "variance"],
        // The bounds are of method moments4 only.
        "ambient_occlusion" => &["openness", "lower", "upper"],
        "window" => &["openness"],
        "obscurance" => &["openness", "rgb"],
        "transfer" => &["opacity", "rgb"],
        "opacity_modulation" => &["opacity"],
        "gradient" => &["magnitude", "vector"],
        "saliency" => &["saliency"],
        "ambient_light" => &["rgb"],
        "combine" => &["value"],
        _ => &[],
    }
}

pub(super) const METHODS: &[&str] =
    &["exact", "cdf_power", "gaussian_cdf", "chebyshev", "chebyshev_literal", "beta", "moments4", "levels"];
pub(super) const FORMATS: &[&str] =
    &["ome-zarr-0.5", "ome-zarr-0.4", "nrrd", "nii", "npy", "raw", "0.5", "0.4", "zarr3", "zarr2", "nifti"];
/// Fields that `synthetic` names; the store makes them.
pub const SYNTHETIC: &[&str] = &["sphere", "plane", "gyroid", "noise", "ramp", "phantom", "constant"];

const NO_OPS: &[&str] = &[];
const WINDOWED: &[&str] = &["box", "gaussian", "ambient_occlusion"];
/// All but `occlusion_map`, whose levels pool every voxel.
const MASKED: &[&str] = &[
    "box",
    "gaussian",
    "ambient_occlusion",
    "obscurance",
    "transfer",
    "window",
    "opacity_modulation",
    "gradient",
    "saliency",
    "ambient_light",
    "combine",
];
const REGRESSION: &[&str] = &["gradient", "saliency"];
const ONE_INPUT: &[&str] = &[
    "box",
    "gaussian",
    "occlusion_map",
    "ambient_occlusion",
    "obscurance",
    "transfer",
    "window",
    "opacity_modulation",
    "gradient",
    "saliency",
    "ambient_light",
];

const fn run(name: &'static str, kind: Kind, default: &'static str, doc: &'static str) -> Key {
    Key { section: Section::Run, name, ops: NO_OPS, kind, default: Default::Toml(default), doc }
}

const fn key(section: Section, name: &'static str, kind: Kind, default: Default, doc: &'static str) -> Key {
    Key { section, name, ops: NO_OPS, kind, default, doc }
}

const fn stage(
    ops: &'static [&'static str],
    name: &'static str,
    kind: Kind,
    default: Default,
    doc: &'static str,
) -> Key {
    Key { section: Section::Stage, name, ops, kind, default, doc }
}

use self::Default::{Absent, Required, Toml};
use self::Section::{Input, Output, Pareto, Where};

/// The table.
#[rustfmt::skip]
pub const KEYS: &[Key] = &[
    // [run]
    run("memory", Kind::Bytes, "\"2GiB\"", "ceiling for everything that a run holds in memory; k, M, G, T are powers of 1000, Ki, Mi, Gi, Ti of 1024"),
    run("threads", Kind::Int { min: 0, max: 4096 }, "0", "worker threads; 0 = all cores"),
    run("device", Kind::Choice(&["auto", "cpu", "gpu", "gpu:software"]), "\"auto\"", "where stages run; gpu:software asks for a software adapter"),
    run("brick", Kind::Brick, "\"auto\"", "unit of work in voxels"),
    run("region", Kind::Region, "\"all\"", "part of the volume that outputs cover, half-open, in voxels of level 0"),
    run("scratch", Kind::PathOrAuto, "\"auto\"", "folder for two-phase runs and unpacked inputs; auto = beside the output"),
    run("lanes", Kind::Choice(&["pure", "mixed"]), "\"pure\"", "mixed: bricks of one stage may go to CPU and GPU both, and bytes may then depend on which"),
    // [input.NAME]
    key(Input, "path", Kind::Path, Absent("synthetic is given instead"), "file or folder: raw, NRRD, NIfTI, MetaImage, TIFF, npy, Zarr, OME-Zarr"),
    key(Input, "synthetic", Kind::Choice(SYNTHETIC), Absent("path is given instead"), "a field made on the fly instead of a file"),
    key(Input, "format", Kind::Choice(&["auto", "raw"]), Toml("\"auto\""), "raw: headerless voxels, x fastest; auto: by the file's name and head"),
    key(Input, "shape", Kind::Shape, Absent("the file says it"), "raw and synthetic only: voxels"),
    key(Input, "dtype", Kind::DType, Absent("the file says it; u8 for synthetic"), "raw and synthetic only: element type"),
    key(Input, "endian", Kind::Choice(&["little", "big", "native"]), Toml("\"little\""), "raw only: byte order"),
    key(Input, "offset", Kind::Int { min: 0, max: i64::MAX }, Toml("0"), "raw only: bytes before the first voxel"),
    key(Input, "trailing", Kind::Choice(&["refuse", "ignore"]), Toml("\"refuse\""), "raw only: bytes after the last voxel"),
    key(Input, "seed", Kind::Int { min: 0, max: i64::MAX }, Toml("0"), "synthetic only: seed of random fields"),
    key(Input, "level", Kind::Int { min: 0, max: 63 }, Toml("0"), "level of a multiscale Zarr to read"),
    key(Input, "array", Kind::Text, Absent("the array of `level`"), "array inside a Zarr group, instead of a level"),
    key(Input, "channel", Kind::Select, Toml("0"), "channel to read"),
    key(Input, "time", Kind::Select, Toml("0"), "time step to read"),
    key(Input, "spacing", Kind::Spacing, Absent("the file's; 1 where it has none"), "voxel size, overriding the file's"),
    key(Input, "unit", Kind::Unit, Absent("the file's"), "unit of spacing and origin, overriding the file's"),
    key(Input, "origin", Kind::Position, Absent("the file's"), "position of voxel 0, overriding the file's"),
    key(Input, "slope", Kind::AnyNumber, Absent("the file's; 1 where it has none"), "scaled = slope * stored + intercept; 0 means no scaling"),
    key(Input, "intercept", Kind::AnyNumber, Absent("the file's; 0 where it has none"), "see slope"),
    key(Input, "nodata", Kind::AnyNumber, Absent("the file's"), "stored value of missing voxels"),
    // [stage.NAME]
    stage(NO_OPS, "op", Kind::Choice(&OPS), Required, "what the stage does"),
    stage(ONE_INPUT, "input", Kind::Ref, Required, "what it reads"),
    stage(&["combine"], "inputs", Kind::Refs, Required, "what it reads, all of one shape"),
    stage(&["combine"], "input", Kind::Refs, Absent("inputs is given"), "another name of `inputs`"),
    stage(MASKED, "where", Kind::Where, Absent("everywhere"), "which voxels are needed"),
    stage(MASKED, "fill", Kind::AnyNumber, Absent("1 for openness and its bounds, else 0"), "value of voxels that `where` excludes"),
    stage(WINDOWED, "border", Kind::Border, Toml("\"clip\""), "what a window sees beyond the edge of the volume; a constant is in scaled units"),
    stage(&["occlusion_map"], "border", Kind::Choice(&["clip"]), Toml("\"clip\""), "weights are renormalised at the edge"),
    stage(REGRESSION, "border", Kind::Choice(&["nearest"]), Toml("\"nearest\""), "the regression repeats the edge"),
    stage(&["box", "ambient_occlusion"], "radius", Kind::Radius, Required, "half-width of the window, which has 2 r + 1 voxels per axis"),
    stage(&["gaussian"], "sigma", Kind::Sigma, Required, "standard deviation; truncated at ceil(3 sigma)"),
    stage(&["occlusion_map"], "start_level", Kind::Int { min: 0, max: 1 }, Toml("1"), "level of the map that is dataset 0 of its output"),
    stage(&["ambient_occlusion"], "method", Kind::Choice(METHODS), Required, "estimator of openness"),
    stage(&["ambient_occlusion"], "level_count", Kind::Int { min: 8, max: 64 }, Toml("32"), "method levels only: quantile levels of the volume's values"),
    stage(&["ambient_occlusion"], "ties", Kind::Choice(&["le", "mid"]), Toml("\"le\""), "how voxels equal to the centre count"),
    stage(&["ambient_occlusion"], "region", Kind::Choice(&["box", "equal_volume", "ball"]), Toml("\"box\""), "shape of the window; ball for method exact only"),
    stage(&["ambient_occlusion", "obscurance"], "solid", Kind::Choice(&["high", "low"]), Toml("\"high\""), "whether larger or smaller scaled values are solid"),
    stage(&["obscurance"], "directions", Kind::Int { min: 1, max: 8191 }, Toml("42"), "12, 42 or 162; any count with set = \"fibonacci\""),
    stage(&["obscurance"], "set", Kind::Choice(&["icosahedron", "fibonacci"]), Toml("\"icosahedron\""), "family of directions"),
    stage(&["obscurance"], "rho", Kind::Choice(&["step", "linear", "exponential", "sqrt"]), Toml("\"sqrt\""), "dimming of an occluder with distance"),
    stage(&["obscurance"], "max_distance", Kind::Distance, Toml("64"), "reach; voxels of the finest axis, or physical"),
    stage(&["obscurance"], "weights", Kind::Choice(&["uniform", "voronoi"]), Toml("\"uniform\""), "weights of the directions; voronoi for the icosahedron only"),
    stage(&["obscurance"], "weight_by_normal", Kind::Bool, Toml("false"), "weigh directions by max(0, n.w)"),
    stage(&["obscurance"], "colour", Kind::Ref, Absent("no channel rgb"), "stage with channel rgb that bleeds colour"),
    stage(&["obscurance"], "ambient", Kind::Rgb, Toml("[1.0, 1.0, 1.0]"), "linear RGB where nothing occludes"),
    stage(&["transfer"], "points", Kind::Points, Required, "table from scaled value to opacity and linear RGB"),
    stage(&["window"], "low", Kind::AnyNumber, Required, "openness below it becomes 0"),
    stage(&["window"], "high", Kind::AnyNumber, Required, "openness above it becomes 1"),
    stage(&["window"], "mode", Kind::Choice(&["keep", "stretch"]), Toml("\"keep\""), "what happens in between"),
    stage(&["opacity_modulation"], "by", Kind::Ref, Required, "a variance or a saliency"),
    stage(&["opacity_modulation"], "sigma_max2", Kind::Number { min: 0.0, strict: true }, Toml("5.0"), "by a variance: opacity times min(by / sigma_max2, 1); a negative by counts as 0"),
    stage(&["opacity_modulation"], "threshold", Kind::AnyNumber, Toml("0.2"), "by a saliency: opacity is 0 below it"),
    stage(&["opacity_modulation"], "gain", Kind::Number { min: 0.0, strict: false }, Toml("1.0"), "by a saliency: factor"),
    stage(REGRESSION, "size", Kind::Size, Toml("5"), "voxels per axis of the regression: 5 or 3"),
    stage(REGRESSION, "weight", Kind::Choice(&["distance", "inverse"]), Toml("\"distance\""), "weight of a voxel by its distance"),
    stage(&["saliency"], "scale", Kind::Choice(&["none", "max"]), Toml("\"none\""), "max: divided by the volume's maximum (two-phase)"),
    stage(&["ambient_light"], "rgb", Kind::Ref, Required, "stage with channel rgb"),
    stage(&["ambient_light"], "k", Kind::AnyNumber, Toml("1.0"), "factor"),
    stage(&["combine"], "op_kind", Kind::Choice(&["add", "multiply", "min", "max", "mean"]), Required, "how the inputs are joined"),
    // where = { .. }
    key(Where, "input", Kind::Ref, Required, "volume or channel that decides"),
    key(Where, "min", Kind::AnyNumber, Absent("no lower bound"), "least needed value, scaled units"),
    key(Where, "max", Kind::AnyNumber, Absent("no upper bound"), "largest needed value, scaled units"),
    key(Where, "iso", Kind::Numbers, Absent("min and max decide"), "values of isosurfaces, scaled units"),
    key(Where, "band", Kind::Number { min: 0.0, strict: false }, Toml("2.0"), "with iso: distance to a crossing, voxels of the finest axis"),
    // [output.NAME]
    key(Output, "path", Kind::Path, Required, "file or folder to write"),
    key(Output, "from", Kind::Refs, Required, "channel, list of channels, or an input's name"),
    key(Output, "format", Kind::Choice(FORMATS), Absent("by the extension: .zarr, .nrrd, .nii, .npy, .raw"), "how it is stored"),
    key(Output, "dtype", Kind::Choice(&["native", "u8", "u16", "f32"]), Absent("u8 for openness, else native"), "element type"),
    key(Output, "range", Kind::Range, Absent("[0, 1] for openness; integers of anything else need it"), "values that map to 0 and the type's maximum; auto is two-phase"),
    key(Output, "chunk", Kind::Chunk, Toml("64"), "unit of storage in voxels"),
    key(Output, "shard", Kind::Shard, Toml("256"), "file of chunks in voxels, a multiple of chunk"),
    key(Output, "codec", Kind::Codec, Toml("\"blosc-lz4\""), "compression of chunks"),
    key(Output, "levels", Kind::Levels, Toml("\"auto\""), "levels of the pyramid; flat files have one"),
    key(Output, "reduce", Kind::Choice(&["mean", "min", "max", "stride", "moments"]), Toml("\"mean\""), "how cells of coarser levels are made"),
    // [pareto]
    key(Pareto, "stage", Kind::Ref, Required, "stage that is varied; its main channel is measured, or stage.channel"),
    key(Pareto, "vary", Kind::Vary, Required, "values by key of the stage, whose combinations are run; device = [..] varies run.device"),
    key(Pareto, "reference", Kind::StageKeys, Absent("the truth that fits: exact counts, obscurance by 6000 Fibonacci directions, means and variances by two passes in f64"), "keys in which a combination's truth differs from it"),
    key(Pareto, "sample", Kind::Sample, Toml("\"auto\""), "how much of the volume is judged, in bricks of 64^3 chosen by hash; auto: 512 of them where there are more"),
    key(Pareto, "seed", Kind::Int { min: 0, max: i64::MAX }, Toml("0"), "which bricks the sample holds"),
    key(Pareto, "folder", Kind::Path, Toml("\"pareto\""), "where outputs, pareto.csv, pareto.json and pareto.svg go"),
    key(Pareto, "repeat", Kind::Int { min: 1, max: 100 }, Toml("1"), "runs per combination, whose median counts, after one more to warm up where it is above 1"),
    key(Pareto, "keep", Kind::Bool, Toml("false"), "whether the volumes of runs and truths are kept, in `volumes` in the folder"),
];

/// Keys of a section (for stages: of one `op`), in the table's order.
pub fn of(section: Section, op: &str) -> impl Iterator<Item = &'static Key> + use<'_> {
    KEYS.iter().filter(move |k| k.section == section && (k.ops.is_empty() || k.ops.contains(&op)))
}

/// Whether any section or any other stage has a key of this name.
pub fn owners(section: Section, name: &str) -> impl Iterator<Item = &'static Key> + use<'_> {
    KEYS.iter().filter(move |k| k.section == section && k.name == name)
}
