//! `[output.NAME]` to [`Output`].

use std::path::Path;

use super::keys::{FORMATS, Section};
use super::section::Reader;
use super::tree::Node;
use super::{Names, Output, OutputDType, OutputFormat, OutputRange, join_path, read, stages};
use crate::Result;
use crate::stage::Reduce;

/// Largest shard edge that is chosen without being asked for; the default of `shard`.
const SHARD: usize = 256;

/// Reads one output.
pub fn read(name: &str, node: &Node, base: &Path, names: &Names) -> Result<Output> {
    let r = Reader::new(Section::Output, format!("output.{name}"), "", node)?;
    let path = r.get("path", |n| join_path(n, base))?;
    let format = format(&r, &path)?;
    let dtypes = [
        ("native", OutputDType::Native),
        ("u8", OutputDType::U8),
        ("u16", OutputDType::U16),
        ("f32", OutputDType::F32),
    ];
    let reduces = [
        ("mean", Reduce::Mean),
        ("min", Reduce::Min),
        ("max", Reduce::Max),
        ("stride", Reduce::Stride),
        ("moments", Reduce::Moments),
    ];
    let chunk = r.get("chunk", read::edges)?;
    Ok(Output {
        name: name.to_string(),
        format,
        from: r.get("from", |n| stages::refs(n, names))?,
        dtype: if r.has("dtype") { Some(r.choice("dtype", &dtypes)?) } else { None },
        range: match r.opt("range", read::range)? {
            None => OutputRange::Unset,
            Some(None) => OutputRange::Auto,
            Some(Some(range)) => OutputRange::Fixed(range),
        },
        chunk,
        shard: shard(&r, chunk, format)?,
        codec: r.get("codec", read::codec)?,
        levels: levels(&r, format)?,
        reduce: if r.has("reduce") { Some(r.choice("reduce", &reduces)?) } else { None },
        path,
        place: r.place,
    })
}

/// Formats in the order of [`FORMATS`]; the first spelling of each is its name.
const MEANINGS: [OutputFormat; 11] = [
    OutputFormat::OmeZarr05,
    OutputFormat::OmeZarr04,
    OutputFormat::Nrrd,
    OutputFormat::Nifti,
    OutputFormat::Npy,
    OutputFormat::Raw,
    OutputFormat::OmeZarr05,
    OutputFormat::OmeZarr04,
    OutputFormat::OmeZarr05,
    OutputFormat::OmeZarr04,
    OutputFormat::Nifti,
];

impl OutputFormat {
    /// As the config spells it.
    pub fn name(self) -> &'static str {
        let at = MEANINGS.iter().position(|f| *f == self).unwrap_or(0);
        FORMATS[at]
    }

    /// One level, no chunks.
    pub fn is_flat(self) -> bool {
        !matches!(self, OutputFormat::OmeZarr05 | OutputFormat::OmeZarr04)
    }
}

fn format(r: &Reader, path: &Path) -> Result<OutputFormat> {
    if r.has("format") {
        let pairs: Vec<(&str, OutputFormat)> = FORMATS.iter().copied().zip(MEANINGS).collect();
        return r.choice("format", &pairs);
    }
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match extension.as_str() {
        "zarr" => Ok(OutputFormat::OmeZarr05),
        "nrrd" => Ok(OutputFormat::Nrrd),
        "nii" => Ok(OutputFormat::Nifti),
        "npy" => Ok(OutputFormat::Npy),
        "raw" => Ok(OutputFormat::Raw),
        _ => {
            let given = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
            let gzip = if extension == "gz" { " (gzip is not written)" } else { "" };
            let message = format!(
                "got {given:?}, whose extension names no format{gzip}; expected .zarr, .nrrd, .nii, .npy or .raw, or the key format = {}",
                super::kinds::one_of(FORMATS)
            );
            Err(r.error("path", message))
        }
    }
}

fn shard(r: &Reader, chunk: [usize; 3], format: OutputFormat) -> Result<Option<[usize; 3]>> {
    let given = r.has("shard");
    let shard = r.get("shard", read::shard)?;
    // Zarr v2 and flat files have no shards: the key is for the outputs beside them.
    if format != OutputFormat::OmeZarr05 {
        return Ok(None);
    }
    if !given {
        return Ok(Some(chunk.map(|c| (SHARD / c).max(1) * c)));
    }
    if let Some(s) = shard
        && (0..3).any(|a| s[a] % chunk[a] != 0)
    {
        return Err(
            r.error("shard", format!("got {s:?}; expected a multiple of chunk {chunk:?} on every axis, or \"none\""))
        );
    }
    Ok(shard)
}

fn levels(r: &Reader, format: OutputFormat) -> Result<Option<usize>> {
    let levels = r.get("levels", read::levels)?;
    if !format.is_flat() {
        return Ok(levels);
    }
    match levels {
        None | Some(1) => Ok(Some(1)),
        Some(n) => {
            let message =
                format!("got {n}, but {} holds level 0 only; expected 1, \"auto\" or a .zarr output", format.name());
            Err(r.error("levels", message))
        }
    }
}
