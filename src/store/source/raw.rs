//! Headerless voxels and NumPy's `.npy`.

use std::path::Path;

use super::bytes;
use super::lattice::{Lattice, Planes};
use super::planar::{Parsed, Pending, components, key, shape_of};
use super::spool::{After, Packed, Packing};
use crate::config::{Input, RawFormat};
use crate::grid::DType;
use crate::store::VolumeInfo;
use crate::{Error, Result};

/// `format = "raw"`, plain or gzip (by its first two bytes).
pub fn open_raw(input: &Input, path: &Path, raw: &RawFormat) -> Result<Parsed> {
    let start = bytes::file_head(path, 2)?;
    if let Some(axis) = raw.shape.iter().position(|n| *n == 0) {
        let text = format!("{:?}: axis {axis} is 0; every axis needs at least 1 voxel", raw.shape);
        return Err(Error::config(key(input, "shape"), text));
    }
    let shape = shape_of(path, raw.shape.map(|n| n as u64), raw.dtype.size())
        .map_err(|_| Error::config(key(input, "shape"), format!("{:?} is larger than any file", raw.shape)))?;
    let too_far = || Error::config(key(input, "offset"), format!("{} is larger than any file", raw.offset));
    let one = shape.iter().product::<usize>() as u64 * raw.dtype.size() as u64;
    let all = one.checked_mul(raw.components as u64).ok_or_else(too_far)?;
    let (pairs, names) = components(input, 1, raw.components, &[])?;
    let lattice = |base: u64| {
        base.checked_add(all).ok_or_else(too_far)?;
        let mut lattice = Lattice::dense(shape, raw.dtype, raw.big_endian, base).ok_or_else(too_far)?;
        if let Planes::Even { bases, .. } = &mut lattice.planes {
            *bases = pairs.iter().map(|(_, c)| base + *c as u64 * one).collect();
        }
        Ok::<_, Error>(lattice)
    };
    let packed = start == [0x1f, 0x8b] && path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz"));
    let (lattice, pending) = if packed {
        lattice(raw.offset)?;
        let after = if raw.trailing_ignore { After::Ignored } else { After::Refused };
        let path = path.to_path_buf();
        let packed = Packed { path, packing: Packing::Gzip, start: 0, skip: raw.offset, len: all, after };
        (lattice(0)?, Pending::Unpack(packed))
    } else {
        (lattice(raw.offset)?, Pending::Nothing)
    };
    let mut info = VolumeInfo::plain(shape, raw.dtype, if packed { "raw, gzip" } else { "raw" });
    (info.components, info.component_names) = (pairs.len(), names);
    let header = format!("{raw:?}").into_bytes();
    Ok(Parsed { info, lattice, files: vec![path.to_path_buf()], pending, header, exact: !raw.trailing_ignore })
}

/// Longest `.npy` header that is read.
const MOST_NPY_HEADER: usize = 1 << 16;

/// NumPy's format, versions 1 to 3, C and Fortran order. Axes are `[z, y, x]`, or `[c, z, y, x]` as outputs of several
/// components have them; leading axes beyond four must be 1.
pub fn open_npy(input: &Input, path: &Path) -> Result<Parsed> {
    let head = bytes::file_head(path, MOST_NPY_HEADER + 12)?;
    let broken = |text: &str| Error::file(path, format!("broken .npy header: {text}"));
    if head.len() < 12 || !head.starts_with(b"\x93NUMPY") {
        return Err(broken("it does not start with \\x93NUMPY and a version"));
    }
    let (start, len) = match head[6] {
        1 => (10, u16::from_le_bytes([head[8], head[9]]) as usize),
        2 | 3 => (12, u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize),
        v => return Err(broken(&format!("version {v}; 1, 2 and 3 are known"))),
    };
    if len > MOST_NPY_HEADER || head.len() < start + len {
        return Err(broken(&format!("it says that it is {len} bytes long, which the file does not have")));
    }
    let text = String::from_utf8_lossy(&head[start..start + len]);
    let value = |name: &str| {
        let at = text.find(&format!("'{name}'"))? + name.len() + 2;
        Some(text[at..].trim_start().strip_prefix(':')?.trim_start())
    };
    let descr = value("descr").ok_or_else(|| broken("no 'descr'"))?;
    let quoted = descr.strip_prefix('\'').and_then(|d| d.split('\'').next());
    let descr = quoted.ok_or_else(|| Error::file(path, "structured .npy arrays are not read; save one plain array"))?;
    let (big_endian, dtype) = numpy_type(path, descr)?;
    let fortran = value("fortran_order").ok_or_else(|| broken("no 'fortran_order'"))?.starts_with("True");
    let dims = value("shape").and_then(|s| s.strip_prefix('(')?.split_once(')')).ok_or_else(|| broken("no 'shape'"))?.0;
    let dims: Vec<u64> = dims
        .split(',')
        .map(str::trim)
        .filter(|d| !d.is_empty())
        .map(|d| d.trim_end_matches('L').parse())
        .collect::<Result<_, _>>()
        .map_err(|_| broken(&format!("shape ({dims}) is not a list of sizes")))?;
    let lead = dims.len().saturating_sub(4);
    if dims[..lead].iter().any(|n| *n != 1) {
        let text = format!("shape {dims:?} has more than four axes longer than 1; expected (z, y, x) or (c, z, y, x)");
        return Err(Error::file(path, text));
    }
    let mut czyx = [1; 4];
    let last = &dims[lead..];
    czyx[4 - last.len()..].copy_from_slice(last);
    let [channels, zyx @ ..] = czyx;
    if channels == 0 {
        return Err(Error::file(path, format!("axis c has size 0 (shape {dims:?})")));
    }
    let shape = shape_of(path, zyx, dtype.size())?;
    let (base, size) = ((start + len) as u64, dtype.size() as u64);
    let one = shape.iter().product::<usize>() as u64 * size;
    channels.checked_mul(one).filter(|n| *n < 1 << 62).ok_or_else(|| broken("sizes overflow"))?;
    let (pairs, names) = components(input, 1, channels as usize, &[])?;
    let mut lattice = Lattice::dense(shape, dtype, big_endian, base).ok_or_else(|| broken("sizes overflow"))?;
    // The first axis is the fastest in Fortran order, and channels stand before z.
    let (between, z) = if fortran { (size, size * channels) } else { (one, one / zyx[0]) };
    lattice.planes = Planes::Even { bases: pairs.iter().map(|(_, c)| base + *c as u64 * between).collect(), plane: z };
    if fortran {
        let [nz, ny, _] = zyx;
        (lattice.row, lattice.step) = (z * nz, z * nz * ny);
    }
    let mut info = VolumeInfo::plain(shape, dtype, if fortran { "npy, Fortran order" } else { "npy" });
    (info.components, info.component_names) = (pairs.len(), names);
    let header = head[..start + len].to_vec();
    Ok(Parsed { info, lattice, files: vec![path.to_path_buf()], pending: Pending::Nothing, header, exact: false })
}

/// A NumPy type string such as `<u2`: big-endian or not, and the type.
pub fn numpy_type(path: &Path, descr: &str) -> Result<(bool, DType)> {
    let (order, kind) = descr.split_at_checked(1).unwrap_or((descr, ""));
    let big = match order {
        ">" => true,
        "<" | "|" | "=" => false,
        _ => return Err(refuse(path, descr)),
    };
    let dtype = match kind {
        "u1" => DType::U8,
        "i1" => DType::I8,
        "u2" => DType::U16,
        "i2" => DType::I16,
        "u4" => DType::U32,
        "i4" => DType::I32,
        "f4" => DType::F32,
        "f8" => DType::F64,
        _ => {
            let name = match kind {
                "b1" | "?" => "bool",
                "u8" => "u64",
                "i8" => "i64",
                "f2" => "f16",
                "f16" => "f128",
                "c8" => "complex64",
                "c16" => "complex128",
                _ => descr,
            };
            return Err(refuse(path, name));
        }
    };
    Ok((big, dtype))
}

/// The error for an element type that is not read.
pub fn refuse(path: &Path, name: &str) -> Error {
    Error::file(
        path,
        format!(
            "element type {name} is not read; accepted are u8, i8, u16, i16, u32, i32, f32 and f64, one value per voxel"
        ),
    )
}
