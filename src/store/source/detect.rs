//! Which format a path is: by its name, then by its first bytes.

use std::path::Path;

use super::bytes;
use crate::{Error, Result};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Npy,
    Nifti,
    Nrrd,
    MetaImage,
    Tiff,
    Zarr,
}

const KNOWN: &str = "NRRD (.nrrd, .nhdr), NIfTI (.nii, .nii.gz), MetaImage (.mha, .mhd), TIFF (.tif, .tiff, or a folder of \
    slices), NumPy (.npy), Zarr and OME-Zarr (a folder), and headerless voxels with format = \"raw\", shape and dtype";

/// The format of an existing file or folder.
pub fn detect(path: &Path) -> Result<Format> {
    let meta = std::fs::metadata(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::file(path, "no such file or folder"),
        _ => Error::file(path, e),
    })?;
    if meta.is_dir() {
        let zarr = ["zarr.json", ".zarray", ".zgroup", ".zattrs"].iter().any(|f| path.join(f).exists());
        return Ok(if zarr { Format::Zarr } else { Format::Tiff });
    }
    if !meta.is_file() {
        return Err(Error::file(path, "neither a file nor a folder"));
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let by_name = [
        (".npy", Format::Npy),
        (".nii", Format::Nifti),
        (".nii.gz", Format::Nifti),
        (".nrrd", Format::Nrrd),
        (".nhdr", Format::Nrrd),
        (".mha", Format::MetaImage),
        (".mhd", Format::MetaImage),
        (".tif", Format::Tiff),
        (".tiff", Format::Tiff),
    ];
    if let Some((_, format)) = by_name.into_iter().find(|(end, _)| name.ends_with(end)) {
        return Ok(format);
    }
    let head = bytes::file_head(path, 512)?;
    by_magic(&head).ok_or_else(|| {
        if is_pair(path, &head) {
            return Error::file(
                path,
                "NIfTI and Analyze pairs of .hdr and .img are not read; save one .nii or .nii.gz",
            );
        }
        let raw = name.ends_with(".raw") || name.ends_with(".raw.gz") || name.ends_with(".bin");
        let hint = if raw { "headerless voxels need format = \"raw\", shape and dtype" } else { "unknown format" };
        Error::file(path, format!("{hint}; read are {KNOWN}"))
    })
}

/// Whether this is a half of a pair: a header of 348 bytes, or voxels with such a header beside them.
fn is_pair(path: &Path, head: &[u8]) -> bool {
    let is_header = |head: &[u8]| [348u32.to_le_bytes(), 348u32.to_be_bytes()].iter().any(|n| head.starts_with(n));
    let header = path.with_extension("hdr");
    let beside = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("img")) && header.is_file();
    is_header(head) || beside && bytes::file_head(&header, 4).is_ok_and(|h| is_header(&h))
}

fn by_magic(head: &[u8]) -> Option<Format> {
    let at = |start: usize, text: &[u8]| head.get(start..start + text.len()) == Some(text);
    if at(0, b"\x93NUMPY") {
        return Some(Format::Npy);
    }
    if at(0, b"NRRD000") {
        return Some(Format::Nrrd);
    }
    if at(344, b"n+1\0") || at(4, b"n+2\0") {
        return Some(Format::Nifti);
    }
    if [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|m| at(0, m)) {
        return Some(Format::Tiff);
    }
    if at(0, b"ObjectType") || at(0, b"NDims") {
        return Some(Format::MetaImage);
    }
    None
}
