//! Checks the vocabulary: `xtask/words.toml` lists words to avoid, their replacements, and the lines that may contain
//! them.
//!
//! Identifiers are split into words (`snake_case`, `CamelCase`), so a refused word is found in identifiers, prose and
//! strings.

use crate::source::File;
use anyhow::{Context as _, Result, bail};
use toml::Table;

/// The content of `xtask/words.toml`.
#[derive(Debug, Default)]
pub struct Words {
    refused: Vec<Refused>,
    types: Vec<RefusedType>,
    allowed: Vec<Allowed>,
}

/// A word or a sequence of words to avoid.
#[derive(Debug)]
struct Refused {
    /// The words of the sequence, in lower case.
    parts: Vec<String>,
    /// The words to use instead.
    say: String,
}

/// A type name that only some files may define.
#[derive(Debug)]
struct RefusedType {
    name: String,
    /// The files that may define it.
    only_in: Vec<String>,
    say: String,
}

/// Lines that may contain a refused word.
#[derive(Debug)]
struct Allowed {
    /// The beginning of the file's path.
    path: String,
    /// A part of the line.
    line: String,
}

impl Words {
    /// Parses the text of `words.toml`.
    pub fn parse(text: &str) -> Result<Self> {
        let table: Table = text.parse().context("words.toml")?;
        let mut words = Self::default();
        let tables = |key: &str| -> Result<Vec<Table>> {
            let Some(value) = table.get(key) else { return Ok(vec![]) };
            let array = value.as_array().with_context(|| format!("words.toml: `{key}` is not an array"))?;
            array.iter().map(|row| row.as_table().cloned().context("words.toml: a row is not a table")).collect()
        };
        let text_of = |row: &Table, key: &str| -> Result<String> {
            let value = row.get(key).and_then(|value| value.as_str());
            value.map(str::to_owned).with_context(|| format!("words.toml: a row lacks `{key}`: {row}"))
        };
        let list_of = |row: &Table, key: &str| -> Result<Vec<String>> {
            let list = row.get(key).and_then(|value| value.as_array());
            let list = list.with_context(|| format!("words.toml: a row lacks the list `{key}`: {row}"))?;
            list.iter().map(|item| item.as_str().map(str::to_owned).context("words.toml: not a string")).collect()
        };
        for row in tables("refused")? {
            for word in list_of(&row, "words")? {
                words.refused.push(Refused { parts: parts(&word), say: text_of(&row, "say")? });
            }
        }
        for row in tables("type")? {
            let (name, say) = (text_of(&row, "name")?, text_of(&row, "say")?);
            words.types.push(RefusedType { name, say, only_in: list_of(&row, "only_in")? });
        }
        for row in tables("allowed")? {
            words.allowed.push(Allowed { path: text_of(&row, "path")?, line: text_of(&row, "line")? });
        }
        if words.refused.is_empty() {
            bail!("words.toml refuses no word");
        }
        Ok(words)
    }

    /// Returns a sentence for each refused word, for each reserved type name that another file defines, and for each
    /// row of the allow list that matches no line.
    pub fn violations(&self, files: &[File]) -> Vec<String> {
        let mut found = vec![];
        let mut used = vec![false; self.allowed.len()];
        for file in files {
            for (number, line) in file.text.lines().enumerate() {
                let mut problems = self.in_line(&file.path, line);
                if problems.is_empty() {
                    continue;
                }
                for (row, used) in self.allowed.iter().zip(&mut used) {
                    if file.path.starts_with(&row.path) && line.contains(&row.line) {
                        *used = true;
                        problems.clear();
                    }
                }
                found.extend(problems.into_iter().map(|problem| format!("{}:{}: {problem}", file.path, number + 1)));
            }
        }
        for (row, _) in self.allowed.iter().zip(&used).filter(|(_, used)| !**used) {
            found.push(format!(
                "words.toml allows `{}` in {}, where no line contains a refused word: delete the row",
                row.line, row.path
            ));
        }
        found
    }

    fn in_line(&self, path: &str, line: &str) -> Vec<String> {
        let parts = parts(line);
        let mut found = vec![];
        for word in &self.refused {
            if parts.windows(word.parts.len()).any(|window| window == word.parts) {
                found.push(format!("`{}`: say {}", word.parts.join(" "), word.say));
            }
        }
        for reserved in self.types.iter().filter(|reserved| !reserved.only_in.iter().any(|file| file == path)) {
            let tokens: Vec<&str> = line.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
            let defines =
                |pair: &[&str]| ["struct", "enum", "trait", "type"].contains(&pair[0]) && pair[1] == reserved.name;
            if path.ends_with(".rs") && tokens.windows(2).any(defines) {
                found.push(format!("a type named `{}`: {}", reserved.name, reserved.say));
            }
        }
        found
    }
}

/// Returns the words of a line in lower case; identifiers are split into words.
fn parts(line: &str) -> Vec<String> {
    let mut parts: Vec<String> = vec![];
    let mut word = String::new();
    let mut lower = false;
    for c in line.chars().chain([' ']) {
        if (!c.is_alphabetic() || (c.is_uppercase() && lower)) && !word.is_empty() {
            parts.push(std::mem::take(&mut word));
        }
        lower = c.is_lowercase();
        if c.is_alphabetic() {
            word.extend(c.to_lowercase());
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIST: &str = "
        [[refused]]
        words = ['picture', 'pictures', 'of others']
        say = 'frame or image'
        [[type]]
        name = 'World'
        only_in = ['a/world.rs']
        say = 'only the class that steps a batch'
        [[allowed]]
        path = 'a/'
        line = 'column named'
    ";

    fn check(path: &str, text: &str) -> Vec<String> {
        let used = File { path: "a/b.rs".to_owned(), text: "a column named picture".to_owned() };
        let file = File { path: path.to_owned(), text: text.to_owned() };
        Words::parse(LIST).expect("parsing the list").violations(&[used, file])
    }

    #[test]
    fn forbidden_words_are_found_in_names_and_prose() {
        for text in ["fn read_pictures()", "struct GoalPicture;", "// A Picture.", "assets of others", "let ofOthers"] {
            let found = check("c.rs", &format!("\n{text}"));
            assert!(found.len() == 1 && found[0].starts_with("c.rs:2: "), "{text}: {found:?}");
        }
        for text in ["pictured", "depicture", "the others of it", "an image"] {
            assert_eq!(check("c.rs", text), Vec::<String>::new(), "{text}");
        }
    }

    #[test]
    fn reserved_type_outside_its_file_is_a_violation() {
        assert_eq!(check("a/world.rs", "pub struct World {"), Vec::<String>::new());
        assert_eq!(check("c.rs", "pub struct WorldConfig {"), Vec::<String>::new());
        assert!(check("c.rs", "struct World<T> {")[0].contains("only the class"));
    }

    #[test]
    fn allow_list_row_without_a_match_is_reported() {
        let found = Words::parse(LIST).expect("parsing the list").violations(&[]);
        assert!(found[0].contains("delete the row"), "{found:?}");
    }
}
