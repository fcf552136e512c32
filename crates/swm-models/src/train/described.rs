//! [`describe`]: a configuration as TOML with a comment above each setting: the first sentence of its documentation.
//!
//! The documentation is read from the sources of the configurations, which the program contains, so a comment cannot differ from
//! it. Structures are found by the names of their types.

use std::collections::BTreeMap;

/// The sources of all configurations.
const SOURCES: &[&str] = &[
    include_str!("config.rs"),
    include_str!("optim.rs"),
    include_str!("schedule.rs"),
    include_str!("../online/config.rs"),
    include_str!("../online/planner_config.rs"),
    include_str!("../nn/backbone.rs"),
    include_str!("../nn/vit.rs"),
    include_str!("../nn/conv.rs"),
    include_str!("../nn/keypoints.rs"),
    include_str!("../nn/dino.rs"),
    include_str!("../nn/patch_cnn.rs"),
    include_str!("../nn/predictor.rs"),
    include_str!("../nn/two_hot.rs"),
    include_str!("../lewm/config.rs"),
    include_str!("../lewm/step.rs"),
    include_str!("../pldm/loss.rs"),
    include_str!("../dino_wm/config.rs"),
    include_str!("../dino_wm/predictor.rs"),
    include_str!("../dino_wm/train.rs"),
    include_str!("../gcrl/config.rs"),
    include_str!("../gcrl/loss.rs"),
    include_str!("../gcrl/transformer.rs"),
    include_str!("../sac/config.rs"),
    include_str!("../tdmpc2/config.rs"),
    include_str!("../inverse/train.rs"),
];

/// The widest line of a comment.
const COLUMNS: usize = 100;

/// A field of a structure.
#[derive(Clone, Debug)]
struct Field {
    /// The type, without `Option`.
    of: String,
    /// The first sentence of the documentation.
    text: String,
}

/// Structures by their names.
type Structures = BTreeMap<String, BTreeMap<String, Field>>;

/// Adds a comment above each table and setting of a configuration. `root` is the type of the configuration, and `generic` the types
/// of its fields with a generic type, such as `M::Config`.
pub(crate) fn describe(toml: &str, root: &str, generic: &[(&str, &str)]) -> String {
    let structures = structures();
    let keys = keys(toml);
    let name_of = |of: &str| {
        let of = generic.iter().find(|(name, _)| *name == of).map_or(of, |(_, own)| *own);
        of.rsplit("::").next().unwrap_or(of).to_owned()
    };
    // The structure of each table: that of the field's type, or the one that has most of the keys.
    let mut of_tables: BTreeMap<Vec<&str>, Option<&BTreeMap<String, Field>>> = BTreeMap::new();
    for (table, names) in &keys {
        let known = match table.split_last() {
            None => structures.get(root),
            Some((last, outer)) => {
                let field = of_tables.get(outer).copied().flatten().and_then(|structure| structure.get(*last));
                field.and_then(|field| structures.get(&name_of(&field.of)))
            }
        };
        let count = |fields: &BTreeMap<String, Field>| names.iter().filter(|name| fields.contains_key(**name)).count();
        let best = || structures.values().filter(|fields| count(fields) > 0).max_by_key(|fields| count(fields));
        of_tables.insert(table.clone(), known.or_else(best));
    }
    let field = |table: &[&str], name: &str| of_tables.get(table).copied().flatten()?.get(name);
    let mut described = String::new();
    let (mut table, mut inside) = (vec![], 0_i64);
    for line in toml.lines() {
        let at_start = inside == 0;
        if let Some(header) = line.strip_prefix('[').filter(|_| at_start) {
            table = header.trim_matches(['[', ']']).split('.').collect();
            if let Some((last, outer)) = table.split_last() {
                comment(&mut described, field(outer, last));
            }
        } else if let Some(name) = key(line).filter(|_| at_start) {
            comment(&mut described, field(&table, name));
            inside += depth(line);
        } else {
            inside += depth(line);
        }
        described += line;
        described.push('\n');
    }
    described
}

/// How many brackets a line opens and does not close. Settings have no brackets in texts.
fn depth(line: &str) -> i64 {
    line.chars().map(|c| i64::from("[{".contains(c)) - i64::from("]}".contains(c))).sum()
}

/// The name of the setting in a line.
fn key(line: &str) -> Option<&str> {
    let (name, _) = line.split_once(" = ")?;
    name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_').then_some(name)
}

/// The names of the settings and tables of each table, outer tables first.
fn keys(toml: &str) -> BTreeMap<Vec<&str>, Vec<&str>> {
    let mut keys: BTreeMap<Vec<&str>, Vec<&str>> = BTreeMap::from([(vec![], vec![])]);
    let mut table: Vec<&str> = vec![];
    for line in toml.lines() {
        if let Some(header) = line.strip_prefix('[').filter(|header| header.trim_end().ends_with(']')) {
            table = header.trim_matches(['[', ']']).split('.').collect();
            keys.entry(table.clone()).or_default();
            for length in 1..=table.len() {
                keys.entry(table[..length - 1].to_vec()).or_default().push(table[length - 1]);
            }
        } else if let Some(name) = key(line) {
            keys.entry(table.clone()).or_default().push(name);
        }
    }
    keys
}

/// Writes a text as lines of a comment.
fn comment(to: &mut String, field: Option<&Field>) {
    let Some(field) = field else { return };
    let mut line = String::from("#");
    for word in field.text.split_whitespace() {
        if line.len() + 1 + word.len() > COLUMNS {
            *to += &line;
            to.push('\n');
            line.truncate(1);
        }
        line.push(' ');
        line += word;
    }
    *to += &line;
    to.push('\n');
}

/// The structures of the sources, and the enumerations with their variants as fields.
fn structures() -> Structures {
    let mut structures = Structures::new();
    for source in SOURCES {
        let (mut name, mut text): (Option<String>, Vec<&str>) = (None, vec![]);
        let mut renamed = None;
        for line in source.lines() {
            let item = line.strip_prefix("pub struct ").or_else(|| line.strip_prefix("pub enum "));
            if let Some(rest) = item {
                let own = rest.split(['<', ' ', '(']).next().unwrap_or_default();
                name = rest.ends_with('{').then(|| own.to_owned());
                structures.entry(own.to_owned()).or_default();
            } else if line == "}" {
                name = None;
            } else if let (Some(name), Some((field, of))) = (&name, declared(line.trim())) {
                let field = renamed.take().map_or(field, str::to_owned);
                let field = (field, Field { of: of.to_owned(), text: first_sentence(&text.join(" ")) });
                structures.entry(name.clone()).or_default().extend([field]);
            }
            if let Some(rest) = line.trim().strip_prefix("#[serde(rename = \"") {
                renamed = rest.split('"').next();
            }
            match line.trim().strip_prefix("///") {
                Some(words) => text.push(words.trim()),
                None if line.trim().starts_with("#[") => {}
                None => text.clear(),
            }
        }
    }
    // A structure that another module exports under its own name.
    for line in SOURCES.iter().flat_map(|source| source.lines()) {
        let renamed = line.strip_prefix("pub use ").and_then(|rest| rest.strip_suffix(';')?.split_once(" as "));
        let Some((path, own)) = renamed else { continue };
        if let Some(fields) = structures.get(path.rsplit("::").next().unwrap_or(path)).cloned() {
            structures.insert(own.to_owned(), fields);
        }
    }
    structures
}

/// The name and the type of a field, `pub name: Type,`, or of a variant, `Name(Type),`.
fn declared(line: &str) -> Option<(String, &str)> {
    let line = line.strip_suffix(',')?;
    let Some(field) = line.strip_prefix("pub ") else {
        let (variant, of) = line.strip_suffix(')')?.split_once('(')?;
        let is_variant = variant.starts_with(|c: char| c.is_ascii_uppercase());
        return (is_variant && variant.chars().all(|c| c.is_ascii_alphanumeric())).then(|| (snake_case(variant), of));
    };
    let (name, of) = field.split_once(": ")?;
    let of = of.strip_prefix("Option<").and_then(|of| of.strip_suffix('>')).unwrap_or(of);
    Some((name.to_owned(), of))
}

/// The name of a variant in a file: `patch_cnn` of `PatchCnn`.
fn snake_case(variant: &str) -> String {
    let mut name = String::new();
    for c in variant.chars() {
        if c.is_ascii_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.push(c.to_ascii_lowercase());
    }
    name
}

/// The first sentence, without the marks of links and code.
fn first_sentence(text: &str) -> String {
    let end = text
        .match_indices(". ")
        .map(|(at, _)| at + 1)
        .find(|at| text[*at..].trim_start().starts_with(char::is_uppercase));
    let plain: String = text[..end.unwrap_or(text.len())].chars().filter(|c| !"`[]".contains(*c)).collect();
    plain.trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FAMILIES;

    #[test]
    fn every_setting_of_every_preset_has_a_comment() {
        for family in FAMILIES.rows {
            for preset in family.presets {
                let config = (family.config)(preset.id, &[]).expect(family.id);
                let (plain, described) = (config.to_toml().expect("TOML"), config.to_commented_toml().expect("TOML"));
                let without: String =
                    described.lines().filter(|line| !line.starts_with('#')).map(|line| format!("{line}\n")).collect();
                assert_eq!(without, plain, "{} {}", family.id, preset.id);
                let lines: Vec<&str> = described.lines().collect();
                let mut table = "";
                for (i, line) in lines.iter().enumerate() {
                    table = line.strip_prefix('[').unwrap_or(table);
                    // The mixture of goals is declared in swm-data, whose sources this crate cannot include.
                    let name = line.strip_prefix('[').or_else(|| key(line).filter(|_| !table.ends_with("goals]")));
                    // The kind of an encoder is its own name.
                    let is_described = i > 0 && lines[i - 1].starts_with("# ") && lines[i - 1].len() > 4;
                    assert!(
                        name.is_none_or(|name| is_described || name == "kind"),
                        "{} {}: {line}",
                        family.id,
                        preset.id
                    );
                    assert!(line.len() <= COLUMNS || !line.starts_with('#'), "{line}");
                }
            }
        }
    }

    #[test]
    fn comments_are_the_first_sentences_of_the_documentation() {
        let toml = "seed = 1\nlog_every = 2\n\n[data]\nnum_steps = 3\n";
        let described = describe(toml, "TrainConfig", &[]);
        let expected = "# The seed of the initial weights, the order of the data and all other random draws\nseed = 1\n\
                        # The number of steps between two lines of the log\nlog_every = 2\n\n# The data\n[data]\n\
                        # The number of frames of a clip\nnum_steps = 3\n";
        assert_eq!(described, expected);
        assert_eq!(first_sentence("The rate, e.g. 0.1, of [`Adam`]. Then more."), "The rate, e.g. 0.1, of Adam");
    }
}
