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
