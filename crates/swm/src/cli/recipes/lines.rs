//! [`Lines`]: where a step is in the file of a recipe, for errors.

use std::collections::BTreeMap;
use toml::de::{DeTable, DeValue};

/// The line of a step, and those of its options and settings. Empty for a recipe that is no file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lines {
    step: Option<usize>,
    keys: BTreeMap<String, usize>,
}

impl Lines {
    /// The lines of the steps in the tables `[[kind]]` of a text, in order.
    pub fn of(text: &str, kind: &str) -> Vec<Self> {
        let Ok(document) = DeTable::parse(text) else { return vec![] };
        let line = |byte: usize| 1 + text.as_bytes().iter().take(byte).filter(|byte| **byte == b'\n').count();
        let steps = document.get_ref().iter().find(|(key, _)| key.get_ref() == kind);
        let Some(DeValue::Array(steps)) = steps.map(|(_, value)| value.get_ref()) else { return vec![] };
        let of_step = |step: &toml::Spanned<DeValue<'_>>| {
            let mut keys = BTreeMap::new();
            if let DeValue::Table(table) = step.get_ref() {
                collect("", table, &line, &mut keys);
            }
            Self { step: Some(line(step.span().start)), keys }
        };
        steps.iter().map(of_step).collect()
    }

    /// Returns ` (line 12)`: the line of the option or setting that a problem names, or else of the step. Nothing if the lines
    /// are unknown.
    pub fn of_problem(&self, problem: &str) -> String {
        let names = |key: &str| {
            let forms = [format!("--{key}"), format!("'{key}'"), format!("{key} "), format!("{key}=")];
            // Of short names only those that are written as options.
            let forms = if key.contains('.') { &forms[..] } else { &forms[..2] };
            forms.iter().any(|form| problem.contains(form))
        };
        let named = self.keys.iter().filter(|(key, _)| names(key)).max_by_key(|(key, _)| key.len());
        let line = named.map(|(_, line)| *line).or(self.step);
        line.map_or(String::new(), |line| format!(" (line {line})"))
    }
}

/// Returns ` (line 12)` for an error in a text that is not TOML of the expected form; nothing if its place is unknown.
pub fn of_error(text: &str, error: &toml::de::Error) -> String {
    let Some(span) = error.span() else { return String::new() };
    let line = 1 + text.as_bytes().iter().take(span.start).filter(|byte| **byte == b'\n').count();
    format!(" (line {line})")
}

/// Stores the lines of the keys of a table; the keys of nested tables are dotted, without `settings`.
fn collect(prefix: &str, table: &DeTable<'_>, line: &impl Fn(usize) -> usize, keys: &mut BTreeMap<String, usize>) {
    for (key, value) in table {
        let name = match prefix {
            "" | "settings" => key.get_ref().to_string(),
            _ => format!("{prefix}.{}", key.get_ref()),
        };
        if let DeValue::Table(inner) = value.get_ref() {
            collect(&name, inner, line, keys);
        } else {
            keys.insert(name, line(key.span().start));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn problems_have_the_line_of_their_option_setting_or_step() {
        let text = "summary = \"s\"\n\n[[train]]\nname = \"a\"\n\n[[train]]\nname = \"b\"\nimage = 64\n[train.settings]\n\
                    optim.lr = 3\nschedule.steps = 4\n";
        let [first, second] = &Lines::of(text, "train")[..] else { panic!("two steps") };
        assert_eq!(first.of_problem("it has no model"), " (line 3)");
        assert_eq!(second.of_problem("invalid value '64' for '--image <PIXELS>'"), " (line 8)");
        assert_eq!(second.of_problem("setting optim.lr = 3: is too large"), " (line 10)");
        assert_eq!(second.of_problem("schedule.steps=4"), " (line 11)");
        assert_eq!(Lines::of(text, "eval"), []);
        assert_eq!(Lines::default().of_problem("'image'"), "");
    }
}
