//! As much of JSON Schema as the config's schema uses. A keyword that it does not know is an error, so that none can be
//! added without being checked.

use serde_json::Value;

pub fn validate(schema: &Value, value: &Value, at: &str) -> Result<(), String> {
    let Some(rules) = schema.as_object() else { return Err(format!("{at}: the schema is no object")) };
    for (rule, want) in rules {
        keyword(rule, want, rules, value, at)?;
    }
    Ok(())
}

fn keyword(
    rule: &str,
    want: &Value,
    rules: &serde_json::Map<String, Value>,
    value: &Value,
    at: &str,
) -> Result<(), String> {
    let fail = || Err(format!("{at}: {value} breaks {rule} {want}"));
    let holds = |ok: bool| if ok { Ok(()) } else { fail() };
    let number = value.as_f64();
    let limit = want.as_f64().unwrap_or(f64::NAN);
    let count = value.as_array().map(Vec::len);
    match rule {
        "$schema" | "title" | "description" | "default" => Ok(()),
        "type" => holds(match want.as_str() {
            Some("object") => value.is_object(),
            Some("array") => value.is_array(),
            Some("string") => value.is_string(),
            Some("boolean") => value.is_boolean(),
            Some("number") => value.is_number(),
            Some("integer") => number.is_some_and(|v| v.fract() == 0.0),
            _ => return Err(format!("unknown type {want}")),
        }),
        "const" => holds(value == want),
        "enum" => holds(want.as_array().unwrap().contains(value)),
        "minimum" => holds(number.is_none_or(|v| v >= limit)),
        "maximum" => holds(number.is_none_or(|v| v <= limit)),
        "exclusiveMinimum" => holds(number.is_none_or(|v| v > limit)),
        "multipleOf" => holds(number.is_none_or(|v| v % limit == 0.0)),
        "minItems" => holds(count.is_none_or(|n| n as f64 >= limit)),
        "maxItems" => holds(count.is_none_or(|n| n as f64 <= limit)),
        "minLength" => holds(value.as_str().is_none_or(|s| s.len() as f64 >= limit)),
        "minProperties" => holds(value.as_object().is_none_or(|o| o.len() as f64 >= limit)),
        // Checked by eye only: no pattern engine here.
        "pattern" => Ok(()),
        "items" => value
            .as_array()
            .into_iter()
            .flatten()
            .enumerate()
            .try_for_each(|(i, v)| validate(want, v, &format!("{at}[{i}]"))),
        "properties" => {
            let Some(object) = value.as_object() else { return Ok(()) };
            let known = object.iter().filter_map(|(k, v)| want.get(k).map(|s| (k, v, s)));
            known.into_iter().try_for_each(|(k, v, s)| validate(s, v, &format!("{at}.{k}")))
        }
        "required" => {
            let Some(object) = value.as_object() else { return Ok(()) };
            let names = want.as_array().unwrap().iter().filter_map(Value::as_str);
            names
                .into_iter()
                .try_for_each(|n| if object.contains_key(n) { Ok(()) } else { Err(format!("{at}.{n} is missing")) })
        }
        "additionalProperties" => {
            let Some(object) = value.as_object() else { return Ok(()) };
            let listed = |k: &String| rules.get("properties").is_some_and(|p| p.get(k).is_some());
            object.iter().filter(|(k, _)| !listed(k)).try_for_each(|(k, v)| match want {
                Value::Bool(false) => Err(format!("{at}.{k} is not allowed")),
                Value::Bool(true) => Ok(()),
                inner => validate(inner, v, &format!("{at}.{k}")),
            })
        }
        "anyOf" | "oneOf" => {
            let results: Vec<_> = want.as_array().unwrap().iter().map(|s| validate(s, value, at)).collect();
            let matches = results.iter().filter(|r| r.is_ok()).count();
            let reasons: Vec<String> = results.into_iter().filter_map(Result::err).collect();
            let ok = if rule == "oneOf" { matches == 1 } else { matches > 0 };
            if ok { Ok(()) } else { Err(format!("{at}: {matches} alternatives fit: {}", reasons.join("; "))) }
        }
        other => Err(format!("the checker does not know the keyword {other}")),
    }
}
