//! Outputs as users and viewers meet them: paths that cannot be, components, and what a failed deletion leaves.
mod common;

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// Exit code, stdout, stderr; no message may be Rust's own.
fn call(folder: &Path, args: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_occlude")).args(args).current_dir(folder).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(!err.contains("panicked") && !err.contains("RUST_BACKTRACE") && !err.contains("internal error"), "{err}");
    (output.status.code().expect("an exit code"), out, err)
}

const SHAPE: [usize; 3] = [4, 5, 6];

/// A folder with `v.npy` (f32, every voxel another value) and `c.toml`, whose outputs are the text given.
fn job(outputs: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let values: Vec<f32> = (0..120).map(|i| (i * i % 113) as f32).collect();
    common::write_npy(&folder.path().join("v.npy"), "<f4", SHAPE, &common::f32_bytes(&values));
    let stages = "[input.v]\npath = \"v.npy\"\n[stage.g]\nop = \"gradient\"\ninput = \"v\"\n\
                  [stage.t]\nop = \"transfer\"\ninput = \"v\"\npoints = [[0, 0, 1, 0, 0.2], [113, 1, 0.5, 0, 0.4]]\n";
    fs::write(folder.path().join("c.toml"), format!("{stages}{outputs}")).unwrap();
    folder
}

fn omero(path: &Path) -> Vec<Value> {
    let group: Value = serde_json::from_slice(&fs::read(path.join("zarr.json")).unwrap()).unwrap();
    group["attributes"]["ome"]["omero"]["channels"].as_array().unwrap().clone()
}

#[test]
fn a_path_below_a_file_is_refused_at_its_key() {
    let folder = job("[output.o]\nfrom = \"g\"\npath = \"PATH\"\n");
    let f = folder.path();
    fs::write(f.join("plain"), "x").unwrap();
    let text = fs::read_to_string(f.join("c.toml")).unwrap();
    for path in ["plain/o.zarr", "plain/deep/o.npy", "./plain/../plain/o.nrrd"] {
        fs::write(f.join("c.toml"), text.replace("PATH", path)).unwrap();
        for command in ["run", "plan"] {
            let (code, _, err) = call(f, &[command, "c.toml"]);
            let all = ["c.toml:12: output.o.path", "plain is a file", path];
            assert!(code == 2 && all.iter().all(|part| err.contains(part)), "{code}: {err}");
        }
    }
    assert_eq!(fs::read(f.join("plain")).unwrap(), b"x");
}

#[test]
fn the_folder_beside_an_output_is_its_own() {
    let two = "[output.o]\nfrom = \"g\"\npath = \"o.zarr\"\nformat = \"0.5\"\n[output.p]\nfrom = \"g\"\npath = \"P\"\nformat = \"0.5\"\n";
    for path in ["o.zarr.occlude", "o.zarr.occlude/p.zarr"] {
        let folder = job(&two.replace('P', path));
        let (code, _, err) = call(folder.path(), &["run", "c.toml"]);
        assert!(code == 2 && err.contains("output.p.path") && err.contains("NAME.occlude"), "{code}: {err}");
        let swapped = two.replace("o.zarr", "Q").replace("\"P\"", "\"o.zarr\"").replace('Q', path);
        let folder = job(&swapped);
        let (code, _, err) = call(folder.path(), &["run", "c.toml"]);
        assert!(code == 2 && err.contains("output.p.path") && err.contains("NAME.occlude"), "{code}: {err}");
    }
    let folder = job("[output.o]\nfrom = \"g\"\npath = \"o.zarr\"\n");
    let f = folder.path();
    fs::create_dir(f.join("o.zarr.occlude")).unwrap();
    fs::rename(f.join("v.npy"), f.join("o.zarr.occlude/v.npy")).unwrap();
    let (code, _, err) = call(f, &["run", "c.toml", "--set", "input.v.path=o.zarr.occlude/v.npy", "--overwrite"]);
    assert!(
        code == 2 && err.contains("what is unfinished") && f.join("o.zarr.occlude/v.npy").exists(),
        "{code}: {err}"
    );
}

#[test]
fn an_output_that_could_not_be_deleted_is_no_longer_complete() {
    for format in ["0.5", "0.4"] {
        let folder = job(&format!("[output.o]\nfrom = \"g\"\npath = \"o.zarr\"\nformat = \"{format}\"\nchunk = 2\n"));
        let f = folder.path();
        assert_eq!(call(f, &["run", "c.toml", "-q"]).0, 0);
        let last = f.join("o.zarr/1").join(if format == "0.5" { "zarr.json" } else { ".zarray" });
        fs::remove_file(&last).unwrap();
        // What cannot be removed as a file.
        fs::create_dir(&last).unwrap();
        let (code, _, err) = call(f, &["run", "c.toml", "-q", "--overwrite"]);
        assert!(code == 1 && err.contains("cannot be removed"), "{code}: {err}");
        // Chunks are gone, so nothing may take it for whole.
        let (_, out, err) = call(f, &["info", "o.zarr"]);
        assert!(!out.contains("complete: true"), "{out}{err}");
        fs::remove_dir(&last).unwrap();
        let (code, _, err) = call(f, &["run", "c.toml", "-q", "--resume"]);
        assert_eq!(code, 0, "{err}");
        assert!(call(f, &["info", "o.zarr"]).1.contains("complete: true"));
    }
}

#[test]
fn components_are_compared_and_described_in_every_format() {
    let outputs = |name: &str| format!("[output.{name}]\nfrom = [\"g.vector\", \"g\"]\npath = \"{name}.zarr\"\n");
    let folder = job(&outputs("a"));
    let f = folder.path();
    assert_eq!(call(f, &["run", "c.toml", "-q"]).0, 0);
    for format in ["npy", "nrrd", "nii", "raw"] {
        let path = format!("a.{format}");
        let (code, _, err) = call(f, &["run", "c.toml", "-q", "--set", &format!("output.a.path={path}")]);
        assert_eq!(code, 0, "{err}");
        let (code, out, err) = call(f, &["info", &path]);
        assert!(code == 0 && out.contains("4 x 5 x 6"), "{out}{err}");
        if format == "raw" {
            let (code, out, err) = call(f, &["info", &path, "--shape", "16,5,6", "--dtype", "f32"]);
            assert!(code == 0 && out.contains("16 x 5 x 6"), "flags go first: {out}{err}");
        }
        assert_eq!(call(f, &["preview", &path, "p.png"]).0, 0);
        let (code, out, err) = call(f, &["compare", "a.zarr", &path, "--json"]);
        assert_eq!(code, 0, "{path}: {err}");
        let found: Value = serde_json::from_str(&out).unwrap();
        assert!(found["n"] == 480 && found["max_abs"] == 0.0, "{path}: {found}");
    }
}

#[test]
fn colours_share_a_window_and_channels_have_their_own() {
    let folder = job("[output.o]\nfrom = \"t.rgb\"\npath = \"o.zarr\"\ndtype = \"u8\"\nrange = [0, 1]\n\
                      [output.p]\nfrom = [\"g\", \"t.rgb\"]\npath = \"p.zarr\"\n");
    assert_eq!(call(folder.path(), &["run", "c.toml", "-q"]).0, 0);
    for channel in omero(&folder.path().join("o.zarr")) {
        assert_eq!((&channel["window"]["start"], &channel["window"]["end"]), (&0.0.into(), &255.0.into()), "{channel}");
    }
    let channels = omero(&folder.path().join("p.zarr"));
    let ends: Vec<f64> = channels.iter().map(|c| c["window"]["end"].as_f64().unwrap()).collect();
    assert!(ends[0] != 1.0 && ends[1..] == [1.0; 3], "{channels:?}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_limit_of_file_sizes_is_an_error_that_names_the_file() {
    let folder = job("[output.o]\nfrom = \"g.vector\"\npath = \"o.npy\"\n");
    let f = folder.path();
    let limited = |flag: &str| {
        let line = format!("ulimit -f 1 && exec {} run c.toml -q {flag}", env!("CARGO_BIN_EXE_occlude"));
        Command::new("bash").args(["-c", &line]).current_dir(f).output().unwrap()
    };
    let output = limited("");
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && err.contains("o.npy") && err.contains("ulimit -f"), "{err}");
    assert!(!f.join("o.npy").exists());
    let (code, _, err) = call(f, &["run", "c.toml", "-q", "--resume"]);
    assert!(code == 0 && f.join("o.npy").exists(), "{err}");
}

/// A detached header is not its voxels: what it names is read, too.
#[test]
fn voxels_that_a_header_names_are_never_written_over() {
    let folder = job("[output.o]\nfrom = \"g\"\npath = \"own.raw\"\n");
    let f = folder.path();
    let (code, _, err) = call(f, &["run", "c.toml", "-q"]);
    assert_eq!(code, 0, "{err}");
    let voxels = fs::read(f.join("own.raw")).unwrap();
    let nrrd = "NRRD0004\ntype: float\ndimension: 3\nsizes: 6 5 4\nendian: little\nencoding: raw\ndata file: own.raw\n";
    fs::write(f.join("own.nhdr"), nrrd).unwrap();
    let meta = "NDims = 3\nDimSize = 6 5 4\nElementType = MET_FLOAT\nElementDataFile = own.raw\n";
    fs::write(f.join("own.mhd"), meta).unwrap();
    for header in ["own.nhdr", "own.mhd"] {
        let input = format!("input.v.path={header}");
        let refused = |args: &[&str], wants: &str| {
            let (code, _, err) = call(f, &[args, &["--set", &input]].concat());
            assert!(code == 2 && err.contains(wants) && err.contains("own.raw"), "{args:?} {header}: {code} {err}");
            assert_eq!(fs::read(f.join("own.raw")).unwrap(), voxels);
        };
        refused(&["run", "c.toml", "--overwrite"], "c.toml:12: output.o.path");
        refused(&["plan", "c.toml"], "c.toml:12: output.o.path");
        let elsewhere = ["run", "c.toml", "--set", "output.o.path=p.raw"];
        refused(&[&elsewhere[..], &["--report", "own.raw"]].concat(), "is read for an input");
        refused(&[&elsewhere[..], &["--trace", "own.raw"]].concat(), "is read for an input");
        assert!(!f.join("p.raw").exists());
    }
    // Nor files inside a folder that is read.
    let (code, _, err) = call(f, &["run", "c.toml", "-q", "--set", "output.o.path=o.zarr"]);
    assert_eq!(code, 0, "{err}");
    let before = fs::read(f.join("o.zarr/zarr.json")).unwrap();
    let (code, _, err) = call(f, &["preview", "o.zarr", "o.zarr/zarr.json"]);
    assert!(code == 2 && err.contains("which is read"), "{code} {err}");
    assert_eq!(fs::read(f.join("o.zarr/zarr.json")).unwrap(), before);
}

#[test]
fn reports_that_cannot_be_written_are_refused_before_the_work() {
    let folder = job("[output.o]\nfrom = \"g\"\npath = \"o.npy\"\n");
    let f = folder.path();
    let (code, _, err) = call(f, &["run", "c.toml", "--report", "r.json", "--trace", "./r.json"]);
    assert!(code == 2 && err.contains("--trace") && err.contains("--report writes"), "{code} {err}");
    // Whoever is root may write anywhere else.
    let (code, _, err) = call(f, &["run", "c.toml", "--report", "/proc/r.json"]);
    assert!(code == 1 && err.contains("/proc/r.json: cannot write"), "{code} {err}");
    assert!(!f.join("o.npy").exists() && !f.join("r.json").exists());
}
