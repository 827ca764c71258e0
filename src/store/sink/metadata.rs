//! The JSON of OME-Zarr 0.5 (Zarr v3) and 0.4 (Zarr v2): groups and arrays.

use serde_json::{Map, Value, json};

use super::SinkSpec;
use crate::config::{Codec, OutputFormat};
use crate::grid::DType;
use crate::store::blosc;

/// Colours of channels that have no others, hexadecimal RGB.
const COLOURS: [&str; 7] = ["FF0000", "00FF00", "0000FF", "FFFFFF", "FF00FF", "00FFFF", "FFFF00"];

impl SinkSpec {
    /// Dataset `level` as Zarr has it: `[c,] z, y, x` of some per-axis numbers.
    fn with_c<T: Copy>(&self, c: T, zyx: [T; 3]) -> Vec<T> {
        self.components.map(|_| c).into_iter().chain(zyx).collect()
    }

    fn axis_names(&self) -> Vec<&'static str> {
        self.with_c("c", ["z", "y", "x"])
    }

    /// Array shape of a level, with the leading axis of components.
    pub fn array_shape(&self, level: usize) -> Vec<usize> {
        self.with_c(self.components.unwrap_or(1), self.pyramid.levels[level].shape)
    }
}

/// A number as Zarr metadata spells fill values.
fn fill_value(dtype: DType, fill: f64) -> Value {
    if !dtype.is_float() {
        let (lo, hi) = dtype.range();
        return json!(fill.round_ties_even().clamp(lo, hi) as i64);
    }
    if fill.is_nan() {
        return json!("NaN");
    }
    if fill.is_infinite() {
        return json!(if fill > 0.0 { "Infinity" } else { "-Infinity" });
    }
    json!(fill)
}

/// `zarr.json` of one level.
pub fn array_v3(spec: &SinkSpec, level: usize) -> Value {
    let chunk = json!(spec.with_c(1, spec.chunk));
    let inner = codecs_v3(spec);
    let (grid, codecs) = match spec.shard {
        None => (chunk, inner),
        Some(shard) => {
            let sharding = json!({
                "name": "sharding_indexed",
                "configuration": {
                    "chunk_shape": chunk,
                    "codecs": inner,
                    "index_codecs": [
                        { "name": "bytes", "configuration": { "endian": "little" } },
                        { "name": "crc32c" },
                    ],
                    "index_location": "end",
                },
            });
            (json!(spec.with_c(1, shard)), json!([sharding]))
        }
    };
    json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": spec.array_shape(level),
        "data_type": spec.dtype.numpy_name(),
        "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": grid } },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
        "fill_value": fill_value(spec.dtype, spec.fill),
        "codecs": codecs,
        "dimension_names": spec.axis_names(),
        "attributes": {},
    })
}

/// Always objects, with the byte order spelled out: other readers refuse bare names.
fn codecs_v3(spec: &SinkSpec) -> Value {
    let bytes = json!({ "name": "bytes", "configuration": { "endian": "little" } });
    match spec.codec {
        Codec::None => json!([bytes]),
        Codec::Zstd(level) => {
            json!([bytes, { "name": "zstd", "configuration": { "level": level, "checksum": false } }])
        }
        Codec::BloscLz4 => {
            let shuffle = if spec.dtype.size() == 1 { "bitshuffle" } else { "shuffle" };
            let configuration = json!({
                "cname": "lz4", "clevel": blosc::LEVEL, "shuffle": shuffle, "typesize": spec.dtype.size(), "blocksize": 0,
            });
            json!([bytes, { "name": "blosc", "configuration": configuration }])
        }
    }
}

/// `.zarray` of one level.
pub fn array_v2(spec: &SinkSpec, level: usize) -> Value {
    let compressor = match spec.codec {
        Codec::None => Value::Null,
        Codec::Zstd(level) => json!({ "id": "zstd", "level": level }),
        Codec::BloscLz4 => {
            let shuffle = if spec.dtype.size() == 1 { 2 } else { 1 };
            json!({ "id": "blosc", "cname": "lz4", "clevel": blosc::LEVEL, "shuffle": shuffle, "blocksize": 0 })
        }
    };
    json!({
        "zarr_format": 2,
        "shape": spec.array_shape(level),
        "chunks": spec.with_c(1, spec.chunk),
        "dtype": numpy_descr(spec.dtype),
        "compressor": compressor,
        "fill_value": fill_value(spec.dtype, spec.fill),
        "order": "C",
        "filters": null,
        "dimension_separator": "/",
    })
}

/// `.zattrs` of one level: dimension names as xarray has them in Zarr v2.
pub fn array_attributes_v2(spec: &SinkSpec) -> Value {
    json!({ "_ARRAY_DIMENSIONS": spec.axis_names() })
}

/// NumPy's type string, little-endian: `|u1`, `<f4`, ...
pub fn numpy_descr(dtype: DType) -> String {
    let kind = match dtype {
        DType::U8 | DType::U16 | DType::U32 => 'u',
        DType::I8 | DType::I16 | DType::I32 => 'i',
        DType::F32 | DType::F64 => 'f',
    };
    format!("{}{kind}{}", if dtype.size() == 1 { '|' } else { '<' }, dtype.size())
}

/// Attributes of the group. `occlude` of `None`: unfinished, which marks it as this program's without `complete`.
pub fn group_attributes(spec: &SinkSpec, occlude: Option<&Value>, windows: &[[f64; 2]]) -> Value {
    let unfinished = json!({ "version": env!("CARGO_PKG_VERSION") });
    let occlude = occlude.unwrap_or(&unfinished);
    let mut image = Map::new();
    let five = spec.format == OutputFormat::OmeZarr05;
    if five {
        image.insert("version".into(), json!("0.5"));
    }
    image.insert("multiscales".into(), json!([multiscale(spec, occlude, five)]));
    if spec.components.is_some() {
        image.insert("omero".into(), omero(spec, windows));
    }
    if five {
        return json!({ "ome": image, "occlude": occlude });
    }
    image.insert("occlude".into(), occlude.clone());
    Value::Object(image)
}

/// `zarr.json` of the group.
pub fn group_v3(attributes: Value) -> Value {
    json!({ "zarr_format": 3, "node_type": "group", "attributes": attributes })
}

fn multiscale(spec: &SinkSpec, occlude: &Value, five: bool) -> Value {
    let space = |name: &str| match &spec.unit {
        Some(unit) => json!({ "name": name, "type": "space", "unit": unit }),
        None => json!({ "name": name, "type": "space" }),
    };
    let c = spec.components.map(|_| json!({ "name": "c", "type": "channel" }));
    let axes: Vec<Value> = c.into_iter().chain(["z", "y", "x"].map(space)).collect();
    let dataset = |(i, level): (usize, &crate::store::LevelLayout)| {
        json!({
            "path": i.to_string(),
            "coordinateTransformations": [
                { "type": "scale", "scale": spec.with_c(1.0, level.scale) },
                { "type": "translation", "translation": spec.with_c(0.0, level.translation) },
            ],
        })
    };
    let mut metadata = json!({ "method": spec.reduce_name, "version": env!("CARGO_PKG_VERSION") });
    if let Some(hash) = occlude.get("config_hash") {
        metadata["config_hash"] = hash.clone();
    }
    if let Some(orientation) = &spec.orientation {
        metadata["orientation"] = json!({ "matrix": orientation.matrix, "space": orientation.space });
        metadata["region_start"] = json!(spec.region_start);
    }
    let mut out = Map::new();
    if !five {
        out.insert("version".into(), json!("0.4"));
    }
    out.insert("name".into(), json!(spec.name));
    out.insert("axes".into(), json!(axes));
    let datasets: Vec<Value> = spec.pyramid.levels.iter().enumerate().map(dataset).collect();
    out.insert("datasets".into(), json!(datasets));
    out.insert("type".into(), json!(spec.reduce_name));
    out.insert("metadata".into(), metadata);
    Value::Object(out)
}

/// Names, colours and windows of the channels; `windows` may be too short (unfinished outputs).
fn omero(spec: &SinkSpec, windows: &[[f64; 2]]) -> Value {
    let n = spec.components.unwrap_or(1);
    let whole = if spec.dtype.is_float() { [0.0, 1.0] } else { spec.dtype.range().into() };
    let channel = |i: usize| {
        let finite = |w: &&[f64; 2]| w.iter().all(|v| v.is_finite());
        let [start, end] = windows.get(i).filter(finite).copied().unwrap_or(whole);
        let [min, max] = if spec.dtype.is_float() { [start, end] } else { whole };
        let label = spec.component_names.get(i).cloned().unwrap_or_else(|| i.to_string());
        json!({
            "label": label,
            "color": COLOURS[i % COLOURS.len()],
            "active": i < 3,
            "window": { "min": min, "max": max, "start": start, "end": end },
        })
    };
    json!({ "channels": (0..n).map(channel).collect::<Vec<_>>() })
}
