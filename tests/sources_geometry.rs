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
