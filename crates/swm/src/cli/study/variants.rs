//! Variants of a table: one for every combination of the values of its variables.

use super::colour;
use super::file::{Table, Values, Variant};
use std::collections::BTreeMap;
use swm_core::results::TRAINING_SEED;
use swm_core::{Error, Result, VariationSpace};
use swm_eval::Study;

/// The largest size of all texts of all variants, in bytes. A study of [`Study::MAX_CELLS`] cells with options of usual
/// lengths has half of it.
const MAX_TEXT_BYTES: usize = 64 << 20;

/// What a text takes beside its bytes.
const TEXT_OVERHEAD: usize = 24;

/// The memory that the texts of a study may still take, so that a small file does not expand to more than the memory.
pub struct Budget {
    left: usize,
}

impl Default for Budget {
    fn default() -> Self {
        Self { left: MAX_TEXT_BYTES }
    }
}

impl Budget {
    /// Takes memory before it is used. `at` is named in the error.
    ///
    /// # Errors
    /// When less is left.
    pub fn take(&mut self, bytes: usize, at: &str) -> Result<()> {
        let Some(left) = self.left.checked_sub(bytes) else {
            let problem = format!("the texts of all its cells together have more than {} MiB", MAX_TEXT_BYTES >> 20);
            return Err(Error::config(at, problem, "give shorter texts or fewer values"));
        };
        self.left = left;
        Ok(())
    }
}

impl Table {
    /// Returns the table with every combination of the values of its variables; the last variable changes fastest.
    ///
    /// # Errors
    /// When a variable has no values, there are more than [`Study::MAX_CELLS`] combinations, a colour is malformed, or
    /// the texts take more than the budget.
    pub fn variants(&self, factors: Option<&VariationSpace>, budget: &mut Budget) -> Result<Vec<Variant>> {
        let mut combinations: Vec<BTreeMap<String, String>> = vec![BTreeMap::new()];
        for (name, values) in &self.each {
            let values: Vec<String> = match values {
                Values::List(values) => values.clone(),
                Values::Factors => {
                    let space = factors.ok_or_else(|| {
                        Error::config(self.at.clone(), "no environment has these factors", "name one: env = \"…\"")
                    })?;
                    space.factors().iter().map(|factor| factor.key.clone()).collect()
                }
            };
            if values.is_empty() {
                return Err(Error::config(format!("{}: {name}", self.at), "has no values", "give at least one"));
            }
            if combinations.len().saturating_mul(values.len()) > Study::MAX_CELLS {
                let (problem, fix) = ("the variables have too many combinations", "give fewer values");
                return Err(Error::config(self.at.clone(), problem, format!("{fix}: at most {}", Study::MAX_CELLS)));
            }
            let known: usize = combinations.iter().map(size).sum();
            let added: usize = values.iter().map(|value| 2 * TEXT_OVERHEAD + name.len() + value.len()).sum();
            let all = known.saturating_mul(values.len()).saturating_add(added.saturating_mul(combinations.len()));
            budget.take(all.saturating_sub(known), &self.at)?;
            let extended = |known: &BTreeMap<String, String>| {
                let known = known.clone();
                let with = |value: &String| {
                    let mut all = known.clone();
                    all.insert(name.clone(), value.clone());
                    all
                };
                values.iter().map(with).collect::<Vec<_>>()
            };
            combinations = combinations.iter().flat_map(extended).collect();
        }
        combinations.into_iter().map(|variables| self.variant(variables, budget)).collect()
    }

    fn variant(&self, variables: BTreeMap<String, String>, budget: &mut Budget) -> Result<Variant> {
        let any_seed = if variables.contains_key(TRAINING_SEED) {
            let place = format!("{{{TRAINING_SEED}}}");
            if !self.name.contains(&place) {
                let problem = format!("the name '{}' does not contain {place}", self.name);
                return Err(Error::config(self.at.clone(), problem, "policies of several training seeds need names"));
            }
            let mut any = variables.clone();
            any.insert(TRAINING_SEED.to_owned(), "*".to_owned());
            Some(fill(&self.name, &any, budget, &self.at)?)
        } else {
            None
        };
        let mut options = BTreeMap::new();
        for (key, values) in &self.options {
            budget.take(TEXT_OVERHEAD + key.len(), &self.at)?;
            let mut filled = Vec::with_capacity(values.len());
            for value in values {
                let value = fill(value, &variables, budget, &self.at)?;
                filled.push(if key == "pin" { colour::resolve(&value, &self.at)? } else { value });
            }
            options.insert(key.clone(), filled);
        }
        let name = fill(&self.name, &variables, budget, &self.at)?;
        Ok(Variant { at: self.at.clone(), name, any_seed, options, variables, starts: self.starts.clone() })
    }
}

impl Variant {
    /// The memory of the texts, in bytes.
    pub fn size(&self) -> usize {
        let text = |text: &String| TEXT_OVERHEAD + text.len();
        let options = self.options.iter().map(|(key, values)| text(key) + values.iter().map(text).sum::<usize>());
        text(&self.name) + self.any_seed.as_ref().map_or(0, text) + options.sum::<usize>() + size(&self.variables)
    }
}

/// The memory of the values of variables, in bytes.
fn size(variables: &BTreeMap<String, String>) -> usize {
    variables.iter().map(|(name, value)| 2 * TEXT_OVERHEAD + name.len() + value.len()).sum()
}

/// Replaces every `{NAME}` of a text by the value of the variable, in one pass: a `{NAME}` in a value stays as it is, and so
/// do braces around anything but a name, such as those of a setting.
///
/// # Errors
/// When no variable has such a name, or the texts are too long.
fn fill(text: &str, variables: &BTreeMap<String, String>, budget: &mut Budget, at: &str) -> Result<String> {
    budget.take(TEXT_OVERHEAD, at)?;
    let (mut filled, mut rest) = (String::new(), text);
    while let Some((head, tail)) = rest.split_once('}') {
        let (before, value) = match head.rsplit_once('{') {
            Some((before, name)) if is_name(name) => {
                (before, variables.get(name).ok_or_else(|| unknown(name, variables, at))?.as_str())
            }
            _ => (head, "}"),
        };
        budget.take(before.len() + value.len(), at)?;
        filled.push_str(before);
        filled.push_str(value);
        rest = tail;
    }
    budget.take(rest.len(), at)?;
    filled.push_str(rest);
    Ok(filled)
}

/// Whether a text in braces is meant as the name of a variable.
fn is_name(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || ['-', '_', '.'].contains(&c))
}

fn unknown(name: &str, variables: &BTreeMap<String, String>, at: &str) -> Error {
    let known = variables.keys().map(String::as_str);
    Error::unknown(
        "variable",
        name,
        known,
        format!("{at} has '{{{name}}}'; variables are declared by each = {{ NAME = [VALUE, VALUE] }}"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_variable_is_an_error_with_the_nearest_name() {
        let variables = BTreeMap::from([("colour".to_owned(), "red".to_owned())]);
        let error = |text: &str, variables: &BTreeMap<_, _>| {
            fill(text, variables, &mut Budget::default(), "study.toml:7").expect_err(text).to_string()
        };
        let misspelt = error("agent.color={color}", &variables);
        assert!(misspelt.contains("study.toml:7") && misspelt.contains("did you mean colour?"), "{misspelt}");
        assert!(error("{x}", &BTreeMap::new()).contains("each = "));
    }

    #[test]
    fn variables_are_replaced_once() {
        let variables = [("a", "{b}"), ("b", "1"), ("c", "}")];
        let variables: BTreeMap<_, _> = variables.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
        let fill = |text: &str| fill(text, &variables, &mut Budget::default(), "study.toml:1").expect("a text");
        for (text, expected) in [
            ("{a}{b} {b}", "{b}1 1"),
            ("{{b}}", "{1}"),
            ("{d=1} }{ {b", "{d=1} }{ {b"),
            ("{a{b}c}", "{a1c}"),
            ("{b{c}", "{b}"),
            ("{}{2}", "{}{2}"),
            ("", ""),
            ("é{b}é", "é1é"),
        ] {
            assert_eq!(fill(text), expected, "{text}");
        }
    }

    #[test]
    fn texts_are_bounded_before_they_are_made() {
        let value = "x".repeat(1 << 20);
        let variables = BTreeMap::from([("a".to_owned(), value)]);
        let error = fill(&"{a}".repeat(65), &variables, &mut Budget::default(), "study.toml:1").expect_err("65 MiB");
        assert!(error.to_string().contains("study.toml:1") && error.to_string().contains("64 MiB"), "{error}");
        assert!(fill(&"{a}".repeat(63), &variables, &mut Budget::default(), "study.toml:1").is_ok());
        let mut budget = Budget { left: 3 };
        assert!(budget.take(4, "").is_err() && budget.take(3, "").is_ok() && budget.take(1, "").is_err());
    }
}
