//! `swm solvers`: what plans, and what each asks of a model; and how a solver is named on the command line.

use super::planner::named;
use super::{emit, emit_json, table};
use serde_json::{Map, Value, json};
use swm_core::{Error, Result};
use swm_plan::{SOLVERS, SolverEntry};

/// Lists them.
pub fn solvers(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all: Map<String, Value> = SOLVERS.rows.iter().map(|row| (row.id.to_owned(), describe(row))).collect();
        return emit_json(&all);
    }
    let word = |value: Value| value.as_str().unwrap_or_default().to_owned();
    let rows = SOLVERS.rows.iter().map(|row| {
        let needs: Vec<String> = row.needs.iter().map(|need| word(json!(need))).collect();
        vec![
            row.id.to_owned(),
            word(json!(row.family)),
            word(json!(row.actions)),
            if needs.is_empty() { "–".to_owned() } else { needs.join(", ") },
            words(&(row.defaults)()),
            row.summary.to_owned(),
        ]
    });
    emit(&table(&["solver", "family", "actions", "needs", "settings and defaults", "how it searches"], rows));
    Ok(())
}

fn describe(row: &SolverEntry) -> Value {
    json!({
        "summary": row.summary,
        "family": row.family,
        "actions": row.actions,
        "needs": row.needs,
        "paper": row.paper,
        "settings": (row.defaults)(),
    })
}

/// Settings as one writes them, a line each: `samples=300`, `optimizer.step=0.1`.
fn words(settings: &Value) -> String {
    let mut lines = vec![];
    flatten("", settings, &mut lines);
    lines.iter().map(|(key, value)| format!("{key}={}", plain(value))).collect::<Vec<_>>().join("\n")
}

/// The settings within settings, by keys with dots.
fn flatten<'a>(path: &str, value: &'a Value, lines: &mut Vec<(String, &'a Value)>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                flatten(&path, value, lines);
            }
        }
        leaf => lines.push((path.to_owned(), leaf)),
    }
}

/// A value as one writes it; single precision without the digits it does not have.
#[allow(clippy::cast_possible_truncation)]
fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => "none".to_owned(),
        Value::Number(number) if number.is_f64() => {
            number.as_f64().map_or_else(String::new, |v| (v as f32).to_string())
        }
        other => other.to_string(),
    }
}

/// A solver and its settings, complete, from `icem,samples=64,iterations=5`.
///
/// # Errors
/// When the solver or a setting is unknown, or the settings contradict each other.
pub fn parse(text: &str) -> Result<(&'static SolverEntry, Value)> {
    let (id, given) = named("--solver", text)?;
    let entry = SOLVERS.get(id)?;
    let mut settings = (entry.defaults)();
    let mut known = vec![];
    flatten("", &settings, &mut known);
    let known: Vec<String> = known.into_iter().map(|(key, _)| key).collect();
    for (key, value) in given {
        if !known.contains(&key) {
            let hint = format!("`swm solvers` lists the settings of {id}");
            return Err(Error::unknown("solver setting", &key, known.iter().map(String::as_str), hint));
        }
        let place = key.split('.').fold(&mut settings, |at, part| &mut at[part]);
        if !place.is_null() && std::mem::discriminant(place) != std::mem::discriminant(&value) {
            let fix = format!("give a value like its default, {}", plain(place));
            return Err(Error::config(format!("solver setting {key}"), plain(&value), fix));
        }
        *place = value;
    }
    (entry.make)(&settings)?;
    Ok((entry, settings))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solvers_are_read_with_their_settings() {
        let (entry, settings) = parse("cem,samples=64,sigma=0.5").expect("a solver");
        assert_eq!(entry.id, "cem");
        assert_eq!((&settings["samples"], &settings["sigma"]), (&json!(64), &json!(0.5)));
        assert_eq!(settings["iterations"], json!(30), "the default");
        let (_, settings) = parse("gd,optimizer.step=0.5").expect("a solver");
        assert_eq!((&settings["optimizer"]["step"], &settings["optimizer"]["kind"]), (&json!(0.5), &json!("adam")));
        for (text, words) in [
            ("cme", "did you mean cem"),
            ("cem,sample=3", "did you mean samples"),
            ("cem,samples", "KEY=VALUE"),
            ("cem,samples=many", "samples"),
            ("gd,optimizer.stepp=1", "did you mean optimizer.step"),
        ] {
            let message = parse(text).err().expect(text).to_string();
            assert!(message.contains(words), "{text}: {message}");
        }
    }
}
