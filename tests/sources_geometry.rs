//! Spacings and origins as files and configs give them.

mod common;
mod common_sources;

use std::fs;

use common_sources::*;
use occlude::store::Source;

/// A NRRD of 2 x 3 x 4 voxels with lines of the caller's.
fn nrrd(lines: &str) -> Vec<u8> {
    let head = format!("NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\n{lines}\n");
    let mut bytes = head.into_bytes();
    bytes.extend(0..24);
    bytes
}

#[test]
fn axis_mins_are_an_origin_where_no_other_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    for (lines, origin) in [
        ("spacings: 0.5 2 3\naxis mins: 10 20 -30\n", [-30.0, 20.0, 10.0]),
        ("spacings: 0.5 2 3\naxismins: 10 nan -30\ncenterings: node node node\n", [-30.0, 0.0, 10.0]),
        // Samples in the middle of cells: an axis begins half a cell before its first voxel.
        ("spacings: 0.5 2 3\naxis mins: 10 20 -30\ncenterings: cell node cell\n", [-28.5, 20.0, 10.25]),
        ("space dimension: 3\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (1,2,3)\n", [3.0, 2.0, 1.0]),
        ("spacings: 0.5 2 3\n", [0.0; 3]),
    ] {
        fs::write(&path, nrrd(lines)).unwrap();
        near(Source::open(&file_input(&path)).unwrap().info().origin, origin);
    }
    fs::write(&path, nrrd("spacings: 1 1 1\naxis mins: 1 2\n")).unwrap();
    let e = Source::open(&file_input(&path)).unwrap_err().to_string();
    assert!(e.contains("axis mins: 1 2") && e.contains("3 numbers are expected"), "{e}");
}

#[test]
fn axis_maxs_are_a_spacing_where_no_other_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    for (lines, spacing, origin) in [
        ("axis mins: 0 0 0\naxis maxs: 10 12 14\ncenterings: cell cell cell\n", [7.0, 4.0, 2.5], [3.5, 2.0, 1.25]),
        ("axis mins: 0 0 0\naxis maxs: 10 12 14\n", [7.0, 4.0, 2.5], [3.5, 2.0, 1.25]),
        (
            "axis mins: 10 -20 30\naxis maxs: 16 -10 48\ncenters: node node node\n",
            [18.0, 5.0, 2.0],
            [30.0, -20.0, 10.0],
        ),
        ("spacings: 1 nan 3\naxis mins: 0 0 0\naxis maxs: 9 9 9\ncenters: node node node\n", [3.0, 4.5, 1.0], [0.0; 3]),
        ("axis maxs: 9 9 9\n", [1.0; 3], [0.0; 3]),
    ] {
        fs::write(&path, nrrd(lines)).unwrap();
        let source = Source::open(&file_input(&path)).unwrap();
        near(source.info().spacing, spacing);
        near(source.info().origin, origin);
    }
    // Of four axes the one without a spacing is none of space.
    let head = "NRRD0004\ntype: uint8\ndimension: 4\nsizes: 2 4 3 2\nencoding: raw\nspacings: nan 1.5 2 3\n\n";
    fs::write(&path, [head.as_bytes(), &[0; 48]].concat()).unwrap();
    let source = Source::open(&file_input(&path)).unwrap();
    assert_eq!(source.info().shape, [2, 3, 4]);
    near(source.info().spacing, [3.0, 2.0, 1.5]);
}

/// A NIfTI-1 file of 2 x 3 x 4 voxels u8 with this pixdim and sform.
fn nifti(pixdim: [f32; 3], sform: [[f32; 4]; 3]) -> Vec<u8> {
    let mut head = vec![0u8; 352 + 24];
    head[..4].copy_from_slice(&348i32.to_le_bytes());
    [3i16, 4, 3, 2, 1, 1, 1, 1]
        .iter()
        .enumerate()
        .for_each(|(i, n)| head[40 + 2 * i..][..2].copy_from_slice(&n.to_le_bytes()));
    head[70..72].copy_from_slice(&2i16.to_le_bytes());
    head[72..74].copy_from_slice(&8i16.to_le_bytes());
    pixdim.iter().enumerate().for_each(|(i, v)| head[80 + 4 * i..][..4].copy_from_slice(&v.to_le_bytes()));
    head[108..112].copy_from_slice(&352f32.to_le_bytes());
    head[123] = 2;
    head[254..256].copy_from_slice(&1i16.to_le_bytes());
    sform
        .as_flattened()
        .iter()
        .enumerate()
        .for_each(|(i, v)| head[280 + 4 * i..][..4].copy_from_slice(&v.to_le_bytes()));
    head[344..348].copy_from_slice(b"n+1\0");
    head
}

#[test]
fn an_affine_that_contradicts_pixdim_counts_and_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let straight = [[1.5, 0.0, 0.0, 4.0], [0.0, 2.0, 0.0, 5.0], [0.0, 0.0, 3.0, 6.0]];
    // Turned by 30 degrees about z, with unequal steps.
    let (c, s) = (0.866_025_4, 0.5);
    let oblique = [[1.5 * c, -2.0 * s, 0.0, 4.0], [1.5 * s, 2.0 * c, 0.0, 5.0], [0.0, 0.0, 3.0, 6.0]];
    for (name, sform) in [("a.nii", straight), ("b.nii", oblique)] {
        fs::write(folder.path().join(name), nifti([1.0; 3], sform)).unwrap();
        let text = format!("[input.v]\npath = '{name}'\n[output.o]\npath = 'o{name}'\nfrom = 'v'\n");
        common::run(folder.path(), &text, &[]);
        for file in [name.to_string(), format!("o{name}")] {
            let source = Source::open(&file_input(&folder.path().join(&file))).unwrap();
            near(source.info().spacing, [3.0, 2.0, 1.5]);
            let matrix = source.info().orientation.as_ref().unwrap().matrix;
            for (got, want) in matrix.as_flattened().iter().zip(sform.as_flattened()) {
                assert!((got - *want as f64).abs() < 1e-5, "{file}: {matrix:?}");
            }
            let warned = source.info().warnings.iter().any(|w| w.contains("the affine counts"));
            assert_eq!(warned, file == name, "{file}");
        }
    }
    // f32 noise between the two is no contradiction.
    let near_one = [[1.000_01, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let path = folder.path().join("c.nii");
    fs::write(&path, nifti([1.0; 3], near_one)).unwrap();
    let source = Source::open(&file_input(&path)).unwrap();
    assert_eq!((source.info().spacing, source.info().warnings.len()), ([1.0; 3], 0));
}

#[test]
fn an_origin_in_the_config_reaches_every_output() {
    let folder = tempfile::tempdir().unwrap();
    // Straight, rotated, and in a space of which two axes are turned around.
    for (name, straight) in [("nifti/u8.nii", true), ("nifti/be2.nii", false), ("nrrd/raw.nrrd", true)] {
        let file = data(name);
        for (output, region, want) in [
            ("o.nii", "'all'", [1.0, 2.0, 3.0]),
            ("o.nrrd", "'all'", [1.0, 2.0, 3.0]),
            ("o.zarr", "'all'", [1.0, 2.0, 3.0]),
            ("part.nrrd", "[[1, 3], [2, 5], [0, 6]]", [1.0 + 2.0, 2.0 + 2.0 * 0.6, 3.0]),
        ] {
            let text = format!(
                "[run]\nregion = {region}\n[input.v]\npath = '{}'\norigin = [1.0, 2.0, 3.0]\n[output.o]\npath = '{output}'\nfrom = 'v'\n",
                file.display()
            );
            common::run(folder.path(), &text, &[]);
            let source = Source::open(&file_input(&folder.path().join(output))).unwrap();
            let info = source.info();
            if straight && !(output == "o.nii" && name.ends_with("nrrd")) {
                near(info.origin, want);
            }
            let Some(orientation) = &info.orientation else { continue };
            if straight && output == "o.nii" {
                // RAS is the only space of NIfTI; LPS turns x and y around.
                let turn = if name.ends_with("nrrd") { -1.0 } else { 1.0 };
                let m = orientation.matrix;
                near([m[2][3], turn * m[1][3], turn * m[0][3]], want);
            } else if output != "part.nrrd" {
                let m = orientation.matrix;
                near([m[2][3], m[1][3], m[0][3]], want);
            }
        }
    }
}

/// An OME-Zarr 0.4 image of 4 x 5 x 6 voxels whose axes have these names.
fn ome(folder: &std::path::Path, names: [&str; 3]) {
    ome_in(folder, names.map(|n| serde_json::json!({ "name": n, "type": "space", "unit": "micrometer" })));
}

fn ome_in(folder: &std::path::Path, axes: [serde_json::Value; 3]) {
    let scale = serde_json::json!([{ "type": "scale", "scale": [2, 1, 1] }]);
    let image = serde_json::json!({
        "version": "0.4", "axes": axes, "datasets": [{ "path": "0", "coordinateTransformations": scale }]
    });
    fs::create_dir_all(folder.join("0")).unwrap();
    fs::write(folder.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    fs::write(folder.join(".zattrs"), serde_json::json!({ "multiscales": [image] }).to_string()).unwrap();
    let array = serde_json::json!({
        "zarr_format": 2, "shape": [4, 5, 6], "chunks": [4, 5, 6], "dtype": "|u1", "order": "C", "fill_value": 0,
        "compressor": null, "filters": null, "dimension_separator": "/"
    });
    fs::write(folder.join("0/.zarray"), array.to_string()).unwrap();
    fs::create_dir_all(folder.join("0/0/0")).unwrap();
    fs::write(folder.join("0/0/0/0"), (0..120).collect::<Vec<u8>>()).unwrap();
}

#[test]
fn axes_in_another_order_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.zarr");
    let text = "[input.v]\npath = 'm.zarr'\n[output.o]\npath = 'o.npy'\nfrom = 'v'\n";
    for (names, odd) in [(["x", "y", "z"], true), (["z", "x", "y"], true), (["z", "y", "x"], false)] {
        ome(&path, names);
        let warnings = Source::open(&file_input(&path)).unwrap().info().warnings.clone();
        let (_, plan) = occlude::plan::explain(&common::parse(folder.path(), text, &[])).unwrap();
        let info = std::process::Command::new(common::program()).arg("info").arg(&path).output().unwrap();
        let info = String::from_utf8(info.stdout).unwrap();
        let said = format!("axes are named {}, slowest first", names.join(", "));
        assert_eq!(warnings.iter().any(|w| w.contains(&said)), odd, "{warnings:?}");
        assert_eq!(plan["warnings"].to_string().contains(&format!("input v: its {said}")), odd, "{plan}");
        assert_eq!(info.contains(&said), odd, "{info}");
    }
}

#[test]
fn axes_without_a_unit_take_that_of_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.zarr");
    let axis = |name: &str, unit: Option<&str>| match unit {
        Some(unit) => serde_json::json!({ "name": name, "type": "space", "unit": unit }),
        None => serde_json::json!({ "name": name, "type": "space" }),
    };
    for (units, spacing, warned) in [
        ([Some("micrometer"), None, None], [2.0, 1.0, 1.0], true),
        ([None, None, Some("micrometer")], [2.0, 1.0, 1.0], true),
        ([Some("millimeter"), None, Some("micrometer")], [2.0, 1.0, 1e-3], true),
        ([Some("nanometer"), Some("micrometer"), Some("micrometer")], [2.0, 1000.0, 1000.0], false),
        ([None, None, None], [2.0, 1.0, 1.0], false),
    ] {
        ome_in(&path, [0, 1, 2].map(|a| axis(["z", "y", "x"][a], units[a])));
        let source = Source::open(&file_input(&path)).unwrap();
        assert_eq!(source.info().spacing, spacing, "{units:?}");
        assert_eq!(source.info().unit.as_deref(), units.into_iter().flatten().next(), "{units:?}");
        let said = source.info().warnings.iter().any(|w| w.contains("have no unit"));
        assert_eq!(said, warned, "{units:?}");
    }
}

/// A Zarr array of a million voxels per axis of which nothing is stored.
#[test]
fn volumes_of_more_tasks_than_can_be_counted_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let array = serde_json::json!({
        "zarr_format": 2, "shape": [1_000_000, 1_000_000, 1_000_000], "chunks": [64, 64, 64], "dtype": "|u1", "order": "C",
        "fill_value": 0, "compressor": null, "filters": null
    });
    fs::create_dir(folder.path().join("v.zarr")).unwrap();
    fs::write(folder.path().join("v.zarr/.zarray"), array.to_string()).unwrap();
    let text = "[run]\nregion = 'all'\n[input.v]\npath = 'v.zarr'\n[stage.s]\nop = 'box'\ninput = 'v'\nradius = 2\n\
                [output.o]\npath = 'o.zarr'\nfrom = 's'\n";
    let error = occlude::plan::explain(&common::parse(folder.path(), text, &[])).unwrap_err();
    let said = error.to_string();
    assert!(error.exit_code() == 2 && said.contains(":2: run.region") && said.contains("tasks"), "{said}");
    let part = "run.region=[[0, 99], [999_900, 1_000_000], [5, 500]]";
    common::run(folder.path(), text, &[part]);
    // As large as can be: what is looked at does not grow with it.
    let wide = "run.region=[[0, 100_000], [0, 100_000], [0, 50_000]]";
    occlude::plan::explain(&common::parse(folder.path(), text, &[wide])).unwrap();
}
