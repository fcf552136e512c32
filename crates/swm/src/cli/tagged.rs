//! Options of the form `NAME,KEY=VALUE,…` whose names and settings are those of a type, such as `--term goal,when=closest`.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use swm_core::{Error, Result};

/// Reads the value of an option. `tag` is the field in which the type keeps the name.
///
/// # Errors
/// When the settings are not those of the type; the message names the setting, and what it may be.
pub fn read<T: DeserializeOwned>(option: &str, tag: &str, name: &str, settings: &Map<String, Value>) -> Result<T> {
    let make = |settings: Map<String, Value>| {
        let tagged = settings.into_iter().chain([(tag.to_owned(), json!(name))]);
        serde_json::from_value(Value::Object(tagged.collect()))
    };
    let whole = match make(settings.clone()) {
        Ok(made) => return Ok(made),
        Err(error) => error,
    };
    // The error does not name the setting with the wrong value, so each is tried alone.
    let alone = settings.iter().find_map(|(key, value)| {
        let error: Result<T, serde_json::Error> = make(Map::from_iter([(key.clone(), value.clone())]));
        let error = error.err().map(|error| error.to_string()).filter(|error| !error.starts_with("missing field"))?;
        Some(in_words(option, key, value, &error))
    });
    Err(alone.unwrap_or_else(|| in_words(option, name, &Value::Null, &whole.to_string())))
}

/// Returns the error of a setting for serde's message.
fn in_words(option: &str, key: &str, value: &Value, message: &str) -> Error {
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    let shown = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    match &quoted[..] {
        [given, known @ ..] if message.starts_with("unknown field") => {
            let hint = format!("the settings of {option} are {}", known.join(", "));
            Error::unknown("setting", given, known.iter().copied(), hint)
        }
        [given, known @ ..] if message.starts_with("unknown variant") => {
            let hint = format!("{key} of {option} is one of {}", known.join(", "));
            Error::unknown("value", given, known.iter().copied(), hint)
        }
        [field] if message.starts_with("missing field") => {
            let fix = format!("add it: {option},{field}=VALUE");
            Error::config(option, format!("the setting '{field}' is missing"), fix)
        }
        _ => {
            let expected = message.rsplit_once("expected ").map_or(message, |(_, expected)| expected);
            let expected = type_in_words(expected);
            Error::config(option, format!("{key}={shown} is not {expected}"), format!("give {expected}"))
        }
    }
}

/// Returns what serde expected in words.
fn type_in_words(name: &str) -> &str {
    match name {
        "f32" | "f64" => "a number",
        "usize" | "u64" | "u32" => "a whole number of at least 0",
        "i64" | "i32" => "a whole number",
        "a boolean" => "true or false",
        "a sequence" => "a list",
        "a string" => "a word",
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_plan::objective::{Limit, Term};

    #[test]
    fn errors_name_the_setting_and_what_it_may_be() {
        let term =
            |settings: Value| read::<Term>("--term goal", "term", "goal", settings.as_object().expect("settings"));
        term(json!({"when": "closest", "weight": 2})).expect("a term");
        for (settings, message) in [
            (
                json!({"weight": 1, "when": "closets"}),
                "unknown value 'closets' (did you mean closest?); when of --term goal is one of terminal, running, closest",
            ),
            (json!({"weights": 1}), "unknown setting 'weights' (did you mean weight"),
            (json!({"weight": "x"}), "--term goal: weight=x is not a number; give a number"),
            (json!({"latents": "x"}), "--term goal: latents=x is not a list"),
            (json!({"discount": [1]}), "discount=[1] is not a number"),
        ] {
            let error = term(settings).expect_err(message).to_string();
            assert!(error.contains(message), "{error}");
        }
        let limit = read::<Limit>("--limit action-norm", "constraint", "action_norm", &Map::new());
        let error = limit.expect_err("a limit without its number").to_string();
        assert!(error.contains("--limit action-norm: the setting 'limit' is missing; add it"), "{error}");
    }
}
