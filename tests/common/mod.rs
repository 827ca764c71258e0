//! What the integration tests share: volumes, runs, decoded outputs, and a comparison that has a failing test of its own.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use occlude::brick::Voxels;
use occlude::config::{self, Config};
use occlude::grid::Region;
use occlude::run::{Report, RunOptions, Silent};

/// A number from a seed and an index: the same on every machine.
pub fn hash(seed: u64, index: u64) -> u64 {
    let mut h = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ index.wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 31)).wrapping_mul(0x94d0_49bb_1331_11eb);
    h ^ (h >> 29)
}

/// Writes an array as .npy.
pub fn write_npy(path: &Path, descr: &str, shape: [usize; 3], data: &[u8]) {
    let mut header = format!(
        "{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}, {}, {}), }}",
        shape[0], shape[1], shape[2]
    );
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((header.len() as u16).to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(data);
    fs::write(path, file).unwrap();
}

/// Blobs, flats and noise as u16: smooth enough for levels, rough enough for ranks, with constant corners.
pub fn mixed_u16(shape: [usize; 3]) -> Vec<u16> {
    let value = |z: usize, y: usize, x: usize| {
        if z < shape[0] / 3 && y < shape[1] / 3 {
            return 100;
        }
        let wave = ((z as f64 * 0.23).sin() + (y as f64 * 0.31).cos() + (x as f64 * 0.17).sin()) * 8000.0 + 30000.0;
        let noise = hash(7, ((z * 4096 + y) * 4096 + x) as u64) % 3000;
        wave as u16 + noise as u16
    };
    fill(shape, value)
}

/// Values of a function of z, y, x in C order.
pub fn fill<T>(shape: [usize; 3], value: impl Fn(usize, usize, usize) -> T) -> Vec<T> {
    let mut out = Vec::with_capacity(shape.iter().product());
    for z in 0..shape[0] {
        for y in 0..shape[1] {
            out.extend((0..shape[2]).map(|x| value(z, y, x)));
        }
    }
    out
}

pub fn u16_bytes(v: &[u16]) -> Vec<u8> {
    v.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub fn f32_bytes(v: &[f32]) -> Vec<u8> {
    v.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// A config from text, as if it stood in `dir`.
pub fn parse(dir: &Path, text: &str, sets: &[&str]) -> Config {
    let sets: Vec<String> = sets.iter().map(|s| s.to_string()).collect();
    config::parse(text, &dir.join("config.toml"), &sets).unwrap_or_else(|e| panic!("{e}"))
}

/// Runs a config; existing outputs of ours are deleted first.
pub fn run(dir: &Path, text: &str, sets: &[&str]) -> Report {
    run_with(&parse(dir, text, sets), &RunOptions { overwrite: true, ..Default::default() })
}

pub fn run_with(config: &Config, options: &RunOptions) -> Report {
    occlude::run::run(config, options, &Silent).unwrap_or_else(|e| panic!("{e}"))
}

/// One array of an output: shape and voxels as exact numbers, per level and component.
pub type Decoded = BTreeMap<String, (Vec<usize>, Vec<u64>)>;

/// Every level and component of an output, decoded by this program's own reader.
pub fn decode(path: &Path) -> Decoded {
    let mut all = Decoded::new();
    for level in 0.. {
        let text = format!(
            "[input.a]\npath = '{}'\nlevel = {level}\nchannel = 'all'\n[output.b]\npath = 'b.npy'\nfrom = 'a'\n",
            path.display()
        );
        let Ok(config) = config::parse(&text, Path::new("/nowhere/config.toml"), &[]) else { break };
        let Ok(mut source) = occlude::store::Source::open(&config.inputs[0]) else { break };
        source.prepare(Path::new("/nowhere"), &|_| true).unwrap();
        let info = source.info().clone();
        for c in 0..info.components {
            let mut voxels = Voxels::zeroed(info.dtype, info.voxels());
            read_whole(&source, c, &mut voxels);
            let numbers = (0..voxels.len()).map(|i| voxels.at(i).to_bits()).collect();
            all.insert(format!("level {level} component {c}"), (info.shape.to_vec(), numbers));
        }
        if level > 0 && info.chunk.is_none() {
            break;
        }
    }
    assert!(!all.is_empty(), "nothing to decode at {}", path.display());
    all
}

fn read_whole(source: &occlude::store::Source, component: usize, out: &mut Voxels) {
    let info = source.info();
    let whole = Region::whole(info.shape);
    let Some(chunk) = info.chunk else {
        source.read(component, whole, out.view_mut(info.shape)).unwrap();
        return;
    };
    for index in whole.cells([0; 3], chunk).iter() {
        let mut part = Voxels::zeroed(info.dtype, chunk.iter().product());
        if let occlude::store::source::ChunkRead::Missing(v) = source.read_chunk(component, index, &mut part).unwrap() {
            part.fill(v);
        }
        let region = Region::of_cell(index, [0; 3], chunk);
        occlude::brick::gather::copy_common(part.view(chunk), region, out.view_mut(info.shape), whole);
    }
}

/// The metadata files of a Zarr output, by name.
pub fn metadata(path: &Path) -> BTreeMap<PathBuf, String> {
    let mut found = BTreeMap::new();
    let mut open = vec![path.to_path_buf()];
    while let Some(dir) = open.pop() {
        for entry in fs::read_dir(dir).unwrap() {
            let entry = entry.unwrap().path();
            if entry.is_dir() {
                open.push(entry);
            } else if entry.file_name().is_some_and(|n| n == "zarr.json" || n.to_string_lossy().starts_with(".z")) {
                let text = fs::read_to_string(&entry).unwrap();
                found.insert(entry.strip_prefix(path).unwrap().to_path_buf(), text);
            }
        }
    }
    found
}

/// The first difference of two decoded outputs, in words.
pub fn difference(a: &Decoded, b: &Decoded) -> Option<String> {
    if a.keys().ne(b.keys()) {
        return Some(format!("arrays {:?} against {:?}", a.keys(), b.keys()));
    }
    for (name, (shape, values)) in a {
        let (other_shape, others) = &b[name];
        if shape != other_shape {
            return Some(format!("{name}: shape {shape:?} against {other_shape:?}"));
        }
        if let Some(i) = (0..values.len()).find(|&i| values[i] != others[i]) {
            let (ny, nx) = (shape[1], shape[2]);
            let at = [i / (ny * nx), i / nx % ny, i % nx];
            let count = (0..values.len()).filter(|&i| values[i] != others[i]).count();
            let (v, o) = (f64::from_bits(values[i]), f64::from_bits(others[i]));
            return Some(format!("{name} {at:?} (z, y, x): {v} against {o}, {count} voxels differ"));
        }
    }
    None
}

/// Asserts that two outputs decode to the same bytes.
pub fn assert_same(what: &str, a: &Decoded, b: &Decoded) {
    if let Some(text) = difference(a, b) {
        panic!("{what}: {text}");
    }
}

/// The path of the program under test.
pub fn program() -> PathBuf {
    PathBuf::from(env!("CARGO_BIN_EXE_occlude"))
}
