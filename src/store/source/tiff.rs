//! TIFF stacks: many pages in one file, or a folder of slices in natural order.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use tiff::decoder::{Decoder, Limits};
use tiff::tags::Tag;

use super::bytes;
use super::lattice::{Lattice, Planes};
use super::planar::{Parsed, Pending, components, shape_of};
use super::raw::refuse;
use super::reblock::Reblock;
use super::tiff_text::{Described, Order, describe};
use crate::config::Input;
use crate::grid::DType;
use crate::store::VolumeInfo;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// Bytes of the shortest directory of a page with voxels (its width, height and strips); more pages than these fit into
/// the file mean that the chain of pages goes in circles.
const LEAST_PAGE: u64 = 40;
/// Longest strip or tile that is decoded, in bytes.
pub const MOST_CHUNK: usize = 1 << 30;

/// Planes of an image and of its tiles, in a page that holds a volume (SGI's extension).
const IMAGE_DEPTH: Tag = Tag::Unknown(32997);
const TILE_DEPTH: Tag = Tag::Unknown(32998);

pub type Reader = Decoder<Buffered>;

/// Bytes that a reader has at hand: more than decoders ask for at once, which would go past the buffer.
const AT_HAND: usize = 128 << 10;

/// A file behind a buffer that a seek inside it does not empty: decoders seek to every strip, and strips may be a few bytes.
pub struct Buffered {
    file: BufReader<File>,
    at: u64,
}

impl Read for Buffered {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        let n = self.file.read(to)?;
        self.at += n as u64;
        Ok(n)
    }
}

impl Seek for Buffered {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        let by = match to {
            SeekFrom::Start(at) => i64::try_from(at as i128 - self.at as i128).ok(),
            SeekFrom::Current(by) => Some(by),
            SeekFrom::End(_) => None,
        };
        match by {
            Some(by) => {
                self.file.seek_relative(by)?;
                self.at = self.at.wrapping_add_signed(by);
            }
            None => self.at = self.file.seek(to)?,
        }
        Ok(self.at)
    }
}

/// Opens a TIFF file at its first page, believing in tables of tags and in strips or tiles of up to `most` bytes.
pub fn reader(path: &Path, most: usize) -> Result<Reader> {
    let file = bytes::open_file(path)?;
    check_directory(path, &file).map_err(|text| broken(path, 0, text))?;
    let mut limits = Limits::default();
    limits.decoding_buffer_size = most;
    limits.intermediate_buffer_size = most;
    let file = Buffered { file: BufReader::with_capacity(AT_HAND, file), at: 0 };
    Ok(Decoder::new(file).map_err(|e| broken(path, 0, e))?.with_limits(limits))
}

/// Refuses a first directory whose tags claim more values than the file has bytes: the decoder takes limits only after
/// it has read (and allocated for) that one.
fn check_directory(path: &Path, file: &File) -> Result<(), String> {
    let len = bytes::file_len(path).map_err(|e| e.to_string())?;
    let read = |at: u64, n: usize| -> Result<[u8; 8], String> {
        let mut raw = [0; 8];
        file.read_exact_at(&mut raw[..n], at)
            .map_err(|_| "the file ends inside its header or first directory".to_string())?;
        Ok(raw)
    };
    let start = read(0, 4)?;
    let big = start[0] == b'M';
    let number = |at: u64, n: usize| -> Result<u64, String> {
        let raw = read(at, n)?;
        Ok(if big { u64::from_be_bytes(raw) >> (64 - 8 * n) } else { u64::from_le_bytes(raw) })
    };
    let wide = number(2, 2)? == 43;
    let (at, entries, first, step) = if wide {
        let at = number(8, 8)?;
        (at, number(at, 8)?, 8, 20)
    } else {
        let at = number(4, 4)?;
        (at, number(at, 2)?, 2, 12)
    };
    if entries > len / step {
        return Err(format!("the directory claims {entries} tags"));
    }
    for i in 0..entries {
        let entry = at.saturating_add(first + i * step);
        let count = if wide { number(entry + 4, 8)? } else { number(entry + 4, 4)? };
        if count > len {
            return Err(format!("tag {} claims {count} values, the file has {len} bytes", number(entry, 2)?));
        }
    }
    Ok(())
}

pub fn broken(path: &Path, page: usize, e: impl std::fmt::Display) -> Error {
    Error::file(path, format!("TIFF page {page} cannot be read: {e}"))
}

/// One page that holds a plane.
#[derive(Debug, Clone, PartialEq)]
struct Page {
    file: u32,
    /// Index of the image in its file.
    image: u32,
    form: Form,
    /// First byte of the voxels where they lie uncompressed and in one piece.
    plain: Option<u64>,
}

/// What all pages of a stack must share.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Form {
    width: u32,
    height: u32,
    dtype: DType,
    big_endian: bool,
    white_is_zero: bool,
    compression: u16,
}

impl std::fmt::Display for Form {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let order = if self.big_endian { "big" } else { "little" };
        let zero = if self.white_is_zero { ", white is zero" } else { "" };
        let Form { width, height, dtype, compression, .. } = self;
        write!(f, "{width} x {height} {dtype}, {order} endian, compression {compression}{zero}")
    }
}

fn dtype(path: &Path, bits: u64, format: u64) -> Result<DType> {
    Ok(match (format, bits) {
        (1 | 4, 8) => DType::U8,
        (1 | 4, 16) => DType::U16,
        (1 | 4, 32) => DType::U32,
        (2, 8) => DType::I8,
        (2, 16) => DType::I16,
        (2, 32) => DType::I32,
        (3, 32) => DType::F32,
        (3, 64) => DType::F64,
        _ => {
            let name = match (format, bits) {
                (1 | 4, 1) => "bool (1 bit)".to_string(),
                (1 | 4, n) => format!("u{n}"),
                (2, n) => format!("i{n}"),
                (3, n) => format!("f{n}"),
                (5 | 6, _) => "complex".to_string(),
                (f, n) => format!("of {n} bits, sample format {f}"),
            };
            return Err(refuse(path, &name));
        }
    })
}

/// Facts of the page where `decoder` stands; `None` for thumbnails and masks. `display`: a palette says how grey values are shown.
fn page(path: &Path, decoder: &mut Reader, file: u32, image: usize, display: bool) -> Result<Option<Page>> {
    let fail = |e: tiff::TiffError| broken(path, image, e);
    let mut number =
        |tag: Tag, or: u64| -> Result<u64> { Ok(decoder.find_tag_unsigned::<u64>(tag).map_err(fail)?.unwrap_or(or)) };
    if number(Tag::NewSubfileType, 0)? & 0b101 != 0 {
        return Ok(None);
    }
    let compression = number(Tag::Compression, 1)?;
    if !matches!(compression, 1 | 5 | 7 | 8 | 32773 | 32946 | 50000) {
        let text = format!(
            "{compression} is no compression that is read; accepted are none, LZW, Deflate, PackBits, JPEG and zstd"
        );
        return Err(broken(path, image, text));
    }
    let predictor = number(Tag::Predictor, 1)?;
    let photometric = number(Tag::PhotometricInterpretation, 1)?;
    let samples = number(Tag::SamplesPerPixel, 1)?;
    if samples != 1 {
        let name = match photometric {
            2 if samples == 4 => "RGBA".to_string(),
            2 => "RGB".to_string(),
            6 => "YCbCr".to_string(),
            _ => format!("of {samples} samples per pixel"),
        };
        return Err(refuse(path, &name));
    }
    if photometric == 3 && !display {
        let text =
            "palette colours (photometric interpretation 3) are not read; accepted are grey values: save it as grey";
        return Err(broken(path, image, text));
    }
    if !matches!(photometric, 0 | 1 | 3) {
        return Err(broken(
            path,
            image,
            format!("photometric interpretation {photometric}; only grey values are read"),
        ));
    }
    let depth = number(IMAGE_DEPTH, 1)?.max(number(TILE_DEPTH, 1)?);
    if depth > 1 {
        let text = format!(
            "volumetric tiles (ImageDepth {depth}) are not read; accepted are planes: one page, or one file, per plane"
        );
        return Err(broken(path, image, text));
    }
    let first = |list: Option<Vec<u64>>, or: u64| list.and_then(|l| l.first().copied()).unwrap_or(or);
    let bits = first(decoder.find_tag_unsigned_vec(Tag::BitsPerSample).map_err(fail)?, 1);
    let format = first(decoder.find_tag_unsigned_vec(Tag::SampleFormat).map_err(fail)?, 1);
    let dtype = dtype(path, bits, format)?;
    let (width, height) = decoder.dimensions().map_err(fail)?;
    let form = Form {
        width,
        height,
        dtype,
        big_endian: decoder.byte_order() == tiff::tags::ByteOrder::BigEndian,
        white_is_zero: photometric == 0,
        compression: compression as u16,
    };
    let mut plain = None;
    let tiled = decoder.find_tag(Tag::TileWidth).map_err(fail)?.is_some();
    if compression == 1 && predictor == 1 && !tiled {
        let offsets: Vec<u64> = decoder.find_tag_unsigned_vec(Tag::StripOffsets).map_err(fail)?.unwrap_or_default();
        let rows = decoder.find_tag_unsigned::<u64>(Tag::RowsPerStrip).map_err(fail)?.unwrap_or(height as u64);
        let strip = (rows.min(height as u64).max(1) * width as u64).saturating_mul(dtype.size() as u64);
        let whole = (height as u64).div_ceil(rows.clamp(1, height.max(1) as u64)) == offsets.len() as u64;
        let follows = |w: &[u64]| w[0].checked_add(strip) == Some(w[1]);
        plain = offsets.first().copied().filter(|_| whole && offsets.windows(2).all(follows));
    }
    Ok(Some(Page { file, image: image as u32, form, plain }))
}

/// All pages of a file, and the description of its first.
fn pages(path: &Path, file: u32) -> Result<(Vec<Page>, Described)> {
    let len = bytes::file_len(path)?;
    // A tag's values take 32 bytes each in memory and at least one in the file.
    let mut decoder = reader(path, (len as usize).saturating_mul(32).clamp(1 << 16, MOST_CHUNK))?;
    let text = decoder.find_tag(Tag::ImageDescription).ok().flatten().and_then(|v| v.into_string().ok());
    let mut ratio = |tag: Tag| decoder.find_tag(tag).ok().flatten().and_then(per_unit);
    let resolution = [ratio(Tag::YResolution), ratio(Tag::XResolution)];
    let text = text.as_deref().unwrap_or("");
    let described = describe(path, text, resolution)?;
    // ImageJ keeps the table by which it shows grey values as a palette.
    let display = text.starts_with("ImageJ=");
    let most = len / LEAST_PAGE;
    let mut pages = Vec::new();
    for image in 0.. {
        if image > 0 {
            if !decoder.more_images() {
                break;
            }
            decoder.next_image().map_err(|e| broken(path, image, e))?;
        }
        if image as u64 > most {
            return Err(Error::file(path, "the chain of TIFF pages goes in circles"));
        }
        pages.extend(page(path, &mut decoder, file, image, display)?);
    }
    Ok((pages, described))
}

/// Pixels per unit of a resolution tag.
fn per_unit(value: tiff::decoder::ifd::Value) -> Option<f64> {
    use tiff::decoder::ifd::Value;
    match value {
        Value::Rational(a, b) => Some(a as f64 / b as f64),
        Value::List(list) => per_unit(list.into_iter().next()?),
        Value::Float(v) => Some(v as f64),
        Value::Double(v) => Some(v),
        _ => None,
    }
}

/// Order in which people number files: runs of digits by value, the rest by letter.
pub fn natural_cmp(a: &str, b: &str) -> std::cmp::Ordering {
    use std::cmp::Ordering::Equal;
    let (mut a, mut b) = (a.as_bytes(), b.as_bytes());
    let digits = |s: &[u8]| s.iter().take_while(|c| c.is_ascii_digit()).count();
    loop {
        let (m, n) = (digits(a), digits(b));
        if m > 0 && n > 0 {
            let trim = |s: &[u8]| s.iter().take_while(|c| **c == b'0').count();
            let (x, y) = (&a[trim(&a[..m])..m], &b[trim(&b[..n])..n]);
            let order = x.len().cmp(&y.len()).then_with(|| x.cmp(y));
            if order != Equal {
                return order;
            }
            (a, b) = (&a[m..], &b[n..]);
            continue;
        }
        match (a.first(), b.first()) {
            (None, None) => return Equal,
            (x, y) if x == y => (a, b) = (&a[1..], &b[1..]),
            (x, y) => return x.cmp(&y),
        }
    }
}

/// The TIFF files of a folder, in natural order.
fn slices(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| Error::file(folder, e))? {
        let path = entry.map_err(|e| Error::file(folder, e))?.path();
        let tiff = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("tif") || e.eq_ignore_ascii_case("tiff"));
        // Hidden files are some system's own (`._slice.tif`).
        let hidden = path.file_name().is_some_and(|n| n.as_encoded_bytes().starts_with(b"."));
        if tiff && !hidden && !path.is_dir() {
            found.push(path);
        }
    }
    let name = |p: &PathBuf| p.file_name().unwrap_or_default().to_string_lossy().into_owned();
    found.sort_by(|a, b| natural_cmp(&name(a), &name(b)).then_with(|| a.cmp(b)));
    if found.is_empty() {
        return Err(Error::file(
            folder,
            "the folder is neither a Zarr array or group nor does it hold .tif or .tiff slices",
        ));
    }
    Ok(found)
}

/// Opens one TIFF file or a folder of slices.
pub fn open(input: &Input, path: &Path) -> Result<Parsed> {
    let files = if path.is_dir() { slices(path)? } else { vec![path.to_path_buf()] };
    let (mut all, described) = pages(&files[0], 0)?;
    let several = files.len() > 1;
    for (i, file) in files.iter().enumerate().skip(1) {
        all.extend(pages(file, i as u32)?.0);
    }
    let name = |p: &Page| format!("page {} of {}", p.image, files[p.file as usize].display());
    let first = all.first().cloned().ok_or_else(|| Error::file(path, "the TIFF has no page with voxels"))?;
    if several && all.len() != files.len() {
        return Err(Error::file(
            path,
            format!("{} slices hold {} pages; a folder of slices needs one page per file", files.len(), all.len()),
        ));
    }
    if let Some(odd) = all.iter().find(|p| p.form != first.form) {
        let text = format!("{} ({}) differs from the first page ({})", name(odd), odd.form, first.form);
        return Err(Error::file(path, text));
    }
    let form = first.form;
    let plane_bytes = (form.width as u64 * form.height as u64).saturating_mul(form.dtype.size() as u64);
    // ImageJ stores large stacks as one page, the other planes following without pages of their own.
    if let (1, Some(planes), Some(start)) = (all.len(), described.planes, first.plain)
        && planes > 1
    {
        let have = bytes::file_len(path)?;
        if start.saturating_add(plane_bytes.saturating_mul(planes)) > have {
            return Err(Error::file(
                path,
                format!("the description promises {planes} images, which {have} bytes cannot hold"),
            ));
        }
        all = (0..planes).map(|k| Page { plain: Some(start + k * plane_bytes), ..first.clone() }).collect();
    }
    let described = if several { Described { order: Order::stack(all.len()), ..described } } else { described };
    place(input, path, files, all, described, form)
}

fn place(
    input: &Input,
    path: &Path,
    files: Vec<PathBuf>,
    pages: Vec<Page>,
    described: Described,
    form: Form,
) -> Result<Parsed> {
    let order = described.order.fit(path, pages.len())?;
    let shape = shape_of(path, [order.z as u64, form.height as u64, form.width as u64], form.dtype.size())?;
    let (pairs, names) = components(input, order.t, order.c, &described.labels)?;
    let picked: Vec<&Page> = pairs
        .iter()
        .flat_map(|(t, c)| (0..order.z).map(|z| (*t, *c, z)))
        .map(|(t, c, z)| order.index(z, c, t).and_then(|i| pages.get(i)))
        .collect::<Option<_>>()
        .ok_or_else(|| Error::file(path, "the OME description names planes that the TIFF does not have"))?;
    let folder = if files.len() > 1 { " folder" } else { "" };
    let kind = if form.compression == 1 { "uncompressed".to_string() } else { compression_name(form.compression) };
    let mut info = VolumeInfo::plain(shape, form.dtype, format!("TIFF{folder}, {kind}"));
    (info.components, info.component_names) = (pairs.len(), names);
    info.times = order.t;
    info.spacing = described.spacing;
    info.unit = described.unit;
    let header = format!("{form:?} {order:?} {pairs:?}").into_bytes();
    let overflow = || Error::file(path, "the TIFF's sizes overflow");
    if picked.iter().all(|p| p.plain.is_some()) {
        let mut lattice = Lattice::dense(shape, form.dtype, form.big_endian, 0).ok_or_else(overflow)?;
        lattice.planes = Planes::Table(picked.iter().map(|p| (p.file, p.plain.unwrap_or(0))).collect());
        return Ok(Parsed { info, lattice, files, pending: Pending::Nothing, header, exact: false });
    }
    let one = shape.iter().product::<usize>() as u64 * form.dtype.size() as u64;
    let mut lattice = Lattice::dense(shape, form.dtype, cfg!(target_endian = "big"), 0).ok_or_else(overflow)?;
    if let Planes::Even { bases, .. } = &mut lattice.planes {
        *bases = (0..pairs.len() as u64).map(|c| c.checked_mul(one)).collect::<Option<_>>().ok_or_else(overflow)?;
    }
    lattice.ends(1).ok_or_else(overflow)?;
    if form.white_is_zero && !matches!(form.dtype, DType::U8 | DType::U16 | DType::U32) {
        return Err(refuse(path, &format!("{} with white as zero, compressed or tiled", form.dtype)));
    }
    let reblock = Reblock {
        pages: picked.iter().map(|p| (p.file, p.image)).collect(),
        wanted: (0..picked.len()).collect(),
        width: form.width as usize,
        height: form.height as usize,
        dtype: form.dtype,
        invert: form.white_is_zero,
    };
    Ok(Parsed { info, lattice, files, pending: Pending::Reblock(reblock), header, exact: false })
}

fn compression_name(code: u16) -> String {
    match code {
        5 => "LZW".to_string(),
        7 => "JPEG".to_string(),
        8 | 32946 => "Deflate".to_string(),
        32773 => "PackBits".to_string(),
        50000 => "zstd".to_string(),
        other => format!("compression {other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::natural_cmp;

    #[test]
    fn slices_sort_as_people_number_them() {
        let mut names = ["s10.tif", "s9.tif", "s1.tif", "s010.tif", "s2b.tif", "s2.tif", "r99.tif"];
        names.sort_by(|a, b| natural_cmp(a, b).then(a.cmp(b)));
        assert_eq!(names, ["r99.tif", "s1.tif", "s2.tif", "s2b.tif", "s9.tif", "s010.tif", "s10.tif"]);
    }
}
