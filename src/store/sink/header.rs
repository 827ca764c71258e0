//! Headers of flat files: NumPy, NRRD. (NIfTI: see `nifti`.) A header has the same length before and after a run, since
//! the voxels behind it are written first.

use serde_json::Value;

use super::SinkSpec;
use super::metadata::numpy_descr;
use crate::config::OutputFormat;
use crate::grid::DType;

/// Room for what only the end of a run knows (the hash of the configuration), bytes.
const NRRD_RESERVE: usize = 128;

/// The header of a flat file; `occlude` once the run is done. Its length depends on `spec` alone.
pub fn header(spec: &SinkSpec, occlude: Option<&Value>) -> Vec<u8> {
    match spec.format {
        OutputFormat::Npy => npy(spec),
        OutputFormat::Nrrd => nrrd(spec, occlude),
        OutputFormat::Nifti => super::nifti::nifti(spec, occlude),
        OutputFormat::Raw | OutputFormat::OmeZarr05 | OutputFormat::OmeZarr04 => Vec::new(),
    }
}

/// The hash of the configuration, cut to what no header chokes on.
pub fn config_hash(occlude: Option<&Value>) -> Option<String> {
    let hash = occlude?.get("config_hash")?.as_str()?;
    Some(hash.chars().filter(char::is_ascii_graphic).take(72).collect())
}

/// NPY 1.0, C order, `(c, z, y, x)`; the voxels start at a multiple of 64.
fn npy(spec: &SinkSpec) -> Vec<u8> {
    let shape: Vec<String> = spec.array_shape(0).iter().map(usize::to_string).collect();
    let text = format!(
        "{{'descr': '{}', 'fortran_order': False, 'shape': ({}), }}",
        numpy_descr(spec.dtype),
        shape.join(", ")
    );
    let total = (10 + text.len() + 1).next_multiple_of(64);
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend(((total - 10) as u16).to_le_bytes());
    out.extend(text.bytes());
    out.resize(total - 1, b' ');
    out.push(b'\n');
    out
}

fn nrrd_type(dtype: DType) -> &'static str {
    match dtype {
        DType::U8 => "uint8",
        DType::I8 => "int8",
        DType::U16 => "uint16",
        DType::I16 => "int16",
        DType::U32 => "uint32",
        DType::I32 => "int32",
        DType::F32 => "float",
        DType::F64 => "double",
    }
}

/// NRRD has short unit names by habit.
fn short_unit(unit: &str) -> &str {
    match unit {
        "millimeter" => "mm",
        "micrometer" => "um",
        "nanometer" => "nm",
        "centimeter" => "cm",
        "meter" => "m",
        other => other,
    }
}

/// Spaces that NRRD knows by name.
fn nrrd_space(space: &str) -> Option<&str> {
    const KNOWN: [&str; 6] = [
        "right-anterior-superior",
        "left-anterior-superior",
        "left-posterior-superior",
        "scanner-xyz",
        "3D-right-handed",
        "3D-left-handed",
    ];
    match space {
        "RAS" => Some("right-anterior-superior"),
        "LAS" => Some("left-anterior-superior"),
        "LPS" => Some("left-posterior-superior"),
        other => KNOWN.into_iter().find(|k| k.eq_ignore_ascii_case(other)),
    }
}

/// NRRD0005, raw, little-endian, axes fastest first: `x y z [c]`; components are a list axis.
fn nrrd(spec: &SinkSpec, occlude: Option<&Value>) -> Vec<u8> {
    let clean = |s: &str| s.chars().filter(|c| !c.is_control()).collect::<String>();
    let level = &spec.pyramid.levels[0];
    let [z, y, x] = level.shape;
    let c = spec.components;
    let list = |of_space: &str, of_list: &str| match c {
        Some(_) => format!("{of_space} {of_list}"),
        None => of_space.to_string(),
    };
    let mut out = String::from("NRRD0005\n");
    let mut line = |text: String| {
        out.push_str(&text);
        out.push('\n');
    };
    line(format!("content: {}", clean(&spec.name)));
    line(format!("type: {}", nrrd_type(spec.dtype)));
    line(format!("dimension: {}", if c.is_some() { 4 } else { 3 }));
    if let Some(word) = spec.orientation.as_ref().and_then(|o| nrrd_space(&o.space)) {
        line(format!("space: {word}"));
    } else if spec.needs_space() {
        line("space dimension: 3".into());
    }
    line(format!("sizes: {}", list(&format!("{x} {y} {z}"), &c.unwrap_or(1).to_string())));
    let unit = spec.unit.as_deref().map(short_unit).map(clean);
    let vector = |v: [f64; 3]| format!("({},{},{})", v[0], v[1], v[2]);
    if spec.needs_space() {
        let m = spec.placed_matrix();
        let column = |a: usize| vector([m[0][a], m[1][a], m[2][a]]);
        line(format!("space directions: {}", list(&format!("{} {} {}", column(0), column(1), column(2)), "none")));
        line(format!("space origin: {}", column(3)));
        if let Some(unit) = &unit {
            line(format!("space units: \"{unit}\" \"{unit}\" \"{unit}\""));
        }
    } else {
        let [sz, sy, sx] = level.scale;
        line(format!("spacings: {}", list(&format!("{sx} {sy} {sz}"), "nan")));
        if let Some(unit) = &unit {
            line(format!("units: {}", list(&format!("\"{unit}\" \"{unit}\" \"{unit}\""), "\"\"")));
        }
    }
    line(format!("kinds: {}", list("domain domain domain", "list")));
    if spec.dtype.size() > 1 {
        line("endian: little".into());
    }
    line("encoding: raw".into());
    line(format!("occlude_version:={}", env!("CARGO_PKG_VERSION")));
    if !spec.component_names.is_empty() {
        line(format!("occlude_components:={}", clean(&spec.component_names.join(","))));
    }
    let total = (out.len() + NRRD_RESERVE).next_multiple_of(64);
    if let Some(hash) = config_hash(occlude) {
        out.push_str(&format!("occlude_config_hash:={hash}\n"));
    }
    // A comment fills up what was reserved; an empty line ends the header.
    out.push_str("# ");
    out.extend(std::iter::repeat_n('.', total - out.len() - 2));
    out.push_str("\n\n");
    out.into_bytes()
}
