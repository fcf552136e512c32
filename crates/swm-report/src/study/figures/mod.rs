//! The figures of a study, chosen by the variables of its conditions.
//!
//! - `density`: prediction errors of solved and of failed trajectories;
//! - `dots`: the values of a study whose cells are no evaluations;
//! - `drop`: the gap of each condition, as a dot with its interval;
//! - `line`: success against a variable with numbers, with a fitted decay;
//! - `paths`: the paths of rows in a plane, such as latents along two principal components;
//! - `wheel`: success over a hue and another variable;
//! - `heat`: success of conditions by policies, for more conditions than `drop` shows.

pub(super) mod density;
pub(super) mod dots;
mod drop;
mod heat;
mod legend;
mod line;
pub(super) mod paths;
mod scale;
#[cfg(test)]
mod tests;
mod wheel;

use super::sheet::Sheet;
use crate::plot::{self, Drawing};
use std::collections::{BTreeMap, BTreeSet};
use swm_core::Result;

/// A figure with its texts.
pub(super) struct Drawn {
    /// The name of its files, without their suffixes.
    pub name: &'static str,
    pub heading: String,
    pub caption: String,
    pub drawing: Drawing,
}

/// Conditions that one figure shows.
enum Family<'a> {
    /// Conditions without a common scale.
    Named(Vec<usize>),
    /// A variable and its value in each condition.
    Line(&'a str, Vec<(f64, usize)>),
    /// A hue, another variable if there is one, and their values in each condition.
    Wheel(&'a str, Option<&'a str>, Vec<([f64; 2], usize)>),
}

/// The height of ticks and their title.
const AXIS: f64 = 46.0;
/// The smallest number of values that a line is drawn through.
const LINE_VALUES: usize = 3;

/// Draws the figures of a sheet for one counting.
///
/// # Errors
/// When drawing fails.
pub(super) fn draw(sheet: &Sheet<'_>, counting: usize) -> Result<Vec<Drawn>> {
    let mut drawn = vec![];
    for family in families(sheet) {
        drawn.extend(match family {
            Family::Named(conditions) if heat::is_better(sheet, &conditions) => {
                heat::draw(sheet, counting, &conditions)?
            }
            Family::Named(conditions) => drop::draw(sheet, counting, &conditions)?,
            Family::Line(variable, points) => line::draw(sheet, counting, variable, &points)?,
            Family::Wheel(hue, other, points) => wheel::draw(sheet, counting, hue, other, &points)?,
        });
    }
    Ok(drawn)
}

/// The shifted conditions, divided by the variables with numbers that vary between them.
fn families<'a>(sheet: &Sheet<'a>) -> Vec<Family<'a>> {
    let variables = |condition: usize| sheet.variables(condition).into_iter().flatten();
    let mut values: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for condition in sheet.shifted() {
        for (name, value) in variables(condition) {
            values.entry(name.as_str()).or_default().insert(value);
        }
    }
    let varies = |name: &str| values.get(name).is_some_and(|values| values.len() > 1);
    let is_numeric =
        |name: &str| values.get(name).is_some_and(|values| values.iter().all(|value| number(value).is_some()));
    // Conditions with the same numeric variables, and the same values of all others.
    type Key<'k> = (Vec<&'k str>, Vec<(&'k str, &'k str)>);
    let mut groups: BTreeMap<Key<'_>, Vec<usize>> = BTreeMap::new();
    let mut order = vec![];
    for condition in sheet.shifted() {
        let of = variables(condition).filter(|(name, _)| varies(name));
        let (numeric, other): (Vec<_>, Vec<_>) = of.partition(|(name, _)| is_numeric(name));
        let numeric: Vec<&str> = numeric.into_iter().map(|(name, _)| name.as_str()).collect();
        let other = other.into_iter().map(|(name, value)| (name.as_str(), value.as_str())).collect();
        let key = if numeric.is_empty() { (vec![], vec![]) } else { (numeric, other) };
        groups.entry(key.clone()).or_insert_with(|| {
            order.push(key.clone());
            vec![]
        });
        groups.entry(key).or_default().push(condition);
    }
    let (mut families, mut named) = (vec![], vec![]);
    for key in order {
        let conditions = groups.remove(&key).unwrap_or_default();
        match family(&key.0, &conditions, |condition, name| number(sheet.variables(condition)?.get(name)?)) {
            Some(family) => families.push(family),
            None => named.extend(conditions),
        }
    }
    if !named.is_empty() {
        named.sort_unstable();
        families.insert(0, Family::Named(named));
    }
    families
}

/// A line or a wheel, if the variables make one.
fn family<'a>(
    names: &[&'a str],
    conditions: &[usize],
    value: impl Fn(usize, &str) -> Option<f64>,
) -> Option<Family<'a>> {
    let hue = names.iter().copied().find(|name| name.to_lowercase().ends_with("hue"));
    match (hue, names) {
        (None, [name]) => {
            let mut points: Vec<(f64, usize)> =
                conditions.iter().filter_map(|condition| Some((value(*condition, name)?, *condition))).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            let different: BTreeSet<u64> = points.iter().map(|(value, _)| value.to_bits()).collect();
            (different.len() >= LINE_VALUES).then_some(Family::Line(name, points))
        }
        (Some(hue), [_] | [_, _]) => {
            let other = names.iter().copied().find(|name| *name != hue);
            let at = |condition: usize| {
                let radius = other.map_or(Some(1.0), |other| value(condition, other))?;
                Some(([value(condition, hue)?.rem_euclid(360.0), radius], condition))
            };
            let points: Vec<_> = conditions.iter().filter_map(|condition| at(*condition)).collect();
            let hues: BTreeSet<u64> = points.iter().map(|(at, _)| at[0].to_bits()).collect();
            (hues.len() >= LINE_VALUES).then_some(Family::Wheel(hue, other, points))
        }
        _ => None,
    }
}

/// A finite number.
fn number(text: &str) -> Option<f64> {
    text.trim().parse().ok().filter(|value: &f64| value.is_finite() && value.abs() < 1e9)
}

/// Draws a figure with its texts.
fn finish(name: &'static str, heading: String, caption: String, figure: &impl plot::Figure) -> Result<Vec<Drawn>> {
    Ok(vec![Drawn { name, heading, caption, drawing: plot::draw(figure)? }])
}

#[cfg(test)]
mod choice_tests {
    use super::super::tests::{row, study};
    use super::*;

    fn kinds(rows: Vec<swm_core::results::StudyRow>) -> Vec<String> {
        let results = study(rows);
        let sheets = Sheet::all(&results);
        let names = families(&sheets[0]).into_iter().map(|family| match family {
            Family::Named(conditions) => format!("named {}", conditions.len()),
            Family::Line(name, points) => format!("line {name} {}", points.len()),
            Family::Wheel(hue, other, points) => format!("wheel {hue} {other:?} {}", points.len()),
        });
        names.collect()
    }

    #[test]
    fn figures_follow_the_variables_of_the_conditions() {
        let plain = || row("plain", "a", &[], 9);
        let named = |name: &'static str| row(name, "a", &[("factor", name)], 4);
        assert_eq!(kinds(vec![plain(), named("agent.color"), named("block.color")]), ["named 2"]);
        let count = |value: &'static str| row(value, "a", &[("count", value), ("protocol", "strict")], 4);
        assert_eq!(kinds(vec![plain(), count("1"), count("2")]), ["named 2"], "two values are no line");
        assert_eq!(kinds(vec![plain(), count("1"), count("2"), count("16"), named("x")]), ["named 1", "line count 3"]);
        assert_eq!(kinds(vec![plain(), count("1"), count("2"), count("many")]), ["named 3"]);
        let hue = |name: &'static str, hue: &'static str, s: &'static str| row(name, "a", &[("hue", hue), ("s", s)], 4);
        let wheel = vec![plain(), hue("1", "0", "0.5"), hue("2", "120", "0.5"), hue("3", "240", "1")];
        assert_eq!(kinds(wheel), ["wheel hue Some(\"s\") 3"]);
    }
}
