//! Every shader is parsed and validated without an adapter, so that a broken one is found on any machine.

use std::fs;
use std::path::Path;

use naga::Module;
use naga::back::pipeline_constants::process_overrides;
use naga::back::{hlsl, msl, spv};
use naga::front::wgsl;
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use occlude::gpu::record::Shader;

fn parsed(text: &str) -> Result<(Module, ModuleInfo), String> {
    let module = wgsl::parse_str(text).map_err(|e| e.emit_to_string(text))?;
    let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
    let info = validator.validate(&module).map_err(|e| e.emit_to_string(text))?;
    Ok((module, info))
}

/// What is wrong with a shader, and the names of its entry points.
fn check(text: &str) -> Result<Vec<String>, String> {
    parsed(text).map(|(module, _)| module.entry_points.iter().map(|e| e.name.clone()).collect())
}

/// A shader in the languages of Vulkan (as words), Metal and Direct3D 12.
fn translated(text: &str) -> Result<(Vec<u32>, String, String), String> {
    let (module, info) = parsed(text)?;
    let constants = Default::default();
    let settled = process_overrides(&module, &info, None, &constants).map_err(|e| format!("constants: {e}"))?;
    let (module, info) = (settled.0.as_ref(), settled.1.as_ref());
    let spv = spv::write_vec(module, info, &spv::Options::default(), None).map_err(|e| format!("SPIR-V: {e}"))?;
    let (options, of_pipeline) = (msl::Options::default(), msl::PipelineOptions::default());
    let (metal, entries) = msl::write_string(module, info, &options, &of_pipeline).map_err(|e| format!("MSL: {e}"))?;
    entries.entry_point_names.into_iter().collect::<Result<Vec<_>, _>>().map_err(|e| format!("MSL: {e}"))?;
    let mut direct = String::new();
    let (options, of_pipeline) = (hlsl::Options::default(), hlsl::PipelineOptions::default());
    let mut writer = hlsl::Writer::new(&mut direct, &options, &of_pipeline);
    let entries = writer.write(module, info, None).map_err(|e| format!("HLSL: {e}"))?;
    entries.entry_point_names.into_iter().collect::<Result<Vec<_>, _>>().map_err(|e| format!("HLSL: {e}"))?;
    Ok((spv, metal, direct))
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
        let goes_on = shader.text().contains("+= all_threads(groups)");
        if (0..shader.entries().len()).any(|e| shader.goes_on(e)) != goes_on {
            failures += &format!("{name}: whether its threads go on\n");
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

/// The body of a function in a text with braces.
fn body<'t>(text: &'t str, head: &str) -> Option<&'t str> {
    text.split_once(head)?.1.split_once("{")?.1.split_once("}").map(|b| b.0)
}

#[test]
fn every_shader_is_translated_for_vulkan_metal_and_direct3d() {
    for shader in Shader::ALL {
        let name = shader.name();
        let (spv, metal, direct) = translated(shader.text()).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(spv[0], 0x0723_0203, "{name}: SPIR-V begins with its number");
        for (language, text) in [("MSL", &metal), ("HLSL", &direct)] {
            for entry in shader.entries() {
                assert!(text.contains(&format!("void {entry}")), "{name}: {language} has no {entry}");
            }
            // No compiler may fuse what goes through integers, whatever its fast mathematics allow among floats: naga sets no
            // flags, and Metal's are fast by default.
            if shader.files().contains(&"floats") {
                let alone = body(text, "float alone(").unwrap_or_else(|| panic!("{name}: {language} keeps `alone`"));
                let hidden = [["as_type<uint>(v)", "as_type<float>("], ["asuint(v)", "asfloat("]];
                let hidden = hidden.iter().any(|h| h.iter().all(|part| alone.contains(part)));
                assert!(hidden && alone.contains(" ^ ") && alone.contains("zero"), "{name}, {language}: {alone}");
            }
            // Built-in functions that drivers approximate as they like.
            for word in ["exp(", "exp2(", "log(", "log2(", "pow(", "fma(", "mad("] {
                let own = |at: usize| text[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_');
                let built_in = text.match_indices(word).find(|(at, _)| !own(*at));
                assert_eq!(built_in, None, "{name}: {language} calls {word}");
            }
        }
    }
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
fn every_helper_is_called() {
    let files = Shader::ALL.iter().flat_map(|s| s.files()).collect::<std::collections::BTreeSet<_>>();
    let read = |file: &&&str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("shaders/{file}.wgsl"));
        let text = fs::read_to_string(path).unwrap();
        let code: Vec<&str> = text.lines().map(|l| l.split("//").next().unwrap_or_default()).collect();
        code.join("\n")
    };
    let all: Vec<String> = files.iter().map(read).collect();
    // Entry points stand behind their attribute, and are called by nobody.
    let helpers = all.iter().flat_map(|text| text.split("\n\nfn ").skip(1)).filter_map(|f| f.split('(').next());
    let called = |name: &str| {
        let call = format!("{name}(");
        let own = |before: &str| before.ends_with("fn ") || before.ends_with(|c: char| c.is_alphanumeric() || c == '_');
        all.iter().any(|text| text.match_indices(&call).any(|(at, _)| !own(&text[..at])))
    };
    let dead: Vec<&str> = helpers.filter(|name| !called(name)).collect();
    assert!(dead.is_empty(), "{dead:?}");
}

#[test]
fn a_broken_shader_is_noticed() {
    assert!(check("fn f() -> u32 { return 1.5; }").is_err());
    assert!(check("@compute @workgroup_size(64) fn first() { missing[0] = 1u; }").is_err());
}
