//! The table of a study: conditions by policies, with the countings side by side.

use super::sheet::Sheet;
use crate::limits;
use crate::text::{escape, percent, points, shorten, whole_points};
use std::fmt::Write as _;
use swm_core::results::{Paired, Proportion, StudyResults, StudyRow, Verdict};

pub(super) const NONE: &str = "<span class=\"quiet\">–</span>";
/// A table of more rows is folded.
const OPEN_ROWS: usize = 60;

/// Writes the tables of all sheets, up to [`limits::STUDY_TABLE_BYTES`].
pub(super) fn write(html: &mut String, sheets: &[Sheet<'_>], results: &StudyResults) {
    if sheets.is_empty() {
        return;
    }
    html.push_str(
        "<section>\n<h2>Results</h2>\n<p class=\"note\">Success rates with their 95 % intervals, in percent. A gap is \
         the rate under the condition minus that under the first condition, on the same starts, in percentage points; the \
         intervals of a family of gaps hold together with 95 %. In bold, a gap is told apart from zero; “too few” starts differ \
         to tell any gap apart. The floor is the rate of a random policy.</p>\n",
    );
    let (start, mut left_out) = (html.len(), 0);
    for sheet in sheets {
        if html.len() - start > limits::STUDY_TABLE_BYTES {
            left_out += rows(sheet).count();
            continue;
        }
        let folded = rows(sheet).count() > OPEN_ROWS;
        let label = escape(&shorten(&sheet.label, limits::STUDY_NAME_CHARS));
        if folded {
            let summary = if label.is_empty() { "All conditions".to_owned() } else { label };
            let _ = writeln!(html, "<details>\n<summary>{summary}</summary>");
        } else if !label.is_empty() {
            let _ = writeln!(html, "<h3>{label}</h3>");
        }
        left_out += one(html, sheet, start + limits::STUDY_TABLE_BYTES);
        html.push_str(if folded { "</details>\n" } else { "" });
    }
    if left_out > 0 {
        let _ = writeln!(html, "<p class=\"note\">{left_out} more rows are in <code>table.csv</code>.</p>");
    }
    write_leaks(html, &results.rows);
    for family in results.families.iter().take(limits::FAMILIES) {
        let name = escape(&shorten(&family.name, limits::STUDY_NAME_CHARS));
        let _ = writeln!(html, "<p class=\"note\">{name}: {}.</p>", escape(&family.to_string()));
    }
    html.push_str("</section>\n");
}

/// Writes from which starts policies were evaluated that they were trained on, which says nothing about new starts.
fn write_leaks(html: &mut String, rows: &[StudyRow]) {
    let mut leaks: Vec<(&str, &str)> = vec![];
    for row in rows.iter().filter(|row| row.trained_on_starts == Some(true)) {
        let leak = (row.policy.as_str(), row.starts.as_str());
        if !leaks.contains(&leak) && leaks.len() < limits::FAMILIES {
            leaks.push(leak);
        }
    }
    for (policy, starts) in leaks {
        let [policy, starts] = [policy, starts].map(|name| escape(&shorten(name, limits::STUDY_NAME_CHARS)));
        let from = if starts.is_empty() { String::new() } else { format!(" from “{starts}”") };
        let _ = writeln!(html, "<p class=\"note\">{policy} was trained on the episodes of its starts{from}.</p>");
    }
}

/// The conditions and policies that have a row.
fn rows<'s>(sheet: &'s Sheet<'_>) -> impl Iterator<Item = [usize; 2]> + 's {
    (0..sheet.conditions.len()).flat_map(|i| sheet.policies_of(i).into_iter().map(move |j| [i, j]))
}

/// Writes the table of a sheet until the page has `most` bytes, and returns the number of rows that are left out.
fn one(html: &mut String, sheet: &Sheet<'_>, most: usize) -> usize {
    html.push_str(
        "<div class=\"wide stack study numbers\">\n<table>\n\
         <thead>\n<tr><th scope=\"col\">Condition</th><th scope=\"col\">Policy</th>",
    );
    for counting in &sheet.countings {
        let name = if sheet.countings.len() > 1 { format!(", {}", counting.name()) } else { String::new() };
        let _ = write!(
            html,
            "<th scope=\"col\" class=\"n\">Success{name}</th><th scope=\"col\" class=\"n\">Gap{name}</th>"
        );
    }
    html.push_str("<th scope=\"col\" class=\"n\">Episodes</th><th scope=\"col\" class=\"n\">Floor</th>");
    html.push_str("</tr>\n</thead>\n");
    let (mut left_out, mut last) = (0, None);
    for [condition, policy] in rows(sheet) {
        if html.len() > most {
            left_out += 1;
            continue;
        }
        if last != Some(condition) {
            html.push_str(if last.is_some() { "</tbody>\n<tbody>\n" } else { "<tbody>\n" });
        }
        html.push_str("<tr>");
        let shown = |name: &str| escape(&shorten(name, limits::STUDY_NAME_CHARS));
        if last != Some(condition) {
            let span = sheet.policies_of(condition).len();
            let name = shown(sheet.conditions[condition]);
            let _ = write!(html, "<th scope=\"rowgroup\" rowspan=\"{span}\">{name}</th>");
        }
        last = Some(condition);
        let of = sheet.policies[policy];
        let _ =
            write!(html, "<th scope=\"row\"><span class=\"swatch {}\"></span>{}</th>", of.ink.class(), shown(of.name));
        cells(html, sheet, condition, policy);
        html.push_str("</tr>\n");
    }
    html.push_str(if last.is_some() { "</tbody>\n</table>\n</div>\n" } else { "</table>\n</div>\n" });
    left_out
}

/// Writes the rates and gaps of every counting, then the numbers of episodes and the floors.
fn cells(html: &mut String, sheet: &Sheet<'_>, condition: usize, policy: usize) {
    let rows: Vec<Option<&StudyRow>> =
        (0..sheet.countings.len()).map(|counting| sheet.row(condition, policy, counting)).collect();
    let cell = |label: &str, words: &str| format!("<td data-label=\"{label}\">{words}</td>");
    let none = || NONE.to_owned();
    for (row, counting) in rows.iter().zip(&sheet.countings) {
        let name = if sheet.countings.len() > 1 { format!(", {}", counting.name()) } else { String::new() };
        html.push_str(&cell(&format!("Success{name}"), &row.map_or_else(none, |row| rate(&row.success))));
        let gap = row.and_then(|row| row.gap.as_ref()).map_or_else(none, gap);
        html.push_str(&cell(&format!("Gap{name}"), &gap));
    }
    let each = |of: &dyn Fn(&StudyRow) -> String| {
        let mut values: Vec<String> = rows.iter().map(|row| row.map_or_else(none, of)).collect();
        values.dedup();
        values.join(" / ")
    };
    let floor = |row: &StudyRow| if is_share(row.floor.rate) { percent(row.floor.rate) } else { none() };
    html.push_str(&cell("Episodes", &each(&|row| row.success.n.to_string())));
    html.push_str(&cell("Floor", &each(&floor)));
}

/// A success rate with its interval.
pub(super) fn rate(p: &Proportion) -> String {
    if p.n == 0 || ![p.rate, p.low, p.high].into_iter().all(is_share) {
        return NONE.to_owned();
    }
    format!("<b>{}</b> [{:.0}, {:.0}]", percent(p.rate), 100.0 * p.low, 100.0 * p.high)
}

/// A gap with its interval.
fn gap(gap: &Paired) -> String {
    if ![gap.difference, gap.low, gap.high].into_iter().all(|value| is_share(value.abs())) {
        return NONE.to_owned();
    }
    let words = format!("{} [{}, {}]", points(gap.difference), whole_points(gap.low), whole_points(gap.high));
    match gap.verdict {
        Verdict::Lower | Verdict::Higher => format!("<b>{words}</b>"),
        Verdict::NotToldApart => words,
        Verdict::TooFew => format!("{words} <span class=\"quiet\">too few</span>"),
    }
}

fn is_share(value: f64) -> bool {
    (0.0..=1.0).contains(&value)
}

/// A share in percent with one decimal, or a dash if it is none.
pub(super) fn share(value: f64) -> String {
    if is_share(value) { format!("{:.1}", 100.0 * value) } else { "–".to_owned() }
}
