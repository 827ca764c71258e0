//! What an output records of the config that made it.

use serde_json::{Map, Value, json};

use super::keys::{self, Default, Section};
use super::schema::default_value;
use super::{AoRegion, Op};
use crate::stage::Method;

/// The config without comments and without what cannot change a voxel: budget, threads, brick, device, scratch, and where
/// the outputs lie. So outputs of equal runs are equal, metadata included, however they were computed.
pub fn provenance(text: &str) -> String {
    let Ok(mut table) = text.parse::<toml::Table>() else { return text.to_string() };
    if let Some(run) = table.get_mut("run").and_then(|r| r.as_table_mut()) {
        run.retain(|key, _| ["region", "lanes"].contains(&key));
        if run.is_empty() {
            table.remove("run");
        }
    }
    if let Some(outputs) = table.get_mut("output").and_then(|o| o.as_table_mut()) {
        for (_, output) in outputs.iter_mut() {
            if let Some(output) = output.as_table_mut() {
                output.remove("path");
            }
        }
    }
    table.remove("pareto");
    toml::to_string(&table).unwrap_or_else(|_| text.to_string())
}

/// Every key of a stage with its value, as given or by default, as JSON: what a result records of the method.
pub fn stage_parameters(text: &str, stage: &str, op: &str) -> Value {
    let table = text.parse::<toml::Table>().unwrap_or_default();
    let given = table.get("stage").and_then(|s| s.get(stage));
    let mut parameters = Map::new();
    for key in keys::of(Section::Stage, op).filter(|k| k.name != "op") {
        let value = match (given.and_then(|g| g.get(key.name)), key.default) {
            (Some(value), _) => serde_json::to_value(value).unwrap_or_else(|_| json!(value.to_string())),
            (None, Default::Toml(text)) => default_value(text),
            (None, _) => continue,
        };
        parameters.insert(key.name.to_string(), value);
    }
    Value::Object(parameters)
}

/// The numbers that a stage's formulas use and that no key names.
pub fn stage_constants(op: &Op) -> Value {
    match op {
        Op::AmbientOcclusion { region, method, .. } => {
            let mut constants = Map::new();
            if *method == Method::CdfPower {
                constants.insert("beta".into(), json!([1e-6, 1e6]));
            }
            if *method == Method::Moments4 {
                constants.insert("code_bits".into(), json!(16));
            }
            if *region == AoRegion::EqualVolume {
                constants.insert("equal_volume_factor".into(), json!(0.806));
            }
            Value::Object(constants)
        }
        Op::Gaussian { .. } => json!({ "truncation_sigma": 3.0 }),
        Op::OcclusionMap { .. } => json!({ "taps": [0.0625, 0.25, 0.375, 0.25, 0.0625] }),
        _ => json!({}),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_those_given_and_the_defaults() {
        let text = "[stage.ao]\nop = 'ambient_occlusion'\ninput = 'ct'\nmethod = 'cdf_power'\nradius = [1, 2, 3]\n";
        let p = stage_parameters(text, "ao", "ambient_occlusion");
        assert_eq!(p["radius"], json!([1, 2, 3]));
        assert_eq!((&p["ties"], &p["border"], &p["solid"]), (&json!("le"), &json!("clip"), &json!("high")));
        assert!(p.get("where").is_none() && p.get("op").is_none());
    }

    #[test]
    fn runs_that_differ_in_budget_and_place_only_record_the_same() {
        let one = "[run]\nmemory = '1GiB' # much\nthreads = 2\n[input.a]\npath = 'a.npy'\n[output.b]\npath = 'x.zarr'\nfrom = 'a'\n";
        let two = "[input.a]\npath = 'a.npy'\n[output.b]\nfrom = 'a'\npath = 'elsewhere/y.zarr'\n";
        assert_eq!(provenance(one), provenance(two));
        assert!(provenance("[run]\nregion = [[0, 1], [0, 1], [0, 1]]\n").contains("region"));
    }
}
