//! Every shipped config does what it says, on a part of its volume.

mod common;

use std::path::{Path, PathBuf};

use common::*;

fn configs() -> Vec<PathBuf> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut list: Vec<PathBuf> = std::fs::read_dir(dir)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "toml"))
        .collect();
    list.sort();
    assert!(list.len() >= 8, "{list:?}");
    list
}

#[test]
fn shipped_configs_run() {
    for path in configs() {
        let name = path.file_stem().unwrap().to_string_lossy().to_string();
        let out = tempfile::tempdir().unwrap();
        let mut config = occlude::config::load(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
        if name == "reference" {
            continue; // names files that are examples; its values are tested with the parser
        }
        for output in &mut config.outputs {
            output.path = out.path().join(output.path.file_name().unwrap());
        }
        for input in &mut config.inputs {
            if let occlude::config::InputKind::Synthetic { shape, .. } = &mut input.kind {
                *shape = shape.map(|n| n.min(40));
            }
        }
        if config
            .inputs
            .iter()
            .any(|i| matches!(&i.kind, occlude::config::InputKind::Path { path, .. } if !path.exists()))
        {
            println!("SKIPPED {name}: its volume does not ship");
            continue;
        }
        if name.starts_with("head") {
            config.run.region = Some([[80, 100], [90, 120], [60, 110]]);
        }
        let report = run_with(&config, &Default::default());
        assert!(report.voxels > 0, "{name}");
        for output in &config.outputs {
            assert!(!decode(&output.path).is_empty(), "{name}");
        }
    }
}
