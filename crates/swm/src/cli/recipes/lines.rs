//! [`Lines`]: where a step is in the file of a recipe, for errors.

use std::collections::BTreeMap;
use toml::de::{DeTable, DeValue};

/// The positions of the line feeds of a text. A file of a stranger may ask for the lines of very many keys.
pub struct LineFeeds(Vec<usize>);

impl LineFeeds {
    /// Finds them.
    pub fn of(text: &str) -> Self {
        Self(text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect())
    }

    /// The line of a byte, counted from 1.
    pub fn line(&self, byte: usize) -> usize {
        1 + self.0.partition_point(|feed| *feed < byte)
    }
}

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
        let feeds = LineFeeds::of(text);
        let steps = document.get_ref().iter().find(|(key, _)| key.get_ref() == kind);
        let Some(DeValue::Array(steps)) = steps.map(|(_, value)| value.get_ref()) else { return vec![] };
        let of_step = |step: &toml::Spanned<DeValue<'_>>| {
            let mut keys = BTreeMap::new();
            if let DeValue::Table(table) = step.get_ref() {
                collect("", table, &feeds, &mut keys);
            }
            Self { step: Some(feeds.line(step.span().start)), keys }
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
    format!(" (line {})", LineFeeds::of(text).line(span.start))
}

/// Stores the lines of the keys of a table; the keys of nested tables are dotted, without `settings`.
fn collect(prefix: &str, table: &DeTable<'_>, feeds: &LineFeeds, keys: &mut BTreeMap<String, usize>) {
    for (key, value) in table {
        let name = match prefix {
            "" | "settings" => key.get_ref().to_string(),
            _ => format!("{prefix}.{}", key.get_ref()),
        };
        if let DeValue::Table(inner) = value.get_ref() {
            collect(&name, inner, feeds, keys);
        } else {
            keys.insert(name, feeds.line(key.span().start));
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

    #[test]
    fn lines_of_very_many_keys_are_found_at_once() {
        let keys: String = (0..100_000).map(|i| format!("k{i}=1\n")).collect();
        let start = std::time::Instant::now();
        let lines = Lines::of(&format!("[[train]]\n{keys}"), "train");
        assert_eq!((lines[0].step, lines[0].keys["k99999"], lines[0].keys.len()), (Some(1), 100_001, 100_000));
        assert!(start.elapsed().as_secs() < 5, "{:?}", start.elapsed());
    }
}
