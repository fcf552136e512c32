//! Pages that are generated from the registries: one for each environment, wrapper, solver, model family and format.

use serde_json::Value;
use std::fmt::Write as _;

/// A page of the book.
pub struct Page {
    /// The entry in the table of contents.
    pub title: String,
    /// The path from the root of the book.
    pub path: String,
    /// The content, as Markdown.
    pub text: String,
}

/// The pages of one registry: the first one lists the others.
pub struct Group {
    /// The name by which the table of contents places the group.
    pub name: &'static str,
    /// The pages.
    pub pages: Vec<Page>,
}

impl Group {
    /// Returns the pages of a registry behind a page with this introduction and a table of their summaries.
    pub fn new(name: &'static str, title: &str, introduction: &str, rows: Vec<(String, Page)>) -> Self {
        let mut text = format!("# {title}\n\n{introduction}\n\n| | |\n| --- | --- |\n");
        for (summary, page) in &rows {
            let file = page.path.rsplit('/').next().unwrap_or_default();
            let _ = writeln!(text, "| [`{}`]({file}) | {} |", page.title, cell(summary));
        }
        let list = Page { title: title.to_owned(), path: format!("{name}/list.md"), text };
        Self { name, pages: std::iter::once(list).chain(rows.into_iter().map(|(_, page)| page)).collect() }
    }
}

/// Returns the file name of a page: an id without the characters that have a meaning in paths.
pub fn file_name(id: &str) -> String {
    id.replace(['/', ':', ' '], "-")
}

/// Returns the page of an environment. `images` are the paths of its frames from the page; `notes` is that of
/// the page with its equations and its differences from the reference.
pub fn environment(id: &str, env: &Value, images: &[String], notes: Option<&str>) -> String {
    let mut text = format!("# `{id}`\n\n{}.\n\n", sentence(&env["summary"]));
    if let Some(missing) = env["missing"].as_str() {
        let _ = write!(text, "This page was made without the assets of the environment ({missing}).\n\n");
        return text;
    }
    let shown: Vec<String> =
        images.iter().map(|image| format!("![Initial state, all factors sampled]({image})")).collect();
    if !shown.is_empty() {
        // A table keeps the images in one row.
        let _ = write!(
            text,
            "|{}\n|{}\n| {} |\n\n",
            " |".repeat(shown.len()),
            " --- |".repeat(shown.len()),
            shown.join(" | ")
        );
    }
    let _ = write!(text, "    swm collect {id} --output data --policy random --episodes 10 --image 64\n\n");
    let experts: Vec<String> = list(&env["experts"])
        .iter()
        .map(|expert| format!("`{}`: {}", string(&expert["id"]), string(&expert["summary"])))
        .collect();
    let cameras: Vec<String> = list(&env["cameras"]).iter().map(|camera| format!("`{}`", string(camera))).collect();
    text += "| | |\n| --- | --- |\n";
    for (name, value) in [
        ("action", space(&env["action_space"])),
        ("time limit", format!("{} steps", env["max_episode_steps"])),
        ("experts", or_none(&experts.join("; "))),
        ("cameras", or_none(&cameras.join(", "))),
    ] {
        let _ = writeln!(text, "| {name} | {} |", cell(&value));
    }
    if let Some(notes) = notes {
        let _ = write!(text, "\n[Dynamics, rewards, and differences from the reference]({notes}).\n");
    }
    let options = list(&env["options"]);
    if !options.is_empty() {
        let _ = write!(text, "\n## Options\n\nOptions follow the id: `{id},{}=…`.\n\n", string(&options[0]["key"]));
        text += "| option | values, the default first | |\n| --- | --- | --- |\n";
        for option in options {
            let values: Vec<String> =
                list(&option["values"]).iter().map(|value| format!("`{}`", string(value))).collect();
            let summary = cell(&string(&option["summary"]));
            let _ = writeln!(text, "| `{}` | {} | {summary} |", string(&option["key"]), values.join(", "));
        }
    }
    text += "\n## Columns\n\n| column | type and shape of a row |\n| --- | --- |\n";
    for (column, kind) in entries(&env["info"]) {
        let _ = writeln!(text, "| `{column}` | {} |", cell(&string(kind)));
    }
    text + &factors(env)
}

/// Returns the section about the factors of variation.
fn factors(env: &Value) -> String {
    let factors = &env["variation"];
    let sampled: Vec<String> = list(&env["default_variations"]).iter().map(string).collect();
    let mut text = "\n## Factors of variation\n\n".to_owned();
    if entries(factors).is_empty() {
        return text + "None.\n";
    }
    text += "| factor | values | default | sampled at reset |\n| --- | --- | --- | --- |\n";
    for key in list(&env["sampling_order"]).iter().map(string) {
        let factor = &factors[&key];
        if factor.is_null() {
            continue;
        }
        let at_reset = if sampled.contains(&key) { "yes" } else { "" };
        let _ =
            writeln!(text, "| `{key}` | {} | {} | {at_reset} |", cell(&space(factor)), values(&factor["init_value"]));
    }
    text
}

/// Returns the page of a solver.
pub fn solver(id: &str, solver: &Value) -> String {
    let mut text = format!("# `{id}`\n\n{}.\n\n", sentence(&solver["summary"]));
    let needs: Vec<String> = list(&solver["needs"]).iter().map(string).collect();
    text += "| | |\n| --- | --- |\n";
    for (name, value) in [
        ("family", string(&solver["family"])),
        ("actions", string(&solver["actions"])),
        ("requires of a model", or_none(&needs.join(", "))),
        ("paper", or_none(&string(&solver["paper"]))),
    ] {
        let _ = writeln!(text, "| {name} | {} |", cell(&value));
    }
    let mut settings = vec![];
    flatten("", &solver["settings"], &mut settings);
    let example = settings.first().map_or(String::new(), |(key, value)| format!(",{key}={value}"));
    let _ = write!(text, "\n    swm eval my-model --env swm/TwoRoom-v1 --solver {id}{example}\n\n");
    text += "## Settings\n\n| setting | default |\n| --- | --- |\n";
    for (key, value) in settings {
        let _ = writeln!(text, "| `{key}` | {value} |");
    }
    text
}

/// Returns the page of a visual wrapper.
pub fn wrapper(id: &str, wrapper: &Value) -> String {
    let mut text = format!("# `{id}`\n\n{}.\n\n", sentence(&wrapper["summary"]));
    let parameters = entries(&wrapper["parameters"]);
    let example = parameters.iter().find(|(_, parameter)| !parameter["default"].is_null());
    let example = example.map_or(String::new(), |(key, parameter)| format!(",{key}={}", values(&parameter["default"])));
    let _ = write!(text, "    swm eval my-model --env swm/TwoRoom-v1 --wrapper {id}{example}\n\n");
    text += "| setting | | valid values | default |\n| --- | --- | --- | --- |\n";
    for (key, parameter) in parameters {
        let (summary, valid) = (cell(&string(&parameter["summary"])), cell(&string(&parameter["allowed"])));
        let _ = writeln!(text, "| `{key}` | {summary} | {valid} | {} |", values(&parameter["default"]));
    }
    text + "\n[All wrappers on one sheet, and the rules that hold for all](../wrappers.md).\n"
}

/// Returns the page of a model family. `presets` are the ids, summaries and complete settings of its presets.
pub fn model(id: &str, summary: &str, presets: &[(String, String, String)]) -> String {
    let mut text =
        format!("# `{id}`\n\n{}.\n\n## Presets\n\n| preset | size |\n| --- | --- |\n", summary.trim_end_matches('.'));
    for (preset, size, _) in presets {
        let _ = writeln!(text, "| `{preset}` | {} |", cell(size));
    }
    for (preset, _, settings) in presets {
        let _ = write!(text, "\n## `{preset}`\n\n`swm train {id} --preset {preset} --print-config` prints:\n\n");
        let _ = write!(text, "```toml\n{}\n```\n", settings.trim_end());
    }
    text
}

/// Returns the page of a dataset format.
pub fn format(id: &str, format: &Value) -> String {
    let suffixes: Vec<String> =
        list(&format["suffixes"]).iter().map(|suffix| format!("`.{}`", string(suffix))).collect();
    format!(
        "# `{id}`\n\n{}.\n\n| | |\n| --- | --- |\n| suffixes | {} |\n\n    swm convert rooms rooms-{id} --format {id}\n\n\
         What works with every format is described in [Datasets](../data.md).\n",
        sentence(&format["summary"]),
        or_none(&suffixes.join(", "))
    )
}

/// Returns the page of a command: its help, and that of its subcommands.
pub fn command(name: &str, helps: &[(String, String)]) -> String {
    let mut text = format!("# `swm {name}`\n");
    for (command, help) in helps {
        if *command != format!("swm {name}") {
            let _ = write!(text, "\n## `{command}`\n");
        }
        let _ = write!(text, "\n```text\n{}\n```\n", help.trim_end());
    }
    text
}

/// Describes a space: its type, bounds and shape.
fn space(space: &Value) -> String {
    let kind = string(&space["type"]);
    match kind.as_str() {
        "RGBBox" => "colour".to_owned(),
        "Discrete" => {
            let (n, start) = (space["n"].as_i64().unwrap_or(0), space["start"].as_i64().unwrap_or(0));
            format!("{start} to {}", start + n - 1)
        }
        "MultiDiscrete" => format!("integers below {}", values(&space["nvec"])),
        _ => {
            let shape = values(&space["shape"]);
            let shape = if shape.is_empty() { String::new() } else { format!(", shape [{shape}]") };
            format!("{} to {}{shape}", bound(&space["low"], "−∞"), bound(&space["high"], "∞"))
        }
    }
}

/// Returns a bound: one value if all elements have the same one.
fn bound(value: &Value, infinite: &str) -> String {
    let mut leaves = vec![];
    leaves_of(value, &mut leaves);
    leaves.dedup();
    match leaves[..] {
        [Value::Null] => infinite.to_owned(),
        [one] => values(one),
        _ => values(value),
    }
}

/// Returns the elements of a value, joined by commas; at most nine.
fn values(value: &Value) -> String {
    const MOST: usize = 9;
    let mut leaves = vec![];
    leaves_of(value, &mut leaves);
    let mut texts: Vec<String> = leaves.iter().take(MOST).map(|leaf| string(leaf)).collect();
    if leaves.len() > MOST {
        texts.push("…".to_owned());
    }
    texts.join(", ")
}

fn leaves_of<'a>(value: &'a Value, leaves: &mut Vec<&'a Value>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| leaves_of(value, leaves)),
        leaf => leaves.push(leaf),
    }
}

/// Collects nested settings with their keys joined by dots.
fn flatten(path: &str, value: &Value, found: &mut Vec<(String, String)>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                flatten(&path, value, found);
            }
        }
        leaf => found.push((path.to_owned(), if leaf.is_null() { "none".to_owned() } else { values(leaf) })),
    }
}

/// Returns a scalar as text. Floats have at most the digits of single precision.
pub fn string(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => String::new(),
        Value::Number(number) if number.is_f64() => {
            number.as_f64().map_or_else(String::new, |value| (value as f32).to_string().replace('-', "−"))
        }
        other => other.to_string(),
    }
}

/// Returns a summary as the beginning of a sentence, without its full stop.
fn sentence(summary: &Value) -> String {
    let text = string(summary);
    let mut letters = text.trim_end_matches('.').chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// Returns the fields of an object.
pub fn entries(value: &Value) -> Vec<(&String, &Value)> {
    value.as_object().into_iter().flatten().collect()
}

fn or_none(text: &str) -> String {
    if text.is_empty() { "none".to_owned() } else { text.to_owned() }
}

/// Returns a text as the cell of a table: on one line, without bars.
fn cell(text: &str) -> String {
    text.replace('\n', " ").replace('|', "\\|").replace('[', "\\[")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn spaces_are_described_in_words() {
        let unit = json!({"type": "Box", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]});
        assert_eq!(space(&unit), "−1 to 1, shape [2]");
        let half = json!({"type": "Box", "shape": [], "low": 0.5, "high": null});
        assert_eq!(space(&half), "0.5 to ∞");
        assert_eq!(space(&json!({"type": "Discrete", "n": 3, "start": 1})), "1 to 3");
        assert_eq!(space(&json!({"type": "RGBBox", "shape": [3]})), "colour");
        assert_eq!(values(&json!((0..12).collect::<Vec<_>>())), "0, 1, 2, 3, 4, 5, 6, 7, 8, …");
    }

    #[test]
    fn a_group_lists_its_pages() {
        let page = Page { title: "cem".to_owned(), path: "solvers/cem.md".to_owned(), text: String::new() };
        let group = Group::new("solvers", "Solvers", "All.", vec![("a | b".to_owned(), page)]);
        assert!(group.pages[0].text.contains("| [`cem`](cem.md) | a \\| b |"), "{}", group.pages[0].text);
    }

    #[test]
    fn a_solver_lists_nested_settings() {
        let page = solver("gd", &json!({"summary": "Descent.", "settings": {"optimizer": {"step": 0.5}}}));
        assert!(page.contains("| `optimizer.step` | 0.5 |") && page.contains("gd,optimizer.step=0.5"), "{page}");
    }
}
