//! Outputs read back by other means than the program's own readers, and what becomes of them when things go wrong.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use occlude::brick::Voxels;
use occlude::brick::gather::copy_common;
use occlude::config::{Codec, OutputFormat};
use occlude::grid::{DType, Region, Shape, Voxel};
use occlude::store::info::Orientation;
use occlude::store::sink::{Encoded, Existing, existing, remove_ours};
use occlude::store::{Pyramid, Sink, SinkSpec};
use occlude::with_voxels;
use serde_json::{Value, json};

const ZARR: [OutputFormat; 2] = [OutputFormat::OmeZarr05, OutputFormat::OmeZarr04];

fn spec(path: PathBuf, format: OutputFormat, dtype: DType, shape: Shape) -> SinkSpec {
    let count = if ZARR.contains(&format) { None } else { Some(1) };
    SinkSpec {
        name: "ao".into(),
        path,
        format,
        dtype,
        fill: if dtype.is_float() { f64::NAN } else { 1.0 },
        pyramid: Pyramid::new(shape, [0.5, 0.25, 0.25], [0.0; 3], [8; 3], count, false),
        components: None,
        component_names: Vec::new(),
        chunk: [8; 3],
        shard: Some([16, 16, 32]),
        codec: Codec::BloscLz4,
        unit: Some("millimeter".into()),
        orientation: None,
        region_start: [0; 3],
        reduce_name: "mean".into(),
    }
}

/// Voxels of one level and component: noise, with a corner of the fill value alone.
fn field(spec: &SinkSpec, level: usize, component: usize) -> Voxels {
    let shape = spec.pyramid.levels[level].shape;
    let mut v = Voxels::zeroed(spec.dtype, shape.iter().product());
    let (lo, hi) = spec.dtype.range();
    let (lo, hi) = (lo.max(-1e6), hi.min(1e6));
    let mut state = 1 + (level * 7 + component) as u64;
    with_voxels!(&mut v, v => for (i, d) in v.iter_mut().enumerate() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        let random = lo + (hi - lo) * ((state >> 33) as f64 / (1u64 << 31) as f64);
        let inside = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]].iter().all(|p| *p < 8);
        *d = Voxel::from_f64(if inside { spec.fill } else { random });
    });
    v
}

fn pieces(spec: &SinkSpec, level: usize, piece: Shape) -> Vec<Region> {
    let whole = Region::whole(spec.pyramid.levels[level].shape);
    whole.cells([0; 3], piece).iter().map(|i| Region::of_cell(i, [0; 3], piece).clip(&whole)).collect()
}

fn cut(whole: &Voxels, shape: Shape, region: Region) -> Voxels {
    let mut part = Voxels::zeroed(whole.dtype(), region.voxels());
    copy_common(whole.view(shape), Region::whole(shape), part.view_mut(region.shape()), region);
    part
}

fn put_region(sink: &Sink, level: usize, within: Region) {
    let spec = sink.spec();
    let shape = spec.pyramid.levels[level].shape;
    for component in 0..spec.components.unwrap_or(1) {
        let whole = field(spec, level, component);
        // Backwards, since the order must not matter.
        for region in pieces(spec, level, spec.chunk).into_iter().rev().filter(|r| within.contains(r)) {
            let chunk = sink.encode(level, region, cut(&whole, shape, region).view(region.shape())).unwrap();
            sink.put(level, component, region, chunk).unwrap();
        }
    }
}

fn occlude() -> Value {
    json!({ "complete": true, "version": "0", "config_hash": "00ff00ff", "method": "exact" })
}

fn write_levels(sink: &Sink) {
    for level in 0..sink.spec().pyramid.levels.len() {
        // As tasks do: whole shards, several chunk files at once.
        let file = if sink.spec().is_zarr() { sink.spec().file_shape() } else { sink.spec().chunk };
        let step = std::array::from_fn(|a| [16usize, 16, 32][a].next_multiple_of(file[a]));
        for file in pieces(sink.spec(), level, step) {
            put_region(sink, level, file);
            sink.commit(level, file).unwrap();
            sink.commit(level, file).unwrap();
        }
    }
}

fn write_all(spec: SinkSpec) -> SinkSpec {
    let sink = Sink::create(spec, false).unwrap();
    write_levels(&sink);
    let windows = vec![[0.0, 1.0]; sink.spec().components.unwrap_or(0)];
    sink.finish(&occlude(), &windows).unwrap();
    sink.spec().clone()
}

/// All voxels of a level by zarrs, as little-endian bytes.
fn read_zarr(spec: &SinkSpec, level: usize) -> Vec<u8> {
    let store = Arc::new(zarrs::filesystem::FilesystemStore::new(&spec.path).unwrap());
    let array = zarrs::array::Array::open(store, &format!("/{level}")).unwrap();
    let bytes: zarrs::array::ArrayBytes = array.retrieve_array_subset(&array.subset_all()).unwrap();
    bytes.into_fixed().unwrap().into_owned()
}

fn expected(spec: &SinkSpec, level: usize) -> Vec<u8> {
    (0..spec.components.unwrap_or(1)).flat_map(|c| field(spec, level, c).as_bytes().to_vec()).collect()
}

fn check_zarr(spec: &SinkSpec) {
    for level in 0..spec.pyramid.levels.len() {
        let what = format!("{:?} {} {:?} {:?} level {level}", spec.format, spec.dtype, spec.codec, spec.shard);
        assert!(read_zarr(spec, level) == expected(spec, level), "{what}");
    }
}

/// Files and links below a folder, relative to it, sorted; none if there is no folder.
fn files_below(dir: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).into_iter().flatten().map(|e| e.unwrap()) {
        let name = entry.file_name().into_string().unwrap();
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(files_below(&entry.path()).iter().map(|f| format!("{name}/{f}"))),
            false => found.push(name),
        }
    }
    found.sort();
    found
}

#[test]
fn zarrs_reads_back_every_type_codec_and_layout() {
    let folder = tempfile::tempdir().unwrap();
    let codecs = [Codec::BloscLz4, Codec::Zstd(1), Codec::None];
    for (i, format) in ZARR.into_iter().enumerate() {
        for (d, dtype) in DType::ALL.into_iter().enumerate() {
            for (k, codec) in codecs.into_iter().enumerate() {
                // Every layout and codec with u8, every type with some of them: syncing files is what costs time here.
                let layouts = [Some([16, 16, 32]), None, Some([8; 3]), Some([64; 3])];
                let some = |j: &usize| dtype == DType::U8 || (*j == d % 4 && k == d % 3);
                for (j, shard) in layouts.into_iter().enumerate().filter(|(j, _)| some(j)) {
                    let path = folder.path().join(format!("{i}-{dtype}-{k}-{j}.zarr"));
                    let spec = SinkSpec { codec, shard, ..spec(path, format, dtype, [17, 9, 35]) };
                    let spec = write_all(spec);
                    check_zarr(&spec);
                    assert!(!Sink::work_dir(&spec.path).exists());
                }
            }
        }
    }
}

#[test]
fn thin_shapes_components_and_start_levels_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    for (i, format) in ZARR.into_iter().enumerate() {
        for (j, shape) in [[1, 1, 1], [1, 33, 40], [8, 8, 8], [40, 1, 7]].into_iter().enumerate() {
            let path = folder.path().join(format!("{i}-{j}.zarr"));
            let mut spec = spec(path, format, DType::U16, shape);
            spec.components = Some(3);
            spec.component_names = vec!["a".into(), "b".into()];
            spec.pyramid = Pyramid::starting_at(1, shape, [1.0; 3], [0.0; 3], [8; 3], None, false);
            check_zarr(&write_all(spec));
        }
    }
}

#[test]
fn nothing_stands_under_a_final_name_before_its_commit_and_empty_shards_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut spec = spec(folder.path().join("a.zarr"), OutputFormat::OmeZarr05, DType::U8, [16, 16, 64]);
    spec.shard = Some([8, 8, 8]); // the corner shard holds the fill value alone
    let sink = Sink::create(spec, false).unwrap();
    let whole = Region::whole([16, 16, 64]);
    put_region(&sink, 0, whole);
    let data = |level: usize| files_below(&sink.spec().path.join(format!("{level}/c")));
    assert_eq!(data(0), Vec::<String>::new());
    assert!(sink.finish(&occlude(), &[]).unwrap_err().to_string().contains("not committed"));
    sink.commit(0, Region::new([0, 0, 8], [8, 8, 16])).unwrap();
    assert_eq!(data(0), ["0/0/1"]);
    sink.commit(0, whole).unwrap();
    assert_eq!(data(0).len(), 2 * 2 * 8 - 1);
    assert!(!data(0).contains(&"0/0/0".to_string()));
    // A chunk that turns out to be empty when it is done again is not stored.
    let corner = Region::new([0; 3], [8; 3]);
    sink.put(0, 0, corner, Encoded::Bytes(vec![1, 2, 3])).unwrap();
    sink.put(0, 0, corner, Encoded::Empty).unwrap();
    sink.commit(0, corner).unwrap();
    assert_eq!(data(0).len(), 2 * 2 * 8 - 1);
    assert_eq!(files_below(&Sink::work_dir(&sink.spec().path).join("tmp")), Vec::<String>::new());
}

#[test]
fn metadata_has_placement_names_and_marks() {
    let folder = tempfile::tempdir().unwrap();
    let mut five = spec(folder.path().join("five.zarr"), OutputFormat::OmeZarr05, DType::F32, [16, 32, 32]);
    five.components = Some(2);
    five.component_names = vec!["mean".into(), "variance".into()];
    let sink = Sink::create(five, false).unwrap();
    let root = || -> Value { serde_json::from_slice(&fs::read(sink.spec().path.join("zarr.json")).unwrap()).unwrap() };
    assert!(root()["attributes"]["occlude"].is_object() && root()["attributes"]["occlude"]["complete"].is_null());
    write_levels(&sink);
    sink.finish(&occlude(), &[[0.0, 2.0], [0.0, f64::INFINITY]]).unwrap();
    let root = root();
    let ome = &root["attributes"]["ome"];
    assert_eq!(root["attributes"]["occlude"], occlude());
    assert_eq!(ome["omero"]["channels"][1]["label"], "variance");
    assert_eq!(ome["omero"]["channels"][0]["window"]["end"], 2.0);
    assert_eq!(ome["omero"]["channels"][1]["window"]["end"], 1.0, "JSON has no infinity");
    let image = &ome["multiscales"][0];
    assert_eq!(image["axes"][0], json!({ "name": "c", "type": "channel" }));
    assert_eq!(image["axes"][1], json!({ "name": "z", "type": "space", "unit": "millimeter" }));
    assert_eq!(image["datasets"][1]["path"], "1");
    // z is twice as coarse: only y and x are halved.
    let transforms = &image["datasets"][1]["coordinateTransformations"];
    assert_eq!(transforms[0], json!({ "type": "scale", "scale": [1.0, 0.5, 0.5, 0.5] }));
    assert_eq!(transforms[1], json!({ "type": "translation", "translation": [0.0, 0.0, 0.125, 0.125] }));
    assert_eq!((&ome["version"], &image["type"]), (&json!("0.5"), &json!("mean")));
    let array: Value = serde_json::from_slice(&fs::read(sink.spec().path.join("0/zarr.json")).unwrap()).unwrap();
    assert_eq!(array["dimension_names"], json!(["c", "z", "y", "x"]));
    assert_eq!(array["fill_value"], "NaN");
    assert_eq!(array["chunk_grid"]["configuration"]["chunk_shape"], json!([1, 16, 16, 32]));
    assert!(array["codecs"].as_array().unwrap().iter().all(Value::is_object));
}

/// Where the voxels of a flat file start, by each format's own word.
fn data_start(format: OutputFormat, bytes: &[u8]) -> usize {
    match format {
        OutputFormat::Npy => 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize,
        OutputFormat::Nrrd => bytes.windows(2).position(|w| w == b"\n\n").unwrap() + 2,
        OutputFormat::Nifti => f32::from_le_bytes(bytes[108..112].try_into().unwrap()) as usize,
        _ => 0,
    }
}

const FLAT: [(OutputFormat, &str); 4] = [
    (OutputFormat::Npy, "npy"),
    (OutputFormat::Raw, "raw"),
    (OutputFormat::Nrrd, "nrrd"),
    (OutputFormat::Nifti, "nii"),
];

#[test]
fn flat_files_hold_the_voxels_behind_their_header() {
    let folder = tempfile::tempdir().unwrap();
    for (format, extension) in FLAT {
        for dtype in DType::ALL {
            for (components, chunk) in [(None, [8; 3]), (Some(2), [3, 64, 64]), (None, [5, 4, 64])] {
                let path = folder.path().join(format!("{dtype}-{}.{extension}", chunk[0]));
                let mut spec = spec(path, format, dtype, [11, 9, 13]);
                (spec.components, spec.chunk, spec.shard) = (components, chunk, None);
                let spec = write_all(spec);
                let bytes = fs::read(&spec.path).unwrap();
                let start = data_start(format, &bytes);
                assert!(bytes[start..] == expected(&spec, 0), "{format:?} {dtype} {components:?}");
                assert!(
                    matches!(existing(&spec.path), Existing::Ours { complete: true, occlude: Some(o) } if o == occlude())
                );
                remove_ours(&spec.path).unwrap();
            }
        }
    }
}

#[test]
fn flat_files_of_thin_volumes_hold_every_voxel_in_its_place() {
    let folder = tempfile::tempdir().unwrap();
    for shape in [[19, 1, 21], [1, 19, 21], [19, 21, 1], [1, 1, 21], [19, 1, 1]] {
        let path = folder.path().join(format!("{shape:?}.raw"));
        let spec = write_all(spec(path, OutputFormat::Raw, DType::U16, shape));
        assert!(fs::read(&spec.path).unwrap() == expected(&spec, 0), "{shape:?}");
    }
}

#[test]
fn nrrd_and_nifti_keep_orientation_with_region_start() {
    let folder = tempfile::tempdir().unwrap();
    let matrix = [[-0.25, 0.0, 0.0, 10.0], [0.0, -0.25, 0.0, 20.0], [0.0, 0.0, 0.5, -5.0]];
    for (format, extension) in &FLAT[2..] {
        let mut spec = spec(folder.path().join(format!("o.{extension}")), *format, DType::U8, [4, 4, 4]);
        spec.orientation = Some(Orientation { matrix, space: "LPS".into() });
        (spec.region_start, spec.shard) = ([2, 4, 8], None);
        let spec = write_all(spec);
        let bytes = fs::read(&spec.path).unwrap();
        if *format == OutputFormat::Nrrd {
            let text = String::from_utf8_lossy(&bytes[..data_start(*format, &bytes)]).into_owned();
            assert!(text.contains("space: left-posterior-superior\n"), "{text}");
            assert!(text.contains("space origin: (8,19,-4)\n"), "{text}");
            assert!(text.contains("space directions: (-0.25,0,0) (0,-0.25,0) (0,0,0.5)\n"), "{text}");
            assert!(text.contains("occlude_config_hash:=00ff00ff\n"), "{text}");
        } else {
            let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
            // RAS: x and y change sign.
            let rows: Vec<f32> = (0..12).map(|i| float(280 + 4 * i)).collect();
            assert_eq!(rows, [0.25, 0.0, 0.0, -8.0, 0.0, 0.25, 0.0, -19.0, 0.0, 0.0, 0.5, -4.0]);
            assert_eq!((bytes[123], float(80), float(84), float(88)), (2, 0.25, 0.25, 0.5));
        }
    }
}

#[test]
fn a_long_axis_makes_it_nifti_2() {
    let folder = tempfile::tempdir().unwrap();
    let mut spec = spec(folder.path().join("long.nii"), OutputFormat::Nifti, DType::U8, [1, 2, 40_000]);
    (spec.chunk, spec.shard) = ([1, 2, 40_000], None);
    let spec = write_all(spec);
    let bytes = fs::read(&spec.path).unwrap();
    assert_eq!(bytes[..8], *b"\x1c\x02\0\0n+2\0");
    assert_eq!(i64::from_le_bytes(bytes[24..32].try_into().unwrap()), 40_000);
    assert!(bytes[544..] == expected(&spec, 0));
}

#[test]
fn resuming_keeps_what_is_committed_and_sweeps_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    for (format, extension) in
        [(OutputFormat::OmeZarr05, "zarr"), (OutputFormat::OmeZarr04, "04.zarr"), (OutputFormat::Npy, "npy")]
    {
        let spec = spec(folder.path().join(format!("r.{extension}")), format, DType::I16, [20, 20, 40]);
        let file = if spec.is_zarr() { spec.file_shape() } else { spec.chunk };
        let first = pieces(&spec, 0, file)[0];
        let sink = Sink::create(spec.clone(), false).unwrap();
        put_region(&sink, 0, first);
        sink.commit(0, first).unwrap();
        for r in pieces(&spec, 0, file).into_iter().skip(1).take(2) {
            put_region(&sink, 0, r); // lost with the process
        }
        drop(sink);
        assert!(matches!(existing(&spec.path), Existing::Ours { complete: false, .. }));
        let sink = Sink::create(spec.clone(), true).unwrap();
        assert_eq!(files_below(&Sink::work_dir(&spec.path).join("tmp")), Vec::<String>::new());
        for level in 0..spec.pyramid.levels.len() {
            for r in pieces(&spec, level, file).into_iter().filter(|r| level > 0 || *r != first) {
                put_region(&sink, level, r);
                sink.commit(level, r).unwrap();
            }
        }
        sink.finish(&occlude(), &[]).unwrap();
        match spec.is_zarr() {
            true => check_zarr(&spec),
            false => assert!(fs::read(&spec.path).unwrap().ends_with(&expected(&spec, 0))),
        }
        assert!(matches!(existing(&spec.path), Existing::Ours { complete: true, .. }));
    }
}

#[test]
fn a_flat_file_that_vanished_is_not_resumed_as_zeros() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(folder.path().join("a.npy"), OutputFormat::Npy, DType::U8, [8; 3]);
    drop(Sink::create(spec.clone(), false).unwrap());
    fs::remove_file(Sink::work_dir(&spec.path).join("data.part")).unwrap();
    assert!(Sink::create(spec, true).unwrap_err().to_string().contains("start again"));
}

#[test]
fn removal_takes_our_files_and_leaves_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let outside = folder.path().join("outside");
    fs::create_dir(&outside).unwrap();
    fs::write(outside.join("0"), "precious").unwrap();
    for (i, format) in ZARR.into_iter().enumerate() {
        let spec = write_all(spec(folder.path().join(format!("{i}.zarr")), format, DType::U8, [20, 20, 40]));
        fs::write(spec.path.join("notes.txt"), "mine").unwrap();
        fs::write(spec.path.join("0/notes.txt"), "mine").unwrap();
        fs::create_dir(spec.path.join("7")).unwrap();
        fs::write(spec.path.join("7/3"), "mine").unwrap();
        std::os::unix::fs::symlink(&outside, spec.path.join("0/9")).unwrap();
        remove_ours(&spec.path).unwrap();
        assert_eq!(files_below(&spec.path), ["0/9", "0/notes.txt", "7/3", "notes.txt"]);
        assert!(outside.join("0").exists());
        assert_eq!(existing(&spec.path), Existing::Foreign);
        assert!(remove_ours(&spec.path).unwrap_err().to_string().contains("left alone"));
    }
    let clean = write_all(spec(folder.path().join("c.zarr"), OutputFormat::OmeZarr05, DType::U8, [20, 20, 40]));
    remove_ours(&clean.path).unwrap();
    assert!(!clean.path.exists());
    assert_eq!(existing(&clean.path), Existing::None);
    remove_ours(&clean.path).unwrap();
}

#[test]
fn files_of_others_are_foreign() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("a.npy"), "not ours").unwrap();
    assert_eq!(existing(&at("a.npy")), Existing::Foreign);
    fs::create_dir(at("b.zarr")).unwrap();
    assert_eq!(existing(&at("b.zarr")), Existing::Foreign, "an empty folder may be anyone's");
    fs::write(at("b.zarr/zarr.json"), r#"{"attributes": {"ome": {}}}"#).unwrap();
    assert_eq!(existing(&at("b.zarr")), Existing::Foreign);
    std::os::unix::fs::symlink(at("nowhere"), at("c.zarr")).unwrap();
    assert_eq!(existing(&at("c.zarr")), Existing::Foreign);
    // Finished here, then replaced by its owner's own file.
    let mut spec = spec(at("d.npy"), OutputFormat::Npy, DType::U8, [8; 3]);
    spec.shard = None;
    let spec = write_all(spec);
    let mut bytes = fs::read(&spec.path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&spec.path, bytes).unwrap();
    assert_eq!(existing(&spec.path), Existing::Foreign);
    assert!(remove_ours(&spec.path).is_err() && spec.path.exists());
}

#[test]
fn more_shards_than_file_handles_and_many_threads() {
    let folder = tempfile::tempdir().unwrap();
    let mut spec = spec(folder.path().join("m.zarr"), OutputFormat::OmeZarr05, DType::U8, [64, 64, 64]);
    (spec.chunk, spec.shard) = ([4, 8, 8], Some([8, 8, 16]));
    spec.pyramid = Pyramid::new([64, 64, 64], [1.0; 3], [0.0; 3], [8; 3], Some(1), false);
    let sink = Sink::create(spec.clone(), false).unwrap();
    let (chunks, whole) = (pieces(&spec, 0, spec.chunk), field(&spec, 0, 0));
    std::thread::scope(|s| {
        for t in 0..4 {
            let (chunks, whole, sink) = (&chunks, &whole, &sink);
            s.spawn(move || {
                for r in chunks.iter().skip(t).step_by(4) {
                    let part = cut(whole, [64; 3], *r);
                    sink.put(0, 0, *r, sink.encode(0, *r, part.view(r.shape())).unwrap()).unwrap();
                }
            });
        }
    });
    sink.commit(0, Region::whole([64; 3])).unwrap();
    sink.finish(&occlude(), &[]).unwrap();
    check_zarr(&spec);
}

#[test]
fn wrong_boxes_and_layouts_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let good = spec(folder.path().join("w.zarr"), OutputFormat::OmeZarr05, DType::U8, [20; 3]);
    let refused = |change: &dyn Fn(&mut SinkSpec), word: &str| {
        let mut spec = good.clone();
        change(&mut spec);
        let error = Sink::create(spec, false).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    };
    refused(&|s| s.shard = Some([12; 3]), "output.ao.shard");
    refused(&|s| s.chunk = [0, 8, 8], "output.ao.chunk");
    refused(&|s| s.chunk = [usize::MAX; 3], "output.ao.chunk");
    refused(&|s| s.shard = Some([8 << 30; 3]), "output.ao.shard");
    let sink = Sink::create(good, false).unwrap();
    for (level, lo, hi) in [(0, 1, 9), (0, 16, 24), (0, 0, 7), (9, 0, 8)] {
        assert!(sink.put(level, 0, Region::new([lo; 3], [hi; 3]), Encoded::Empty).is_err());
    }
    assert!(sink.put(0, 1, Region::new([0; 3], [8; 3]), Encoded::Empty).is_err());
}

/// A file-size limit stands for a full disk; it holds for a whole process, so the test runs itself in another one.
#[test]
fn a_failed_write_names_the_chunk_and_leaves_nothing_half_written() {
    const CHILD: &str = "OCCLUDE_TEST_FILE_LIMIT";
    if std::env::var_os(CHILD).is_none() {
        let name = "a_failed_write_names_the_chunk_and_leaves_nothing_half_written";
        let mut child = std::process::Command::new(std::env::current_exe().unwrap());
        let status = child.args(["--exact", name]).env(CHILD, "1").output().unwrap();
        assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stdout));
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut spec = spec(folder.path().join("f.zarr"), OutputFormat::OmeZarr05, DType::F64, [32, 32, 64]);
    spec.codec = Codec::None;
    let sink = Sink::create(spec.clone(), false).unwrap();
    let limit = libc::rlimit { rlim_cur: 8000, rlim_max: libc::RLIM_INFINITY };
    // SAFETY: plain system calls with valid arguments; this process runs no other test.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
        assert_eq!(libc::setrlimit(libc::RLIMIT_FSIZE, &limit), 0);
    }
    let whole = field(&spec, 0, 0);
    let put = |x: i64| {
        let r = Region::new([0, 0, x], [8, 8, x + 8]);
        let part = cut(&whole, [32, 32, 64], r);
        sink.put(0, 0, r, sink.encode(0, r, part.view(r.shape())).unwrap())
    };
    assert!(put(8).is_ok());
    let error = put(16).unwrap_err().to_string();
    assert!(error.contains("f.zarr/0/c/0/0/0") && error.contains("chunk 0/0/0/2"), "{error}");
    assert!(!spec.path.join("0/c/0/0/0").exists());
}

/// Samples for `tests/python/check_outputs.py`: `cargo test --test sinks -- --ignored samples` writes them below
/// `$OCCLUDE_SAMPLES`, each beside `NAME.level0.npy`.
#[test]
#[ignore = "writes samples for the Python check"]
fn samples() {
    let folder = PathBuf::from(std::env::var("OCCLUDE_SAMPLES").expect("OCCLUDE_SAMPLES names a folder"));
    let matrix = [[0.0, -0.25, 0.0, 10.0], [0.25, 0.0, 0.0, 20.0], [0.0, 0.0, 0.5, -5.0]];
    let zarr = ZARR.map(|f| (f, "zarr"));
    for (format, extension) in zarr.into_iter().chain(FLAT) {
        for dtype in DType::ALL {
            for (k, codec) in [Codec::BloscLz4, Codec::Zstd(3), Codec::None].into_iter().enumerate() {
                for components in [None, Some(2)] {
                    let stem = format!("{format:?}-{dtype}-{k}-{}", components.unwrap_or(0));
                    let mut s = spec(folder.join(format!("{stem}.{extension}")), format, dtype, [17, 9, 35]);
                    (s.codec, s.components) = (codec, components);
                    s.shard = s.shard.filter(|_| k != 1);
                    if k == 2 {
                        s.orientation = Some(Orientation { matrix, space: "RAS".into() });
                    }
                    let mut npy = s.clone();
                    (npy.format, npy.path) = (OutputFormat::Npy, folder.join(format!("{stem}.level0.npy")));
                    npy.pyramid.levels.truncate(1);
                    write_all(npy);
                    write_all(s);
                }
            }
        }
    }
}
