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
    let axes = names.map(|n| serde_json::json!({ "name": n, "type": "space", "unit": "micrometer" }));
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
