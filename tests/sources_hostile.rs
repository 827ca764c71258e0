//! Files that are cut off, lie or were hit by stray bits: each is answered with an error that helps, or with voxels;
//! never with a panic, a hang or an allocation by an unchecked number.

mod common_sources;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};

use common_sources::*;
use occlude::brick::Voxels;
use occlude::config::{Input, Select};
use occlude::grid::{DType, Region};
use occlude::store::Source;

/// Remembers the largest request, so that the tests can bound it.
struct Watched;
thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

fn note(size: usize) {
    let _ = LARGEST.try_with(|largest| largest.set(largest.get().max(size)));
}

fn largest() -> usize {
    LARGEST.with(Cell::get)
}

// SAFETY: every call is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, old: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note(size);
        unsafe { System.realloc(old, layout, size) }
    }
    unsafe fn dealloc(&self, old: *mut u8, layout: Layout) {
        unsafe { System.dealloc(old, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watched = Watched;

/// Most bytes that any single request may ask for while small files are read.
const BOUND: usize = 64 << 20;

/// A fixed sequence of numbers (xorshift), so that every failure can be repeated.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n.max(1) as u64) as usize
    }

    /// Flips, overwrites, removes or repeats a few bytes of the first `header` ones.
    fn damage(&mut self, bytes: &mut Vec<u8>, header: usize) {
        const ODD: [&[u8]; 12] = [
            b"\xff\xff\xff\xff",
            b"\0\0\0\0",
            b"-1",
            b"0",
            b"99999999999",
            b"nan",
            b"\x7f",
            b"\x80",
            b"1e300",
            b"(",
            b"\n",
            b"\xfe",
        ];
        for _ in 0..1 + self.below(3) {
            let n = header.min(bytes.len());
            let at = self.below(n);
            match self.below(6) {
                0 if n > 0 => bytes[at] ^= 1 << self.below(8),
                1 if n > 0 => bytes[at] = self.below(256) as u8,
                2 => {
                    let odd = ODD[self.below(ODD.len())];
                    let end = (at + odd.len()).min(bytes.len());
                    bytes[at..end].copy_from_slice(&odd[..end - at]);
                }
                3 => {
                    let odd = ODD[self.below(ODD.len())];
                    bytes.splice(at..at, odd.iter().copied());
                }
                4 => bytes.truncate(self.below(bytes.len())),
                _ => {
                    let end = (at + 1 + self.below(8)).min(bytes.len());
                    bytes.drain(at..end);
                }
            }
        }
    }
}

/// Opens a damaged volume and reads what it then claims to hold, if that is little.
fn survive(input: &Input) -> Result<(), String> {
    let mut source = Source::open(input).map_err(|e| e.to_string())?;
    source.identity().map_err(|e| e.to_string())?;
    let scratch = tempfile::tempdir().unwrap();
    if source.spool_bytes() < 1 << 24 {
        source.prepare(scratch.path(), &|_| true).map_err(|e| e.to_string())?;
    }
    let info = source.info().clone();
    assert!(info.spacing.iter().all(|s| s.is_finite() && *s > 0.0), "{info:?}");
    assert!(info.origin.iter().all(|s| s.is_finite()), "{info:?}");
    let whole = Region::whole(info.shape);
    for component in [0, info.components - 1] {
        let last = info.shape.map(|n| n as i64 - 1);
        let corner = Region::new(last, last.map(|i| i + 1));
        let cells = info.chunk.map_or(1, |c| whole.cells([0; 3], c).voxels());
        let region = if info.shape.iter().all(|n| *n <= 64) && cells <= 512 { whole } else { corner };
        if info.chunk.is_some_and(|c| c.iter().product::<usize>() > 1 << 20) {
            continue;
        }
        let mut out = Voxels::zeroed(info.dtype, region.voxels());
        source.read(component, region, out.view_mut(region.shape())).map_err(|e| e.to_string())?;
    }
    Ok(())
}

/// Writes a file anew: cutting an old one to nothing first makes some file systems wait for the disk.
fn replace(path: &Path, bytes: &[u8]) {
    fs::remove_file(path).unwrap();
    fs::write(path, bytes).unwrap();
}

/// Damages `name` (a file; others beside it are copied along) `rounds` times and reads it each time.
fn fuzz(name: &str, header: usize, rounds: usize, select: Select) {
    let folder = tempfile::tempdir().unwrap();
    let source = data(name);
    for entry in fs::read_dir(source.parent().unwrap()).unwrap().flatten().filter(|e| e.path().is_file()) {
        fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
    }
    let path = folder.path().join(source.file_name().unwrap());
    let good = fs::read(&source).unwrap();
    let mut random = Random(0x9E37_79B9_7F4A_7C15 ^ name.len() as u64);
    let (mut read, mut refused) = (0, 0);
    for round in 0..rounds {
        let mut bytes = good.clone();
        random.damage(&mut bytes, header);
        replace(&path, &bytes);
        let mut input = file_input(&path);
        (input.channel, input.time) = (select, select);
        let result = std::panic::catch_unwind(|| survive(&input));
        let keep = |what: &str| {
            panic!(
                "{name}, round {round}: {what}; header {:?}",
                String::from_utf8_lossy(&bytes[..bytes.len().min(header)])
            )
        };
        match result {
            Ok(Ok(())) => read += 1,
            Ok(Err(text)) => {
                assert!(!text.trim().is_empty());
                refused += 1;
            }
            Err(_) => keep("panicked"),
        }
        if largest() > BOUND {
            keep(&format!("asked for {} bytes", largest()));
        }
    }
    assert!(
        read > 0 && refused > rounds / 50,
        "{name}: {read} read, {refused} refused: the damage is too weak or too strong"
    );
}

#[test]
fn damaged_nifti() {
    fuzz("nifti/i16.nii", 352, 3000, Select::All);
    fuzz("nifti/be2.nii", 544, 2000, Select::Index(0));
    fuzz("nifti/time.nii.gz", 200, 1000, Select::All);
}

#[test]
fn damaged_nrrd() {
    fuzz("nrrd/raw.nrrd", 330, 3000, Select::All);
    fuzz("nrrd/gz.nrrd", 500, 2000, Select::Index(0));
    fuzz("nrrd/det.nhdr", 300, 2000, Select::All);
    fuzz("nrrd/vec.nrrd", 300, 2000, Select::All);
}

#[test]
fn damaged_metaimage() {
    fuzz("meta/plain.mha", 330, 3000, Select::All);
    fuzz("meta/rot.mha", 600, 2000, Select::Index(0));
    fuzz("meta/vec.mha", 400, 2000, Select::All);
}

#[test]
fn damaged_tiff() {
    fuzz("tiff/strips.tif", 2000, 3000, Select::Index(0));
    fuzz("tiff/be_lzwish.tif", 3000, 2000, Select::Index(0));
    fuzz("tiff/tiled.tif", 2000, 2000, Select::All);
    fuzz("tiff/imagej.tif", 600, 3000, Select::All);
    fuzz("tiff/ome.ome.tif", 1200, 3000, Select::All);
}

#[test]
fn damaged_npy() {
    fuzz("npy/c.npy", 80, 3000, Select::Index(0));
    fuzz("npy/f.npy", 80, 2000, Select::All);
}

/// Damages one file of a Zarr folder at a time.
fn fuzz_zarr(name: &str, rounds: usize, select: Select) {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("v.zarr");
    copy_tree(&data(name), &root);
    let mut files = Vec::new();
    fn walk(folder: &Path, files: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap().flatten() {
            if entry.path().is_dir() { walk(&entry.path(), files) } else { files.push(entry.path()) }
        }
    }
    walk(&root, &mut files);
    files.sort();
    let (metadata, chunks): (Vec<_>, Vec<_>) = files
        .into_iter()
        .partition(|f| f.file_name().unwrap().to_string_lossy().contains(".z") || f.ends_with("zarr.json"));
    let mut random = Random(0xD1B5_4A32_D192_ED03 ^ name.len() as u64);
    let (mut read, mut refused) = (0, 0);
    for round in 0..rounds {
        let list = if round % 3 == 0 { &chunks } else { &metadata };
        let path = &list[random.below(list.len())];
        let good = fs::read(path).unwrap();
        let mut bytes = good.clone();
        random.damage(&mut bytes, good.len());
        replace(path, &bytes);
        let mut input = file_input(&root);
        (input.channel, input.time) = (select, select);
        let result = std::panic::catch_unwind(|| survive(&input));
        let what = || format!("{name}, round {round}, {}: {}", path.display(), String::from_utf8_lossy(&bytes));
        match result {
            Ok(Ok(())) => read += 1,
            Ok(Err(_)) => refused += 1,
            Err(_) => panic!("panicked: {}", what()),
        }
        assert!(largest() <= BOUND, "{} bytes asked for: {}", largest(), what());
        replace(path, &good);
    }
    assert!(read > 0 && refused > rounds / 50, "{name}: {read} read, {refused} refused");
}

#[test]
fn damaged_zarr() {
    fuzz_zarr("zarr/v3sharded", 1000, Select::Index(0));
    fuzz_zarr("zarr/v3plain", 600, Select::All);
    fuzz_zarr("zarr/v2be", 600, Select::Index(0));
    fuzz_zarr("zarr/v2f", 600, Select::Index(0));
    fuzz_zarr("zarr/ome05", 1000, Select::All);
    fuzz_zarr("zarr/ome04", 600, Select::Index(0));
}

/// Every cut of every small file is an error or (past the last voxel) the whole volume.
#[test]
fn cut_off_at_every_byte() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["nifti/u8.nii", "nrrd/raw.nrrd", "meta/plain.mha", "npy/c.npy", "meta/rot.mha", "nrrd/gz.nrrd"] {
        let good = fs::read(data(name)).unwrap();
        let path = folder.path().join(Path::new(name).file_name().unwrap());
        for n in 0..good.len() {
            fs::write(&path, &good[..n]).unwrap();
            let result = survive(&file_input(&path));
            assert!(result.is_err() || n + 16 > good.len(), "{name} cut to {n} of {} bytes was read", good.len());
        }
    }
}

/// Headers that lie in one chosen way, and a word that the answer must hold.
#[test]
fn lies_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let nrrd =
        |more: &str| format!("NRRD0004\ntype: uchar\ndimension: 3\nencoding: raw\n{more}\n\n0123456789").into_bytes();
    let mha = |more: &str| {
        format!("ObjectType = Image\nNDims = 3\nElementType = MET_UCHAR\n{more}\nElementDataFile = LOCAL\n0123456789")
            .into_bytes()
    };
    let npy = |dict: &str| {
        let mut b = b"\x93NUMPY\x01\0".to_vec();
        b.extend((dict.len() as u16).to_le_bytes());
        b.extend(dict.as_bytes());
        b
    };
    let mut pair = vec![0; 348];
    pair[..4].copy_from_slice(&348u32.to_le_bytes());
    let lies: Vec<(&str, Vec<u8>, &str)> = vec![
        ("a.nrrd", nrrd("sizes: 4 4 4"), "cut off or its header is wrong"),
        ("b.nrrd", nrrd("sizes: 4294967296 4294967296 4294967296"), "larger than any file"),
        ("c.nrrd", nrrd("sizes: 0 4 4"), "size 0"),
        ("d.nrrd", nrrd("sizes: 4 4"), "3 numbers are expected"),
        ("e.nrrd", nrrd("sizes: 1 1 1\nspacings: 0 1 1"), "spacing"),
        (
            "f.nrrd",
            b"NRRD0004\ntype: uchar\ndimension: 3\nencoding: hex\nsizes: 1 1 1\n\n0".to_vec(),
            "raw, gzip and bzip2 are",
        ),
        // Text has no byte order.
        (
            "f2.nrrd",
            b"NRRD0004\ntype: short\ndimension: 3\nencoding: ascii\nsizes: 1 1 1\n\n7".to_vec(),
            "raw, gzip and bzip2 are",
        ),
        ("pair.hdr", pair.clone(), "pairs of .hdr and .img"),
        ("pair.img", vec![0; 64], "pairs of .hdr and .img"),
        ("g.nrrd", b"NRRD0004\ntype: block\ndimension: 3\nencoding: raw\nsizes: 1 1 1\n\n0".to_vec(), "block"),
        ("h.nrrd", b"NRRD0004\ntype: short\ndimension: 3\nencoding: raw\nsizes: 1 1 1\n\n00".to_vec(), "endian"),
        ("i.nrrd", nrrd("sizes: 3 1 1\nkinds: RGB-color space space"), "rgb-color"),
        (
            "j.nhdr",
            b"NRRD0004\ntype: uchar\ndimension: 3\nencoding: raw\nsizes: 1 1 1\ndata file: gone.raw\n".to_vec(),
            "gone.raw",
        ),
        ("k.mha", mha("DimSize = 4 4 4"), "cut off or its header is wrong"),
        ("l.mha", mha("DimSize = -4 4 4"), "DimSize"),
        ("m.mha", mha("DimSize = 2 2 2\nBinaryData = False"), "BinaryData"),
        ("n.mha", mha("DimSize = 2 2 2\nCompressedData = True"), "zlib"),
        ("o.mha", mha("DimSize = 2 2 2\nElementNumberOfChannels = 99999999999999"), "cut off"),
        ("p.npy", npy("{'descr': '<u2', 'fortran_order': False, 'shape': (4, 4, 4), }"), "cut off"),
        ("q.npy", npy("{'descr': '<u2', 'fortran_order': False, 'shape': (2, 1, 4, 4, 4), }"), "four axes"),
        ("qa.npy", npy("{'descr': '<u2', 'fortran_order': False, 'shape': (0, 4, 4, 4), }"), "axis c has size 0"),
        ("qb.npy", npy("{'descr': '<u2', 'fortran_order': False, 'shape': (2, 4, 4, 4), }"), "cut off"),
        (
            "qc.npy",
            npy("{'descr': '<u2', 'fortran_order': True, 'shape': (4611686018427387904, 4, 4, 4), }"),
            "overflow",
        ),
        ("r.npy", npy("{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (4,), }"), "structured"),
        ("s.npy", npy("{'descr': '<c8', 'fortran_order': False, 'shape': (4,), }"), "complex64"),
        ("t.npy", npy("{'descr': '<u2', 'fortran_order': False, 'shape': (99999999999999999999,), }"), "sizes"),
        ("u.tif", b"II*\0\xff\xff\xff\xff".to_vec(), "TIFF"),
        ("v.nii", vec![0; 400], "NIfTI"),
        ("w.nii.gz", gzip(&[0; 400]), "NIfTI"),
        ("x.nii", Vec::new(), "shorter than a header"),
        ("y.tif", Vec::new(), "TIFF"),
    ];
    for (name, bytes, word) in lies {
        fs::write(at(name), bytes).unwrap();
        let text = survive(&file_input(&at(name))).expect_err(name);
        assert!(text.contains(word) && text.contains(folder.path().to_str().unwrap()), "{name}: {text}");
    }
}

#[test]
fn lying_zarr_metadata_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let array = |shape: &str, chunk: &str, kind: &str| {
        format!(
            r#"{{"zarr_format":3,"node_type":"array","shape":{shape},"data_type":"{kind}","chunk_grid":{{"name":"regular",
            "configuration":{{"chunk_shape":{chunk}}}}},"chunk_key_encoding":{{"name":"default"}},"fill_value":0,
            "codecs":[{{"name":"bytes","configuration":{{"endian":"little"}}}}]}}"#
        )
    };
    for (text, word) in [
        (array("[4,4,4]", "[1099511627776,1024,1024]", "uint8"), "one chunk"),
        (array("[4,4,4]", "[4,4]", "uint8"), "3 sizes"),
        (array("[4,4,4]", "[0,4,4]", "uint8"), "at least 1"),
        (array("[4,0,4]", "[4,4,4]", "uint8"), "at least 1"),
        (array("[-1,4,4]", "[4,4,4]", "uint8"), "shape"),
        (array("[281474976710655,281474976710655,281474976710655]", "[4,4,4]", "uint8"), "larger than any store"),
        (array("[4,4,4]", "[4,4,4]", "uint64"), "u64"),
        (array("[4,4,4]", "[4,4,4]", "bool"), "bool"),
        (array("[4,4,4]", "[4,4,4]", "float16"), "f16"),
        (array("[2,2,2,2,4,4,4]", "[1,1,1,1,4,4,4]", "uint8"), "more axes"),
        (array("[4,4,4]", "[4,4,4]", "uint8").replace("\"bytes\"", "\"bz2\""), "codecs that are read: blosc"),
        ("{}".to_string(), "neither"),
        ("{".to_string(), "broken JSON"),
        (r#"{"zarr_format":3,"node_type":"group","attributes":{}}"#.to_string(), "without multiscales"),
        (r#"{"zarr_format":3,"node_type":"group","attributes":{"ome":{"version":"0.5","multiscales":[{"datasets":[{"path":"../up"}]}]}}}"#.to_string(), "no name"),
        (r#"{"zarr_format":3,"node_type":"group","attributes":{"ome":{"version":"0.5","multiscales":[{"datasets":[{"path":"0"}]}]}}}"#.to_string(), "does not exist"),
    ] {
        fs::write(folder.path().join("zarr.json"), &text).unwrap();
        let e = survive(&file_input(folder.path())).expect_err(&text);
        assert!(e.contains(word), "{text}: {e}");
    }
    fs::remove_file(folder.path().join("zarr.json")).unwrap();
    let e = survive(&file_input(folder.path())).unwrap_err();
    assert!(e.contains("neither a Zarr array or group nor"), "{e}");
}

/// A corrupt chunk or shard index is named, and a bomb is not unpacked.
#[test]
fn corrupt_chunks_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("v");
    copy_tree(&data("zarr/v3sharded"), &root);
    let shard = root.join("c/0/0/0");
    let good = fs::read(&shard).unwrap();
    let mut bytes = good.clone();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&shard, &bytes).unwrap();
    let e = survive(&file_input(&root)).unwrap_err();
    assert!(e.contains("index is corrupt") && e.contains("c/0/0/0"), "{e}");
    bytes = good.clone();
    bytes[4] ^= 0x40; // the size that the first chunk's blosc header declares
    fs::write(&shard, &bytes).unwrap();
    let e = survive(&file_input(&root)).unwrap_err();
    assert!(e.contains("chunk [0, 0, 0] cannot be decoded"), "{e}");

    // A gzip chunk of 8 MiB of zeros in place of 48 bytes.
    let root = folder.path().join("bomb");
    copy_tree(&data("zarr/v2be"), &root);
    fs::write(root.join("0.0.0"), gzip(&vec![0; 8 << 20])).unwrap();
    let mut chunk = Voxels::zeroed(DType::I16, 24);
    let e = Source::open(&file_input(&root)).unwrap().read_chunk(0, [0; 3], &mut chunk).unwrap_err().to_string();
    assert!(e.contains("more than the 48 bytes that the metadata say"), "{e}");
}

/// Nobody writes into these pipes: an open would wait for ever.
#[test]
fn pipes_are_no_volumes() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("p.raw");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\ndata file: p.raw\n";
    fs::write(folder.path().join("p.nhdr"), header).unwrap();
    let raw = raw_format([2, 3, 4], DType::U8);
    for input in [raw_input(&pipe, raw), file_input(&folder.path().join("p.nhdr"))] {
        let error = Source::open(&input).unwrap_err().to_string();
        assert!(error.contains("p.raw") && error.contains("neither a file nor a folder"), "{error}");
    }
}
