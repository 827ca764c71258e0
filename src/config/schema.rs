//! JSON Schema of the config, made from the table of keys.

use serde_json::{Map, Value, json};

use super::keys::{self, Default, Key, OPS, Section};
use super::kinds::Kind;
use super::{read, tree};

/// The schema (draft 2020-12) of a whole config file.
pub fn schema() -> Value {
    let stage: Vec<Value> = OPS.iter().map(|op| object(Section::Stage, op)).collect();
    let named = |item: Value| json!({"type": "object", "additionalProperties": item});
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "occlude configuration",
        "type": "object",
        "properties": {
            "run": object(Section::Run, ""),
            "input": named(input()),
            "stage": named(json!({"oneOf": stage})),
            "output": json!({"type": "object", "minProperties": 1, "additionalProperties": object(Section::Output, "")}),
            "pareto": object(Section::Pareto, ""),
        },
        "required": ["output"],
        "additionalProperties": false,
    })
}

fn input() -> Value {
    let mut schema = object(Section::Input, "");
    schema["oneOf"] = json!([{"required": ["path"]}, {"required": ["synthetic"]}]);
    schema
}

/// One table: every key with type, default and meaning.
fn object(section: Section, op: &str) -> Value {
    let mut properties = Map::new();
    let mut required = Vec::new();
    for key in keys::of(section, op) {
        properties.insert(key.name.to_string(), property(key, op));
        if key.default == Default::Required {
            required.push(key.name);
        }
    }
    let mut schema =
        json!({"type": "object", "properties": properties, "required": required, "additionalProperties": false});
    if op == "combine" {
        // Two names of one key.
        required.retain(|key| *key != "inputs");
        schema["required"] = json!(required);
        schema["oneOf"] = json!([{"required": ["inputs"]}, {"required": ["input"]}]);
    }
    schema
}

fn property(key: &Key, op: &str) -> Value {
    let mut schema = match key.kind {
        Kind::Where => object(Section::Where, ""),
        _ if key.section == Section::Stage && key.name == "op" => json!({"const": op}),
        kind => kind.schema(),
    };
    schema["description"] = json!(match key.default {
        Default::Absent(meaning) => format!("{}; where not given: {meaning}", key.doc),
        _ => key.doc.to_string(),
    });
    if let Default::Toml(text) = key.default {
        schema["default"] = default_value(text);
    }
    schema
}

/// A default as JSON.
pub(super) fn default_value(text: &str) -> Value {
    let table = tree::parse(&format!("v = {text}")).map(|t| read::toml_table(&t));
    let value = table.ok().and_then(|t| serde_json::to_value(&t["v"]).ok());
    value.unwrap_or_else(|| json!(text))
}
