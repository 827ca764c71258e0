//! Kinds of configuration values: what each accepts, in words and as JSON Schema.

use serde_json::{Value, json};

/// What a key's value may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// Whole number in `min..=max`.
    Int {
        min: i64,
        max: i64,
    },
    /// Finite number, at least `min` (above it when `strict`).
    Number {
        min: f64,
        strict: bool,
    },
    /// Any finite number.
    AnyNumber,
    Bool,
    Text,
    Choice(&'static [&'static str]),
    Path,
    /// `"auto"` or a path.
    PathOrAuto,
    /// Size of memory.
    Bytes,
    /// `"auto"`, an edge or `[z, y, x]`.
    Brick,
    /// `"all"` or `[[z0, z1], [y0, y1], [x0, x1]]`.
    Region,
    /// `name` or `name.channel`.
    Ref,
    /// One or several [`Kind::Ref`]s.
    Refs,
    /// Whole voxels, per axis or not, or a physical length.
    Radius,
    /// Voxels above 0, per axis or not, or a physical length.
    Sigma,
    /// Voxels of the finest axis above 0, or a physical length.
    Distance,
    /// `[z, y, x]` voxels.
    Shape,
    DType,
    /// Positive number or `[z, y, x]` of them.
    Spacing,
    /// `[z, y, x]`, any finite numbers.
    Position,
    Unit,
    /// Index or `"all"`.
    Select,
    /// Voxels of an edge or `[z, y, x]`.
    Chunk,
    /// [`Kind::Chunk`] or `"none"`.
    Shard,
    Codec,
    /// `"auto"` or a count.
    Levels,
    /// `[lo, hi]` or `"auto"`.
    Range,
    Border,
    /// The inline table of `where`.
    Where,
    /// One number or several.
    Numbers,
    /// 3 or 5.
    Size,
    /// `[r, g, b]`.
    Rgb,
    /// Rows of a transfer table.
    Points,
    /// Keys of a stage with values.
    StageKeys,
    /// Keys with lists of values.
    Vary,
    /// How much of a volume is judged.
    Sample,
}

/// Largest extent that a config may name: products of three stay within `u64`.
pub const MAX_EXTENT: i64 = 1 << 40;
/// Largest edge of bricks and chunks.
pub const MAX_EDGE: i64 = 1 << 20;
/// Largest radius in voxels; beyond any volume.
pub const MAX_RADIUS: i64 = 1 << 40;

const DTYPES: [&str; 8] = ["u8", "i8", "u16", "i16", "u32", "i32", "f32", "f64"];

impl Kind {
    /// What would be accepted, for messages: "expected ...".
    pub fn accepts(&self) -> String {
        match self {
            Kind::Int { min, max } if *max == i64::MAX => format!("a whole number from {min} up"),
            Kind::Int { min, max } => format!("a whole number from {min} to {max}"),
            Kind::Number { min, strict: true } => format!("a number above {min}"),
            Kind::Number { min, strict: false } => format!("a number of at least {min}"),
            Kind::AnyNumber => "a finite number".into(),
            Kind::Bool => "true or false".into(),
            Kind::Text => "a string".into(),
            Kind::Choice(words) => one_of(words),
            Kind::Path => "a path as a string".into(),
            Kind::PathOrAuto => "\"auto\" or a folder as a string".into(),
            Kind::Bytes => "bytes, or a size such as \"2GiB\", \"512 MiB\", \"1.5GB\"".into(),
            Kind::Brick => {
                format!("\"auto\", an edge in voxels (1 to {MAX_EDGE}) or [z, y, x]")
            }
            Kind::Region => "\"all\" or [[z0, z1], [y0, y1], [x0, x1]] with 0 <= lower < upper".into(),
            Kind::Ref => "the name of an input or stage, or \"stage.channel\"".into(),
            Kind::Refs => "the name of an input or stage, \"stage.channel\", or a list of them".into(),
            Kind::Radius => "whole voxels of at least 0, [z, y, x] of them, or a length such as \"2.5 mm\"".into(),
            Kind::Sigma => "voxels above 0, [z, y, x] of them, or a length such as \"2.5 mm\"".into(),
            Kind::Distance => "voxels of the finest axis above 0, or a length such as \"20 mm\"".into(),
            Kind::Shape => "[z, y, x] in voxels, each at least 1".into(),
            Kind::DType => one_of(&DTYPES),
            Kind::Spacing => "a positive number or [z, y, x] of them".into(),
            Kind::Position => "[z, y, x], finite numbers".into(),
            Kind::Unit => format!("a unit of length: {}", super::units::ACCEPTED),
            Kind::Select => "an index from 0 or \"all\"".into(),
            Kind::Chunk => format!("an edge in voxels (1 to {MAX_EDGE}) or [z, y, x]"),
            Kind::Shard => format!("an edge in voxels (1 to {MAX_EDGE}), [z, y, x], or \"none\""),
            Kind::Codec => "\"blosc-lz4\", \"zstd\", \"zstd:LEVEL\" (-7 to 22) or \"none\"".into(),
            Kind::Levels => "\"auto\" or the number of levels (1 to 64, level 0 counted)".into(),
            Kind::Range => "[lo, hi] with lo < hi, or \"auto\"".into(),
            Kind::Border => "\"clip\", \"nearest\", \"reflect\" or { constant = value }".into(),
            Kind::Where => {
                "{ input = \"name\", min = a, max = b } or { input = \"name\", iso = [values], band = voxels }".into()
            }
            Kind::Numbers => "a finite number or a list of them".into(),
            Kind::Size => "5 or 3".into(),
            Kind::Rgb => "[r, g, b], numbers of at least 0".into(),
            Kind::Points => {
                "[[value, opacity, r, g, b], ...] with ascending values, opacity in 0..1, colours of at least 0".into()
            }
            Kind::StageKeys => "stage keys, e.g. { method = \"exact\" }".into(),
            Kind::Vary => {
                "lists of values by stage key (device: of run.device), e.g. { method = [\"cdf_power\"], radius = [5, 10] }".into()
            }
            Kind::Sample => "\"auto\", \"all\", a number of bricks from 1 up, or a share such as \"5 %\"".into(),
        }
    }

    /// The same as a JSON Schema fragment.
    pub fn schema(&self) -> Value {
        let edge = json!({"type": "integer", "minimum": 1, "maximum": MAX_EDGE});
        let three = |item: Value| json!({"type": "array", "items": item, "minItems": 3, "maxItems": 3});
        let above_zero = json!({"type": "number", "exclusiveMinimum": 0});
        let physical = json!({"type": "string", "pattern": "^\\s*[0-9.eE+-]+\\s*\\D.*$"});
        let voxels = json!({"type": "number", "minimum": 0, "maximum": MAX_RADIUS, "multipleOf": 1});
        match self {
            Kind::Int { min, max } if *max == i64::MAX => json!({"type": "integer", "minimum": min}),
            Kind::Int { min, max } => json!({"type": "integer", "minimum": min, "maximum": max}),
            Kind::Number { min, strict: true } => json!({"type": "number", "exclusiveMinimum": min}),
            Kind::Number { min, strict: false } => json!({"type": "number", "minimum": min}),
            Kind::AnyNumber => json!({"type": "number"}),
            Kind::Bool => json!({"type": "boolean"}),
            Kind::Choice(words) => json!({"enum": words}),
            Kind::Text | Kind::Path | Kind::PathOrAuto | Kind::Ref | Kind::Unit => {
                json!({"type": "string", "minLength": 1})
            }
            Kind::Bytes => json!({"anyOf": [{"type": "integer", "minimum": 1},
                {"type": "string", "pattern": "^\\s*[0-9._]+\\s*([kKmMgGtT]?[iI]?[bB]?|bytes?)\\s*$"}]}),
            Kind::Brick => json!({"anyOf": [{"const": "auto"}, edge, three(edge.clone())]}),
            Kind::Region => {
                let pair = json!({"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": MAX_EXTENT},
                    "minItems": 2, "maxItems": 2});
                json!({"anyOf": [{"const": "all"}, three(pair)]})
            }
            Kind::Refs => json!({"anyOf": [{"type": "string", "minLength": 1},
                {"type": "array", "items": {"type": "string", "minLength": 1}, "minItems": 1}]}),
            Kind::Radius => json!({"anyOf": [voxels, three(voxels.clone()), physical]}),
            Kind::Sigma => json!({"anyOf": [above_zero, three(above_zero.clone()), physical]}),
            Kind::Distance => json!({"anyOf": [above_zero, physical]}),
            Kind::Shape => three(json!({"type": "integer", "minimum": 1, "maximum": MAX_EXTENT})),
            Kind::DType => json!({"enum": DTYPES}),
            Kind::Spacing => json!({"anyOf": [above_zero, three(above_zero.clone())]}),
            Kind::Position => three(json!({"type": "number"})),
            Kind::Select => json!({"anyOf": [{"type": "integer", "minimum": 0}, {"const": "all"}]}),
            Kind::Chunk => json!({"anyOf": [edge, three(edge.clone())]}),
            Kind::Shard => json!({"anyOf": [edge, three(edge.clone()), {"const": "none"}]}),
            Kind::Codec => json!({"type": "string", "pattern": "^(blosc-lz4|none|zstd(:-?[0-9]+)?)$"}),
            Kind::Levels => json!({"anyOf": [{"const": "auto"}, {"type": "integer", "minimum": 1, "maximum": 64}]}),
            Kind::Range => json!({"anyOf": [{"const": "auto"},
                {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}]}),
            Kind::Border => json!({"anyOf": [{"enum": ["clip", "nearest", "reflect"]},
                {"type": "object", "properties": {"constant": {"type": "number"}}, "required": ["constant"],
                 "additionalProperties": false}]}),
            Kind::Where | Kind::StageKeys => json!({"type": "object"}),
            Kind::Vary => json!({"type": "object", "minProperties": 1,
                "additionalProperties": {"type": "array", "minItems": 1}}),
            Kind::Sample => json!({"anyOf": [{"enum": ["auto", "all"]}, {"type": "integer", "minimum": 1},
                {"type": "string", "pattern": "^\\s*[0-9.eE+-]+\\s*%$"}]}),
            Kind::Numbers => json!({"anyOf": [{"type": "number"},
                {"type": "array", "items": {"type": "number"}, "minItems": 1}]}),
            Kind::Size => json!({"enum": [3, 5]}),
            Kind::Rgb => three(json!({"type": "number", "minimum": 0})),
            Kind::Points => json!({"type": "array", "minItems": 1, "items":
                {"type": "array", "items": {"type": "number"}, "minItems": 5, "maxItems": 5}}),
        }
    }
}

/// `"a", "b" or "c"`.
pub fn one_of(words: &[&str]) -> String {
    let quoted: Vec<String> = words.iter().map(|w| format!("{w:?}")).collect();
    match quoted.split_last() {
        None => "nothing".into(),
        Some((last, [])) => last.clone(),
        Some((last, rest)) => format!("{} or {last}", rest.join(", ")),
    }
}
