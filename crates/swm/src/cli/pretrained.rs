//! [`pretrained_weights`]: the files of weights that a configuration names.

use serde_json::Value;

/// Returns the dotted keys of the pretrained weights in a configuration, with their values.
pub fn pretrained_weights(config: &Value) -> Vec<(String, String)> {
    let mut found = vec![];
    weights("", config, &mut found);
    found
}

/// Appends the dotted keys of all texts named `weights` in a configuration, with their values, to `found`.
fn weights(prefix: &str, value: &Value, found: &mut Vec<(String, String)>) {
    let below = |key: &str| if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") };
    match value {
        Value::Object(entries) => {
            for (key, value) in entries {
                match value.as_str() {
                    Some("") => {}
                    Some(from) if key == "weights" => found.push((below(key), from.to_owned())),
                    _ => weights(&below(key), value, found),
                }
            }
        }
        Value::Array(values) => values.iter().for_each(|value| weights(prefix, value, found)),
        _ => {}
    }
}
