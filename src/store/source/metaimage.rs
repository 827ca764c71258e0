//! MetaImage: `.mha` (header and voxels in one file) and `.mhd` (voxels beside it), plain or zlib.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::bytes;
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

struct Header {
    fields: HashMap<String, String>,
    /// Lines after `ElementDataFile = LIST`.
    list: Vec<String>,
    /// Bytes up to the end of the `ElementDataFile` line.
    len: usize,
}

fn parse(path: &Path, head: &[u8]) -> Result<Header> {
    let mut header = Header { fields: HashMap::new(), list: Vec::new(), len: 0 };
    let mut at = 0;
    while at < head.len() {
        let end = head[at..].iter().position(|b| *b == b'\n').unwrap_or(head.len() - at);
        let line = String::from_utf8_lossy(&head[at..at + end]).trim().to_string();
        at = (at + end + 1).min(head.len());
        if line.is_empty() {
            continue;
        }
        let Some((name, value)) = line.split_once('=') else {
            let text = line.chars().take(60).collect::<String>();
            return Err(Error::file(path, format!("broken MetaImage header: `{text}` is no `Name = value`")));
        };
        let (name, value) = (name.trim().to_lowercase(), value.trim().to_string());
        let last = name == "elementdatafile";
        header.fields.insert(name, value.clone());
        if last {
            header.len = at;
            if value.split_whitespace().next() == Some("LIST") {
                let rest = String::from_utf8_lossy(&head[at..]);
                header.list = rest.lines().map(str::trim).filter(|l| !l.is_empty()).map(str::to_string).collect();
            }
            return Ok(header);
        }
    }
    Err(Error::file(path, "broken MetaImage header: no ElementDataFile"))
}

impl Header {
    fn get(&self, names: &[&str]) -> Option<&str> {
        names.iter().find_map(|n| self.fields.get(&n.to_lowercase())).map(String::as_str)
    }

    fn flag(&self, names: &[&str]) -> bool {
        self.get(names).is_some_and(|v| v.starts_with(['T', 't', '1']))
    }

    fn numbers<T: std::str::FromStr>(&self, path: &Path, names: &[&str], count: usize) -> Result<Option<Vec<T>>> {
        let Some(text) = self.get(names) else { return Ok(None) };
        let broken = || {
            let name = names[0];
            Error::file(path, format!("broken MetaImage header: `{name} = {text}`, where {count} numbers are expected"))
        };
        let list: Vec<T> =
            text.split_whitespace().map(|w| w.parse()).collect::<Result<_, _>>().map_err(|_| broken())?;
        if list.len() == count { Ok(Some(list)) } else { Err(broken()) }
    }
}

fn dtype(path: &Path, text: &str) -> Result<DType> {
    Ok(match text {
        "MET_UCHAR" => DType::U8,
        "MET_CHAR" => DType::I8,
        "MET_USHORT" => DType::U16,
        "MET_SHORT" => DType::I16,
        "MET_UINT" | "MET_ULONG" => DType::U32,
        "MET_INT" | "MET_LONG" => DType::I32,
        "MET_FLOAT" => DType::F32,
        "MET_DOUBLE" => DType::F64,
        "MET_LONG_LONG" => return Err(refuse(path, "i64 (MET_LONG_LONG)")),
        "MET_ULONG_LONG" => return Err(refuse(path, "u64 (MET_ULONG_LONG)")),
        other => return Err(refuse(path, other)),
    })
}

/// Spacing, unit and direction matrix. A row of `TransformMatrix` is the direction of one axis; the world is LPS.
fn geometry(path: &Path, h: &Header, dims: usize, info: &mut VolumeInfo) -> Result<()> {
    let spacing: Option<Vec<f64>> = h.numbers(path, &["ElementSpacing", "ElementSize"], dims)?;
    let offset: Option<Vec<f64>> = h.numbers(path, &["Offset", "Position", "Origin"], dims)?;
    let rows: Option<Vec<f64>> = h.numbers(path, &["TransformMatrix", "Rotation", "Orientation"], dims * dims)?;
    let space = dims.min(3);
    let mut matrix = [[0.0; 4]; 3];
    for i in 0..3 {
        let size = spacing.as_ref().filter(|_| i < space).map_or(1.0, |s| s[i].abs());
        info.spacing[2 - i] = size;
        for (k, row) in matrix.iter_mut().enumerate() {
            let identity = (i == k) as u8 as f64;
            let direction = rows.as_ref().filter(|_| i < space && k < space).map_or(identity, |m| m[i * dims + k]);
            row[i] = direction * size;
        }
        matrix[i][3] = offset.as_ref().filter(|_| i < space).map_or(0.0, |o| o[i]);
    }
    if matrix.iter().flatten().all(|v| v.is_finite()) {
        info.orientation = Some(Orientation { matrix, space: "LPS".to_string() });
    }
    info.unit = h.get(&["DistanceUnits"]).and_then(units::normalise).or_else(|| Some("millimeter".to_string()));
    Ok(())
}

/// Files with the voxels, whether they are the header's own file, and how many axes each spans. A pattern without an end names so
/// many slices.
fn data_files(path: &Path, h: &Header, slices: u64) -> Result<(Vec<PathBuf>, bool, Option<usize>)> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let text = h.get(&["ElementDataFile"]).unwrap_or_default();
    let words: Vec<&str> = text.split_whitespace().collect();
    match words.first() {
        Some(&"LOCAL" | &"Local" | &"local") => return Ok((vec![path.to_path_buf()], true, None)),
        Some(&"LIST") => {
            let axes = words.get(1).and_then(|w| w.trim_end_matches(['D', 'd']).parse().ok());
            return Ok((h.list.iter().map(|n| folder.join(n)).collect(), false, axes));
        }
        Some(first) if first.contains('%') => {
            let number = |i: usize, or: i64| words.get(i).and_then(|w| w.parse().ok()).unwrap_or(or);
            let (from, step) = (number(1, 1), number(3, 1));
            let to = number(2, from.saturating_add(i64::try_from(slices).unwrap_or(i64::MAX).saturating_sub(1)));
            return Ok((parts::pattern(path, folder, first, from, to, step)?, false, None));
        }
        None => return Err(Error::file(path, "broken MetaImage header: ElementDataFile is empty")),
        _ => {}
    }
    Ok((vec![folder.join(text)], false, None))
}

/// Opens a MetaImage. Axis 4 is time, `ElementNumberOfChannels` the channels (interleaved).
pub fn open(input: &Input, path: &Path) -> Result<Parsed> {
    let head = bytes::file_head(path, MOST_HEADER)?;
    let h = parse(path, &head)?;
    let broken = |text: String| Error::file(path, format!("broken MetaImage header: {text}"));
    if h.get(&["ObjectType"]).is_some_and(|t| !t.eq_ignore_ascii_case("image")) {
        return Err(Error::file(
            path,
            format!("ObjectType {}: only Image is read", h.get(&["ObjectType"]).unwrap_or("")),
        ));
    }
    if h.get(&["BinaryData"]).is_some() && !h.flag(&["BinaryData"]) {
        return Err(Error::file(
            path,
            "MetaImage voxels as text (BinaryData = False) are not read; save them as binary",
        ));
    }
    let dims = h.get(&["NDims"]).and_then(|t| t.parse::<usize>().ok()).filter(|n| (1..=8).contains(n));
    let dims = dims.ok_or_else(|| broken(format!("NDims {:?}; 1 to 8 are possible", h.get(&["NDims"]))))?;
    let sizes: Vec<u64> = h.numbers(path, &["DimSize"], dims)?.ok_or_else(|| broken("no DimSize".into()))?;
    let dtype = dtype(path, h.get(&["ElementType"]).ok_or_else(|| broken("no ElementType".into()))?)?;
    let big_endian = h.flag(&["ElementByteOrderMSB", "BinaryDataByteOrderMSB"]);
    let channels = h.numbers::<u64>(path, &["ElementNumberOfChannels"], 1)?.map_or(1, |n| n[0]);
    let mut axes = vec![Axis::Extra(Extra::Channel, channels)];
    axes.extend(
        sizes.iter().enumerate().map(|(a, n)| if a < 3 { Axis::Space(*n) } else { Axis::Extra(Extra::Time, *n) }),
    );
    let layout = parts::layout(input, path, &axes, dtype)?;
    let shape = shape_of(path, layout.zyx, dtype.size())?;
    let packed = h.flag(&["CompressedData"]);
    let mut info = VolumeInfo::plain(shape, dtype, if packed { "MetaImage, zlib" } else { "MetaImage" });
    (info.components, info.component_names) = (layout.bases.len(), layout.names.clone());
    info.times = layout.times as usize;
    geometry(path, &h, dims, &mut info)?;

    let (files, local, spanned) = data_files(path, &h, sizes[dims - 1])?;
    let skip = h.numbers::<i64>(path, &["HeaderSize"], 1)?.map_or(0, |n| n[0]);
    if !(-1..1 << 48).contains(&skip) {
        return Err(broken(format!("HeaderSize {skip}; a number from -1 is expected")));
    }
    let lattice =
        |base: u64| layout.lattice(shape, dtype, big_endian, base).ok_or_else(|| broken("the sizes overflow".into()));
    let header = head[..h.len].to_vec();
    if files.len() != 1 || spanned.is_some() {
        if packed || skip < 0 {
            return Err(Error::file(
                path,
                "several MetaImage data files are read uncompressed and without HeaderSize -1 only",
            ));
        }
        let spanned = spanned.map(|n: usize| n.saturating_add(1)); // the channel axis counts
        let lattice = parts::over_files(path, lattice(0)?, &axes, files.len(), spanned, skip as u64)?;
        return Ok(Parsed { info, lattice, files, pending: Pending::Nothing, header, exact: false });
    }
    // A positive HeaderSize counts from the start of the file, whichever that is.
    let start = if local && skip <= 0 { h.len as u64 } else { 0 };
    if packed {
        let start = start + skip.max(0) as u64;
        let packed = Packed {
            path: files[0].clone(),
            packing: Packing::Zlib,
            start,
            skip: 0,
            len: layout.bytes,
            after: After::Refused,
        };
        return Ok(Parsed {
            info,
            lattice: lattice(0)?,
            files,
            pending: Pending::Unpack(packed),
            header,
            exact: false,
        });
    }
    let base = if skip == -1 {
        let have = bytes::file_len(&files[0])?;
        let short = || Error::file(&files[0], format!("has {have} bytes, but the header asks for {}", layout.bytes));
        have.checked_sub(layout.bytes).ok_or_else(short)?
    } else {
        start + skip as u64
    };
    Ok(Parsed { info, lattice: lattice(base)?, files, pending: Pending::Nothing, header, exact: false })
}
