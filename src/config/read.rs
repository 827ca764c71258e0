//! Nodes of the tree to typed values. Every function says in its error what is wrong; the caller adds key, line, the
//! value given and what would be accepted.

use super::kinds::{MAX_EDGE, MAX_EXTENT, MAX_RADIUS};
use super::tree::{Node, Table, Value};
use super::{Codec, Length, Select, units};
use crate::grid::{Border, DType};

/// Why a value is refused. An empty reason means that its type alone is wrong.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Bad {
    pub reason: String,
    /// Line of the offending part, where that is not the key's.
    pub line: Option<usize>,
    /// Key inside an inline table.
    pub key: Option<String>,
}

impl From<&str> for Bad {
    fn from(reason: &str) -> Bad {
        Bad { reason: reason.into(), ..Bad::default() }
    }
}

impl From<String> for Bad {
    fn from(reason: String) -> Bad {
        Bad { reason, ..Bad::default() }
    }
}

type Read<T> = Result<T, Bad>;

/// Wrong type, nothing more to say.
fn wrong<T>() -> Read<T> {
    Err(Bad::default())
}

pub fn text(node: &Node) -> Read<&str> {
    match &node.value {
        Value::Text(s) => Ok(s),
        _ => wrong(),
    }
}

pub fn non_empty(node: &Node) -> Read<&str> {
    let s = text(node)?;
    if s.trim().is_empty() { Err("it is empty".into()) } else { Ok(s) }
}

pub fn boolean(node: &Node) -> Read<bool> {
    match node.value {
        Value::Bool(b) => Ok(b),
        _ => wrong(),
    }
}

/// A whole number in `min..=max`; `2.0` counts as whole.
pub fn integer(node: &Node, min: i64, max: i64) -> Read<i64> {
    let v = match node.value {
        Value::Int(v) => v,
        Value::Float(v) if v.fract() == 0.0 && v.abs() < 9e15 => v as i64,
        Value::Float(_) => return Err("not a whole number".into()),
        _ => return wrong(),
    };
    if v < min {
        return Err("too small".into());
    }
    if v > max { Err("too large".into()) } else { Ok(v) }
}

/// A finite number.
pub fn number(node: &Node) -> Read<f64> {
    match node.value {
        Value::Int(v) => Ok(v as f64),
        Value::Float(v) if v.is_finite() => Ok(v),
        Value::Float(_) => Err("not finite".into()),
        _ => wrong(),
    }
}

/// A finite number of at least `min`, above it when `strict`.
pub fn at_least(node: &Node, min: f64, strict: bool) -> Read<f64> {
    let v = number(node)?;
    if v < min || (strict && v == min) { Err("too small".into()) } else { Ok(v) }
}

/// Exactly `N` elements.
fn list<const N: usize, T>(node: &Node, item: impl Fn(&Node) -> Read<T>) -> Read<[T; N]> {
    let Value::List(items) = &node.value else { return wrong() };
    let read: Vec<T> =
        items.iter().map(|n| item(n).map_err(|b| Bad { line: b.line.or(n.line), ..b })).collect::<Read<_>>()?;
    let n = read.len();
    read.try_into().map_err(|_| format!("{n} elements instead of {N}").into())
}

/// One value for all three axes, or `[z, y, x]`.
fn per_axis<T: Copy>(node: &Node, item: impl Fn(&Node) -> Read<T>) -> Read<[T; 3]> {
    match &node.value {
        Value::List(_) => list(node, item),
        _ => item(node).map(|v| [v; 3]),
    }
}

/// Bytes: a whole number, or number and unit. `k`, `M`, `G`, `T` (also with `B`, in any case) are powers of 1000; with `i`
/// powers of 1024.
pub fn bytes(node: &Node) -> Read<u64> {
    match &node.value {
        Value::Int(_) | Value::Float(_) => integer(node, 1, i64::MAX).map(|v| v as u64),
        Value::Text(s) => parse_bytes(s).map_err(Bad::from),
        _ => wrong(),
    }
}

/// See [`bytes`].
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let split = text.find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '_')).unwrap_or(text.len());
    let (digits, unit) = text.split_at(split);
    let value: f64 = digits.replace('_', "").parse().map_err(|_| "it does not start with a number".to_string())?;
    let unit = unit.trim().to_ascii_lowercase();
    let factor = match unit.as_str() {
        "" | "b" | "byte" | "bytes" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        "t" | "tb" => 1e12,
        "ki" | "kib" => 1024.0,
        "mi" | "mib" => 1024f64.powi(2),
        "gi" | "gib" => 1024f64.powi(3),
        "ti" | "tib" => 1024f64.powi(4),
        _ => return Err(format!("unknown unit {unit:?}")),
    };
    let total = (value * factor).round();
    if total < 1.0 {
        return Err("it must be above 0".into());
    }
    if total >= 9.2e18 { Err("too large".into()) } else { Ok(total as u64) }
}

pub fn brick(node: &Node) -> Read<Option<[usize; 3]>> {
    match &node.value {
        Value::Text(s) if s == "auto" => Ok(None),
        _ => edges(node).map(Some),
    }
}

/// An edge or `[z, y, x]`.
pub fn edges(node: &Node) -> Read<[usize; 3]> {
    per_axis(node, |n| integer(n, 1, MAX_EDGE).map(|v| v as usize))
}

pub fn shard(node: &Node) -> Read<Option<[usize; 3]>> {
    match &node.value {
        Value::Text(s) if s == "none" => Ok(None),
        _ => edges(node).map(Some),
    }
}

pub fn region(node: &Node) -> Read<Option<[[u64; 2]; 3]>> {
    if let Value::Text(s) = &node.value {
        return if s == "all" { Ok(None) } else { wrong() };
    }
    let range = |n: &Node| {
        let [lo, hi] = list(n, |n| integer(n, 0, MAX_EXTENT).map(|v| v as u64))?;
        if lo < hi { Ok([lo, hi]) } else { Err(format!("[{lo}, {hi}] is empty").into()) }
    };
    list(node, range).map(Some)
}

/// Extent of a volume, whose voxels must be countable in bytes.
pub fn shape(node: &Node) -> Read<[usize; 3]> {
    let shape = list(node, |n| integer(n, 1, MAX_EXTENT).map(|v| v as usize))?;
    let voxels = shape.iter().try_fold(1u64, |n, &e| n.checked_mul(e as u64)).filter(|&n| n <= 1 << 59);
    if voxels.is_none() { Err("more voxels than can be addressed".into()) } else { Ok(shape) }
}

pub fn dtype(node: &Node) -> Read<DType> {
    DType::parse(text(node)?).ok_or_else(Bad::default)
}

pub fn spacing(node: &Node) -> Read<[f64; 3]> {
    per_axis(node, |n| at_least(n, 0.0, true))
}

pub fn position(node: &Node) -> Read<[f64; 3]> {
    list(node, number)
}

/// The UDUNITS name.
pub fn unit(node: &Node) -> Read<String> {
    let s = text(node)?;
    units::udunits_name(s).map(String::from).ok_or_else(|| "unknown unit".into())
}

pub fn select(node: &Node) -> Read<Select> {
    match &node.value {
        Value::Text(s) if s == "all" => Ok(Select::All),
        _ => integer(node, 0, 1 << 31).map(|v| Select::Index(v as usize)),
    }
}

/// `"2.5 mm"`: a positive length whose unit becomes its UDUNITS name.
fn physical(text: &str) -> Read<Length> {
    let text = text.trim();
    // The longest prefix that is a number: `1e3m` is 1000 m, `5 e` is not.
    let ends = text.char_indices().map(|(i, _)| i).chain([text.len()]);
    let numeric = |end: &usize| {
        let head = text[..*end].trim_end();
        head.ends_with(|c: char| c.is_ascii_digit() || c == '.') && head.parse::<f64>().is_ok()
    };
    let end = ends.filter(numeric).max().ok_or("it does not start with a number")?;
    let value: f64 = text[..end].trim_end().parse().map_err(|_| "it does not start with a number")?;
    let unit = text[end..].trim();
    if unit.is_empty() {
        return Err("the unit is missing (voxels are written without quotes)".into());
    }
    let unit = units::udunits_name(unit)
        .ok_or_else(|| format!("unknown unit {unit:?}, known are {}", units::ACCEPTED))?
        .to_string();
    if !(value > 0.0 && value.is_finite()) {
        return Err("a length must be above 0".into());
    }
    Ok(Length::Physical { value, unit })
}

/// Voxels per axis by `item`, or a physical length.
fn length(node: &Node, item: impl Fn(&Node) -> Read<f64>) -> Read<Length> {
    match &node.value {
        Value::Text(s) => physical(s),
        Value::List(items) if items.iter().any(|n| matches!(n.value, Value::Text(_))) => {
            Err("lengths per axis are in voxels; one physical length serves all axes".into())
        }
        _ => per_axis(node, item).map(Length::Voxels),
    }
}

pub fn radius(node: &Node) -> Read<Length> {
    length(node, |n| integer(n, 0, MAX_RADIUS).map(|v| v as f64))
}

pub fn sigma(node: &Node) -> Read<Length> {
    length(node, |n| at_least(n, 0.0, true))
}

pub fn distance(node: &Node) -> Read<Length> {
    match node.value {
        Value::List(_) => Err("one distance serves all axes".into()),
        _ => length(node, |n| at_least(n, 0.0, true)),
    }
}

pub fn border(node: &Node) -> Read<Border> {
    match &node.value {
        Value::Text(s) => match s.as_str() {
            "clip" => Ok(Border::Clip),
            "nearest" => Ok(Border::Nearest),
            "reflect" => Ok(Border::Reflect),
            "constant" => Err("a constant needs its value".into()),
            _ => wrong(),
        },
        Value::Table(t) => match t.as_slice() {
            [(key, value)] if key == "constant" => number(value).map(Border::Constant),
            _ => Err("its only key is `constant`".into()),
        },
        _ => wrong(),
    }
}

pub fn codec(node: &Node) -> Read<Codec> {
    let s = text(node)?;
    match s {
        "blosc-lz4" => Ok(Codec::BloscLz4),
        "none" => Ok(Codec::None),
        "zstd" => Ok(Codec::Zstd(1)),
        _ => {
            let level = s.strip_prefix("zstd:").ok_or_else(Bad::default)?;
            let level: i32 = level.trim().parse().map_err(|_| Bad::default())?;
            if (-7..=22).contains(&level) { Ok(Codec::Zstd(level)) } else { Err("level out of range".into()) }
        }
    }
}

pub fn levels(node: &Node) -> Read<Option<usize>> {
    match &node.value {
        Value::Text(s) if s == "auto" => Ok(None),
        _ => integer(node, 1, 64).map(|v| Some(v as usize)),
    }
}

/// `None` stands for `"auto"`.
pub fn range(node: &Node) -> Read<Option<[f64; 2]>> {
    match &node.value {
        Value::Text(s) if s == "auto" => Ok(None),
        _ => {
            let [lo, hi] = list(node, number)?;
            if lo < hi { Ok(Some([lo, hi])) } else { Err(format!("{lo} is not below {hi}").into()) }
        }
    }
}

pub fn rgb(node: &Node) -> Read<[f64; 3]> {
    list(node, |n| at_least(n, 0.0, false))
}

/// One number or several, at least one.
pub fn numbers(node: &Node) -> Read<Vec<f64>> {
    match &node.value {
        Value::List(items) if items.is_empty() => Err("the list is empty".into()),
        Value::List(items) => items.iter().map(number).collect(),
        _ => number(node).map(|v| vec![v]),
    }
}

/// Rows of a transfer table, ascending in value.
pub fn points(node: &Node) -> Read<Vec<[f64; 5]>> {
    let Value::List(rows) = &node.value else { return wrong() };
    if rows.is_empty() {
        return Err("the list is empty".into());
    }
    let mut table: Vec<[f64; 5]> = Vec::with_capacity(rows.len());
    for row in rows {
        let at = |b: Bad| Bad { line: row.line, reason: format!("row {}: {}", row, b.reason), ..b };
        let point: [f64; 5] = list(row, number).map_err(at)?;
        if !(0.0..=1.0).contains(&point[1]) {
            return Err(at("opacity lies in 0..1".into()));
        }
        if point[2..].iter().any(|&c| c < 0.0) {
            return Err(at("colours are at least 0".into()));
        }
        if table.last().is_some_and(|last| last[0] >= point[0]) {
            return Err(at("values must ascend".into()));
        }
        table.push(point);
    }
    Ok(table)
}

/// One or several strings, at least one.
pub fn texts(node: &Node) -> Read<Vec<&str>> {
    match &node.value {
        Value::List(items) if items.is_empty() => Err("the list is empty".into()),
        Value::List(items) => items.iter().map(non_empty).collect(),
        _ => non_empty(node).map(|s| vec![s]),
    }
}

/// A table as the `toml` crate has it.
pub fn toml_table(table: &Table) -> toml::Table {
    table.iter().map(|(k, v)| (k.clone(), toml_value(v))).collect()
}

fn toml_value(node: &Node) -> toml::Value {
    match &node.value {
        Value::Text(s) => s.clone().into(),
        Value::Int(v) => (*v).into(),
        Value::Float(v) => (*v).into(),
        Value::Bool(v) => (*v).into(),
        Value::Time(t) => t.parse().map_or_else(|_| t.clone().into(), toml::Value::Datetime),
        Value::List(items) => toml::Value::Array(items.iter().map(toml_value).collect()),
        Value::Table(t) => toml::Value::Table(toml_table(t)),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tree::parse_value;
    use super::*;

    #[test]
    fn sizes_are_read_generously() {
        for (text, bytes) in [
            ("2GiB", 2u64 << 30),
            ("512 MiB", 512 << 20),
            ("1.5GB", 1_500_000_000),
            ("900MB", 900_000_000),
            ("1g", 1_000_000_000),
            ("4 ki", 4096),
            ("17", 17),
            ("1_000 b", 1000),
        ] {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
        for bad in ["", "GiB", "2 QiB", "0", "-1", "1.2.3", "1e3", "nan", "999999999 TB"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn lengths_are_voxels_or_physical() {
        let read = |t: &str| radius(&parse_value(t).unwrap());
        assert_eq!(read("5"), Ok(Length::Voxels([5.0; 3])));
        assert_eq!(read("[0, 1, 2.0]"), Ok(Length::Voxels([0.0, 1.0, 2.0])));
        let physical = |value: f64, unit: &str| Ok(Length::Physical { value, unit: unit.into() });
        assert_eq!(read("\"2.5 mm\""), physical(2.5, "millimeter"));
        assert_eq!(read("\"25e-1mm\""), physical(2.5, "millimeter"));
        assert_eq!(read("\"1e3m\""), physical(1000.0, "meter"));
        assert_eq!(read("\"5 µm\""), physical(5.0, "micrometer"));
        for bad in [
            "-1",
            "2.5",
            "nan",
            "inf",
            "true",
            "[1, 2]",
            "[1, 2, -3]",
            "\"2.5\"",
            "\"mm\"",
            "\"-1 mm\"",
            "\"0 mm\"",
            "\"1 furlong\"",
            "\"inf mm\"",
            "\"nan mm\"",
            "[\"1 mm\", 2, 3]",
            "\"1e999 mm\"",
            "{}",
        ] {
            assert!(read(bad).is_err(), "{bad}");
        }
        assert!(sigma(&parse_value("0.4").unwrap()).is_ok());
        assert!(sigma(&parse_value("0").unwrap()).is_err());
        assert!(distance(&parse_value("[1, 2, 3]").unwrap()).is_err());
    }

    #[test]
    fn extents_that_cannot_be_addressed_are_refused() {
        let read = |t: &str| shape(&parse_value(t).unwrap());
        assert!(read("[1024, 1024, 1024]").is_ok());
        for bad in ["[1099511627776, 1099511627776, 2]", "[0, 1, 1]", "[1, 1]", "7", "[1, 1, 1.5]"] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }
}
