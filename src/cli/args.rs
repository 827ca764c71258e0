//! The command line, as typed.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

/// Streams volumes larger than memory into mip-mapped ambient occlusion, obscurance and variance pyramids.
#[derive(Debug, Parser)]
#[command(name = "occlude", version, propagate_version = true, max_term_width = 110)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
    /// Only errors
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
    /// More messages; twice for still more
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the job that a config describes
    Run(RunArgs),
    /// Show what `run` would do: graph, placement, halos, bricks, memory, bytes
    Plan(PlanArgs),
    /// Show what a volume or an output is
    Info(InfoArgs),
    /// Compare level 0 of two volumes: rmse, mae, bias (A - B), max_abs, p99, ssim
    Compare(CompareArgs),
    /// Draw the three middle slices of a volume as PNG
    Preview(PreviewArgs),
    /// Measure time against error over the methods and settings of the config's [pareto] table
    ///
    /// Keys of [pareto]: stage = the stage that is varied (its main channel is measured, or "stage.channel");
    /// vary = { method = ["cdf_power", "chebyshev"], radius = [5, 10] }, whose combinations are run (device = [..] varies
    /// run.device); reference = the keys in which a combination's truth differs from it, e.g. { method = "exact" } (default:
    /// the truth that fits: exact counts in the box or ball, obscurance by 6000 Fibonacci directions, means and variances by
    /// two passes in f64); sample = how much is judged, in bricks of 64^3 chosen by hash: "all", a number of bricks, a share
    /// such as "5 %", or "auto" (default: 512 bricks where there are more), the truth being computed only there; seed = which
    /// bricks (default 0); folder = where outputs, pareto.csv, pareto.json and pareto.svg go (default "pareto"); repeat = runs
    /// per combination, whose median counts, after one more to warm up where it is above 1 (default 1); keep = whether volumes
    /// are kept (default false).
    Pareto(ParetoArgs),
    /// Print the JSON Schema of the config
    Schema,
    /// Print shell completions
    Completions {
        /// Shell to complete for
        shell: clap_complete::Shell,
    },
}

/// A config and what overrides it.
#[derive(Debug, Args)]
pub struct ConfigArgs {
    /// Config file (TOML)
    pub config: PathBuf,
    /// Set any config key, e.g. stage.ao.radius=5; the value is TOML, or a plain string where that fails
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Where stages run (run.device)
    #[arg(long)]
    pub device: Option<DeviceArg>,
    /// Worker threads, 0 = all cores (run.threads)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=4096))]
    pub threads: Option<u16>,
    /// Memory ceiling, e.g. 2GiB (run.memory)
    #[arg(long, value_name = "SIZE", value_parser = memory)]
    pub memory: Option<u64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum DeviceArg {
    Auto,
    Cpu,
    Gpu,
    #[value(name = "gpu:software")]
    GpuSoftware,
}

fn memory(text: &str) -> Result<u64, String> {
    let expected = crate::config::kinds::Kind::Bytes.accepts();
    crate::config::read::parse_bytes(text).map_err(|why| format!("{why}; expected {expected}"))
}

#[derive(Debug, Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Continue what an earlier run left; starts afresh where there is nothing
    #[arg(long)]
    pub resume: bool,
    /// Delete existing outputs that this program wrote
    #[arg(long, conflicts_with = "resume")]
    pub overwrite: bool,
    /// Compute also what could be skipped; the result is the same
    #[arg(long)]
    pub no_skip: bool,
    /// Write a report as JSON
    #[arg(long, value_name = "FILE.json")]
    pub report: Option<PathBuf>,
    /// Write a trace for chrome://tracing or Perfetto
    #[arg(long, value_name = "FILE.json")]
    pub trace: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct PlanArgs {
    #[command(flatten)]
    pub config: ConfigArgs,
    /// As JSON
    #[arg(long)]
    pub json: bool,
}

/// Headerless volumes need to be described.
#[derive(Debug, Args, Clone, Default)]
pub struct RawArgs {
    /// Headerless volume: voxels as z,y,x
    #[arg(long, value_name = "Z,Y,X", value_parser = triple)]
    pub shape: Option<[usize; 3]>,
    /// Headerless volume: u8 i8 u16 i16 u32 i32 f32 f64
    #[arg(long, value_parser = dtype)]
    pub dtype: Option<crate::grid::DType>,
    /// Headerless volume: byte order is big-endian
    #[arg(long)]
    pub big_endian: bool,
    /// Headerless volume: bytes before the first voxel
    #[arg(long, default_value_t = 0)]
    pub offset: u64,
}

fn triple(text: &str) -> Result<[usize; 3], String> {
    let parts: Vec<usize> = text.split(',').filter_map(|p| p.trim().parse().ok()).filter(|n| *n > 0).collect();
    let fits = |s: &[usize; 3]| s.iter().try_fold(1usize, |n, e| n.checked_mul(*e)).is_some_and(|n| n < 1 << 59);
    let expected = || "expected three positive whole numbers, e.g. 113,256,256".to_string();
    parts.try_into().ok().filter(|s| text.split(',').count() == 3 && fits(s)).ok_or_else(expected)
}

fn dtype(text: &str) -> Result<crate::grid::DType, String> {
    let expected = crate::config::kinds::Kind::DType.accepts();
    crate::grid::DType::parse(text).ok_or_else(|| format!("expected {expected}"))
}

#[derive(Debug, Args)]
pub struct InfoArgs {
    /// Volume or output
    pub path: PathBuf,
    /// As JSON
    #[arg(long)]
    pub json: bool,
    /// Read it for min, max, mean, variance and histogram
    #[arg(long)]
    pub stats: bool,
    /// Level that --stats reads
    #[arg(long, default_value_t = 0)]
    pub level: usize,
    #[command(flatten)]
    pub raw: RawArgs,
}

#[derive(Debug, Args)]
pub struct CompareArgs {
    /// First volume
    pub a: PathBuf,
    /// Second volume
    pub b: PathBuf,
    /// As JSON
    #[arg(long)]
    pub json: bool,
    /// Exit with 1 where the root mean square error is above this
    #[arg(long, value_name = "X", value_parser = bound, allow_hyphen_values = true)]
    pub max_rmse: Option<f64>,
    #[command(flatten)]
    pub raw: RawArgs,
}

fn bound(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|v| *v >= 0.0);
    value.ok_or_else(|| "expected a number of at least 0".to_string())
}

#[derive(Debug, Args)]
pub struct PreviewArgs {
    /// Volume or output
    pub path: PathBuf,
    /// PNG to write
    pub out: PathBuf,
    /// One slice instead of the three middle ones, e.g. z=40
    #[arg(long, value_name = "AXIS=INDEX", value_parser = slice)]
    pub slice: Option<(usize, usize)>,
    /// Values of the colour map's ends; without it: the least and largest value shown, 0 and 1 for openness
    #[arg(long, value_name = "LO,HI", value_parser = range, allow_hyphen_values = true)]
    pub range: Option<[f64; 2]>,
    /// Level of the pyramid
    #[arg(long, default_value_t = 0)]
    pub level: usize,
    /// Component of a volume with several; without it three components are shown as RGB, else the first
    #[arg(long)]
    pub component: Option<usize>,
    /// Colour map
    #[arg(long, default_value = "grey")]
    pub map: MapArg,
    #[command(flatten)]
    pub raw: RawArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MapArg {
    #[value(alias = "gray")]
    Grey,
    Viridis,
    Magma,
}

/// `z=40` to axis and index.
fn slice(text: &str) -> Result<(usize, usize), String> {
    let read = || {
        let (axis, index) = text.split_once('=')?;
        let axis = ["z", "y", "x"].iter().position(|a| *a == axis.trim())?;
        Some((axis, index.trim().parse().ok()?))
    };
    read().ok_or_else(|| "expected an axis and an index, e.g. z=40".to_string())
}

fn range(text: &str) -> Result<[f64; 2], String> {
    let parts: Vec<f64> =
        text.split(',').filter_map(|p| p.trim().parse().ok()).filter(|v: &f64| v.is_finite()).collect();
    let range: Option<[f64; 2]> = parts.try_into().ok();
    range.filter(|[lo, hi]| lo < hi).ok_or_else(|| "expected LO,HI with LO below HI, e.g. 0,1".to_string())
}

#[derive(Debug, Args)]
pub struct ParetoArgs {
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Name the cheapest combination whose rmse (over all voxels) is at most this, and the config lines for it
    #[arg(long, value_name = "RMSE", value_parser = bound)]
    pub max_error: Option<f64>,
    /// Print the table as JSON
    #[arg(long)]
    pub json: bool,
}
