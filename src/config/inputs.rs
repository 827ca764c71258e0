//! `[input.NAME]` to [`Input`].

use std::path::Path;

use super::keys::{SYNTHETIC, Section};
use super::section::Reader;
use super::tree::Node;
use super::{Input, InputKind, RawFormat, join_path, read};
use crate::Result;
use crate::grid::DType;

/// Reads one input.
pub fn read(name: &str, node: &Node, base: &Path) -> Result<Input> {
    let r = Reader::new(Section::Input, format!("input.{name}"), "", node)?;
    let kind = match (r.has("path"), r.has("synthetic")) {
        (true, false) => file(&r, base)?,
        (false, true) => synthetic(&r)?,
        (true, true) => return Err(r.error("synthetic", "path and synthetic are both given; expected one of them")),
        (false, false) => return Err(r.error("path", "missing; expected path = \"file\" or synthetic = \"field\"")),
    };
    if r.has("array") && r.has("level") {
        return Err(r.error("array", "array and level are both given; expected one of them"));
    }
    Ok(Input {
        name: name.to_string(),
        level: r.int("level")? as usize,
        array: r.opt("array", |n| read::non_empty(n).map(String::from))?,
        channel: r.get("channel", read::select)?,
        time: r.get("time", read::select)?,
        spacing: r.opt("spacing", read::spacing)?,
        unit: r.opt("unit", read::unit)?,
        origin: r.opt("origin", read::position)?,
        slope: r.opt("slope", slope)?,
        intercept: r.opt_number("intercept")?,
        nodata: r.opt("nodata", nodata)?,
        kind,
        place: r.place,
    })
}

/// A factor; NaN means "no scaling", as it does in a NIfTI header.
fn slope(node: &Node) -> Result<f64, read::Bad> {
    match node.value {
        super::tree::Value::Float(v) if v.is_nan() => Ok(v),
        _ => read::number(node),
    }
}

/// A stored value; NaN is what floats use anyway.
fn nodata(node: &Node) -> Result<f64, read::Bad> {
    match node.value {
        super::tree::Value::Float(v) => Ok(v),
        _ => read::number(node),
    }
}

fn synthetic(r: &Reader) -> Result<InputKind> {
    refuse(r, &["format", "endian", "offset", "trailing", "array", "level"], "is for files, not for synthetic fields")?;
    if !r.has("shape") {
        return Err(r.error("shape", "missing; a synthetic field needs shape = [z, y, x]"));
    }
    Ok(InputKind::Synthetic {
        field: r.choice("synthetic", &SYNTHETIC.iter().map(|f| (*f, *f)).collect::<Vec<_>>())?.to_string(),
        shape: r.get("shape", read::shape)?,
        dtype: r.opt("dtype", read::dtype)?.unwrap_or(DType::U8),
        seed: r.int("seed")? as u64,
    })
}

fn file(r: &Reader, base: &Path) -> Result<InputKind> {
    refuse(r, &["seed"], "is for synthetic fields")?;
    let path = r.get("path", |n| join_path(n, base))?;
    let said_raw = r.choice("format", &[("auto", false), ("raw", true)])?;
    if !(said_raw || looks_raw(&path)) {
        let keys = ["shape", "dtype", "endian", "offset", "trailing"];
        refuse(r, &keys, "describes headerless data; expected format = \"raw\" beside it, or no such key")?;
        return Ok(InputKind::Path { path, raw: None });
    }
    for key in ["shape", "dtype"] {
        if !r.has(key) {
            let file = path.file_name().unwrap_or_default().to_string_lossy();
            let message = format!(
                "missing; {file} is headerless and needs format = \"raw\", shape = [z, y, x], dtype = \"u8\" (and endian, offset where they differ from \"little\", 0)"
            );
            return Err(r.error(key, message));
        }
    }
    let big = cfg!(target_endian = "big");
    let raw = RawFormat {
        shape: r.get("shape", read::shape)?,
        dtype: r.get("dtype", read::dtype)?,
        big_endian: r.choice("endian", &[("little", false), ("big", true), ("native", big)])?,
        offset: r.int("offset")? as u64,
        trailing_ignore: r.choice("trailing", &[("refuse", false), ("ignore", true)])?,
        components: 1,
    };
    Ok(InputKind::Path { path, raw: Some(raw) })
}

/// `.raw` and `.bin`, also gzipped.
fn looks_raw(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let stem = name.strip_suffix(".gz").unwrap_or(&name);
    stem.ends_with(".raw") || stem.ends_with(".bin")
}

fn refuse(r: &Reader, names: &[&str], why: &str) -> Result<()> {
    match names.iter().find(|n| r.has(n)) {
        Some(name) => Err(r.error(name, why)),
        None => Ok(()),
    }
}
