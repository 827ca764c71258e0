//! What an output says about itself: the attribute `occlude`, wherever its format keeps it.

use std::path::Path;

use serde_json::Value;

use crate::grid::DType;
use crate::store::{Orientation, Sink};

/// Larger metadata is not read.
const MAX_BYTES: u64 = 64 << 20;

/// Metadata beside or inside a volume. Absent parts are `None`; broken ones count as absent.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Attributes {
    /// The attribute `occlude`.
    pub occlude: Option<Value>,
    /// Datasets of the first multiscale, by path.
    pub datasets: Vec<String>,
    /// Shape and element type of a flat output, which a headerless one cannot say itself.
    pub shape: Option<[usize; 3]>,
    pub dtype: Option<DType>,
    /// Components of a flat output of several.
    pub components: Option<usize>,
}

/// Reads the metadata of a Zarr group or array (v3, then v2), or the file beside a flat output.
pub fn read(path: &Path) -> Attributes {
    let from_group = |attributes: &Value| {
        let multiscale = attributes.pointer("/ome/multiscales/0").or_else(|| attributes.pointer("/multiscales/0"));
        let datasets = multiscale.and_then(|m| m.get("datasets")).and_then(Value::as_array);
        let names = datasets.into_iter().flatten().filter_map(|d| d.get("path")?.as_str().map(String::from));
        Attributes { occlude: attributes.get("occlude").cloned(), datasets: names.collect(), ..Attributes::default() }
    };
    if let Some(attributes) = json(&path.join("zarr.json")).as_ref().and_then(|v| v.get("attributes")) {
        return from_group(attributes);
    }
    if let Some(attributes) = json(&path.join(".zattrs")) {
        return from_group(&attributes);
    }
    let Some(beside) = json(&Sink::work_dir(path).join("meta.json")) else { return Attributes::default() };
    let sizes = beside.get("shape").and_then(Value::as_array);
    let sizes = sizes.and_then(|s| s.iter().map(|n| n.as_u64().map(|n| n as usize)).collect::<Option<Vec<_>>>());
    let (components, sizes) = match sizes.as_deref() {
        Some([c, rest @ ..]) if rest.len() == 3 => (Some(*c), Some(rest)),
        other => (None, other),
    };
    Attributes {
        components,
        shape: sizes.and_then(|s| s.try_into().ok()),
        dtype: beside.get("dtype").and_then(Value::as_str).and_then(DType::parse),
        // An unfinished output has no attribute yet, only the note that it is not complete.
        occlude: beside.get("occlude").cloned().or(Some(beside)),
        datasets: Vec::new(),
    }
}

fn json(path: &Path) -> Option<Value> {
    let meta = std::fs::metadata(path).ok().filter(|m| m.is_file() && m.len() <= MAX_BYTES)?;
    let bytes = std::fs::read(path).ok().filter(|b| b.len() as u64 <= meta.len() + 4096)?;
    serde_json::from_slice(&bytes).ok()
}

impl Attributes {
    /// `[lo, hi]`: what code 0 and the largest code of an integer output stand for.
    pub fn value_range(&self) -> Option<[f64; 2]> {
        let range = self.occlude.as_ref()?.get("value_range")?.as_array()?;
        let range: [f64; 2] = range.iter().filter_map(Value::as_f64).collect::<Vec<_>>().try_into().ok()?;
        (range[0] < range[1] && range.iter().all(|v| v.is_finite())).then_some(range)
    }

    /// Whether its only channel is openness.
    pub fn is_openness(&self) -> bool {
        let Some(occlude) = &self.occlude else { return false };
        let named = |v: &Value| match v {
            Value::String(s) => s == "openness" || s.ends_with(".openness"),
            Value::Object(o) => o.get("name").or_else(|| o.get("channel")).is_some_and(|n| n == "openness"),
            _ => false,
        };
        ["channel", "channels", "quantity"].iter().filter_map(|key| occlude.get(*key)).any(|v| match v {
            Value::Array(items) => !items.is_empty() && items.iter().all(named),
            one => named(one),
        })
    }

    /// Voxel size of level 0 and its unit.
    pub fn spacing(&self) -> Option<([f64; 3], Option<String>)> {
        let occlude = self.occlude.as_ref()?;
        let sizes: Vec<f64> = occlude.get("spacing")?.as_array()?.iter().filter_map(Value::as_f64).collect();
        let sizes: [f64; 3] = sizes.try_into().ok()?;
        let unit = occlude.get("units").and_then(Value::as_str).map(String::from);
        sizes.iter().all(|s| s.is_finite() && *s > 0.0).then_some((sizes, unit))
    }

    /// The input's direction matrix, without its place.
    pub fn orientation(&self) -> Option<Orientation> {
        let recorded = self.occlude.as_ref()?.get("orientation")?;
        let matrix: [[f64; 4]; 3] = serde_json::from_value(recorded.get("matrix_xyz")?.clone()).ok()?;
        Some(Orientation { matrix, space: recorded.get("space")?.as_str()?.to_string() })
    }

    /// `Some(false)`: an output that was not finished.
    pub fn complete(&self) -> Option<bool> {
        let occlude = self.occlude.as_ref()?;
        Some(occlude.get("complete").and_then(Value::as_bool).unwrap_or(false))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn every_format_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let put = |path: &str, value: &Value| {
            let path = folder.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, value.to_string()).unwrap();
        };
        let occlude = json!({"complete": true, "value_range": [-1.0, 3.5], "channels": ["openness"]});
        let multiscales = json!([{"datasets": [{"path": "0"}, {"path": "1"}]}]);
        put("a.zarr/zarr.json", &json!({"attributes": {"occlude": occlude, "ome": {"multiscales": multiscales}}}));
        put("b.zarr/.zattrs", &json!({"occlude": occlude, "multiscales": multiscales}));
        put("c.nii.occlude/meta.json", &occlude);
        put("d.nii.occlude/meta.json", &json!({"occlude": occlude, "shape": [1, 2, 3], "dtype": "u8"}));
        put("g.raw.occlude/meta.json", &json!({"occlude": {"spacing": [2.0, 1.0, 0.5], "units": "millimeter"}}));
        put("h.raw.occlude/meta.json", &json!({"occlude": {"spacing": [2.0, 0.0, 0.5]}}));
        put("f.raw.occlude/meta.json", &json!({"occlude": occlude, "shape": [7, 1, 2, 3], "dtype": "f32"}));
        for (name, levels) in [("a.zarr", 2), ("b.zarr", 2), ("c.nii", 0), ("d.nii", 0)] {
            let a = read(&folder.path().join(name));
            assert_eq!(a.value_range(), Some([-1.0, 3.5]), "{name}");
            assert!(a.is_openness() && a.complete() == Some(true), "{name}");
            assert_eq!(a.datasets.len(), levels, "{name}");
        }
        let spacing = |name: &str| read(&folder.path().join(name)).spacing();
        assert_eq!(spacing("g.raw"), Some(([2.0, 1.0, 0.5], Some("millimeter".to_string()))));
        assert_eq!((spacing("h.raw"), spacing("d.nii")), (None, None));
        let d = read(&folder.path().join("d.nii"));
        assert_eq!((d.shape, d.dtype, d.components), (Some([1, 2, 3]), Some(DType::U8), None));
        let f = read(&folder.path().join("f.raw"));
        assert_eq!((f.shape, f.dtype, f.components), (Some([1, 2, 3]), Some(DType::F32), Some(7)));
        put("e.zarr/zarr.json", &json!({"attributes": {"occlude": {"value_range": [3, 3], "channels": []}}}));
        let e = read(&folder.path().join("e.zarr"));
        assert_eq!((e.value_range(), e.is_openness(), e.complete()), (None, false, Some(false)));
        std::fs::write(folder.path().join("e.zarr/zarr.json"), "{broken").unwrap();
        assert_eq!(read(&folder.path().join("e.zarr")), Attributes::default());
        assert_eq!(read(&folder.path().join("nothing")), Attributes::default());
    }
}
