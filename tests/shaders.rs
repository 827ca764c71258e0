//! Every shader is parsed and validated without an adapter, so that a broken one is found on any machine.

use std::fs;
use std::path::Path;

use naga::front::wgsl;
use naga::valid::{Capabilities, ValidationFlags, Validator};

/// What is wrong with a shader, and the names of its entry points.
fn check(text: &str) -> Result<Vec<String>, String> {
    let module = wgsl::parse_str(text).map_err(|e| e.emit_to_string(text))?;
    let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
    validator.validate(&module).map_err(|e| e.emit_to_string(text))?;
    Ok(module.entry_points.iter().map(|e| e.name.clone()).collect())
}

#[test]
fn every_shader_is_valid() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
    let mut found = 0;
    let mut failures = String::new();
    for entry in fs::read_dir(&dir).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "wgsl") {
            continue;
        }
        found += 1;
        let text = fs::read_to_string(&path).unwrap();
        match check(&text) {
            Ok(names) if names == ["first", "next"] => {}
            Ok(names) => failures += &format!("{}: entry points {names:?}\n", path.display()),
            Err(e) => failures += &format!("{}: {e}\n", path.display()),
        }
        for word in ["Bindings", "Workgroup", "Agrees"] {
            if !text.contains(word) {
                failures += &format!("{}: the head does not state: {word}\n", path.display());
            }
        }
    }
    assert!(found > 0, "no shader in {}", dir.display());
    assert!(failures.is_empty(), "{failures}");
}

#[test]
fn a_broken_shader_is_noticed() {
    assert!(check("fn f() -> u32 { return 1.5; }").is_err());
    assert!(check("@compute @workgroup_size(64) fn first() { missing[0] = 1u; }").is_err());
}
