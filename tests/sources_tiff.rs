//! Tiled and compressed TIFF pages, written by hand here, read back voxel for voxel; forms that are not read are refused by
//! name, with what would be accepted.

mod common_sources;

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use common_sources::*;
use occlude::grid::DType;
use occlude::store::Source;

/// One page to write: little-endian, one sample per pixel.
struct Page {
    dtype: DType,
    width: usize,
    height: usize,
    /// Height and width of a tile; those of the page: one strip.
    tile: [usize; 2],
    compression: u16,
    predictor: u16,
    photometric: u16,
    depth: u32,
    description: &'static str,
}

const PAGE: Page = Page {
    dtype: DType::U8,
    width: 33,
    height: 20,
    tile: [16, 16],
    compression: 5,
    predictor: 1,
    photometric: 1,
    depth: 1,
    description: "",
};

/// The value of a pixel: runs and noise, so that codes of all lengths come.
fn value(dtype: DType, y: usize, x: usize) -> f64 {
    let noise = ((y * 7919 + x * 104_729) as u32).wrapping_mul(2_654_435_761) >> 8;
    let v = if (x / 5 + y / 3).is_multiple_of(3) { 17 } else { noise % 60_000 };
    match dtype {
        DType::U8 => (v % 256) as f64,
        DType::U16 => v as f64,
        _ => v as f64 / 8.0 - 1000.0,
    }
}

/// LZW as TIFF 6.0 has it: codes from 9 to 12 bits, most significant bit first, each width left one code early.
fn lzw(data: &[u8]) -> Vec<u8> {
    let (mut out, mut held, mut bits) = (Vec::new(), 0u64, 0);
    let mut emit = |code: u32, width: u32| {
        (held, bits) = (held << width | code as u64, bits + width);
        while bits >= 8 {
            bits -= 8;
            out.push((held >> bits) as u8);
        }
    };
    let (mut table, mut next, mut width) = (HashMap::new(), 258, 9);
    emit(256, width);
    let mut prefix: Option<u32> = None;
    for &byte in data {
        let Some(code) = prefix else {
            prefix = Some(byte as u32);
            continue;
        };
        if let Some(&longer) = table.get(&(code, byte)) {
            prefix = Some(longer);
            continue;
        }
        emit(code, width);
        table.insert((code, byte), next);
        next += 1;
        match next {
            512 | 1024 | 2048 => width += 1,
            4095 => {
                emit(256, width);
                table.clear();
                (next, width) = (258, 9);
            }
            _ => {}
        }
        prefix = Some(byte as u32);
    }
    if let Some(code) = prefix {
        emit(code, width);
        if matches!(next + 1, 512 | 1024 | 2048) {
            width += 1;
        }
    }
    emit(257, width);
    emit(0, 7);
    out
}

/// Predictors of TIFF 6.0 (2, differences of values) and of its technical note 3 (3, differences of bytes by weight).
fn predict(row: &mut [u8], size: usize, predictor: u16) {
    match predictor {
        2 => {
            for i in (size..row.len()).step_by(size).rev() {
                let number = |at: usize| (0..size).rev().fold(0u32, |n, b| n << 8 | row[at + b] as u32);
                let difference = number(i).wrapping_sub(number(i - size)).to_le_bytes();
                row[i..i + size].copy_from_slice(&difference[..size]);
            }
        }
        3 => {
            let n = row.len() / size;
            let mut planes: Vec<u8> = (0..row.len()).map(|i| row[i % n * size + (size - 1 - i / n)]).collect();
            (1..planes.len()).rev().for_each(|i| planes[i] = planes[i].wrapping_sub(planes[i - 1]));
            row.copy_from_slice(&planes);
        }
        _ => {}
    }
}

/// The bytes of one tile, edges padded by the last pixel.
fn tile(page: &Page, ty: usize, tx: usize) -> Vec<u8> {
    let [th, tw] = page.tile;
    let mut bytes = Vec::new();
    for y in ty * th..(ty + 1) * th {
        let start = bytes.len();
        for x in tx * tw..(tx + 1) * tw {
            let v = value(page.dtype, y.min(page.height - 1), x.min(page.width - 1));
            match page.dtype {
                DType::U8 => bytes.push(v as u8),
                DType::U16 => bytes.extend((v as u16).to_le_bytes()),
                _ => bytes.extend((v as f32).to_le_bytes()),
            }
        }
        predict(&mut bytes[start..], page.dtype.size(), page.predictor);
    }
    match page.compression {
        5 => lzw(&bytes),
        50000 => zstd::encode_all(&bytes[..], 3).unwrap(),
        _ => bytes,
    }
}

fn write(page: &Page, path: &Path) {
    let [th, tw] = page.tile;
    let strip = page.tile == [page.height, page.width];
    let (down, across) = (page.height.div_ceil(th), page.width.div_ceil(tw));
    let mut out = b"II\x2a\0\0\0\0\0".to_vec();
    let (mut offsets, mut counts) = (Vec::new(), Vec::new());
    for (ty, tx) in (0..down).flat_map(|ty| (0..across).map(move |tx| (ty, tx))) {
        let bytes = tile(page, ty, tx);
        offsets.push(out.len() as u32);
        counts.push(bytes.len() as u32);
        out.extend(bytes);
    }
    let format = if page.dtype.is_float() { 3 } else { 1 };
    let bits = 8 * page.dtype.size() as u32;
    let map = if page.photometric == 3 { vec![0; 3 << bits.min(8)] } else { vec![] };
    let tags: Vec<(u16, u16, Vec<u32>)> = vec![
        (256, 4, vec![page.width as u32]),
        (257, 4, vec![page.height as u32]),
        (258, 4, vec![bits]),
        (259, 4, vec![page.compression as u32]),
        (262, 4, vec![page.photometric as u32]),
        (270, 2, page.description.bytes().map(u32::from).collect()),
        (277, 4, vec![1]),
        (317, 4, vec![page.predictor as u32]),
        (320, 3, map),
        (if strip { 273 } else { 324 }, 4, offsets),
        (if strip { 279 } else { 325 }, 4, counts),
        (322, 4, if strip { vec![] } else { vec![tw as u32] }),
        (323, 4, if strip { vec![] } else { vec![th as u32] }),
        (278, 4, if strip { vec![th as u32] } else { vec![] }),
        (339, 4, vec![format]),
        (32997, 4, vec![page.depth]),
        (32998, 4, vec![page.depth]),
    ];
    let mut tags: Vec<_> = tags.into_iter().filter(|t| !t.2.is_empty()).collect();
    tags.sort_by_key(|t| t.0);
    let mut directory = (tags.len() as u16).to_le_bytes().to_vec();
    for (tag, kind, values) in tags {
        directory.extend(tag.to_le_bytes());
        directory.extend(kind.to_le_bytes());
        directory.extend((values.len() as u32).to_le_bytes());
        if values.len() == 1 {
            directory.extend(values[0].to_le_bytes());
            continue;
        }
        directory.extend((out.len() as u32).to_le_bytes());
        for v in values {
            out.extend(&v.to_le_bytes()[..[1, 2, 4][kind as usize - 2]]);
        }
    }
    directory.extend([0; 4]);
    let at = out.len() as u32;
    out[4..8].copy_from_slice(&at.to_le_bytes());
    out.extend(directory);
    fs::write(path, out).unwrap();
}

#[test]
fn tiles_that_stick_out_of_the_page_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiled.tif");
    for dtype in [DType::U8, DType::U16, DType::F32] {
        let predictors: &[u16] = if dtype.is_float() { &[1, 2, 3] } else { &[1, 2] };
        for &predictor in predictors {
            for (height, width) in [(32, 32), (20, 33), (33, 47), (16, 17), (5, 7), (31, 1)] {
                for (tile, compression) in
                    [([16, 16], 5), ([16, 48], 5), ([32, 16], 1), ([96, 128], 5), ([16, 32], 50000)]
                {
                    let page = Page { dtype, width, height, tile, compression, predictor, ..PAGE };
                    let what =
                        format!("{width} x {height} {dtype}, tiles {tile:?}, {compression}, predictor {predictor}");
                    write(&page, &path);
                    let (source, voxels) = whole(&file_input(&path), 0).unwrap_or_else(|e| panic!("{what}: {e}"));
                    assert_eq!((source.info().shape, source.info().dtype), ([1, height, width], dtype), "{what}");
                    for i in 0..voxels.len() {
                        assert_eq!(voxels.at(i), value(dtype, i / width, i % width), "{what}, voxel {i}");
                    }
                }
            }
        }
    }
}

#[test]
fn hidden_files_are_no_slices() {
    let folder = tempfile::tempdir().unwrap();
    let page = Page { dtype: DType::U8, width: 5, height: 7, tile: [16, 16], compression: 5, predictor: 1, ..PAGE };
    for name in ["a1.tif", "a2.tif", "a10.tif"] {
        write(&page, &folder.path().join(name));
    }
    std::fs::write(folder.path().join("._a1.tif"), "what another system keeps beside a file").unwrap();
    let source = occlude::store::Source::open(&file_input(folder.path())).unwrap();
    assert_eq!(source.info().shape, [3, 7, 5]);
}

#[test]
fn palettes_and_volumetric_tiles_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd.tif");
    for compression in [1, 5] {
        write(&Page { photometric: 3, compression, ..PAGE }, &path);
        let e = Source::open(&file_input(&path)).unwrap_err();
        assert_eq!(e.exit_code(), 1);
        let e = e.to_string();
        assert!(e.contains("odd.tif") && e.contains("palette") && e.contains("accepted are grey values"), "{e}");
        write(&Page { depth: 16, compression, ..PAGE }, &path);
        let e = Source::open(&file_input(&path)).unwrap_err();
        assert_eq!(e.exit_code(), 1);
        let e = e.to_string();
        assert!(e.contains("ImageDepth 16") && e.contains("accepted are planes"), "{e}");
    }
    write(&PAGE, &path);
    Source::open(&file_input(&path)).unwrap();
    // What ImageJ keeps as a palette is how it shows grey values.
    let tile = [PAGE.height, PAGE.width];
    write(&Page { photometric: 3, compression: 1, tile, description: "ImageJ=1.53t\n\0", ..PAGE }, &path);
    let (_, voxels) = whole(&file_input(&path), 0).unwrap();
    assert!((0..voxels.len()).all(|i| voxels.at(i) == value(DType::U8, i / PAGE.width, i % PAGE.width)));
}
