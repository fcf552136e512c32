//! Published values beside ours.

use super::sheet::Sheet;
use super::table;
use crate::limits;
use crate::text::{escape, percent, points, shorten};
use std::fmt::Write as _;
use swm_core::results::{Counting, Published};

/// Writes the table of published values; nothing if there are none.
pub(super) fn write(html: &mut String, sheets: &[Sheet<'_>], published: &[Published]) {
    if published.is_empty() {
        return;
    }
    // Ours are those of the first sheet, or of the first one with the stated starts.
    let sheet = |value: &Published| match &value.starts {
        None => sheets.first(),
        Some(starts) => sheets.iter().find(|sheet| sheet.starts() == Some(starts)),
    };
    let condition = |value: &Published| sheet(value)?.conditions.iter().position(|name| *name == value.condition);
    let policy = |value: &Published| sheet(value)?.policies.iter().position(|policy| policy.name == value.policy);
    let last = |index: Option<usize>| index.unwrap_or(usize::MAX);
    let mut values: Vec<&Published> = published.iter().take(limits::PUBLISHED).collect();
    values.sort_by_key(|value| (&value.starts, last(condition(value)), last(policy(value))));
    let countings = sheets.first().map_or(&[][..], |sheet| &sheet.countings);
    head(html, countings);
    let mut sources: Vec<&str> = vec![];
    for value in values {
        let source = sources.iter().position(|source| *source == value.source).unwrap_or_else(|| {
            sources.push(&value.source);
            sources.len() - 1
        });
        let rate = if (0.0..=1.0).contains(&value.rate) { percent(value.rate) } else { "–".to_owned() };
        let _ = write!(
            html,
            "<tr><th scope=\"row\">{}</th><td data-label=\"Policy\">{}</td><td class=\"n\" data-label=\"Published\">{rate} \
             [{}]</td>",
            name(value),
            shown(&value.policy),
            source + 1
        );
        for (counting, kind) in countings.iter().enumerate() {
            let suffix = if countings.len() > 1 { format!(", {}", kind.name()) } else { String::new() };
            let cell =
                |label: &str, words: &str| format!("<td class=\"n\" data-label=\"{label}{suffix}\">{words}</td>");
            let row = condition(value).zip(policy(value));
            let row = row.and_then(|(condition, policy)| sheet(value)?.row(condition, policy, counting));
            match row {
                None => {
                    html.push_str(&(cell("Ours", "<span class=\"quiet\">not run</span>") + &cell("Difference", "–")))
                }
                Some(row) => {
                    let difference = row.success.rate - value.rate;
                    let difference = if difference.abs() <= 1.0 { points(difference) } else { "–".to_owned() };
                    html.push_str(&(cell("Ours", &table::rate(&row.success)) + &cell("Difference", &difference)));
                }
            }
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody>\n</table>\n</div>\n<ol class=\"sources\">\n");
    for source in sources {
        let _ = writeln!(html, "<li>{}</li>", shown(source));
    }
    html.push_str("</ol>\n");
    if published.len() > limits::PUBLISHED {
        let _ = writeln!(html, "<p class=\"note\">{} more are left out.</p>", published.len() - limits::PUBLISHED);
    }
    html.push_str("</section>\n");
}

/// The condition, with the starts if they are stated.
fn name(value: &Published) -> String {
    let starts = value.starts.as_ref().map_or(String::new(), |starts| format!("{starts}: "));
    shown(&format!("{starts}{}", value.condition))
}

/// Writes the start of the section and the head of its table.
fn head(html: &mut String, countings: &[Counting]) {
    html.push_str(
        "<section>\n<h2>Beside published values</h2>\n<p class=\"note\">Published values are those of the named source, \
         from weights and starts of its own. They have no intervals, so a difference shows how near the values are, and is no \
         test.</p>\n<div class=\"wide stack study\">\n<table>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy</th><th scope=\"col\" class=\"n\">Published</th>",
    );
    for counting in countings {
        let name = if countings.len() > 1 { format!(", {}", counting.name()) } else { String::new() };
        let _ = write!(
            html,
            "<th scope=\"col\" class=\"n\">Ours{name}</th><th scope=\"col\" class=\"n\">Difference{name}</th>"
        );
    }
    html.push_str("</tr>\n</thead>\n<tbody>\n");
}

fn shown(name: &str) -> String {
    escape(&shorten(name, limits::STUDY_NAME_CHARS))
}
