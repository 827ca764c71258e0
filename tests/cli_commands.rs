//! The program as users run it: exit codes, streams, results.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

fn occlude(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_occlude")).args(args).current_dir(folder).output().unwrap()
}

/// Exit code, stdout, stderr; no message may be Rust's own.
fn call(folder: &Path, args: &[&str]) -> (i32, String, String) {
    let output = occlude(folder, args);
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(!err.contains("panicked") && !err.contains("RUST_BACKTRACE") && !err.contains("internal error"), "{err}");
    (output.status.code().expect("an exit code"), out, err)
}

fn json(folder: &Path, args: &[&str]) -> Value {
    let (code, out, err) = call(folder, args);
    assert_eq!(code, 0, "{err}");
    serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out}"))
}

/// Writes a NumPy file of `f32`.
fn npy(path: &Path, shape: [usize; 3], value: impl Fn(usize) -> f32) {
    let [z, y, x] = shape;
    let mut head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({z}, {y}, {x}), }}");
    head += &" ".repeat((64 - (10 + head.len() + 1) % 64) % 64);
    head.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((head.len() as u16).to_le_bytes());
    bytes.extend(head.as_bytes());
    (0..z * y * x).for_each(|i| bytes.extend(value(i).to_le_bytes()));
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn wrong_usage_is_2_and_leaves_stdout_empty() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    std::fs::write(f.join("bad.toml"), "[run]\nmemroy = 1\n").unwrap();
    std::fs::write(
        f.join("gone.toml"),
        "[input.ct]\npath = \"gone.nrrd\"\n[output.o]\npath = \"o.zarr\"\nfrom = \"ct\"\n",
    )
    .unwrap();
    for (args, code, fragment) in [
        (vec!["frobnicate"], 2, "unrecognized subcommand"),
        (vec![], 2, "Usage"),
        (vec!["run"], 2, "required"),
        (vec!["run", "absent.toml"], 2, "absent.toml: cannot read the config"),
        (vec!["run", "."], 2, "folder"),
        (vec!["run", "bad.toml"], 2, "bad.toml:2: run.memroy"),
        (vec!["plan", "bad.toml"], 2, "did you mean \"memory\"?"),
        (vec!["run", "gone.toml", "--memory", "2QiB"], 2, "unknown unit"),
        (vec!["run", "gone.toml", "--device", "cuda"], 2, "gpu:software"),
        (vec!["run", "gone.toml", "--set", "output.o.chunk=0"], 2, "output.o.chunk: got 0 from --set"),
        (vec!["run", "gone.toml", "--report", "no/such/r.json"], 2, "--report"),
        (vec!["run", "gone.toml"], 1, "gone.nrrd"),
        (vec!["plan", "gone.toml"], 1, "gone.nrrd"),
        (vec!["info", "gone.nrrd"], 1, "gone.nrrd"),
        (vec!["compare", "a.npy", "b.npy"], 1, "a.npy"),
        (vec!["compare", "a.npy", "b.npy", "--max-rmse", "-1"], 2, "at least 0"),
        (vec!["preview", "a.npy", "o.png", "--slice", "w=3"], 2, "z=40"),
        (vec!["preview", "a.npy", "o.png", "--range", "3,1"], 2, "LO below HI"),
        (vec!["pareto", "gone.toml"], 2, "pareto: missing"),
        (vec!["completions", "klingon"], 2, "bash"),
    ] {
        let (got, out, err) = call(f, &args);
        assert_eq!(got, code, "{args:?}: {err}");
        assert!(out.is_empty(), "{args:?} printed {out}");
        assert!(err.contains(fragment), "{args:?}: {err:?} lacks {fragment:?}");
    }
    for args in [vec!["--help"], vec!["--version"], vec!["pareto", "--help"]] {
        let (code, out, err) = call(f, &args);
        assert!(code == 0 && !out.is_empty() && err.is_empty(), "{args:?}");
    }
    // An input that nothing reads is not looked for.
    let reference = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/reference.toml");
    assert_eq!(call(f, &["plan", reference]).0, 0);
    assert!(json(f, &["schema"])["properties"]["run"].is_object());
    assert!(call(f, &["completions", "bash"]).1.contains("occlude"));
}

#[test]
fn no_result_is_written_over_what_is_read_or_into_an_output() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    npy(&f.join("a.npy"), [3, 4, 5], |i| i as f32);
    std::os::unix::fs::symlink("a.npy", f.join("link.npy")).unwrap();
    let config = "[input.a]\npath = \"a.npy\"\n[output.o]\npath = \"o.npy\"\nfrom = \"a\"\n";
    std::fs::write(f.join("c.toml"), config).unwrap();
    let before = std::fs::read(f.join("a.npy")).unwrap();
    for args in [
        vec!["preview", "a.npy", "a.npy"],
        vec!["preview", "a.npy", "link.npy"],
        vec!["run", "c.toml", "--report", "a.npy"],
        vec!["run", "c.toml", "--trace", "link.npy"],
        vec!["run", "c.toml", "--report", "c.toml"],
    ] {
        let (code, _, err) = call(f, &args);
        assert!(code == 2 && err.contains("which is read"), "{args:?}: {err}");
    }
    std::fs::create_dir(f.join("z.zarr")).unwrap();
    let zarr = ["--set", "output.z.path=z.zarr", "--set", "output.z.from=a"];
    for (flag, path) in [("--report", "o.npy"), ("--trace", "z.zarr/zarr.json"), ("--report", "z.zarr/../z.zarr/r")] {
        let (code, _, err) = call(f, &[&["run", "c.toml", flag, path][..], &zarr].concat());
        assert!(code == 2 && err.contains(flag) && err.contains("output"), "{flag} {path}: {err}");
    }
    assert!(std::fs::read(f.join("a.npy")).unwrap() == before && !f.join("o.npy").exists());
}

#[test]
fn a_closed_pipe_is_no_failure_to_talk_about() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_occlude"))
        .arg("schema")
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn info_counts_what_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let value = |i: usize| if i == 7 { f32::NAN } else { i as f32 };
    npy(&folder.path().join("a.npy"), [3, 4, 5], value);
    let info = json(folder.path(), &["info", "a.npy", "--stats", "--json"]);
    assert_eq!(info["shape"], serde_json::json!([3, 4, 5]));
    assert_eq!(info["dtype"], "f32");
    let s = &info["stats"];
    assert_eq!((s["count"].as_u64(), s["missing"].as_u64()), (Some(59), Some(1)));
    assert_eq!((s["min"].as_f64(), s["max"].as_f64()), (Some(0.0), Some(59.0)));
    let mean = (59.0 * 60.0 / 2.0 - 7.0) / 59.0;
    let variance = (0..60).filter(|i| *i != 7).map(|i| (f64::from(i) - mean).powi(2)).sum::<f64>() / 59.0;
    assert!((s["mean"].as_f64().unwrap() - mean).abs() < 1e-12);
    assert!((s["variance"].as_f64().unwrap() - variance).abs() < 1e-9);
    let bins = s["histogram"]["counts"].as_array().unwrap();
    assert_eq!(bins.iter().map(|c| c.as_u64().unwrap()).sum::<u64>(), 59);
    let (code, out, _) = call(folder.path(), &["info", "a.npy", "--stats"]);
    assert!(code == 0 && out.contains("3 x 4 x 5") && out.contains("missing 1"), "{out}");
}

#[test]
fn compare_measures_and_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    let wave = |i: usize| (i as f32 * 0.37).sin();
    npy(&f.join("a.npy"), [12, 13, 14], wave);
    npy(&f.join("b.npy"), [12, 13, 14], |i| wave(i) + if i % 2 == 0 { 0.5 } else { 0.0 });
    npy(&f.join("c.npy"), [12, 13, 15], wave);
    let same = json(f, &["compare", "a.npy", "a.npy", "--json", "--max-rmse", "0"]);
    assert_eq!((same["rmse"].as_f64(), same["n"].as_u64()), (Some(0.0), Some(12 * 13 * 14)));
    assert!((same["ssim"].as_f64().unwrap() - 1.0).abs() < 1e-12);
    let d = json(f, &["compare", "a.npy", "b.npy", "--json"]);
    let near = |key: &str, v: f64| assert!((d[key].as_f64().unwrap() - v).abs() < 1e-6, "{key}: {d}");
    near("rmse", 0.125f64.sqrt());
    near("mae", 0.25);
    near("bias", -0.25);
    near("max_abs", 0.5);
    near("p99", 0.5);
    assert!(d["ssim"].as_f64().unwrap() < 0.99);
    let (code, out, err) = call(f, &["compare", "a.npy", "b.npy", "--max-rmse", "0.3"]);
    assert!(code == 1 && out.contains("rmse") && err.contains("beyond"), "{out} {err}");
    assert_eq!(call(f, &["compare", "a.npy", "b.npy", "--max-rmse", "0.4"]).0, 0);
    let (code, _, err) = call(f, &["compare", "a.npy", "c.npy"]);
    assert!(code == 2 && err.contains("12 x 13 x 15"), "{err}");
}

#[test]
fn preview_draws_slices_in_proportion() {
    let folder = tempfile::tempdir().unwrap();
    npy(&folder.path().join("a.npy"), [10, 20, 30], |i| i as f32);
    let size = |args: &[&str]| {
        let (code, out, err) = call(folder.path(), args);
        assert!(code == 0 && out.is_empty(), "{err}");
        let file = std::fs::File::open(folder.path().join("p.png")).unwrap();
        let reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
        (reader.info().width, reader.info().height)
    };
    let three = size(&["preview", "a.npy", "p.png"]);
    let one = size(&["preview", "a.npy", "p.png", "--slice", "x=29", "--map", "magma", "--range", "0,10"]);
    assert!(three.0 > one.0 && three.1 >= one.1, "{three:?} {one:?}");
    let (code, _, err) = call(folder.path(), &["preview", "a.npy", "p.png", "--slice", "x=30"]);
    assert!(code == 2 && err.contains("x=0 to 29"), "{err}");
}

#[test]
fn a_run_from_config_to_comparison() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    let job = "[input.v]\nsynthetic = \"gyroid\"\nshape = [40, 36, 44]\n[stage.s]\nop = \"window\"\ninput = \"v\"\nlow = 0\nhigh = 1\n\
        [output.z]\npath = \"out/z.zarr\"\nfrom = \"v\"\nchunk = 16\nshard = 32\n[output.r]\npath = \"out/r.raw\"\nfrom = \"v\"\n";
    std::fs::write(f.join("job.toml"), job).unwrap();
    let plan = json(f, &["plan", "job.toml", "--json"]);
    assert!(plan.is_object());
    let (code, out, err) = call(f, &["run", "job.toml", "--report", "report.json", "--threads", "2"]);
    assert!(code == 0 && out.is_empty() && err.contains("done in"), "{err}");
    let report: Value = serde_json::from_slice(&std::fs::read(f.join("report.json")).unwrap()).unwrap();
    for key in [
        "seconds",
        "voxels",
        "voxels_per_second",
        "bricks",
        "bytes_read",
        "bytes_written",
        "read_amplification",
        "memory_budget_bytes",
        "peak_memory_bytes",
        "stages",
        "waits",
        "placement",
    ] {
        assert!(!report[key].is_null(), "{key} is not in {report}");
    }
    assert_eq!(report["voxels"], 40 * 36 * 44);
    assert_eq!(json(f, &["compare", "out/z.zarr", "out/r.raw", "--json"])["rmse"], 0.0);
    let info = json(f, &["info", "out/z.zarr", "--json", "--stats"]);
    assert_eq!(info["occlude"]["complete"], true);
    assert!(info["levels"].as_array().unwrap().len() > 1, "{info}");
    // It is there now: refused, unless told what to do with it.
    let (code, _, err) = call(f, &["run", "job.toml", "-q"]);
    assert!(code == 2 && err.contains("--overwrite"), "{err}");
    let (code, out, err) = call(f, &["run", "job.toml", "-q", "--overwrite"]);
    assert!(code == 0 && out.is_empty() && err.is_empty(), "{err}");
    let (code, _, err) = call(f, &["run", "job.toml", "--resume"]);
    assert!(code == 0 && err.contains("nothing was left to do") && !err.contains("voxels/s"), "{err}");
    // What is wrong with a flag is said of the flag.
    for args in
        [&["preview", "out/z.zarr", "o.png", "--level", "9"][..], &["info", "out/z.zarr", "--stats", "--level", "9"]]
    {
        let (code, _, err) = call(f, args);
        assert!(code == 2 && err.contains("error: --level: 9: the image has"), "{err}");
    }
}

#[test]
fn what_planning_refuses_points_at_the_line_of_the_key() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    npy(&f.join("v.npy"), [4, 5, 6], |i| i as f32);
    let text = "[run]\nthreads = 1\nmemory = \"1KiB\"\n[input.v]\npath = \"v.npy\"\nchannel = 0\n[stage.b]\nop = \"box\"\n\
                input = \"v\"\nradius = 1\n[output.o]\npath = \"o.npy\"\nfrom = \"b\"\n";
    for (from, to, expected) in [
        ("", "", "c.toml:3: run.memory"),
        ("memory = \"1KiB\"", "region = [[0, 9], [0, 5], [0, 6]]", "c.toml:3: run.region"),
        ("radius = 1", "radius = \"2 mm\"", "c.toml:10: stage.b.radius"),
        ("channel = 0", "channel = 3", "c.toml:6: input.v.channel"),
        (
            "from = \"b\"",
            "from = [\"b.variance\", \"b.std\"]\nreduce = \"moments\"",
            "c.toml:14: output.o.reduce: \"moments\" is for variances or for standard deviations, not for both in one array",
        ),
    ] {
        std::fs::write(f.join("c.toml"), text.replace(from, to)).unwrap();
        let (code, _, err) = call(f, &["run", "c.toml"]);
        assert!(code == 2 && err.contains(expected), "{code}, expected {expected}: {err}");
    }
}

#[cfg(unix)]
#[test]
fn paths_that_are_not_utf8_are_paths() {
    use std::os::unix::ffi::OsStrExt;
    let folder = tempfile::tempdir().unwrap();
    let odd = folder.path().join(std::ffi::OsStr::from_bytes(b"\xff\xfe"));
    std::fs::create_dir(&odd).unwrap();
    npy(&odd.join("v.npy"), [4, 5, 6], |i| i as f32);
    std::fs::write(odd.join("c.toml"), "[input.v]\npath = \"v.npy\"\n[output.o]\npath = \"o.zarr\"\nfrom = \"v\"\n")
        .unwrap();
    for (command, path) in [("plan", "c.toml"), ("run", "c.toml"), ("info", "o.zarr")] {
        let output = Command::new(env!("CARGO_BIN_EXE_occlude")).arg(command).arg(odd.join(path)).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{command}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn overwrite_looks_at_every_output_before_it_deletes_one() {
    let folder = tempfile::tempdir().unwrap();
    let f = folder.path();
    npy(&f.join("v.npy"), [4, 5, 6], |i| i as f32);
    let text = "[input.v]\npath = \"v.npy\"\nslope = nan\n[output.o]\npath = \"o.zarr\"\nfrom = \"v\"\n[output.p]\npath = \"p.zarr\"\nfrom = \"v\"\n";
    std::fs::write(f.join("c.toml"), text).unwrap();
    assert_eq!(call(f, &["run", "c.toml", "-q"]).0, 0, "slope NaN means 1");
    std::fs::remove_dir_all(f.join("p.zarr")).unwrap();
    std::fs::create_dir(f.join("p.zarr")).unwrap();
    std::fs::write(f.join("p.zarr/notes.txt"), "mine").unwrap();
    let (code, _, err) = call(f, &["run", "c.toml", "-q", "--overwrite"]);
    assert!(code == 2 && err.contains("p.zarr"), "{code}: {err}");
    assert!(f.join("o.zarr/zarr.json").exists() && f.join("p.zarr/notes.txt").exists());
}

#[test]
fn a_histogram_beside_an_infinity_counts_every_finite_value() {
    let folder = tempfile::tempdir().unwrap();
    npy(&folder.path().join("v.npy"), [4, 5, 6], |i| match i {
        7 => f32::INFINITY,
        9 => f32::NAN,
        i => i as f32,
    });
    let stats = &json(folder.path(), &["info", "v.npy", "--json", "--stats"])["stats"];
    let counts = stats["histogram"]["counts"].as_array().unwrap();
    assert_eq!(counts.iter().map(|c| c.as_u64().unwrap()).sum::<u64>(), 118, "{stats}");
    assert_eq!((&stats["count"], &stats["histogram"]["hi"]), (&118.into(), &119.0.into()), "{stats}");
}
