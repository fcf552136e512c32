//! Comparisons on the same starts: policies with each other, and shifted conditions with the condition in distribution.

use super::Room;
use crate::charts;
use crate::gap::Gaps;
use crate::group::{Compared, Pair, Row};
use crate::limits;
use crate::text::{escape, p_value, shorten};
use std::fmt::Write as _;
use swm_core::Result;
use swm_core::results::{Family, MAX_ALL_PAIRS, Paired};

/// Writes the comparisons of policies: those with the floor and with the best run first, the others folded.
///
/// # Errors
/// When drawing fails.
pub(super) fn write(html: &mut String, compared: &[Compared<'_, '_>], room: &mut Room) -> Result<()> {
    let Some(chart) = charts::paired::chart(compared, |pair| pair.is_first)? else { return Ok(()) };
    let limited = compared.iter().any(|family| family.pairs.len() > MAX_ALL_PAIRS * (MAX_ALL_PAIRS - 1) / 2);
    let is_sequential = compared.iter().any(|compared| compared.family.sequential);
    let limit = format!(" With more than {MAX_ALL_PAIRS} runs, there are no others.");
    let caption = format!(
        "Points are differences of success rates over starts that both policies played, whiskers their confidence \
         intervals ({}). The intervals of one condition hold together \
         with 95 %: intervals and p-values are corrected for the number of pairs (Bonferroni). A policy is higher or \
         lower where the interval excludes 0, and its dot is filled. “Too few” means that the starts which exactly one policy \
         solved would not decide even if the same policy had solved all of them. The chart has the comparisons with the \
         random-policy floor and with the highest success rate.{}",
        if is_sequential {
            "confidence sequences, where the e-value of the pairs that differ decides"
        } else {
            "Tango’s, the inversion of the paired score test"
        },
        if limited { limit.as_str() } else { "" }
    );
    room.figure(html, "On the same starts", &caption, &chart);
    let others = compared.iter().flat_map(|family| &family.pairs).filter(|pair| !pair.is_first).count();
    if let Some(chart) = charts::paired::chart(compared, |pair| !pair.is_first)? {
        let what =
            if others == 1 { "The other comparison".to_owned() } else { format!("The other {others} comparisons") };
        let _ = write!(html, "<details>\n<summary>{what}</summary>\n");
        room.figure(html, &what, "Differences as above.", &chart);
        html.push_str("</details>\n");
    }
    table(html, compared, room);
    notes(html, compared.iter().map(|compared| &compared.family));
    Ok(())
}

/// Writes the generalisation gaps; nothing without a shift.
///
/// # Errors
/// When drawing fails.
pub(super) fn gaps(html: &mut String, policies: &[Gaps<'_, '_>], room: &mut Room) -> Result<()> {
    let Some(chart) = charts::gaps::chart(policies)? else { return Ok(()) };
    let caption = "The success rate of a policy under a shift minus its success rate in distribution, over the same starts, \
                   with confidence intervals as in comparisons of policies. The intervals of one policy hold together with \
                   95 %. A filled dot is told apart from zero.";
    room.figure(html, "Generalisation gap", caption, &chart);
    notes(html, policies.iter().map(|gaps| &gaps.family));
    Ok(())
}

/// Writes what each family can show.
fn notes<'f>(html: &mut String, families: impl Iterator<Item = &'f Family>) {
    for family in families.take(limits::SENTENCES) {
        let name = escape(&shorten(&family.name, limits::TEXT_CHARS));
        let _ = writeln!(html, "<p class=\"note\">{name}: {family}.</p>");
    }
}

/// Writes the folded table of the counts from which the differences are computed.
fn table(html: &mut String, families: &[Compared<'_, '_>], room: &mut Room) {
    html.push_str(
        "<details>\n<summary>Counts of all comparisons</summary>\n<div class=\"wide stack\">\n<table>\n\
         <caption>The number of starts that both, one or neither of the policies solved. Only starts that exactly one \
         policy solved show a difference between the policies.</caption>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy A</th><th scope=\"col\">Policy B</th>\
         <th scope=\"col\" class=\"n\">Both</th><th scope=\"col\" class=\"n\">Only A</th>\
         <th scope=\"col\" class=\"n\">Only B</th><th scope=\"col\" class=\"n\">Neither</th>\
         <th scope=\"col\" class=\"n\">p, corrected</th>\
         <th scope=\"col\">Verdict on A</th></tr>\n</thead>\n",
    );
    let mut left_out = 0;
    for Compared { family, pairs } in families {
        let (mut body, mut written) = (String::new(), 0);
        for pair in pairs {
            written += usize::from(room.row(&mut body, &counts(pair)));
        }
        left_out += pairs.len() - written;
        if written > 0 {
            let name = escape(&shorten(&family.name, limits::TEXT_CHARS));
            let head = format!("<tr><th scope=\"rowgroup\" rowspan=\"{written}\">{name}</th>");
            let _ = write!(html, "<tbody>\n{}</tbody>\n", body.replacen("<tr>", &head, 1));
        }
    }
    html.push_str("</table>\n</div>\n");
    if left_out > 0 {
        let _ = writeln!(html, "<p class=\"note\">{left_out} more comparisons are in the results files.</p>");
    }
    html.push_str("</details>\n");
}

/// The row of a comparison, without its condition.
fn counts(Pair { a, b, table, .. }: &Pair<'_, '_>) -> String {
    let Paired { both, only_a, only_b, neither, verdict, .. } = table;
    let name = |row: &Row<'_>| {
        let label = escape(&shorten(&row.label, limits::TEXT_CHARS));
        format!("<span class=\"swatch {}\"></span>{label}", row.ink.class())
    };
    let p = p_value(table.p_corrected());
    let p = p.strip_prefix("p\u{a0}=\u{a0}").unwrap_or(p.trim_start_matches("p\u{a0}"));
    format!(
        "<tr><th scope=\"row\">{}</th><td data-label=\"Policy B\">{}</td><td class=\"n\" data-label=\"Both\">{both}</td>\
         <td class=\"n\" data-label=\"Only A\"><b>{only_a}</b></td><td class=\"n\" data-label=\"Only B\"><b>{only_b}</b></td>\
         <td class=\"n\" data-label=\"Neither\">{neither}</td><td class=\"n\" data-label=\"p, corrected\">{}</td>\
         <td data-label=\"Verdict on A\">{verdict}</td></tr>\n",
        name(a),
        name(b),
        escape(p)
    )
}
