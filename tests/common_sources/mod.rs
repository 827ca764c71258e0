//! What the tests of sources share.
#![allow(dead_code)] // each test file uses a part of it

use std::io::Write;
use std::path::{Path, PathBuf};

use occlude::brick::Voxels;
use occlude::config::{Input, InputKind, Place, RawFormat, Select};
use occlude::grid::{DType, Region};
use occlude::store::Source;

pub fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

pub fn fixture(name: &str) -> Input {
    file_input(&data(name))
}

pub fn file_input(path: &Path) -> Input {
    Input {
        name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        place: Place::default(),
        kind: InputKind::Path { path: path.to_path_buf(), raw: None },
        level: 0,
        array: None,
        channel: Select::Index(0),
        time: Select::Index(0),
        spacing: None,
        unit: None,
        origin: None,
        slope: None,
        intercept: None,
        nodata: None,
    }
}

/// Little-endian voxels and nothing else.
pub fn raw_format(shape: [usize; 3], dtype: DType) -> RawFormat {
    RawFormat { shape, dtype, big_endian: false, offset: 0, trailing_ignore: false, components: 1 }
}

pub fn raw_input(path: &Path, raw: RawFormat) -> Input {
    Input { kind: InputKind::Path { path: path.to_path_buf(), raw: Some(raw) }, ..file_input(path) }
}

/// Opens, prepares and reads one component whole.
pub fn whole(input: &Input, component: usize) -> occlude::Result<(Source, Voxels)> {
    let mut source = Source::open(input)?;
    let scratch = tempfile::tempdir().unwrap();
    source.prepare(scratch.path(), &|_| true)?;
    let shape = source.info().shape;
    assert!(shape.iter().product::<usize>() < 1 << 28, "{shape:?} was believed");
    let mut voxels = Voxels::zeroed(source.info().dtype, shape.iter().product());
    source.read(component, Region::whole(shape), voxels.view_mut(shape))?;
    Ok((source, voxels))
}

pub fn near(a: [f64; 3], b: [f64; 3]) {
    assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-6), "{a:?}, {b:?} expected");
}

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut writer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    writer.write_all(bytes).unwrap();
    writer.finish().unwrap()
}

/// Writes a stack of bytes as pages of one strip each, packed by zlib; the strip of one page is none.
pub fn deflated_tiff(path: &Path, [nz, ny, nx]: [usize; 3], voxels: &[u8], broken: Option<usize>) {
    let mut file = b"II\x2a\x00\x00\x00\x00\x00".to_vec();
    let mut link = 4;
    for z in 0..nz {
        let mut packer = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        packer.write_all(&voxels[z * ny * nx..][..ny * nx]).unwrap();
        let mut strip = packer.finish().unwrap();
        if broken == Some(z) {
            strip.fill(0x55);
        }
        let start = file.len() as u32;
        file.extend(&strip);
        file.resize(file.len().next_multiple_of(2), 0);
        let here = file.len() as u32;
        file[link..link + 4].copy_from_slice(&here.to_le_bytes());
        // Width, height, bits, compression, black is zero, strip, samples, rows, bytes of the strip.
        let entries: [(u16, u32); 9] = [
            (256, nx as u32),
            (257, ny as u32),
            (258, 8),
            (259, 8),
            (262, 1),
            (273, start),
            (277, 1),
            (278, ny as u32),
            (279, strip.len() as u32),
        ];
        file.extend((entries.len() as u16).to_le_bytes());
        for (tag, value) in entries {
            file.extend(tag.to_le_bytes());
            file.extend(4u16.to_le_bytes());
            file.extend(1u32.to_le_bytes());
            file.extend(value.to_le_bytes());
        }
        link = file.len();
        file.extend([0; 4]);
    }
    std::fs::write(path, file).unwrap();
}

pub fn copy_tree(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_tree(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// The fixtures hold `z * 40 + y * 7 + x + 100 * component`.
pub fn expected(shape: [usize; 3], component: usize) -> impl Fn(usize) -> f64 {
    move |i| {
        let (z, y, x) = (i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]);
        (z * 40 + y * 7 + x + 100 * component) as f64
    }
}

/// Opens, prepares and checks a fixture of 4 x 5 x 6 voxels, in whole and in a box.
pub fn check(input: &Input, component: usize, value: usize) -> Source {
    let (source, voxels) = whole(input, component).unwrap_or_else(|e| panic!("{}: {e}", input.name));
    assert_eq!(source.info().shape, [4, 5, 6], "{}", input.name);
    let wrap = |v: f64| if voxels.dtype() == DType::U8 { v % 256.0 } else { v };
    for i in 0..voxels.len() {
        assert_eq!(voxels.at(i), wrap(expected([4, 5, 6], value)(i)), "{} voxel {i}", input.name);
    }
    let region = Region::new([1, 2, 1], [4, 4, 6]);
    let mut part = Voxels::zeroed(source.info().dtype, region.voxels());
    source.read(component, region, part.view_mut(region.shape())).unwrap();
    for (i, [z, y, x]) in region.iter().enumerate() {
        assert_eq!(part.at(i), wrap((z * 40 + y * 7 + x) as f64 + 100.0 * value as f64), "{} box", input.name);
    }
    source.release(Region::whole([4, 5, 6]));
    assert_eq!(source.identity().unwrap(), Source::open(input).unwrap().identity().unwrap());
    source
}

/// As `check`, for types in which the values wrap around.
pub fn check_wrapped(input: &Input) -> Source {
    let (source, voxels) = whole(input, 0).unwrap_or_else(|e| panic!("{}: {e}", input.name));
    for i in 0..voxels.len() {
        let v = expected([4, 5, 6], 0)(i);
        let v = if voxels.dtype() == DType::I8 { v as i64 as i8 as f64 } else { v };
        assert_eq!(voxels.at(i), v, "{} voxel {i}", input.name);
    }
    source
}

pub fn shared_data() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    // Beside the repository, or one folder further up from a worktree.
    let found = ["../shared/data", "../../shared/data"].into_iter().map(|f| root.join(f)).find(|f| f.is_dir());
    if found.is_none() {
        eprintln!("skipped: the published volumes are not at {}", root.join("../shared/data").display());
    }
    found
}

/// SHA-256, as the published checksums are (FIPS 180-4).
pub fn sha256(data: &[u8]) -> String {
    // The constants are the fractional parts of roots of the first primes.
    let primes: Vec<u64> = (2u64..).filter(|n| (2..*n).all(|d| n % d != 0)).take(64).collect();
    let root = |p: u64, cube: bool| -> u32 {
        // floor(root(p) * 2^32) by bisection in integers, without its whole part.
        let (mut lo, mut hi) = (0u128, 1u128 << 37);
        while hi - lo > 1 {
            let mid = (lo + hi) / 2;
            let (value, scale) = if cube { (mid * mid * mid, 96) } else { (mid * mid, 64) };
            if value <= (p as u128) << scale { lo = mid } else { hi = mid }
        }
        lo as u32
    };
    let k: Vec<u32> = primes.iter().map(|p| root(*p, true)).collect();
    let mut h: Vec<u32> = primes[..8].iter().map(|p| root(*p, false)).collect();
    let mut tail = data[data.len() / 64 * 64..].to_vec();
    tail.push(0x80);
    tail.resize((tail.len() + 8).div_ceil(64) * 64 - 8, 0);
    tail.extend((data.len() as u64 * 8).to_be_bytes());
    for block in data.chunks_exact(64).chain(tail.chunks_exact(64)) {
        let mut w: Vec<u32> = block.chunks_exact(4).map(|b| u32::from_be_bytes(b.try_into().unwrap())).collect();
        w.resize(64, 0);
        for i in 16..64 {
            let s0 = w[i - 15].rotate_right(7) ^ w[i - 15].rotate_right(18) ^ w[i - 15] >> 3;
            let s1 = w[i - 2].rotate_right(17) ^ w[i - 2].rotate_right(19) ^ w[i - 2] >> 10;
            w[i] = w[i - 16].wrapping_add(s0).wrapping_add(w[i - 7]).wrapping_add(s1);
        }
        let mut v: [u32; 8] = h[..8].try_into().unwrap();
        for i in 0..64 {
            let [a, b, c, d, e, f, g, last] = v;
            let s1 = e.rotate_right(6) ^ e.rotate_right(11) ^ e.rotate_right(25);
            let t1 = last.wrapping_add(s1).wrapping_add((e & f) ^ (!e & g)).wrapping_add(k[i]).wrapping_add(w[i]);
            let s0 = a.rotate_right(2) ^ a.rotate_right(13) ^ a.rotate_right(22);
            let t2 = s0.wrapping_add((a & b) ^ (a & c) ^ (b & c));
            v = [t1.wrapping_add(t2), a, b, c, d.wrapping_add(t1), e, f, g];
        }
        h.iter_mut().zip(v).for_each(|(h, v)| *h = h.wrapping_add(v));
    }
    h.iter().map(|v| format!("{v:08x}")).collect()
}
