//! Volumes written by other programs (nibabel, pynrrd, SimpleITK, tifffile, zarr-python, NumPy) and by hand read back
//! voxel for voxel, and what files that lie are answered with.

mod common_sources;

use std::fs;
use std::io::Read;
use std::path::Path;

use common_sources::*;
use occlude::brick::Voxels;
use occlude::config::{Input, InputKind, RawFormat, Select};
use occlude::grid::{DType, Region};
use occlude::store::Source;
use occlude::store::source::ChunkRead;
use serde_json::json;

#[test]
fn nifti_of_each_type_and_byte_order() {
    for (name, dtype) in [("u8", DType::U8), ("i16", DType::I16), ("f64", DType::F64)] {
        let source = check(&fixture(&format!("nifti/{name}.nii")), 0, 0);
        let info = source.info();
        assert_eq!((info.dtype, info.unit.as_deref()), (dtype, Some("millimeter")));
        near(info.spacing, [2.0, 0.6, 0.5]);
        near(info.origin, [30.0, -20.0, 10.0]);
        assert_eq!(info.orientation.as_ref().unwrap().space, "RAS");
        assert!(info.affine.is_identity());
    }
    let source = check(&fixture("nifti/be2.nii"), 0, 0);
    let info = source.info();
    assert_eq!((info.dtype, info.unit.as_deref(), info.format.as_str()), (DType::I16, Some("micrometer"), "NIfTI-2"));
    assert_eq!((info.affine.slope, info.affine.intercept), (2.0, -1.0));
    // Rotated: the origin is 0 and the matrix kept.
    assert_eq!(info.origin, [0.0; 3]);
    let m = info.orientation.as_ref().unwrap().matrix;
    near([m[0][1], m[1][0], m[2][3]], [-0.6, 0.5, 30.0]);
}

#[test]
fn nifti_time_points_are_selected_and_the_qform_gives_the_matrix() {
    let mut input = fixture("nifti/time.nii.gz");
    input.time = Select::Index(1);
    let source = check(&input, 0, 1);
    let m = source.info().orientation.as_ref().unwrap().matrix;
    near([m[0][1], m[1][0], m[2][2]], [-0.6, 0.5, 2.0]);
    input.time = Select::All;
    let source = check(&input, 1, 1);
    assert_eq!(source.info().component_names, ["time 0", "time 1"]);
    assert_eq!(source.info().times, 2, "told even where one is read");
    input.time = Select::Index(2);
    let e = Source::open(&input).unwrap_err();
    assert_eq!(e.exit_code(), 2);
    assert!(e.to_string().contains("input.time.nii.gz.time: 2 does not exist; the input has 2"), "{e}");
}

#[test]
fn nrrd_raw_gzip_attached_detached_and_interleaved() {
    for (name, dtype) in [("raw", DType::I16), ("gz", DType::F32)] {
        let source = check(&fixture(&format!("nrrd/{name}.nrrd")), 0, 0);
        let info = source.info();
        assert_eq!(
            (info.dtype, info.unit.as_deref()),
            (dtype, Some("millimeter")),
            "a medical space means millimetres"
        );
        near(info.spacing, [2.0, 0.6, 0.5]);
        near(info.origin, [3.0, 2.0, 1.0]);
        assert_eq!(info.orientation.as_ref().unwrap().space, "LPS");
    }
    let source = check(&fixture("nrrd/det.nhdr"), 0, 0);
    assert_eq!((source.info().dtype, source.info().unit.as_deref()), (DType::U16, Some("micrometer")));
    near(source.info().spacing, [2.0, 0.6, 0.5]);
    let mut input = fixture("nrrd/vec.nrrd");
    input.channel = Select::Index(1);
    check(&input, 0, 1);
    input.channel = Select::All;
    check(&input, 1, 1);
}

#[test]
fn metaimage_plain_packed_detached_and_interleaved() {
    for name in ["plain.mha", "det.mhd"] {
        let source = check(&fixture(&format!("meta/{name}")), 0, 0);
        near(source.info().spacing, [2.0, 0.6, 0.5]);
        near(source.info().origin, [3.0, 2.0, 1.0]);
        assert_eq!(source.info().unit.as_deref(), Some("millimeter"));
    }
    let source = check(&fixture("meta/rot.mha"), 0, 0);
    let m = source.info().orientation.as_ref().unwrap().matrix;
    near([m[0][1], m[1][0], m[2][2]], [-0.6, 0.5, 2.0]); // as SimpleITK maps indices to points
    assert_eq!(source.info().origin, [0.0; 3]);
    let mut input = fixture("meta/vec.mha");
    input.channel = Select::Index(1);
    check(&input, 0, 1);
}

#[test]
fn tiff_strips_tiles_folders_imagej_and_ome() {
    let source = check(&fixture("tiff/strips.tif"), 0, 0);
    assert_eq!(source.spool_bytes(), 0, "plain strips are read in place");
    for (name, dtype) in [("be_lzwish", DType::I32), ("lzw", DType::I8), ("white", DType::U8), ("slices", DType::F32)] {
        let path = if name == "slices" { "tiff/slices".to_string() } else { format!("tiff/{name}.tif") };
        assert_eq!(check_wrapped(&fixture(&path)).info().dtype, dtype);
    }
    let (source, voxels) = whole(&fixture("tiff/tiled.tif"), 0).unwrap();
    assert_eq!((source.info().shape, voxels.len()), ([2, 40, 50], 4000));
    assert!((0..4000).all(|i| voxels.at(i) == i as f64));

    let mut input = fixture("tiff/imagej.tif");
    input.channel = Select::Index(1);
    let source = check(&input, 0, 1);
    near(source.info().spacing, [2.0, 0.5, 0.25]);
    assert_eq!(source.info().unit.as_deref(), Some("micrometer"));

    let mut input = fixture("tiff/ome.ome.tif");
    input.channel = Select::All;
    let source = check(&input, 1, 1);
    near(source.info().spacing, [0.3, 0.2, 0.1]);
    assert_eq!(source.info().unit.as_deref(), Some("micrometer"));
    assert_eq!(source.info().component_names, ["DAPI", "GFP"]);
}

#[test]
fn npy_in_both_orders() {
    assert_eq!(check(&fixture("npy/c.npy"), 0, 0).info().dtype, DType::U16);
    assert_eq!(check(&fixture("npy/f.npy"), 0, 0).info().dtype, DType::F32);
    let (source, voxels) = whole(&fixture("npy/2d.npy"), 0).unwrap();
    assert_eq!(source.info().shape, [1, 5, 6]);
    assert_eq!(voxels.at(7), 40.0 + 7.0 + 1.0);
    // Three components before z, as outputs of several have them.
    let folder = tempfile::tempdir().unwrap();
    let values: Vec<f64> = (0..3).flat_map(|c| (0..120).map(move |i| expected([4, 5, 6], c)(i))).collect();
    for fortran in [false, true] {
        let path = folder.path().join(format!("{fortran}.npy"));
        let head = format!(
            "{{'descr': '<i4', 'fortran_order': {}, 'shape': (3, 4, 5, 6), }}",
            ["False", "True"][usize::from(fortran)]
        );
        let mut bytes =
            [b"\x93NUMPY\x01\x00".to_vec(), (head.len() as u16).to_le_bytes().to_vec(), head.into_bytes()].concat();
        let turned = |i: usize| (i % 3) * 120 + (i / 3 % 4) * 30 + (i / 12 % 5) * 6 + i / 60;
        (0..360).for_each(|i| bytes.extend((values[if fortran { turned(i) } else { i }] as i32).to_le_bytes()));
        fs::write(&path, bytes).unwrap();
        for c in 0..3 {
            check(&Input { channel: Select::Index(c), ..file_input(&path) }, 0, c);
            let source = check(&Input { channel: Select::All, ..file_input(&path) }, c, c);
            assert_eq!(source.info().component_names, ["channel 0", "channel 1", "channel 2"]);
        }
        let e = Source::open(&Input { channel: Select::Index(3), ..file_input(&path) }).unwrap_err();
        assert!(e.to_string().contains("channel: 3 does not exist; the input has 3"), "{e}");
    }
}

#[test]
fn zarr_v3_shards_missing_chunks_and_v2_orders() {
    let source = Source::open(&fixture("zarr/v3sharded")).unwrap();
    assert_eq!((source.info().chunk, source.info().dtype), (Some([2, 2, 3]), DType::U16));
    let mut chunk = Voxels::zeroed(DType::U16, 12);
    assert_eq!(source.read_chunk(0, [1, 1, 1], &mut chunk).unwrap(), ChunkRead::Missing(7.0));
    assert!(matches!(source.read_chunk(0, [1, 2, 1], &mut chunk).unwrap(), ChunkRead::Data { stored_bytes: 1.. }));
    assert_eq!(chunk.at(0), (2 * 40 + 4 * 7 + 3) as f64);
    assert!(source.read_chunk(0, [2, 0, 0], &mut chunk).is_err());
    assert!(source.read_chunk(1, [0, 0, 0], &mut chunk).is_err());
    let (_, voxels) = whole(&fixture("zarr/v3sharded"), 0).unwrap();
    for (i, [z, y, x]) in Region::whole([4, 5, 6]).iter().enumerate() {
        let hole = z >= 2 && (2..4).contains(&y) && x >= 3;
        assert_eq!(voxels.at(i), if hole { 7.0 } else { expected([4, 5, 6], 0)(i) });
    }

    let (source, voxels) = whole(&fixture("zarr/v3plain"), 0).unwrap();
    assert_eq!(source.info().chunk, Some([2, 3, 4]));
    for (i, [z, y, x]) in Region::whole([4, 5, 6]).iter().enumerate() {
        let hole = z < 2 && y < 3 && x >= 4;
        assert!(if hole { voxels.at(i).is_nan() } else { voxels.at(i) == expected([4, 5, 6], 0)(i) });
    }
    let mut chunk = Voxels::zeroed(DType::F32, 24);
    assert!(matches!(source.read_chunk(0, [0, 0, 1], &mut chunk).unwrap(), ChunkRead::Missing(v) if v.is_nan()));
    assert_eq!(check(&fixture("zarr/v2be"), 0, 0).info().dtype, DType::I16);
    assert_eq!(check(&fixture("zarr/v2f"), 0, 0).info().dtype, DType::F64);
}

/// Arrays of version 2 in the packings of numcodecs, one chunk each, and with a checksum between voxels and packing.
#[test]
fn zarr_v2_codecs_of_numcodecs() {
    type Pack = fn(&[u8]) -> Vec<u8>;
    let bz2: Pack = |bytes| {
        let mut out = Vec::new();
        bzip2::read::BzEncoder::new(bytes, bzip2::Compression::fast()).read_to_end(&mut out).unwrap();
        out
    };
    let lz4: Pack = lz4_flex::block::compress_prepend_size;
    // Fletcher's sum as HDF5 has it: words of 16 bits, high byte first.
    let summed: Pack = |bytes| {
        let (mut a, mut b) = (0u32, 0u32);
        for word in bytes.as_chunks::<2>().0 {
            a = (a + u16::from_be_bytes(*word) as u32) % 65535;
            b = (b + a) % 65535;
        }
        gzip(&[bytes, &(b << 16 | a).to_le_bytes()].concat())
    };
    let none = json!(null);
    let cases: [(&str, serde_json::Value, Pack); 4] = [
        ("bz2", none.clone(), bz2),
        ("lz4", none.clone(), lz4),
        ("gzip", none, gzip),
        ("gzip", json!([{ "id": "fletcher32" }]), summed),
    ];
    let voxels: Vec<u8> = (0..120).map(expected([4, 5, 6], 0)).flat_map(|v| (v as u16).to_le_bytes()).collect();
    for (id, filters, pack) in cases {
        let folder = tempfile::tempdir().unwrap();
        let meta = json!({
            "zarr_format": 2, "shape": [4, 5, 6], "chunks": [4, 5, 6], "dtype": "<u2", "order": "C", "fill_value": 0,
            "filters": filters, "compressor": { "id": id },
        });
        fs::write(folder.path().join(".zarray"), meta.to_string()).unwrap();
        fs::write(folder.path().join("0.0.0"), pack(&voxels)).unwrap();
        let input = file_input(folder.path());
        let source = check(&input, 0, 0);
        assert!(source.info().format.contains(id), "{}", source.info().format);
        let packed = pack(&voxels);
        fs::write(folder.path().join("0.0.0"), &packed[..packed.len() - 9]).unwrap();
        let e = whole(&input, 0).unwrap_err().to_string();
        assert!(e.contains("chunk [0, 0, 0] cannot be decoded"), "{id}: {e}");
    }
}

/// Version 3 with its axes stored in any order, among them one of channels inside the chunk; version 2 in Fortran's order.
#[test]
fn zarr_axes_stored_in_another_order() {
    let shape = [2, 4, 5, 6];
    let at = |i: [usize; 4]| ((i[0] * 1000 + i[1] * 100 + i[2] * 10 + i[3]) as u16).to_le_bytes();
    for order in [[0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 3, 2], [2, 3, 0, 1], [0, 3, 1, 2], [3, 0, 2, 1], [1, 2, 3, 0]] {
        // Index along stored axis `i` is that along axis `order[i]`.
        let mut stored = Vec::new();
        let [a, b, c, d] = order.map(|axis: usize| shape[axis]);
        for index in (0..a * b * c * d).map(|i| [i / (b * c * d), i / (c * d) % b, i / d % c, i % d]) {
            let mut of = [0; 4];
            order.iter().zip(index).for_each(|(&axis, i)| of[axis] = i);
            stored.extend(at(of));
        }
        let folder = tempfile::tempdir().unwrap();
        let meta = json!({
            "zarr_format": 3, "node_type": "array", "shape": shape, "data_type": "uint16", "fill_value": 0,
            "dimension_names": ["c", "z", "y", "x"], "attributes": {},
            "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": shape } },
            "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
            "codecs": [
                { "name": "transpose", "configuration": { "order": order } },
                { "name": "bytes", "configuration": { "endian": "little" } },
                { "name": "gzip", "configuration": { "level": 1 } },
            ],
        });
        fs::write(folder.path().join("zarr.json"), meta.to_string()).unwrap();
        fs::create_dir_all(folder.path().join("c/0/0/0")).unwrap();
        fs::write(folder.path().join("c/0/0/0/0"), gzip(&stored)).unwrap();
        let old = tempfile::tempdir().unwrap();
        if order == [3, 2, 1, 0] {
            let meta = json!({
                "zarr_format": 2, "shape": shape, "chunks": shape, "dtype": "<u2", "order": "F", "fill_value": 0,
                "filters": null, "compressor": null,
            });
            fs::write(old.path().join(".zarray"), meta.to_string()).unwrap();
            fs::write(old.path().join("0.0.0.0"), &stored).unwrap();
        }
        for folder in [&folder, &old].into_iter().filter(|f| f.path().read_dir().unwrap().next().is_some()) {
            for channel in 0..2 {
                let input = Input { channel: Select::Index(channel), ..file_input(folder.path()) };
                let (_, voxels) = whole(&input, 0).unwrap();
                for (i, [z, y, x]) in Region::whole([4, 5, 6]).iter().enumerate() {
                    let want = u16::from_le_bytes(at([channel, z as usize, y as usize, x as usize]));
                    assert_eq!(voxels.at(i), f64::from(want), "{order:?} channel {channel} at {z} {y} {x}");
                }
            }
        }
    }
}

#[test]
fn nrrd_in_bzip2() {
    let folder = tempfile::tempdir().unwrap();
    let voxels: Vec<u8> = (0..120).map(|i| expected([4, 5, 6], 0)(i) as u8).collect();
    let mut bytes = b"NRRD0004\ntype: uchar\ndimension: 3\nencoding: bzip2\nsizes: 6 5 4\n\n".to_vec();
    bzip2::read::BzEncoder::new(&voxels[..], bzip2::Compression::fast()).read_to_end(&mut bytes).unwrap();
    let path = folder.path().join("v.nrrd");
    fs::write(&path, &bytes).unwrap();
    assert_eq!(check(&file_input(&path), 0, 0).info().format, "NRRD, bzip2");
    fs::write(&path, &bytes[..bytes.len() - 5]).unwrap();
    assert!(whole(&file_input(&path), 0).unwrap_err().to_string().contains("cut off"));
}

#[test]
fn ome_zarr_levels_channels_times_and_placement() {
    let mut input = fixture("zarr/ome05");
    (input.time, input.channel) = (Select::Index(1), Select::Index(1));
    let source = check(&input, 0, 4);
    near(source.info().spacing, [4.0, 1.0, 0.5]); // the group's scale of 2 is applied after the dataset's
    near(source.info().origin, [20.0, 40.0, 60.0]);
    assert_eq!(source.info().unit.as_deref(), Some("micrometer"));
    (input.time, input.channel) = (Select::Index(0), Select::All);
    let source = check(&input, 2, 2);
    assert_eq!(source.info().component_names, ["DAPI", "GFP", "RFP"]);
    (input.time, input.level) = (Select::Index(1), 1);
    let (source, voxels) = whole(&input, 2).unwrap();
    assert_eq!((source.info().shape, source.info().chunk), ([4, 3, 3], Some([2, 2, 3])));
    near(source.info().spacing, [4.0, 2.0, 1.0]);
    assert_eq!(voxels.at(4), (2 * 7 + 2 + 500) as f64); // z 0, y 1, x 1 of the coarse level
    input.level = 2;
    let e = Source::open(&input).unwrap_err().to_string();
    assert!(e.contains("input.ome05.level: 2: the image has 2 levels, 0 to 1"), "{e}");

    let source = check(&fixture("zarr/ome04"), 0, 0);
    near(source.info().spacing, [2.0, 0.5, 0.25]);
    let mut input = fixture("zarr/ome04");
    input.array = Some("0".into());
    near(check(&input, 0, 0).info().spacing, [2.0, 0.5, 0.25]);
    near(check(&fixture("zarr/ome04/0"), 0, 0).info().spacing, [2.0, 0.5, 0.25]);
    input.array = Some("../../nifti".into());
    assert_eq!(Source::open(&input).unwrap_err().exit_code(), 2);
    input.array = Some("7".into());
    let e = Source::open(&input).unwrap_err().to_string();
    assert!(e.contains("it has: 0"), "{e}");
}

#[test]
fn synthetic_fields_open_by_name() {
    let kind = |field: &str, shape| InputKind::Synthetic { field: field.into(), shape, dtype: DType::U8, seed: 1 };
    let input = Input { kind: kind("ramp", [2, 3, 256]), ..fixture("ramp") };
    let (source, voxels) = whole(&input, 0).unwrap();
    assert_eq!((source.info().shape, source.info().chunk), ([2, 3, 256], None));
    assert!((0..1536).all(|i| voxels.at(i) == (i % 256) as f64));
    assert_ne!(source.identity().unwrap(), Source::from_array([1, 1, 1], Voxels::U8(vec![0])).identity().unwrap());
    for (field, shape, word) in [("blob", [4, 4, 4], "sphere, plane"), ("sphere", [0, 4, 4], "at least 1 voxel")] {
        let e = Source::open(&Input { kind: kind(field, shape), ..fixture("x") }).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains(word), "{e}");
    }
}

#[test]
fn types_that_are_not_read_are_refused_by_name() {
    for (path, name) in [
        ("nifti/complex.nii", "complex64"),
        ("nifti/rgb.nii", "RGB"),
        ("nifti/i64.nii", "i64"),
        ("tiff/rgb.tif", "RGB"),
        ("npy/bool.npy", "bool"),
    ] {
        let e = Source::open(&fixture(path)).unwrap_err();
        assert_eq!(e.exit_code(), 1);
        let text = e.to_string();
        assert!(text.contains(name) && text.contains("accepted are u8, i8"), "{path}: {text}");
    }
}

#[test]
fn the_config_overrides_the_header() {
    let mut input = fixture("nifti/be2.nii");
    input.spacing = Some([3.0, 2.0, 1.0]);
    input.unit = Some("um".into());
    input.origin = Some([1.0, 2.0, 3.0]);
    input.slope = Some(0.5);
    input.nodata = Some(7.0);
    let info = Source::open(&input).unwrap().info().clone();
    assert_eq!((info.spacing, info.origin), ([3.0, 2.0, 1.0], [1.0, 2.0, 3.0]));
    assert_eq!((info.affine.slope, info.affine.intercept), (0.5, -1.0), "the intercept of the file stays");
    assert_eq!((info.unit.as_deref(), info.nodata), (Some("micrometer"), Some(7.0)));
    input.spacing = Some([0.0, 1.0, 1.0]);
    assert!(Source::open(&input).unwrap_err().to_string().starts_with("input.be2.nii.spacing"));
}

#[test]
fn float_nodata_becomes_nan_and_integer_nodata_stays() {
    for (path, is_nan) in [("tiff/slices", true), ("zarr/v3plain", true), ("nrrd/raw.nrrd", false)] {
        let mut input = fixture(path);
        input.nodata = Some(41.0);
        let (_, voxels) = whole(&input, 0).unwrap();
        let at = 5 * 6 + 1; // z 1, y 0, x 1
        assert_eq!(voxels.at(at).is_nan(), is_nan, "{path}");
        assert!(is_nan || voxels.at(at) == 41.0);
        assert_eq!(voxels.at(at - 1), 40.0);
    }
}

#[test]
fn raw_files_of_any_order_offset_and_packing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.raw");
    let shape = [4, 5, 6];
    let body: Vec<u8> = (0..120).flat_map(|i| (expected(shape, 0)(i) as i32).to_be_bytes()).collect();
    let bytes = [b"seven..".to_vec(), body.clone()].concat();
    fs::write(&path, &bytes).unwrap();
    let raw = RawFormat { big_endian: true, offset: 7, ..raw_format(shape, DType::I32) };
    check(&raw_input(&path, raw.clone()), 0, 0);
    // Bytes after the voxels.
    fs::write(&path, [&bytes[..], b"tail"].concat()).unwrap();
    let e = Source::open(&raw_input(&path, raw.clone())).unwrap_err().to_string();
    assert!(e.contains("4 more follow") && e.contains("trailing = \"ignore\""), "{e}");
    check(&raw_input(&path, RawFormat { trailing_ignore: true, ..raw.clone() }), 0, 0);
    // Too short.
    fs::write(&path, &bytes[..480]).unwrap();
    let e = Source::open(&raw_input(&path, raw.clone())).unwrap_err().to_string();
    assert!(e.contains("has 480 bytes") && e.contains("487"), "{e}");
    // Gzip: right, too long, too short, cut off.
    let path = folder.path().join("v.raw.gz");
    fs::write(&path, gzip(&bytes)).unwrap();
    let input = raw_input(&path, raw.clone());
    assert_eq!(Source::open(&input).unwrap().spool_bytes(), 480);
    check(&input, 0, 0);
    for (content, number) in [([&bytes[..], b"tail"].concat(), "491"), (bytes[..400].to_vec(), "400")] {
        fs::write(&path, gzip(&content)).unwrap();
        let e = whole(&input, 0).unwrap_err().to_string();
        assert!(e.contains(&format!("expand to {number} bytes, but the header says 487")), "{e}");
    }
    let packed = gzip(&bytes);
    fs::write(&path, &packed[..packed.len() / 2]).unwrap();
    assert!(whole(&input, 0).unwrap_err().to_string().contains("cut off"), "a cut gzip stream");
}

#[test]
fn a_spool_leaves_nothing_behind_and_stops_on_request() {
    let scratch = tempfile::tempdir().unwrap();
    let mut source = Source::open(&fixture("nifti/time.nii.gz")).unwrap();
    assert_eq!(source.prepare(scratch.path(), &|_| false).unwrap_err().exit_code(), 130);
    source.prepare(scratch.path(), &|_| true).unwrap();
    assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 0);
    let mut source = Source::open(&fixture("nifti/time.nii.gz")).unwrap();
    let mut out = Voxels::zeroed(source.info().dtype, 120);
    assert!(source.read(0, Region::whole([4, 5, 6]), out.view_mut([4, 5, 6])).is_err(), "not prepared yet");
    assert!(source.prepare(Path::new("/nonexistent"), &|_| true).is_err());
}

#[test]
fn a_file_that_shrinks_is_an_error_not_a_crash() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.raw");
    fs::write(&path, vec![1u8; 1 << 20]).unwrap();
    let raw = raw_format([16, 256, 256], DType::U8);
    let source = Source::open(&raw_input(&path, raw)).unwrap();
    fs::write(&path, b"gone").unwrap();
    let mut out = Voxels::zeroed(DType::U8, 1 << 20);
    let e = source.read(0, Region::whole([16, 256, 256]), out.view_mut([16, 256, 256])).unwrap_err().to_string();
    assert!(e.contains("shrank from 1048576 to 4 bytes"), "{e}");
}

#[test]
fn nrrd_lists_patterns_and_skips() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let slice = |z: usize| (0..30).map(|i| expected([4, 5, 6], 0)(z * 30 + i) as u8).collect::<Vec<_>>();
    for z in 0..4 {
        fs::write(at(&format!("s{:02}.raw", z + 3)), [b"xy".to_vec(), slice(z)].concat()).unwrap();
    }
    let head =
        "NRRD0004\n# comment\ntype: uint8_t\ndimension: 3\nsizes: 6 5 4\nencoding: raw\nkey:=value: with colon\n";
    let pattern = format!("{head}byte skip: 2\ndata file: s%02d.raw 3 6 1 2\n");
    let list = format!("{head}byteskip: 2\ndatafile: LIST 2\ns03.raw\ns04.raw\ns05.raw\ns06.raw\n");
    let all: Vec<u8> = (0..4).flat_map(slice).collect();
    fs::write(at("all.bin"), [b"line one\nline two\nab".to_vec(), all.clone()].concat()).unwrap();
    let skips = format!("{head}line skip: 2\nbyte skip: 2\ndata file: all.bin\n");
    let last = format!("{head}byte skip: -1\ndata file: ./all.bin\n\n");
    for text in [pattern, list, skips, last] {
        fs::write(at("v.nhdr"), text).unwrap();
        check(&file_input(&at("v.nhdr")), 0, 0);
    }
    fs::write(at("v.nhdr"), format!("{head}data file: LIST\ns03.raw\ns04.raw\ns05.raw\n")).unwrap();
    assert!(Source::open(&file_input(&at("v.nhdr"))).is_err(), "three files cannot hold four planes of 6 x 5");
    let mha = "ObjectType = Image\nNDims = 3\nDimSize = 6 5 4\nElementType = MET_UCHAR\n";
    fs::write(at("v.mhd"), format!("{mha}HeaderSize = 2\nElementDataFile = s%02d.raw 3 6 1\n")).unwrap();
    check(&file_input(&at("v.mhd")), 0, 0);
    fs::write(
        at("v.mhd"),
        format!("{mha}HeaderSize = 2\nElementDataFile = LIST\ns03.raw\ns04.raw\ns05.raw\ns06.raw\n"),
    )
    .unwrap();
    check(&file_input(&at("v.mhd")), 0, 0);
    fs::write(at("v.mhd"), format!("{mha}HeaderSize = -1\nElementDataFile = all.bin\n")).unwrap();
    check(&file_input(&at("v.mhd")), 0, 0);
    // Without its end a pattern names as many slices as there are; without its start it begins at 1.
    fs::write(at("v.mhd"), format!("{mha}HeaderSize = 2\nElementDataFile = s%02d.raw 3\n")).unwrap();
    check(&file_input(&at("v.mhd")), 0, 0);
    (0..4).for_each(|z| fs::write(at(&format!("t{}.raw", z + 1)), slice(z)).unwrap());
    fs::write(at("v.mhd"), format!("{mha}ElementDataFile = t%d.raw\n")).unwrap();
    check(&file_input(&at("v.mhd")), 0, 0);
    // In its own file the voxels start where HeaderSize says, counted from the file's first byte.
    let own = format!("{mha}HeaderSize = 300\nElementDataFile = LOCAL\n");
    let padding = vec![b' '; 300 - own.len()];
    fs::write(at("v.mha"), [own.into_bytes(), padding, all].concat()).unwrap();
    check(&file_input(&at("v.mha")), 0, 0);
}

/// As other readers have it: more bytes than the header asks for are somebody's padding, a broken sum is not.
#[test]
fn bytes_after_the_voxels_of_packed_files_with_headers_are_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.nii.gz");
    let mut plain = Vec::new();
    flate2::read::GzDecoder::new(fs::File::open(data("nifti/time.nii.gz")).unwrap()).read_to_end(&mut plain).unwrap();
    plain.extend([7; 5000]);
    let packed = gzip(&plain);
    fs::write(&path, &packed).unwrap();
    let mut input = file_input(&path);
    input.time = Select::Index(1);
    let mut expect = fixture("nifti/time.nii.gz");
    expect.time = Select::Index(1);
    assert_eq!(whole(&input, 0).unwrap().1, whole(&expect, 0).unwrap().1);
    let mut broken = packed.clone();
    let sum = broken.len() - 8;
    broken[sum] ^= 1;
    fs::write(&path, &broken).unwrap();
    assert!(whole(&input, 0).unwrap_err().to_string().contains("broken"), "a wrong checksum after the padding");
}

/// zarr-python writes what JSON does not know.
#[test]
fn bare_numbers_in_zarr_attributes_are_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let array = folder.path().join("a.zarr");
    fs::create_dir_all(array.join("c/0/0")).unwrap();
    let meta = r#"{"zarr_format":3,"node_type":"array","shape":[1,1,3],"data_type":"uint8","fill_value":0,
        "chunk_grid":{"name":"regular","configuration":{"chunk_shape":[1,1,3]}},
        "chunk_key_encoding":{"name":"default","configuration":{"separator":"/"}},
        "codecs":[{"name":"bytes","configuration":{"endian":"little"}}],
        "attributes":{"x":NaN,"lo":-Infinity,"hi":[Infinity, 1],"text":"\"NaN\" and \\"}}"#;
    fs::write(array.join("zarr.json"), meta).unwrap();
    fs::write(array.join("c/0/0/0"), [4, 5, 6]).unwrap();
    assert_eq!(whole(&file_input(&array), 0).unwrap().1, Voxels::U8(vec![4, 5, 6]));
    fs::write(array.join("zarr.json"), meta.replace("NaN,", "NaM,")).unwrap();
    assert!(whole(&file_input(&array), 0).unwrap_err().to_string().contains("broken JSON"));
}

/// n5-zarr writes numbers as text, others integers with a point; zarr-python reads both.
#[test]
fn fill_values_of_zarr_v2_as_writers_have_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(".zarray");
    let of = |dtype: &str, fill: serde_json::Value| {
        let meta = json!({
            "zarr_format": 2, "shape": [1, 1, 3], "chunks": [1, 1, 2], "dtype": dtype, "order": "C", "fill_value": fill,
            "filters": null, "compressor": null,
        });
        fs::write(&path, meta.to_string()).unwrap();
        whole(&file_input(folder.path()), 0).map(|r| r.1).map_err(|e| e.to_string())
    };
    let all = |v: u16| Ok(Voxels::U16(vec![v; 3]));
    for (fill, expected) in
        [(json!("0"), 0), (json!(" 7 "), 7), (json!(5.0), 5), (json!("65535"), 65535), (json!(9), 9), (json!(null), 0)]
    {
        assert_eq!(of("<u2", fill.clone()), all(expected), "{fill}");
    }
    assert_eq!(of("|i1", json!("-3.0")), Ok(Voxels::I8(vec![-3; 3])));
    assert_eq!(of("<f4", json!("0.25")), Ok(Voxels::F32(vec![0.25; 3])));
    assert_eq!(of("<f8", json!("-Infinity")), Ok(Voxels::F64(vec![f64::NEG_INFINITY; 3])));
    for fill in [json!(0.5), json!("70000"), json!(-1), json!("seven")] {
        assert!(of("<u2", fill.clone()).unwrap_err().contains("fill value"), "{fill}");
    }
}

#[test]
fn an_array_in_memory_reads_like_a_file() {
    let voxels = Voxels::I16((0..120).map(|i| expected([4, 5, 6], 0)(i) as i16).collect());
    let source = Source::from_array([4, 5, 6], voxels);
    let mut out = Voxels::zeroed(DType::I16, 6);
    source.read(0, Region::new([3, 4, 0], [4, 5, 6]), out.view_mut([1, 1, 6])).unwrap();
    assert_eq!(out, Voxels::I16(vec![148, 149, 150, 151, 152, 153]));
    assert!(source.read(0, Region::new([3, 4, 0], [5, 5, 6]), out.view_mut([2, 1, 3])).is_err());
}

#[test]
fn formats_are_found_by_their_first_bytes_and_unknown_ones_listed() {
    let folder = tempfile::tempdir().unwrap();
    for (i, name) in
        ["npy/c.npy", "nifti/i16.nii", "nrrd/raw.nrrd", "meta/plain.mha", "tiff/strips.tif"].iter().enumerate()
    {
        let path = folder.path().join(format!("volume{i}"));
        fs::copy(data(name), &path).unwrap();
        check(&file_input(&path), 0, 0);
    }
    let path = folder.path().join("odd.raw");
    fs::write(&path, b"no header here").unwrap();
    let e = Source::open(&file_input(&path)).unwrap_err().to_string();
    assert!(e.contains("format = \"raw\"") && e.contains("NRRD"), "{e}");
    let e = Source::open(&file_input(&folder.path().join("absent.nrrd"))).unwrap_err();
    assert_eq!((e.exit_code(), e.to_string().contains("no such file")), (1, true));
    let mut input = fixture("npy/c.npy");
    input.level = 1;
    assert_eq!(Source::open(&input).unwrap_err().exit_code(), 2);
}

/// More slices than files that are held open, in natural order; one that changes is noticed.
#[test]
fn many_slices_are_mapped_one_by_one() {
    let folder = tempfile::tempdir().unwrap();
    for i in 0..20 {
        fs::copy(data(&format!("tiff/slices/s{}.tif", 8 + i % 4)), folder.path().join(format!("img{i}.tiff"))).unwrap();
    }
    fs::write(folder.path().join("notes.txt"), "not a slice").unwrap();
    let (source, voxels) = whole(&file_input(folder.path()), 0).unwrap();
    assert_eq!(source.info().shape, [20, 5, 6]);
    assert!((0..600).all(|i| voxels.at(i) == expected([4, 5, 6], 0)(i % 120)));
    fs::write(folder.path().join("img3.tiff"), b"II").unwrap();
    let mut out = Voxels::zeroed(DType::F32, 30);
    let e = source.read(0, Region::new([3, 0, 0], [4, 5, 6]), out.view_mut([1, 5, 6])).unwrap_err().to_string();
    assert!(e.contains("img3.tiff: changed from"), "{e}");
    fs::copy(data("tiff/strips.tif"), folder.path().join("img3.tiff")).unwrap();
    assert!(Source::open(&file_input(folder.path())).unwrap_err().to_string().contains("one page per file"));
}

#[test]
fn released_planes_come_back_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.raw");
    fs::write(&path, (0..1 << 22).map(|i: u32| (i.wrapping_mul(2654435761) >> 24) as u8).collect::<Vec<_>>()).unwrap();
    let shape = [64, 256, 256];
    let raw = raw_format(shape, DType::U8);
    let source = Source::open(&raw_input(&path, raw)).unwrap();
    let read = || {
        let mut out = Voxels::zeroed(DType::U8, 1 << 22);
        source.read(0, Region::whole(shape), out.view_mut(shape)).unwrap();
        out
    };
    let before = read();
    for region in [
        Region::new([3, 0, 0], [40, 256, 256]),
        Region::new([-9, -9, -9], [99, 999, 999]),
        Region::new([5, 1, 0], [9, 9, 9]),
    ] {
        source.release(region);
        assert_eq!(read(), before);
    }
}

#[test]
fn sources_are_shared_between_threads() {
    fn shared<T: Send + Sync>(_: &T) {}
    let source = Source::open(&fixture("zarr/ome05")).unwrap();
    shared(&source);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for region in [Region::whole([4, 5, 6]), Region::new([1, 1, 1], [3, 4, 6])] {
                    let mut out = Voxels::zeroed(DType::U16, region.voxels());
                    source.read(0, region, out.view_mut(region.shape())).unwrap();
                    assert_eq!(out.at(0), (region.lo[0] * 40 + region.lo[1] * 7 + region.lo[2]) as f64);
                }
            });
        }
    });
}

#[test]
fn an_identity_follows_the_content_not_the_place() {
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.nrrd");
    fs::copy(data("nrrd/raw.nrrd"), &copy).unwrap();
    let of = |path: &Path| Source::open(&file_input(path)).unwrap().identity().unwrap();
    assert_eq!(of(&copy), of(&data("nrrd/raw.nrrd")));
    let before = of(&copy);
    let mut bytes = fs::read(&copy).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&copy, &bytes).unwrap();
    assert_ne!(of(&copy), before);
    let zarr = folder.path().join("z");
    copy_tree(&data("zarr/v2be"), &zarr);
    assert_eq!(of(&zarr), of(&data("zarr/v2be")));
    fs::remove_file(zarr.join("0.0.0")).unwrap();
    assert_ne!(of(&zarr), of(&data("zarr/v2be")));
}

/// Checksums of the published volumes' voxels, little-endian (see their README).
#[test]
fn published_volumes_have_the_right_voxels() {
    let Some(folder) = shared_data() else { return };
    let raw = |shape, dtype, big_endian| Some(RawFormat { big_endian, ..raw_format(shape, dtype) });
    let volumes = [
        (
            "cthead_256x256x113_uint16be.raw.gz",
            raw([113, 256, 256], DType::U16, true),
            "8a378356d37fc55a977032375b1bd34298c0b137167dd0f05e025d66e0ae5d94",
        ),
        (
            "aneurism_256x256x256_uint8.raw.gz",
            raw([256; 3], DType::U8, false),
            "2826a66db406f19bdd9e38cfe42a80b861fbce34a947c24ce511f07f1c160b83",
        ),
        (
            "vismale_128x256x256_uint8.raw.gz",
            raw([256, 256, 128], DType::U8, false),
            "3aa9da2a3338259e6952834935b64f81aac567bd7635cdbb85a8e59647a395ed",
        ),
        ("colin27_ch2.nii.gz", None, "38e1383cfd10824abc62dd61c9597f83ff899c82e2a84eb37737bdc83bfc9d7d"),
        ("tooth.nrrd", None, "1ae7d4681ad9b58c3778af0742f3c585354625a6aed232a181c93c669522172e"),
        ("cells3d_nuclei.tif", None, "3ce5179fcc8bb48110bd2422bdda7ef26c56f1f444be6aca8c1e5ec803d8fc85"),
    ];
    let mut seen = 0;
    for (name, raw, sum) in volumes {
        let path = folder.join(name);
        if !path.exists() {
            eprintln!("skipped: {} is not there", path.display());
            continue;
        }
        let input = Input { kind: InputKind::Path { path, raw }, ..file_input(Path::new(name)) };
        let (source, voxels) = whole(&input, 0).unwrap();
        assert_eq!(sha256(voxels.as_bytes()), sum, "{name}");
        if name.starts_with("colin") {
            assert_eq!(
                (source.info().origin, source.info().unit.as_deref()),
                ([-71.0, -125.0, -90.0], None), // the file names no unit
            );
        }
        seen += 1;
    }
    assert!(seen > 0, "the folder of published volumes is there but empty");
}
