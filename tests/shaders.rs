//! Every shader is parsed and validated without an adapter, so that a broken one is found on any machine.

use std::fs;
use std::path::Path;

use naga::front::wgsl;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use occlude::gpu::record::Shader;

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
    let mut files: Vec<String> = fs::read_dir(&dir)
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|n| n.ends_with(".wgsl"))
        .collect();
    let mut failures = String::new();
    for shader in Shader::ALL {
        let name = shader.name();
        files.retain(|f| *f != format!("{name}.wgsl"));
        match check(shader.text()) {
            Ok(names) if names == shader.entries() => {}
            Ok(names) => failures += &format!("{name}: entry points {names:?}\n"),
            Err(e) => failures += &format!("{name}: {e}\n"),
        }
        let storage = shader.text().matches("var<storage").count();
        if storage != shader.bindings() {
            failures += &format!("{name}: {storage} storage bindings\n");
        }
        for word in ["Bindings", "Workgroup", "Agrees"] {
            if !shader.text().contains(word) {
                failures += &format!("{name}: the head does not state: {word}\n");
            }
        }
    }
    assert!(files.is_empty(), "no pipeline is made of {files:?}");
    assert!(failures.is_empty(), "{failures}");
}

#[test]
fn a_broken_shader_is_noticed() {
    assert!(check("fn f() -> u32 { return 1.5; }").is_err());
    assert!(check("@compute @workgroup_size(64) fn first() { missing[0] = 1u; }").is_err());
}
