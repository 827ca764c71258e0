//! `occlude pareto` from the outside: what it runs, writes and advises.

mod common;

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

const SHAPE: [usize; 3] = [20, 24, 28];

fn occlude(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_occlude")).args(args).current_dir(folder).output().unwrap()
}

/// A noisy ball in a constant background: windows of every kind.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let voxel = |i: usize| {
        let c = [i / (SHAPE[1] * SHAPE[2]), i / SHAPE[2] % SHAPE[1], i % SHAPE[2]];
        let r2: f64 = (0..3).map(|a| (c[a] as f64 - SHAPE[a] as f64 / 2.0).powi(2)).sum();
        if r2 < 49.0 { 100 + (common::hash(1, i as u64) % 100) as u8 } else { 0 }
    };
    let data: Vec<u8> = (0..SHAPE.iter().product()).map(voxel).collect();
    common::write_npy(&folder.path().join("ball.npy"), "|u1", SHAPE, &data);
    let config = "[input.ball]\npath = \"ball.npy\"\n[stage.ao]\nop = \"ambient_occlusion\"\ninput = \"ball\"\n\
        method = \"cdf_power\"\nradius = 3\n[output.ao]\npath = \"o.zarr\"\nfrom = \"ao\"\n[pareto]\nstage = \"ao\"\n\
        reference = { method = \"exact\" }\nrepeat = 2\n\
        vary = { method = [\"exact\", \"beta\", \"cdf_power\"], radius = [2, 3], region = [\"box\", \"ball\"] }\n";
    std::fs::write(folder.path().join("p.toml"), config).unwrap();
    folder
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key} in {row}"))
}

#[test]
fn every_combination_is_judged_by_the_reference_that_fits_it() {
    let folder = folder();
    let f = folder.path();
    let output = occlude(f, &["pareto", "p.toml", "--json", "--max-error", "1e-9"]);
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{err}");
    // The config refuses balls for estimators; the rest is run.
    assert_eq!(err.matches("left out").count(), 4, "{err}");
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    let runs = json["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 8);
    assert_eq!(json["references"].as_array().unwrap().len(), 4, "two radii, box and ball");
    for run in runs {
        let exact = run["settings"]["method"] == "exact";
        assert_eq!(number(run, "rmse") == 0.0, exact, "{run}");
        let (vary, edge) = (&run["windows_that_vary"], &run["surface_band"]);
        let all = SHAPE.iter().product::<usize>() as f64;
        assert!(number(vary, "n") > 1000.0 && number(vary, "n") < all, "{run}");
        assert!(number(edge, "n") > 1000.0 && number(edge, "n") <= 0.2 * all, "{run}");
        assert_eq!(number(vary, "rmse") == 0.0, exact, "{run}");
        assert!(
            number(run, "seconds") > 0.0 && number(run, "peak_memory_bytes") > 0.0 && number(run, "bytes_read") > 0.0
        );
        // Constant windows are exact in every method, so all of the squared error lies in the others.
        let squares = |part: &Value| number(part, "rmse").powi(2) * number(part, "n");
        assert!((squares(run) - squares(vary)).abs() <= 1e-6 * squares(run), "{run}");
    }
    assert_eq!(json["cheapest"]["settings"]["method"], "exact");
    let csv = std::fs::read_to_string(f.join("pareto/pareto.csv")).unwrap();
    assert_eq!(csv.lines().count(), 9);
    assert!(csv.starts_with("method,radius,region,seconds,rmse,"), "{csv}");
    assert!(std::fs::read_to_string(f.join("pareto/pareto.svg")).unwrap().ends_with("</svg>\n"));
    let left: Vec<_> = std::fs::read_dir(f.join("pareto")).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "only table, plot and JSON stay: {left:?}");
}

#[test]
fn the_table_ends_with_the_lines_to_copy() {
    let folder = folder();
    let args = ["pareto", "p.toml", "--max-error", "1", "--set", "pareto.vary={ method = [\"exact\"] }"];
    let output = occlude(folder.path(), &args);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success());
    assert!(text.contains("rmse_vary") && !text.contains('\x1b'), "no colours in a pipe: {text}");
    assert!(text.trim_end().ends_with("[stage.ao]\nmethod = \"exact\""), "{text}");
    let none = ["pareto", "p.toml", "--max-error", "0", "--set", "pareto.vary={ method = [\"chebyshev\"] }"];
    let text = String::from_utf8_lossy(&occlude(folder.path(), &none).stdout).into_owned();
    assert!(text.contains("no combination is within rmse 0"), "{text}");
}

/// Writes a noisy volume and a config of one stage, whose `[pareto]` table is given; runs it.
fn pareto(shape: [usize; 3], stage: &str, table: &str, more: &[&str]) -> (tempfile::TempDir, Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let noise = |i: usize| (common::hash(7, i as u64) % 180) as u8 / if i % shape[2] > shape[2] / 2 { 1 } else { 9 };
    let data: Vec<u8> = (0..shape.iter().product()).map(noise).collect();
    common::write_npy(&folder.path().join("v.npy"), "|u1", shape, &data);
    let config = format!(
        "[run]\ndevice = \"cpu\"\n[input.v]\npath = \"v.npy\"\n[stage.s]\ninput = \"v\"\n{stage}\n\
         [output.o]\npath = \"o.zarr\"\nfrom = \"s\"\ndtype = \"f32\"\n[pareto]\nstage = \"s\"\n{table}\n"
    );
    std::fs::write(folder.path().join("p.toml"), config).unwrap();
    let output = occlude(folder.path(), &[&["pareto", "p.toml", "--json"], more].concat());
    let err = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{err}");
    (folder, serde_json::from_slice(&output.stdout).unwrap(), err)
}

fn rows(json: &Value) -> &Vec<Value> {
    json["runs"].as_array().unwrap()
}

#[test]
fn a_large_volume_is_judged_on_bricks_whatever_the_run_is_cut_into() {
    let stage = "op = \"ambient_occlusion\"\nmethod = \"cdf_power\"\nradius = 2\nfill = 7";
    let table = "vary = { method = [\"cdf_power\"] }\nkeep = true\n";
    let shape = [70, 140, 150];
    let of: usize = shape.iter().product();
    let sampled = |sample: &str, more: &[&str]| pareto(shape, stage, &format!("{table}sample = {sample}"), more);
    let (folder, json, _) = sampled("5", &["--threads", "1"]);
    let row = &rows(&json)[0];
    let judged = &row["judged"];
    assert_eq!((judged["bricks"].as_u64(), judged["of_bricks"].as_u64()), (Some(5), Some(2 * 3 * 3)));
    let n = number(judged, "voxels");
    assert!(n > 0.0 && n < of as f64 && number(judged, "of_voxels") == of as f64 && number(row, "n") == n, "{row}");
    assert!(number(&row["surface_band"], "n") <= 0.2 * n && number(&row["windows_that_vary"], "n") <= n);
    // The kept truth shows where it was computed, and where nothing was: there it holds the fill.
    let values = |name: &str| -> Vec<f64> {
        let decoded = common::decode(&folder.path().join("pareto/volumes").join(name));
        decoded["level 0 component 0"].1.iter().map(|bits| f64::from_bits(*bits)).collect()
    };
    let (truth, run) = (values("reference0.zarr"), values("run0.zarr"));
    let pairs: Vec<f64> = truth.iter().zip(&run).filter(|(t, _)| **t != 7.0).map(|(t, r)| r - t).collect();
    assert_eq!(pairs.len() as f64, n);
    let rmse = (pairs.iter().map(|d| d * d).sum::<f64>() / n).sqrt();
    assert!((number(row, "rmse") / rmse - 1.0).abs() < 1e-12, "{} {rmse}", number(row, "rmse"));
    assert!((number(row, "bias") - pairs.iter().sum::<f64>() / n).abs() < 1e-12);
    // Threads, bricks and budget change nothing; the seed does; a share is rounded up to whole bricks.
    let errors = |json: &Value| ["rmse", "bias", "p99", "max_abs", "ssim"].map(|k| number(&rows(json)[0], k));
    let same = ["--threads", "2", "--set", "run.brick=[24, 40, 100]", "--set", "run.memory=64MiB"];
    assert_eq!(errors(&json), errors(&sampled("\"27 %\"", &same).1));
    assert_ne!(errors(&json), errors(&sampled("5", &["--set", "pareto.seed=1"]).1));
    let (_, all, _) = sampled("18", &[]);
    assert_eq!(errors(&all), errors(&sampled("\"all\"", &[]).1));
    assert_eq!(number(&rows(&all)[0]["judged"], "voxels"), of as f64);
}

#[test]
fn how_much_was_judged_is_said_on_screen() {
    let stage = "op = \"ambient_occlusion\"\nmethod = \"cdf_power\"\nradius = 1";
    let (folder, _, _) = pareto([65, 65, 65], stage, "vary = { radius = [1, 2] }\nsample = 2\nseed = 9", &[]);
    let text = String::from_utf8(occlude(folder.path(), &["pareto", "p.toml"]).stdout).unwrap();
    assert!(text.contains("of 274625 voxels") && text.contains("(2 of 8 bricks of 64^3, seed 9)"), "{text}");
    let svg = std::fs::read_to_string(folder.path().join("pareto/pareto.svg")).unwrap();
    assert!(svg.contains("(2 of 8 bricks of 64^3, seed 9)"));
    let csv = std::fs::read_to_string(folder.path().join("pareto/pareto.csv")).unwrap();
    assert!(csv.lines().nth(1).unwrap().contains(",274625,"), "{csv}");
}

#[test]
fn regions_and_radii_are_judged_by_exact_counts_in_the_box_or_the_ball() {
    let stage = "op = \"ambient_occlusion\"\nmethod = \"exact\"\nradius = 3";
    let table = "vary = { region = [\"box\", \"equal_volume\", \"ball\"], radius = [2, 4], method = [\"exact\", \"levels\"], level_count = [8, 32] }";
    let (_, json, err) = pareto(SHAPE, stage, table, &[]);
    // Levels have no ball, counts no levels.
    assert_eq!((rows(&json).len(), err.matches("left out").count()), (8, 16), "{err}");
    let truths: Vec<String> =
        json["references"].as_array().unwrap().iter().map(|r| r["settings"].to_string()).collect();
    assert_eq!(truths.len(), 4, "{truths:?}");
    assert!(truths.iter().all(|t| t.contains("exact") && !t.contains("level_count")), "{truths:?}");
    for row in rows(&json) {
        let rmse = number(row, "rmse");
        let box_of_the_ball = row["settings"]["region"] == "equal_volume";
        // A box is no ball; eight levels are off by less than that.
        assert!(rmse > 0.0 && rmse < 0.2, "{row}");
        assert!(box_of_the_ball || number(row, "p99") < 0.2, "{row}");
        let more = row["settings"]["level_count"] == 32;
        assert!(!more || box_of_the_ball || rmse < 0.03, "{row}");
    }
    let exact = "vary = { region = [\"box\", \"ball\"], radius = [2, 4] }";
    let (_, json, _) = pareto(SHAPE, stage, exact, &[]);
    assert!(rows(&json).iter().all(|r| number(r, "rmse") == 0.0 && number(r, "ssim") > 0.999), "{json}");
}

#[test]
fn sweeps_are_judged_by_6000_directions_of_their_own_rho() {
    let stage = "op = \"obscurance\"\nmax_distance = 9";
    let table =
        "vary = { directions = [12, 42, 400], set = [\"icosahedron\", \"fibonacci\"], rho = [\"step\", \"sqrt\"] }";
    let (_, json, err) = pareto([12, 14, 16], stage, table, &[]);
    assert_eq!((rows(&json).len(), err.matches("left out").count()), (10, 2), "{err}");
    let truths = json["references"].as_array().unwrap();
    assert_eq!(truths.len(), 2, "one per rho");
    assert!(truths.iter().all(|t| t["settings"]["directions"] == 6000 && t["settings"]["set"] == "fibonacci"));
    let worst = |directions: u64| {
        let own = rows(&json).iter().filter(|r| r["settings"]["directions"] == directions);
        own.map(|r| number(r, "rmse")).fold(0.0, f64::max)
    };
    assert!(worst(400) < worst(42) && worst(42) < worst(12), "{} {} {}", worst(400), worst(42), worst(12));
}

#[test]
fn moments_are_judged_by_two_passes_over_their_windows() {
    let cases = [
        (
            "op = \"box\"\nradius = 2",
            "s.variance",
            "vary = { radius = [1, [30, 0, 2]], border = [\"clip\", \"nearest\", \"reflect\"] }",
            6,
        ),
        ("op = \"box\"\nradius = 2", "s.std", "vary = { radius = [[0, 1, 4]] }", 1),
        ("op = \"box\"\nradius = 2", "s.moment2", "vary = { radius = [2] }", 1),
        ("op = \"gaussian\"\nsigma = 1", "s.mean", "vary = { sigma = [0.7, 2.5] }", 2),
        ("op = \"gaussian\"\nsigma = 1", "s.variance", "vary = { sigma = [1.5], border = [\"clip\", \"reflect\"] }", 2),
        ("op = \"occlusion_map\"", "s", "vary = { start_level = [0, 1] }", 2),
        ("op = \"occlusion_map\"", "s.variance", "vary = { start_level = [1] }", 1),
    ];
    for (stage, channel, table, n) in cases {
        for sample in ["\"all\"", "1"] {
            let table = format!("{table}\nsample = {sample}");
            let (_, json, _) = pareto([24, 26, 150], stage, &table, &["--set", &format!("pareto.stage={channel}")]);
            assert_eq!(rows(&json).len(), n, "{stage}");
            assert!(json["references"].as_array().unwrap().iter().all(|t| t["by"] == "two passes in f64"), "{json}");
            for row in rows(&json) {
                let whole = number(&row["judged"], "of_voxels");
                let of = if sample == "1" { number(&row["judged"], "voxels") } else { whole };
                assert!(number(row, "n") == of && (sample == "1") == (of < whole), "{row}");
                // Values reach 180, their squares 180^2; results are f32.
                assert!(number(row, "max_abs") < 0.01 && number(row, "ssim") > 0.999_99, "{stage} {channel}: {row}");
            }
        }
    }
}

#[test]
fn devices_vary_and_one_that_is_not_there_is_left_out() {
    let stage = "op = \"ambient_occlusion\"\nmethod = \"gaussian_cdf\"\nradius = 2";
    let table = "vary = { device = [\"cpu\", \"gpu:software\"], radius = [1, 2] }";
    let (folder, json, err) = pareto(SHAPE, stage, table, &["--max-error", "1"]);
    let software = rows(&json).len() == 4;
    assert!(software || rows(&json).len() == 2 && err.matches("left out: device=gpu:software").count() == 2, "{err}");
    assert_eq!(json["references"].as_array().unwrap().len(), 2, "the truth of both devices is one");
    let text = String::from_utf8(occlude(folder.path(), &["pareto", "p.toml", "--max-error", "1"]).stdout).unwrap();
    assert!(text.contains("[run]\ndevice = \""), "{text}");
    for (cpu, gpu) in rows(&json).iter().zip(rows(&json).iter().skip(2)) {
        assert!((number(cpu, "rmse") - number(gpu, "rmse")).abs() < 1e-5, "{cpu} {gpu}");
    }
}

#[test]
fn a_reference_of_ones_own_fits_every_method() {
    let stage = "op = \"ambient_occlusion\"\nmethod = \"levels\"\nlevel_count = 16\nradius = 2";
    let table = "reference = { method = \"exact\" }\nvary = { method = [\"levels\"], level_count = [8, 64] }";
    let (_, json, _) = pareto(SHAPE, stage, table, &[]);
    assert_eq!((rows(&json).len(), json["references"].as_array().unwrap().len()), (2, 1), "{json}");
    assert!(number(&rows(&json)[0], "rmse") > number(&rows(&json)[1], "rmse"));
}
