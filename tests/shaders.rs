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
        files.retain(|f| !shader.files().iter().any(|s| *f == format!("{s}.wgsl")));
        match check(shader.text()) {
            Ok(names) if names == shader.entries() => {}
            Ok(names) => failures += &format!("{name}: entry points {names:?}\n"),
            Err(e) => failures += &format!("{name}: {e}\n"),
        }
        let storage = shader.text().matches("var<storage").count();
        if storage != shader.bindings() {
            failures += &format!("{name}: {storage} storage bindings\n");
        }
        for k in 1..=shader.bindings() {
            let access = if shader.writes(k) { "read_write" } else { "read" };
            if !shader.text().contains(&format!("@binding({k}) var<storage, {access}>")) {
                failures += &format!("{name}: binding {k} is not for {access}\n");
            }
        }
        for word in ["Bindings", "Workgroup", "Agrees"] {
            if !shader.text().contains(word) {
                failures += &format!("{name}: the head does not state: {word}\n");
            }
        }
    }
    assert!(files.is_empty(), "no shader is made of {files:?}");
    assert!(failures.is_empty(), "{failures}");
}

#[test]
fn no_helper_is_written_twice() {
    let mut seen = std::collections::BTreeMap::new();
    let mut twice = Vec::new();
    for file in Shader::ALL.iter().flat_map(|s| s.files()).collect::<std::collections::BTreeSet<_>>() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("shaders/{file}.wgsl"));
        let text = fs::read_to_string(path).unwrap();
        // A function from its head to the brace at the start of a line.
        for function in text.split("\nfn ").skip(1).map(|f| f.split("\n}").next().unwrap_or_default().to_string()) {
            let body = function.split_once('{').map_or("", |(_, body)| body).trim().to_string();
            if let Some(other) = seen.insert(body, *file) {
                twice.push(format!("{file} and {other}: {}", function.lines().next().unwrap_or_default()));
            }
        }
    }
    assert!(twice.is_empty(), "{twice:?}");
}

#[test]
fn a_broken_shader_is_noticed() {
    assert!(check("fn f() -> u32 { return 1.5; }").is_err());
    assert!(check("@compute @workgroup_size(64) fn first() { missing[0] = 1u; }").is_err());
}
