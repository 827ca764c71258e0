//! NIfTI-1 and NIfTI-2, `.nii` and `.nii.gz`, either byte order.

use std::path::Path;

use super::bytes;
use super::lattice::{Lattice, Planes};
use super::planar::{Parsed, Pending, components, shape_of};
use super::raw::refuse;
use super::spool::{After, Packed, Packing};
use crate::config::Input;
use crate::grid::{Affine, DType};
use crate::store::VolumeInfo;
use crate::store::info::Orientation;
use crate::{Error, Result};

/// Bytes of a NIfTI-2 header, the longer of the two.
const MOST_HEADER: usize = 540;

/// Header fields at their offsets, in the file's byte order.
struct Fields<'a> {
    bytes: &'a [u8],
    big: bool,
}

impl Fields<'_> {
    fn take<const N: usize>(&self, at: usize) -> [u8; N] {
        let mut raw: [u8; N] = self.bytes[at..at + N].try_into().expect("N bytes");
        if self.big != cfg!(target_endian = "big") {
            raw.reverse();
        }
        raw
    }
    fn i16(&self, at: usize) -> i64 {
        i16::from_ne_bytes(self.take(at)) as i64
    }
    fn i32(&self, at: usize) -> i64 {
        i32::from_ne_bytes(self.take(at)) as i64
    }
    fn i64(&self, at: usize) -> i64 {
        i64::from_ne_bytes(self.take(at))
    }
    fn f32(&self, at: usize) -> f64 {
        f32::from_ne_bytes(self.take(at)) as f64
    }
    fn f64(&self, at: usize) -> f64 {
        f64::from_ne_bytes(self.take(at))
    }
}

/// What both versions of the header say.
struct Header {
    version: u8,
    dim: [i64; 8],
    datatype: i64,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    intercept: f64,
    units: i64,
    qform: i64,
    sform: i64,
    /// b, c, d, then the offsets x, y, z.
    quatern: [f64; 6],
    srow: [[f64; 4]; 3],
    big: bool,
    len: usize,
}

fn parse(path: &Path, bytes: &[u8]) -> Result<Header> {
    let not = |text: &str| Error::file(path, format!("not a NIfTI file: {text}"));
    let first = bytes.first_chunk::<4>().ok_or_else(|| not("it is shorter than a header"))?;
    let (version, big) = match (i32::from_le_bytes(*first), i32::from_be_bytes(*first)) {
        (348, _) => (1, false),
        (_, 348) => (1, true),
        (540, _) => (2, false),
        (_, 540) => (2, true),
        (n, _) => {
            return Err(not(&format!("the header length is {n}, where 348 (NIfTI-1) or 540 (NIfTI-2) is expected")));
        }
    };
    let len = if version == 1 { 348 } else { 540 };
    if bytes.len() < len {
        return Err(not(&format!("the header needs {len} bytes, the file ends after {}", bytes.len())));
    }
    let magic = if version == 1 { &bytes[344..347] } else { &bytes[4..7] };
    match magic {
        b"n+1" | b"n+2" => {}
        b"ni1" | b"ni2" => {
            return Err(Error::file(
                path,
                "a NIfTI header with a separate .img file is not read; convert it to one .nii file",
            ));
        }
        _ => return Err(not("the magic is neither n+1 nor n+2 (Analyze 7.5 is not read)")),
    }
    let f = Fields { bytes, big };
    let eight = |f: &dyn Fn(usize) -> f64| std::array::from_fn(f);
    let header = if version == 1 {
        Header {
            version,
            dim: std::array::from_fn(|i| f.i16(40 + 2 * i)),
            datatype: f.i16(70),
            pixdim: eight(&|i| f.f32(76 + 4 * i)),
            vox_offset: f.f32(108),
            slope: f.f32(112),
            intercept: f.f32(116),
            units: bytes[123] as i64,
            qform: f.i16(252),
            sform: f.i16(254),
            quatern: std::array::from_fn(|i| f.f32(256 + 4 * i)),
            srow: std::array::from_fn(|r| std::array::from_fn(|c| f.f32(280 + 16 * r + 4 * c))),
            big,
            len,
        }
    } else {
        Header {
            version,
            dim: std::array::from_fn(|i| f.i64(16 + 8 * i)),
            datatype: f.i16(12),
            pixdim: eight(&|i| f.f64(104 + 8 * i)),
            vox_offset: f.i64(168) as f64,
            slope: f.f64(176),
            intercept: f.f64(184),
            units: f.i32(500),
            qform: f.i32(344),
            sform: f.i32(348),
            quatern: std::array::from_fn(|i| f.f64(352 + 8 * i)),
            srow: std::array::from_fn(|r| std::array::from_fn(|c| f.f64(400 + 32 * r + 8 * c))),
            big,
            len,
        }
    };
    Ok(header)
}

fn dtype(path: &Path, code: i64) -> Result<DType> {
    Ok(match code {
        2 => DType::U8,
        4 => DType::I16,
        8 => DType::I32,
        16 => DType::F32,
        64 => DType::F64,
        256 => DType::I8,
        512 => DType::U16,
        768 => DType::U32,
        _ => {
            let name = match code {
                1 => "bool (NIfTI binary)".to_string(),
                32 => "complex64".to_string(),
                128 => "RGB (24 bits)".to_string(),
                1024 => "i64".to_string(),
                1280 => "u64".to_string(),
                1536 => "f128".to_string(),
                1792 => "complex128".to_string(),
                2048 => "complex256".to_string(),
                2304 => "RGBA (32 bits)".to_string(),
                other => format!("{other} (NIfTI datatype code)"),
            };
            return Err(refuse(path, &name));
        }
    })
}

/// Direction matrix: sform if set, else qform if set.
fn orientation(h: &Header) -> Option<Orientation> {
    let matrix = if h.sform > 0 {
        h.srow
    } else if h.qform > 0 {
        let [b, c, d, x, y, z] = h.quatern;
        let a = (1.0 - (b * b + c * c + d * d)).max(0.0).sqrt();
        let rotation = [
            [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
            [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
            [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ];
        let flip = if h.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
        let size = [h.pixdim[1], h.pixdim[2], h.pixdim[3] * flip];
        std::array::from_fn(|r| {
            let offset = [x, y, z][r];
            [rotation[r][0] * size[0], rotation[r][1] * size[1], rotation[r][2] * size[2], offset]
        })
    } else {
        return None;
    };
    matrix.iter().flatten().all(|v| v.is_finite()).then(|| Orientation { matrix, space: "RAS".to_string() })
}

/// Spacing from the matrix where that contradicts `pixdim`: it is the matrix that says where voxels lie, and which outputs keep.
fn follow_matrix(info: &mut VolumeInfo, axes: usize) {
    let Some(orientation) = &info.orientation else { return };
    let written = info.spacing;
    for column in 0..axes.min(3) {
        let length = orientation.step(column);
        let own = &mut info.spacing[2 - column];
        // Headers hold both as f32, a quaternion with fewer digits still.
        if length.is_normal() && (length / *own - 1.0).abs() > 1e-4 {
            *own = length;
        }
    }
    if info.spacing != written {
        info.warnings.push(format!(
            "pixdim says that voxels measure {written:?} (z, y, x), the affine {:?}: the affine counts; `spacing` would be what you set",
            info.spacing
        ));
    }
}

/// Opens a `.nii` or `.nii.gz` file. Axis 4 is time, axis 5 the channel; the others must be 1.
pub fn open(input: &Input, path: &Path) -> Result<Parsed> {
    let start = bytes::file_head(path, MOST_HEADER)?;
    let gzip = start.starts_with(&[0x1f, 0x8b]);
    let mut packed =
        Packed { path: path.to_path_buf(), packing: Packing::Gzip, start: 0, skip: 0, len: 0, after: After::Allowed };
    let head = if gzip { bytes::head(path, &mut *packed.reader()?, MOST_HEADER)? } else { start };
    let h = parse(path, &head)?;
    let dtype = dtype(path, h.datatype)?;
    let axes = h.dim[0];
    if !(1..=7).contains(&axes) || h.dim[1..=axes as usize].iter().any(|n| *n < 1) {
        return Err(Error::file(
            path,
            format!("broken NIfTI dimensions {:?}: 1 to 7 axes of at least 1 are expected", h.dim),
        ));
    }
    let dim = |i: usize| if i as i64 <= axes { h.dim[i] as u64 } else { 1 };
    if dim(6) > 1 || dim(7) > 1 {
        return Err(Error::file(
            path,
            format!(
                "NIfTI axes 6 and 7 have {} and {} entries; only time (axis 4) and channel (axis 5) may be longer than 1",
                dim(6),
                dim(7)
            ),
        ));
    }
    let shape = shape_of(path, [dim(3), dim(2), dim(1)], dtype.size())?;
    if !(h.vox_offset >= 0.0 && h.vox_offset < 1e15 && h.vox_offset.fract() == 0.0) {
        return Err(Error::file(path, format!("broken NIfTI header: the voxels start at byte {}", h.vox_offset)));
    }
    let base = (h.vox_offset as u64).max(h.len as u64);
    let one = shape.iter().product::<usize>() as u64 * dtype.size() as u64;
    let too_large = || Error::file(path, format!("NIfTI dimensions {:?} are larger than any file", h.dim));
    let len =
        dim(4).checked_mul(dim(5)).and_then(|n| n.checked_mul(one)).filter(|n| *n < 1 << 62).ok_or_else(too_large)?;
    let (pairs, names) = components(input, dim(4) as usize, dim(5) as usize, &[])?;
    let first = if gzip { 0 } else { base };
    let mut lattice = Lattice::dense(shape, dtype, h.big, first).ok_or_else(too_large)?;
    if let Planes::Even { bases, .. } = &mut lattice.planes {
        *bases = pairs.iter().map(|(t, c)| first + (*c as u64 * dim(4) + *t as u64) * one).collect();
    }
    let format = format!("NIfTI-{}{}", h.version, if gzip { ", gzip" } else { "" });
    let mut info = VolumeInfo::plain(shape, dtype, format);
    info.components = pairs.len();
    info.component_names = names;
    info.times = dim(4) as usize;
    info.spacing =
        std::array::from_fn(
            |a| if h.pixdim[3 - a] == 0.0 || 3 - a as i64 > axes { 1.0 } else { h.pixdim[3 - a].abs() },
        );
    info.unit = match h.units & 7 {
        1 => Some("meter".to_string()),
        2 => Some("millimeter".to_string()),
        3 => Some("micrometer".to_string()),
        _ => None,
    };
    info.affine = Affine::new(h.slope, h.intercept);
    info.orientation = orientation(&h);
    follow_matrix(&mut info, axes as usize);
    let pending = if gzip {
        (packed.skip, packed.len) = (base, len);
        Pending::Unpack(packed)
    } else {
        Pending::Nothing
    };
    let header = head[..h.len].to_vec();
    Ok(Parsed { info, lattice, files: vec![path.to_path_buf()], pending, header, exact: false })
}
