//! The tables `[[published]]` of a study's file: success rates that publications state.

use super::file::Source;
use swm_core::results::Published;
use swm_core::{Error, Result};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The names in a table.
const NAMES: &[&str] = &["source", "starts", "rates"];

/// Reads the tables.
///
/// # Errors
/// When a table has a name that is not one of [`NAMES`], lacks a source or rates, or a rate is not a share from 0 to 1.
pub fn read(source: &Source<'_>, value: &Spanned<DeValue<'_>>) -> Result<Vec<Published>> {
    let DeValue::Array(tables) = value.get_ref() else {
        return Err(source.invalid(value, "is not a list of tables", "write [[published]]"));
    };
    Ok(tables.iter().map(|value| table(source, value)).collect::<Result<Vec<_>>>()?.concat())
}

fn table(source: &Source<'_>, value: &Spanned<DeValue<'_>>) -> Result<Vec<Published>> {
    let (mut stated, mut starts, mut rates) = (None, None, None);
    for (key, value) in entries(source, value)? {
        match key.get_ref().as_ref() {
            "source" => stated = Some(source.text_of(value)?),
            "starts" => starts = Some(source.text_of(value)?),
            "rates" => rates = Some(value),
            other => {
                let hint = format!("the names are {}", NAMES.join(", "));
                let what = Error::unknown("name", other, NAMES.iter().copied(), hint);
                return Err(Error::config(source.at(key.span().start), what.to_string(), "correct the file"));
            }
        }
    }
    let (Some(stated), Some(rates)) = (stated, rates) else {
        let fix = "write source = \"…\" and rates = { CONDITION = { POLICY = RATE } }";
        return Err(source.invalid(value, "has no source or no rates", fix));
    };
    let mut published = vec![];
    for (condition, policies) in entries(source, rates)? {
        for (policy, value) in entries(source, policies)? {
            let rate = source.text_of(value)?.parse().ok().filter(|rate| (0.0..=1.0).contains(rate));
            let Some(rate) = rate else {
                return Err(source.invalid(value, "is not a success rate", "give a share from 0 to 1"));
            };
            published.push(Published {
                starts: starts.clone(),
                condition: condition.get_ref().to_string(),
                policy: policy.get_ref().to_string(),
                rate,
                source: stated.clone(),
            });
        }
    }
    Ok(published)
}

fn entries<'v, 'a>(source: &Source<'_>, value: &'v Spanned<DeValue<'a>>) -> Result<&'v DeTable<'a>> {
    match value.get_ref() {
        DeValue::Table(entries) => Ok(entries),
        _ => Err(source.invalid(value, "is not a table", "write NAME = VALUE below the name in brackets")),
    }
}
