//! `swm solvers`: lists the solvers; and parsing of `--solver NAME,KEY=VALUE,…`.

use super::planner::named;
use super::{emit, emit_json, table};
use serde_json::{Map, Value, json};
use swm_core::{Error, Result};
use swm_plan::search::Optimizer;
use swm_plan::{SOLVERS, SolverEntry};

/// Lists the solvers, their settings, and their requirements of a model.
pub fn solvers(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all: Map<String, Value> = SOLVERS.rows.iter().map(|row| (row.id.to_owned(), describe(row))).collect();
        return emit_json(&all);
    }
    let name = |value: Value| value.as_str().unwrap_or_default().to_owned();
    let rows = SOLVERS.rows.iter().map(|row| {
        let needs: Vec<String> = row.needs.iter().map(|need| name(json!(need))).collect();
        vec![
            row.id.to_owned(),
            name(json!(row.family)),
            name(json!(row.actions)),
            if needs.is_empty() { "–".to_owned() } else { needs.join(", ") },
            settings_lines(&(row.defaults)()),
            row.summary.to_owned(),
        ]
    });
    emit(&table(&["solver", "family", "actions", "requires", "settings and defaults", "method"], rows));
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

/// Returns settings in the form of the command line, one per line: `samples=300`, `optimizer.step=0.1`.
fn settings_lines(settings: &Value) -> String {
    let mut lines = vec![];
    flatten("", settings, &mut lines);
    lines.iter().map(|(key, value)| format!("{key}={}", plain(value))).collect::<Vec<_>>().join("\n")
}

/// Collects the leaves of nested settings, by keys with dots.
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

/// Formats a value in the form of the command line. Floats have the digits of single precision.
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

/// Parses a solver and completes its settings with the defaults, from a text such as `icem,samples=64,iterations=5`.
///
/// # Errors
/// When the solver or a setting is unknown, or the settings contradict each other.
pub fn parse(text: &str) -> Result<(&'static SolverEntry, Value)> {
    let (id, given) = named("--solver", text)?;
    let entry = SOLVERS.get(id)?;
    let mut settings = (entry.defaults)();
    for (key, kind) in &given {
        choose_kind(id, &mut settings, key, kind)?;
    }
    let mut known = vec![];
    flatten("", &settings, &mut known);
    let known: Vec<String> = known.into_iter().map(|(key, _)| key).collect();
    for (key, value) in given {
        if !known.contains(&key) {
            let hint = format!("`swm solvers` lists the settings of {id}");
            return Err(Error::unknown("solver setting", &key, known.iter().map(String::as_str), hint));
        }
        let setting = key.split('.').fold(&mut settings, |at, part| &mut at[part]);
        if let Some(kind) = expected(setting, &value) {
            let fix = format!("give {kind}; the default is {}", plain(setting));
            return Err(Error::config(format!("--solver {id}"), format!("{key}={} is not {kind}", shown(&value)), fix));
        }
        *setting = if setting.is_null() && value == "none" { Value::Null } else { value };
    }
    (entry.make)(&settings)?;
    Ok((entry, settings))
}

/// Gives an optimizer the settings of another kind, with their defaults, if `key` is its kind.
///
/// # Errors
/// When there is no such kind.
fn choose_kind(id: &str, settings: &mut Value, key: &str, kind: &Value) -> Result<()> {
    let optimizer = key.strip_suffix(".kind").and_then(|name| settings.get_mut(name));
    let Some(optimizer) =
        optimizer.filter(|found| kind.is_string() && found["kind"].is_string() && found["kind"] != *kind)
    else {
        return Ok(());
    };
    let chosen: Optimizer = serde_json::from_value(json!({"kind": kind})).map_err(|error| {
        let problem = format!("{key}={}: {error}", plain(kind));
        Error::config(format!("--solver {id}"), problem, "choose one of these kinds")
    })?;
    *optimizer = json!(chosen);
    Ok(())
}

/// Formats a given value as it was written, where [`plain`] has a word for what is left out.
fn shown(value: &Value) -> String {
    if value.is_null() { value.to_string() } else { plain(value) }
}

/// Returns the kind of value that a setting has by default, in words, if the given one is of another kind.
fn expected(default: &Value, given: &Value) -> Option<&'static str> {
    match default {
        Value::Number(number) if number.is_u64() => (!given.is_u64()).then_some("a whole number of at least 0"),
        Value::Number(_) => (!given.is_number()).then_some("a number"),
        Value::Bool(_) => (!given.is_boolean()).then_some("true or false"),
        Value::String(_) => (!given.is_string()).then_some("a word"),
        Value::Array(_) => (!given.is_array()).then_some("a list"),
        Value::Null => (!given.is_number() && !given.is_null() && given != "none").then_some("a number or none"),
        Value::Object(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kind_of_an_optimizer_decides_its_settings() {
        let settings = |text: &str| parse(text).expect(text).1;
        for text in
            ["gd,optimizer.kind=sgd,optimizer.momentum=0.5", "lagrangian,optimizer.momentum=0.5,optimizer.kind=sgd"]
        {
            assert_eq!(settings(text)["optimizer"], json!({"kind": "sgd", "step": 1.0, "momentum": 0.5}));
        }
        let grasp = settings("grasp,sync_optimizer.kind=rmsprop,sync_optimizer.decay=0.5,action_optimizer.kind=adam");
        assert_eq!(
            (&grasp["sync_optimizer"]["kind"], &grasp["sync_optimizer"]["decay"]),
            (&json!("rmsprop"), &json!(0.5))
        );
        assert_eq!(
            grasp["action_optimizer"],
            settings("grasp")["action_optimizer"],
            "its own kind has its own defaults"
        );
    }

    #[test]
    fn parses_solvers_with_settings() {
        let (entry, settings) = parse("cem,samples=64,sigma=0.5").expect("parsing the solver");
        assert_eq!(entry.id, "cem");
        assert_eq!((&settings["samples"], &settings["sigma"]), (&json!(64), &json!(0.5)));
        assert_eq!(settings["iterations"], json!(30), "unset settings have their defaults");
        let (_, settings) = parse("gd,optimizer.step=0.5").expect("parsing the solver");
        assert_eq!((&settings["optimizer"]["step"], &settings["optimizer"]["kind"]), (&json!(0.5), &json!("adam")));
        for none in ["gd,clip=none", "gd,clip=null"] {
            assert!(parse(none).expect("parsing the solver").1["clip"].is_null());
        }
        for (text, message) in [
            ("cme", "did you mean cem"),
            ("cem,sample=3", "did you mean samples"),
            ("cem,samples", "KEY=VALUE"),
            ("cem,samples=many", "--solver cem: samples=many is not a whole number of at least 0; give a whole"),
            ("icem,block=0.5", "--solver icem: block=0.5 is not a whole number of at least 0"),
            (
                "gd,clip=wide",
                "--solver gd: clip=wide is not a number or none; give a number or none; the default is none",
            ),
            ("cem,sigma=null", "--solver cem: sigma=null is not a number"),
            ("gd,optimizer.kind=newton", "optimizer.kind=newton: unknown variant `newton`, expected one of `sgd`"),
            ("cem,samples.kind=sgd", "unknown solver setting 'samples.kind'"),
            ("gd,optimizer.kind=sgd,optimizer.beta1=0.5", "unknown solver setting 'optimizer.beta1'"),
            ("cem,sigma=wide", "--solver cem: sigma=wide is not a number; give a number; the default is 1"),
            ("gd,optimizer.stepp=1", "did you mean optimizer.step"),
            ("cem,samples=64,samples=65", "is given twice: 'samples=64' and 'samples=65'"),
            ("cem,samples=8,elites=9", "9 of 8 samples"),
            ("cem,samples=1152921504606846976", "choose 1 to 1000000"),
        ] {
            let error = parse(text).err().expect(text).to_string();
            assert!(error.contains(message), "{text}: {error}");
        }
    }
}
