//! NRRD: attached (`.nrrd`) and detached (`.nhdr`) headers, encodings raw, gzip and bzip2.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::bytes;
use super::lattice::Lattice;
use super::parts::{self, Axis, Extra};
use super::planar::{Parsed, Pending, shape_of};
use super::raw::refuse;
use super::spool::{After, Packed, Packing};
use super::units;
use crate::config::Input;
use crate::grid::DType;
use crate::store::VolumeInfo;
use crate::store::info::Orientation;
use crate::{Error, Result};

/// Longest header that is read.
const MOST_HEADER: usize = 1 << 20;

/// Fields by their lower-case names, file names of `data file: LIST`, and the length of the header in bytes.
struct Header {
    fields: HashMap<String, String>,
    list: Vec<String>,
    len: usize,
}

impl Header {
    fn get(&self, name: &str) -> Option<&str> {
        self.fields.get(name).map(String::as_str)
    }
}

fn parse(path: &Path, head: &[u8]) -> Result<Header> {
    if !head.starts_with(b"NRRD000") {
        return Err(Error::file(path, "not a NRRD file: it does not start with NRRD000"));
    }
    let mut header = Header { fields: HashMap::new(), list: Vec::new(), len: 0 };
    let (mut at, mut line_no, mut in_list) = (0, 0, false);
    loop {
        let rest = &head[at..];
        let Some(end) = rest.iter().position(|b| *b == b'\n') else {
            // A detached header may end without an empty line.
            if head.len() < MOST_HEADER && !rest.is_empty() {
                take_line(path, &mut header, &String::from_utf8_lossy(rest), &mut in_list, line_no)?;
            }
            if head.len() >= MOST_HEADER {
                return Err(Error::file(path, format!("broken NRRD header: no empty line within {MOST_HEADER} bytes")));
            }
            header.len = head.len();
            return Ok(header);
        };
        let line = String::from_utf8_lossy(&rest[..end]);
        let line = line.trim_end_matches('\r');
        at += end + 1;
        if line.is_empty() {
            header.len = at;
            return Ok(header);
        }
        if line_no > 0 {
            take_line(path, &mut header, line, &mut in_list, line_no)?;
        }
        line_no += 1;
    }
}

fn take_line(path: &Path, header: &mut Header, line: &str, in_list: &mut bool, no: usize) -> Result<()> {
    if *in_list {
        header.list.push(line.trim().to_string());
        return Ok(());
    }
    if line.starts_with('#') || line.contains(":=") && !line.contains(": ") {
        return Ok(());
    }
    let Some((name, value)) = line.split_once(": ").or_else(|| line.trim_end().strip_suffix(':').map(|n| (n, "")))
    else {
        if line.contains(":=") {
            return Ok(());
        }
        return Err(Error::file(
            path,
            format!(
                "broken NRRD header, line {}: `{}` is no `field: value`",
                no + 1,
                line.chars().take(60).collect::<String>()
            ),
        ));
    };
    if name.contains(":=") {
        return Ok(()); // a key/value pair whose value has a colon
    }
    let name = name.trim().to_lowercase();
    let name = match name.as_str() {
        "datafile" => "data file",
        "lineskip" => "line skip",
        "byteskip" => "byte skip",
        "centers" => "centerings",
        "axismins" => "axis mins",
        other => other,
    };
    *in_list = name == "data file" && value.split_whitespace().next() == Some("LIST");
    header.fields.insert(name.to_string(), value.trim().to_string());
    Ok(())
}

fn dtype(path: &Path, text: &str) -> Result<DType> {
    let words: Vec<_> = text.split_whitespace().collect();
    Ok(match words.join(" ").as_str() {
        "signed char" | "int8" | "int8_t" => DType::I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => DType::U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => DType::I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => DType::U16,
        "int" | "signed int" | "int32" | "int32_t" => DType::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => DType::U32,
        "float" => DType::F32,
        "double" => DType::F64,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => {
            return Err(refuse(path, "i64"));
        }
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
            return Err(refuse(path, "u64"));
        }
        other => return Err(refuse(path, other)),
    })
}

/// Numbers of one field; an error names it.
fn numbers<T: std::str::FromStr>(path: &Path, h: &Header, name: &str, count: usize) -> Result<Option<Vec<T>>> {
    let Some(text) = h.get(name) else { return Ok(None) };
    let broken =
        || Error::file(path, format!("broken NRRD header: `{name}: {text}`, where {count} numbers are expected"));
    let list: Vec<T> = text.split_whitespace().map(|w| w.parse()).collect::<Result<_, _>>().map_err(|_| broken())?;
    if list.len() == count { Ok(Some(list)) } else { Err(broken()) }
}

/// `(1,0,0) none (0,1,0)`: one vector or nothing per axis.
fn vectors(path: &Path, name: &str, text: &str) -> Result<Vec<Option<Vec<f64>>>> {
    let broken = || {
        Error::file(path, format!("broken NRRD header: `{name}: {text}`, where vectors such as (1,0,0) are expected"))
    };
    let (mut out, mut rest) = (Vec::new(), text.trim());
    while !rest.is_empty() {
        if let Some(tail) = rest.strip_prefix("none") {
            out.push(None);
            rest = tail.trim_start();
        } else {
            let (vector, tail) = rest.strip_prefix('(').and_then(|r| r.split_once(')')).ok_or_else(broken)?;
            let vector: Vec<f64> =
                vector.split(',').map(|w| w.trim().parse()).collect::<Result<_, _>>().map_err(|_| broken())?;
            out.push(Some(vector));
            rest = tail.trim_start();
        }
        if out.len() > 16 {
            return Err(broken());
        }
    }
    Ok(out)
}

/// Quoted or bare words: `"mm" "mm" "mm"`.
fn words(text: &str) -> Vec<String> {
    if text.contains('"') {
        text.split('"').skip(1).step_by(2).map(str::to_string).collect()
    } else {
        text.split_whitespace().map(str::to_string).collect()
    }
}

/// Short name of a space and whether it is a medical one (which is in millimetres).
fn space_name(text: &str) -> (String, bool) {
    let low = text.to_lowercase();
    let short = match low.as_str() {
        "right-anterior-superior" | "ras" => "RAS",
        "left-anterior-superior" | "las" => "LAS",
        "left-posterior-superior" | "lps" => "LPS",
        "right-anterior-superior-time" | "rast" => "RAST",
        "left-anterior-superior-time" | "last" => "LAST",
        "left-posterior-superior-time" | "lpst" => "LPST",
        "scanner-xyz" | "scanner-xyz-time" => return (low, true),
        _ => return (text.to_string(), false),
    };
    (short.to_string(), true)
}

/// What each axis is, fastest first: space or an extra one.
fn axes(path: &Path, h: &Header, sizes: &[u64], directions: &[Option<Vec<f64>>]) -> Result<Vec<Axis>> {
    let kinds: Vec<String> = h.get("kinds").map(words).unwrap_or_default().iter().map(|k| k.to_lowercase()).collect();
    let spacings = numbers::<f64>(path, h, "spacings", sizes.len())?.unwrap_or_default();
    // Among more than three axes, those without a spacing are none of space.
    let measured = sizes.len() > 3 && spacings.iter().filter(|s| !s.is_nan()).count() >= 3;
    let spatial = |a: usize| match directions.get(a) {
        Some(direction) => direction.is_some(),
        None if kinds.is_empty() && measured => !spacings[a].is_nan(),
        None => kinds.get(a).is_none_or(|k| matches!(k.as_str(), "domain" | "space" | "???" | "none")),
    };
    let mut seen = 0;
    let mut out = Vec::new();
    for (a, size) in sizes.iter().enumerate() {
        let kind = kinds.get(a).map_or("", String::as_str);
        if kind.contains("color") || kind.starts_with("complex") || kind.starts_with("quaternion") {
            return Err(refuse(path, &format!("{kind} (axis {a})")));
        }
        if spatial(a) && kind != "time" && seen < 3 {
            out.push(Axis::Space(*size));
            seen += 1;
        } else if kind == "time" || seen == 3 && matches!(kind, "" | "domain" | "space" | "???" | "none") {
            out.push(Axis::Extra(Extra::Time, *size));
        } else {
            out.push(Axis::Extra(Extra::Channel, *size));
        }
    }
    Ok(out)
}

/// Where an axis begins and ends.
struct Span {
    min: Option<f64>,
    max: Option<f64>,
    /// Samples stand in the middle of cells of which the first begins at `min`; else the first stands there.
    cells: bool,
}

impl Span {
    /// From sample to sample of `n`, where both ends are known.
    fn spacing(&self, n: u64) -> Option<f64> {
        let steps = if self.cells { n } else { n.saturating_sub(1) } as f64;
        Some((self.max? - self.min?) / steps).filter(|s| s.is_finite() && *s != 0.0)
    }

    /// Place of the first sample.
    fn first(&self, spacing: f64) -> Option<f64> {
        Some(self.min? + if self.cells { 0.5 * spacing } else { 0.0 })
    }
}

/// `axis mins` and `axis maxs` of all axes. Where the header does not say how samples are centred, cells are meant if both ends are
/// there, as teem takes it.
fn spans(path: &Path, h: &Header, count: usize) -> Result<Vec<Span>> {
    let ends = |name| Ok(numbers::<f64>(path, h, name, count)?.unwrap_or_default());
    let (mins, maxs): (Vec<f64>, Vec<f64>) = (ends("axis mins")?, ends("axis maxs")?);
    let centres = h.get("centerings").map(words).unwrap_or_default();
    let known = |list: &[f64], a: usize| list.get(a).copied().filter(|v| v.is_finite());
    let one = |a: usize| {
        let (min, max) = (known(&mins, a), known(&maxs, a));
        let cells = match centres.get(a).map(|c| c.to_lowercase()).as_deref() {
            Some("cell") => true,
            Some("node") => false,
            _ => min.is_some() && max.is_some(),
        };
        Span { min, max, cells }
    };
    Ok((0..count).map(one).collect())
}

/// Spacing, unit and orientation into `info`.
fn geometry(
    path: &Path,
    h: &Header,
    axes: &[Axis],
    directions: &[Option<Vec<f64>>],
    info: &mut VolumeInfo,
) -> Result<()> {
    let space: Vec<usize> = (0..axes.len()).filter(|a| matches!(axes[*a], Axis::Space(_))).collect();
    // NaN marks axes without a spacing.
    let spacings = numbers::<f64>(path, h, "spacings", axes.len())?.unwrap_or_default();
    let spans = spans(path, h, axes.len())?;
    // Signed: mins and maxs may run backwards.
    let mut steps = [1.0; 3];
    for (i, &a) in space.iter().enumerate() {
        let own = spacings.get(a).copied().filter(|s| !s.is_nan()).map(f64::abs);
        steps[2 - i] = own.or_else(|| spans[a].spacing(axes[a].size())).unwrap_or(1.0);
        info.spacing[2 - i] = steps[2 - i].abs();
    }
    let (name, medical) = h.get("space").map(space_name).unwrap_or_default();
    let origin = h.get("space origin").map(|t| vectors(path, "space origin", t)).transpose()?;
    let origin = origin.and_then(|o| o.into_iter().next().flatten()).unwrap_or_default();
    if !directions.is_empty() {
        if directions.len() != axes.len() {
            let text = format!("broken NRRD header: {} space directions for {} axes", directions.len(), axes.len());
            return Err(Error::file(path, text));
        }
        let mut matrix = [[0.0; 4]; 3];
        for (i, a) in space.iter().enumerate() {
            let Some(v) = &directions[*a] else { continue };
            if v.len() > 4 || v.iter().any(|n| !n.is_finite()) {
                return Err(Error::file(path, format!("broken NRRD header: space direction {v:?} of axis {a}")));
            }
            info.spacing[2 - i] = v.iter().take(3).map(|n| n * n).sum::<f64>().sqrt();
            (0..3).for_each(|r| matrix[r][i] = v.get(r).copied().unwrap_or(0.0));
        }
        (space.len()..3).for_each(|i| matrix[i][i] = 1.0); // axes that the file lacks
        (0..3).for_each(|r| matrix[r][3] = origin.get(r).copied().filter(|v| v.is_finite()).unwrap_or(0.0));
        info.orientation = Some(Orientation { matrix, space: if name.is_empty() { "unknown".into() } else { name } });
    } else {
        for r in 0..3 {
            let min = || space.get(r).and_then(|a| spans[*a].first(steps[2 - r]));
            let known = |v: &f64| v.is_finite();
            info.origin[2 - r] = origin.get(r).copied().filter(known).or_else(min).unwrap_or(0.0);
        }
    }
    let named: Vec<Option<String>> = match (h.get("space units"), h.get("units")) {
        (Some(text), _) => words(text).iter().map(|w| units::normalise(w)).collect(),
        (None, Some(text)) => {
            let all = words(text);
            space.iter().map(|a| all.get(*a).and_then(|w| units::normalise(w))).collect()
        }
        (None, None) => Vec::new(),
    };
    let mut known = named.iter().take(space.len()).flatten();
    info.unit = known.next().cloned();
    if let Some(other) = known.find(|u| Some(*u) != info.unit.as_ref()) {
        let first = info.unit.as_deref().unwrap_or("");
        return Err(Error::file(
            path,
            format!("the NRRD axes have different units ({first}, {other}); one is expected"),
        ));
    }
    if info.unit.is_none() && medical {
        info.unit = Some("millimeter".to_string());
    }
    Ok(())
}

/// Files that hold the voxels, and how many axes each of them spans (`None`: all).
fn data_files(path: &Path, h: &Header) -> Result<Option<(Vec<PathBuf>, Option<usize>)>> {
    let Some(text) = h.get("data file") else { return Ok(None) };
    let folder = path.parent().unwrap_or(Path::new(""));
    let words: Vec<&str> = text.split_whitespace().collect();
    let sub = |word: Option<&&str>| -> Result<Option<usize>> {
        let Some(word) = word else { return Ok(None) };
        let broken =
            || Error::file(path, format!("broken NRRD header: `data file: {text}`: `{word}` is no number of axes"));
        Ok(Some(word.parse().map_err(|_| broken())?))
    };
    if words.first() == Some(&"LIST") {
        let names = h.list.iter().filter(|n| !n.is_empty()).map(|n| folder.join(n)).collect();
        return Ok(Some((names, sub(words.get(1))?)));
    }
    if words.len() >= 4 && words[0].contains('%') {
        let number = |i: usize| words[i].parse::<i64>().ok();
        if let (Some(from), Some(to), Some(by)) = (number(1), number(2), number(3)) {
            return Ok(Some((parts::pattern(path, folder, words[0], from, to, by)?, sub(words.get(4))?)));
        }
    }
    Ok(Some((vec![folder.join(text)], None)))
}

/// Opens a NRRD file with its header attached or detached.
pub fn open(input: &Input, path: &Path) -> Result<Parsed> {
    let head = bytes::file_head(path, MOST_HEADER)?;
    let h = parse(path, &head)?;
    let missing = |name: &str| Error::file(path, format!("broken NRRD header: no `{name}`"));
    let dimension: usize = h
        .get("dimension")
        .ok_or_else(|| missing("dimension"))?
        .parse()
        .ok()
        .filter(|n| (1..=16).contains(n))
        .ok_or_else(|| {
            Error::file(path, format!("broken NRRD header: dimension {:?}; 1 to 16 are possible", h.get("dimension")))
        })?;
    let sizes: Vec<u64> = numbers(path, &h, "sizes", dimension)?.ok_or_else(|| missing("sizes"))?;
    let dtype = dtype(path, h.get("type").ok_or_else(|| missing("type"))?)?;
    // Before the byte order, which text has none of.
    let packing = match h.get("encoding").ok_or_else(|| missing("encoding"))?.to_lowercase().as_str() {
        "raw" => None,
        "gzip" | "gz" => Some(Packing::Gzip),
        "bzip2" | "bz2" => Some(Packing::Bzip2),
        other => return Err(Error::file(path, format!("NRRD encoding {other} is not read; raw, gzip and bzip2 are"))),
    };
    let big_endian = match h.get("endian").map(str::to_lowercase).as_deref() {
        Some("big") => true,
        Some("little") => false,
        None if dtype.size() == 1 => false,
        None => return Err(missing("endian")),
        Some(other) => {
            return Err(Error::file(path, format!("broken NRRD header: endian `{other}`; little or big are expected")));
        }
    };
    let directions =
        h.get("space directions").map(|t| vectors(path, "space directions", t)).transpose()?.unwrap_or_default();
    let axes = axes(path, &h, &sizes, &directions)?;
    let layout = parts::layout(input, path, &axes, dtype)?;
    let shape = shape_of(path, layout.zyx, dtype.size())?;
    let mut info = VolumeInfo::plain(shape, dtype, format!("NRRD, {}", packing.map_or("raw", Packing::name)));
    (info.components, info.component_names) = (layout.bases.len(), layout.names.clone());
    info.times = layout.times as usize;
    geometry(path, &h, &axes, &directions, &mut info)?;

    let skip_lines = skip(path, &h, "line skip")?;
    let skip_bytes = skip(path, &h, "byte skip")?;
    let lattice = |base: u64| -> Result<Lattice> {
        layout.lattice(shape, dtype, big_endian, base).ok_or_else(|| Error::file(path, "the NRRD sizes overflow"))
    };
    let header = head[..h.len].to_vec();
    let (files, spanned) = data_files(path, &h)?.unwrap_or_else(|| (vec![path.to_path_buf()], None));
    let attached = h.get("data file").is_none();
    if attached && h.len >= head.len() {
        return Err(Error::file(
            path,
            "the NRRD header is not followed by voxels; a detached header needs `data file`",
        ));
    }
    if files.len() != 1 || spanned.is_some() {
        if packing.is_some() || skip_lines > 0 {
            return Err(Error::file(
                path,
                "several NRRD data files are read with encoding raw and without line skip only",
            ));
        }
        let base = u64::try_from(skip_bytes)
            .map_err(|_| Error::file(path, "byte skip -1 is not read with several data files"))?;
        let lattice = parts::over_files(path, lattice(0)?, &axes, files.len(), spanned, base)?;
        return Ok(Parsed { info, lattice, files, pending: Pending::Nothing, header, exact: false });
    }
    let file = &files[0];
    let start = parts::skip_lines(file, if attached { h.len as u64 } else { 0 }, skip_lines as u64)?;
    if let Some(packing) = packing {
        let skip = u64::try_from(skip_bytes).map_err(|_| Error::file(path, "byte skip -1 is for encoding raw only"))?;
        let packed = Packed { path: file.clone(), packing, start, skip, len: layout.bytes, after: After::Allowed };
        return Ok(Parsed {
            info,
            lattice: lattice(0)?,
            files,
            pending: Pending::Unpack(packed),
            header,
            exact: false,
        });
    }
    let base = if skip_bytes == -1 {
        let have = bytes::file_len(file)?;
        let short = || Error::file(file, format!("has {have} bytes, but the header asks for {}", layout.bytes));
        have.checked_sub(layout.bytes).ok_or_else(short)?
    } else {
        start.checked_add(skip_bytes as u64).ok_or_else(|| Error::file(path, "byte skip overflows"))?
    };
    Ok(Parsed { info, lattice: lattice(base)?, files, pending: Pending::Nothing, header, exact: false })
}

fn skip(path: &Path, h: &Header, name: &str) -> Result<i64> {
    let Some(text) = h.get(name) else { return Ok(0) };
    let least = if name == "byte skip" { -1 } else { 0 };
    text.parse().ok().filter(|n| (least..1 << 48).contains(n)).ok_or_else(|| {
        Error::file(path, format!("broken NRRD header: `{name}: {text}`, where a number from {least} is expected"))
    })
}
