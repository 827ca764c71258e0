//! Zarr metadata: arrays of both versions checked before anything is allocated, and OME-Zarr multiscales.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::bytes;
use super::chunk_codecs::{ChunkPacking, codec_name, take_outermost};
use super::planar::key;
use super::raw::{numpy_type, refuse};
use super::units;
use crate::config::Input;
use crate::grid::DType;
use crate::{Error, Result};

/// Longest metadata file that is read.
const MOST_METADATA: usize = 16 << 20;
/// Largest decoded chunk.
pub const MOST_CHUNK_BYTES: u64 = 4 << 30;
const MOST_AXES: usize = 16;

/// What an array's metadata says, checked.
#[derive(Debug, Clone)]
pub struct ArrayMeta {
    pub version: u8,
    pub shape: Vec<u64>,
    pub dtype: DType,
    /// Shape of what one file holds.
    pub outer: Vec<u64>,
    /// Shape of the unit that is decoded by itself; equal to `outer` where there are no shards.
    pub inner: Vec<u64>,
    pub shard: Option<ShardMeta>,
    /// Names of the codecs of an inner chunk, the first applied first when written.
    pub codecs: Vec<String>,
    /// Those of them that are unpacked here, with a bound, the outermost first; `value` lacks them.
    pub packings: Vec<ChunkPacking>,
    pub names: Vec<Option<String>>,
    /// The metadata, without those codecs.
    pub value: Value,
    /// The metadata file's text.
    pub text: Vec<u8>,
}

/// The `sharding_indexed` codec.
#[derive(Debug, Clone)]
pub struct ShardMeta {
    /// Codecs of an inner chunk, as in the metadata.
    pub codecs: Value,
    pub index_at_end: bool,
    pub index_crc: bool,
    /// Entries of the index per axis.
    pub grid: Vec<u64>,
}

impl ArrayMeta {
    /// Whether a chunk is one of blosc's containers, of voxels along x, y and z as this machine has them in memory.
    pub fn is_plain_blosc(&self) -> bool {
        let (swapped, v2_swapped) = if cfg!(target_endian = "little") { ("big", '>') } else { ("little", '<') };
        if self.version == 2 {
            let dtype = self.value["dtype"].as_str().unwrap_or("");
            return self.codecs == ["blosc"]
                && self.value["order"].as_str() == Some("C")
                && (self.dtype.size() == 1 || !dtype.starts_with(v2_swapped));
        }
        let list = self.shard.as_ref().map_or(&self.value["codecs"], |shard| &shard.codecs);
        self.codecs == ["bytes", "blosc"]
            && (self.dtype.size() == 1 || list[0]["configuration"]["endian"].as_str().is_some_and(|e| e != swapped))
    }
}

/// Reads a JSON file of a Zarr folder; `None` where it does not exist.
pub fn json(path: &Path) -> Result<Option<(Value, Vec<u8>)>> {
    if !path.is_file() {
        return Ok(None);
    }
    let text = bytes::file_head(path, MOST_METADATA + 1)?;
    if text.len() > MOST_METADATA {
        return Err(Error::file(path, format!("metadata of more than {MOST_METADATA} bytes are not read")));
    }
    let value = serde_json::from_slice(&text).or_else(|e| match without_bare_numbers(&text) {
        Some(text) => serde_json::from_slice(&text),
        None => Err(e),
    });
    let value = value.map_err(|e| Error::file(path, format!("broken JSON: {e}")))?;
    Ok(Some((value, text)))
}

/// Python writes NaN and infinities bare in attributes, which JSON does not know: `null` in their place. `None` where there are none.
fn without_bare_numbers(text: &[u8]) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len());
    let (mut quoted, mut i, mut found) = (false, 0, false);
    while i < text.len() {
        let bare = [&b"-Infinity"[..], b"Infinity", b"NaN"].into_iter().find(|w| !quoted && text[i..].starts_with(w));
        if let Some(word) = bare {
            out.extend_from_slice(b"null");
            (i, found) = (i + word.len(), true);
            continue;
        }
        out.push(text[i]);
        match text[i] {
            b'\\' if quoted && i + 1 < text.len() => {
                i += 1;
                out.push(text[i]);
            }
            b'"' => quoted = !quoted,
            _ => {}
        }
        i += 1;
    }
    found.then_some(out)
}

fn sizes(path: &Path, what: &str, value: &Value, axes: Option<usize>, least: u64) -> Result<Vec<u64>> {
    let list: Option<Vec<u64>> = value.as_array().and_then(|a| a.iter().map(Value::as_u64).collect());
    let ok = |l: &Vec<u64>| {
        (1..=MOST_AXES).contains(&l.len())
            && axes.is_none_or(|n| n == l.len())
            && l.iter().all(|n| (least..1 << 48).contains(n))
    };
    list.filter(ok).ok_or_else(|| {
        let count = axes.map_or(format!("1 to {MOST_AXES}"), |n| n.to_string());
        let text: String = value.to_string().chars().take(100).collect();
        Error::file(
            path,
            format!("broken Zarr metadata: {what} is {text}; {count} sizes of at least {least} are expected"),
        )
    })
}

/// Metadata of the array in `folder`; `None` where there is none.
pub fn array(folder: &Path) -> Result<Option<ArrayMeta>> {
    let v3 = folder.join("zarr.json");
    if let Some((value, text)) = json(&v3)? {
        return match value["node_type"].as_str() {
            Some("array") => Ok(Some(array_v3(&v3, value, text)?)),
            _ => Ok(None),
        };
    }
    let v2 = folder.join(".zarray");
    match json(&v2)? {
        Some((value, mut text)) => {
            let attributes = json(&folder.join(".zattrs"))?;
            if let Some((_, more)) = &attributes {
                text.extend_from_slice(more);
            }
            Ok(Some(array_v2(&v2, value, attributes.map(|a| a.0).unwrap_or_default(), text)?))
        }
        None => Ok(None),
    }
}

fn array_v3(path: &Path, mut value: Value, text: Vec<u8>) -> Result<ArrayMeta> {
    let broken = |text: String| Error::file(path, format!("broken Zarr metadata: {text}"));
    if value["zarr_format"].as_u64() != Some(3) {
        return Err(broken(format!("zarr_format is {}; 3 is expected in zarr.json", value["zarr_format"])));
    }
    if value["fill_value"].is_null() {
        return Err(broken("no fill_value, which every array of Zarr v3 has".to_string()));
    }
    let shape = sizes(path, "shape", &value["shape"], None, 1)?;
    let axes = Some(shape.len());
    let name = value["data_type"].as_str().map_or_else(|| value["data_type"].to_string(), str::to_string);
    let dtype = DType::ALL.into_iter().find(|d| d.numpy_name() == name).ok_or_else(|| refuse(path, short(&name)))?;
    if value["chunk_grid"]["name"].as_str() != Some("regular") {
        let text: String = value["chunk_grid"].to_string().chars().take(100).collect();
        return Err(broken(format!("chunk_grid is {text}; only regular grids are read")));
    }
    let outer = sizes(path, "chunk_shape", &value["chunk_grid"]["configuration"]["chunk_shape"], axes, 1)?;
    let list = value["codecs"].as_array().ok_or_else(|| broken("no codecs".into()))?;
    let names = |list: &[Value]| list.iter().map(|c| codec_name(c).to_string()).collect::<Vec<_>>();
    let mut meta = ArrayMeta {
        version: 3,
        names: dimension_names(&value["dimension_names"], shape.len()),
        inner: outer.clone(),
        shard: None,
        codecs: names(list),
        packings: Vec::new(),
        value: Value::Null,
        shape,
        dtype,
        outer,
        text,
    };
    // A shard inside other codecs is decoded whole.
    if let [codec] = &list[..]
        && codec_name(codec) == "sharding_indexed"
    {
        let config = &codec["configuration"];
        meta.inner = sizes(path, "the shard's chunk_shape", &config["chunk_shape"], axes, 1)?;
        if meta.outer.iter().zip(&meta.inner).any(|(o, i)| o % i != 0) {
            return Err(broken(format!("chunks {:?} do not divide shards {:?}", meta.inner, meta.outer)));
        }
        let grid: Vec<u64> = meta.outer.iter().zip(&meta.inner).map(|(o, i)| o / i).collect();
        let entries = grid.iter().try_fold(1u64, |n, g| n.checked_mul(*g)).filter(|n| *n <= 1 << 24);
        entries.ok_or_else(|| broken(format!("a shard of {grid:?} chunks; at most 2^24 are read")))?;
        let index = names(config["index_codecs"].as_array().map_or(&[][..], |l| l));
        let little = config["index_codecs"][0]["configuration"]["endian"].as_str() != Some("big");
        let index_crc = index.get(1).is_some_and(|n| n == "crc32c");
        if !little || index.first().map(String::as_str) != Some("bytes") || index.len() > 1 + index_crc as usize {
            return Err(broken(format!("shard index codecs {index:?}; little-endian bytes and crc32c are read")));
        }
        let index_at_end = match config["index_location"].as_str() {
            None | Some("end") => true,
            Some("start") => false,
            Some(other) => return Err(broken(format!("index_location {other}; start or end are expected"))),
        };
        meta.codecs = names(config["codecs"].as_array().ok_or_else(|| broken("a shard without codecs".into()))?);
        let inner = &mut value["codecs"][0]["configuration"]["codecs"];
        meta.packings = take_outermost(inner);
        meta.shard = Some(ShardMeta { codecs: inner.clone(), index_at_end, index_crc, grid });
    } else {
        meta.packings = take_outermost(&mut value["codecs"]);
    }
    check_chunk(path, &meta)?;
    meta.value = value;
    Ok(meta)
}

fn array_v2(path: &Path, mut value: Value, attributes: Value, text: Vec<u8>) -> Result<ArrayMeta> {
    if value["zarr_format"].as_u64() != Some(2) {
        return Err(Error::file(path, format!("zarr_format is {}; 2 is expected in .zarray", value["zarr_format"])));
    }
    let shape = sizes(path, "shape", &value["shape"], None, 1)?;
    let outer = sizes(path, "chunks", &value["chunks"], Some(shape.len()), 1)?;
    let descr = value["dtype"].as_str().ok_or_else(|| refuse(path, "a structured type"))?;
    let dtype = numpy_type(path, descr)?.1;
    plain_fill(dtype, &mut value["fill_value"]);
    let filters = value["filters"].as_array().map_or(&[][..], |l| l);
    let ids = filters.iter().chain([&value["compressor"]]).filter_map(|c| c["id"].as_str());
    let codecs: Vec<String> = ids.map(str::to_string).collect();
    let packings = Vec::from_iter(value["compressor"]["id"].as_str().and_then(ChunkPacking::named));
    if !packings.is_empty() {
        value["compressor"] = Value::Null;
    }
    let meta = ArrayMeta {
        version: 2,
        names: dimension_names(&attributes["_ARRAY_DIMENSIONS"], shape.len()),
        inner: outer.clone(),
        shard: None,
        codecs,
        packings,
        value,
        shape,
        dtype,
        outer,
        text,
    };
    check_chunk(path, &meta)?;
    Ok(meta)
}

/// A fill value of Zarr v2 as the specification has it. zarr-python takes more, and writers rely on it: numbers as text (n5-zarr),
/// integers with a point.
fn plain_fill(dtype: DType, fill: &mut Value) {
    let number = match fill {
        Value::String(text) => text.trim().parse::<f64>().ok(),
        Value::Number(number) => number.as_f64(),
        _ => None,
    };
    let Some(v) = number.filter(|v| v.is_finite()) else { return };
    if dtype.is_float() {
        *fill = Value::from(v);
    } else if v.fract() == 0.0 && dtype.range().0 <= v && v <= dtype.range().1 {
        *fill = Value::from(v as i64);
    }
}

fn short(name: &str) -> &str {
    match name {
        "uint64" => "u64",
        "int64" => "i64",
        "float16" => "f16",
        other => other.get(..60).unwrap_or(other),
    }
}

fn dimension_names(value: &Value, axes: usize) -> Vec<Option<String>> {
    let list = value.as_array().map_or(&[][..], |l| l);
    (0..axes).map(|a| list.get(a)?.as_str().map(str::to_lowercase)).collect()
}

/// Refuses chunks that no sane memory holds, before anything of their size is allocated.
fn check_chunk(path: &Path, meta: &ArrayMeta) -> Result<()> {
    let size = meta.dtype.size() as u64;
    let bytes = meta.inner.iter().try_fold(size, |n, d| n.checked_mul(*d)).filter(|n| *n <= MOST_CHUNK_BYTES);
    let voxels = meta.shape.iter().try_fold(size, |n, d| n.checked_mul(*d)).filter(|n| *n < 1 << 62);
    if bytes.is_none() {
        let text = format!(
            "one chunk of {:?} {} is more than {MOST_CHUNK_BYTES} bytes when decoded; rechunk the array",
            meta.inner, meta.dtype
        );
        return Err(Error::file(path, text));
    }
    if voxels.is_none() {
        return Err(Error::file(
            path,
            format!("shape {:?} is larger than any store; the metadata are wrong", meta.shape),
        ));
    }
    Ok(())
}

/// What a group's multiscales say of one of its arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Multiscale {
    /// One per axis: `t`, `c`, `z`, `y`, `x` or others, with its type where given.
    pub axes: Vec<(String, Option<String>, Option<String>)>,
    pub scale: Vec<f64>,
    pub translation: Vec<f64>,
    pub labels: Vec<String>,
    pub version: String,
}

/// Attributes of a group; `None` where the folder is no Zarr group.
pub fn group(folder: &Path) -> Result<Option<(Value, u8)>> {
    if let Some((value, _)) = json(&folder.join("zarr.json"))? {
        return Ok((value["node_type"].as_str() == Some("group")).then(|| (value["attributes"].clone(), 3)));
    }
    let attributes = json(&folder.join(".zattrs"))?;
    if attributes.is_some() || folder.join(".zgroup").is_file() {
        return Ok(Some((attributes.map(|a| a.0).unwrap_or_default(), 2)));
    }
    Ok(None)
}

/// The multiscales entry of a group's attributes, OME-Zarr 0.5 or older.
fn multiscales(attributes: &Value) -> Option<(&Value, &Value)> {
    let root = if attributes["ome"].is_object() { &attributes["ome"] } else { attributes };
    root["multiscales"].as_array().and_then(|m| m.first()).map(|m| (root, m))
}

/// Path and metadata of dataset `level` of a group that is an image; `None` where it is not one.
pub fn dataset(input: &Input, folder: &Path, attributes: &Value) -> Result<Option<(PathBuf, Multiscale)>> {
    let Some((root, image)) = multiscales(attributes) else { return Ok(None) };
    let none = Vec::new();
    let datasets = image["datasets"].as_array().unwrap_or(&none);
    let Some(entry) = datasets.get(input.level) else {
        let have = datasets.len();
        let last = have.saturating_sub(1);
        let text = format!("{}: the image has {have} levels, 0 to {last}", input.level);
        return Err(Error::config(key(input, "level"), text));
    };
    let name = entry["path"].as_str().unwrap_or("");
    Ok(Some((inside(folder, name)?, multiscale(root, image, entry))))
}

/// Metadata that the group's multiscales give its array `name`, if it lists it.
pub fn named(attributes: &Value, name: &str) -> Option<Multiscale> {
    let (root, image) = multiscales(attributes)?;
    let entry = image["datasets"].as_array()?.iter().find(|d| d["path"].as_str() == Some(name))?;
    Some(multiscale(root, image, entry))
}

/// `name` inside `folder`; refuses names that lead out of it.
pub fn inside(folder: &Path, name: &str) -> Result<PathBuf> {
    let parts: Vec<&str> = name.split('/').filter(|p| !p.is_empty() && *p != ".").collect();
    if parts.is_empty() || parts.contains(&"..") || name.contains('\\') || name.contains('\0') {
        return Err(Error::file(folder, format!("`{name}` is no name of an array inside the group")));
    }
    Ok(parts.iter().fold(folder.to_path_buf(), |p, part| p.join(part)))
}

fn multiscale(root: &Value, image: &Value, entry: &Value) -> Multiscale {
    let text = |v: &Value| v.as_str().map(str::to_string);
    let axes = image["axes"].as_array().map_or(&[][..], |a| a);
    let axes: Vec<_> = axes
        .iter()
        .map(|a| match a.as_str() {
            Some(name) => (name.to_lowercase(), None, None), // 0.3
            None => {
                let unit = a["unit"].as_str().and_then(units::normalise);
                (a["name"].as_str().unwrap_or("").to_lowercase(), text(&a["type"]), unit)
            }
        })
        .collect();
    let (inner, outer) =
        (transforms(&entry["coordinateTransformations"]), transforms(&image["coordinateTransformations"]));
    let n = axes.len().max(inner.0.len()).max(inner.1.len()).min(MOST_AXES);
    let at = |list: &[f64], i: usize, or: f64| list.get(i).copied().unwrap_or(or);
    let scale = (0..n).map(|i| at(&inner.0, i, 1.0) * at(&outer.0, i, 1.0)).collect();
    let translation = (0..n).map(|i| at(&inner.1, i, 0.0) * at(&outer.0, i, 1.0) + at(&outer.1, i, 0.0)).collect();
    let channels = root["omero"]["channels"].as_array().map_or(&[][..], |c| c);
    let labels = channels.iter().map(|c| c["label"].as_str().unwrap_or("").to_string()).collect();
    let version = root["version"].as_str().or_else(|| image["version"].as_str()).unwrap_or("");
    Multiscale { axes, scale, translation, labels, version: version.to_string() }
}

/// Scale and translation of a list of transformations (empty: identity).
fn transforms(list: &Value) -> (Vec<f64>, Vec<f64>) {
    let (mut scale, mut translation) = (Vec::new(), Vec::new());
    for entry in list.as_array().map_or(&[][..], |l| l) {
        let numbers =
            |v: &Value| v.as_array().map_or(&[][..], |l| l).iter().map(|n| n.as_f64().unwrap_or(f64::NAN)).collect();
        match entry["type"].as_str() {
            Some("scale") => scale = numbers(&entry["scale"]),
            Some("translation") => translation = numbers(&entry["translation"]),
            _ => {}
        }
    }
    (scale, translation)
}

/// Arrays and groups directly inside a folder, for error messages.
pub fn children(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let node = |p: &Path| ["zarr.json", ".zarray", ".zgroup"].iter().any(|f| p.join(f).is_file());
    let mut names: Vec<String> = entries
        .flatten()
        .take(10_000)
        .filter(|e| node(&e.path()))
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort_by(|a, b| super::tiff::natural_cmp(a, b));
    names.truncate(12);
    names
}
