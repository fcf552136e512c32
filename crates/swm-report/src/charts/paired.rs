//! Paired comparisons of policies on the same starts: the chart of the differences and the table of counts.

use super::svg::{ROW, Scale, Svg, WIDE};
use crate::group::{Group, Pair, Row};
use crate::text::{escape, p_value, points, shorten};
use std::fmt::Write as _;
use swm_core::results::{Family, Paired, Verdict};

/// The left edge of the plot area, right of the names, in pixels.
const LABELS: f64 = 340.0;

/// Draws differences of success rates with their confidence intervals, one row for each pair; `None` if no two policies
/// played the same starts.
pub(crate) fn chart(group: &Group<'_>) -> Option<String> {
    let pairs = pairs_by_condition(group);
    let all = || pairs.iter().flat_map(|(_, pairs)| pairs);
    let rows = all().count();
    if rows == 0 {
        return None;
    }
    let bottom = 8.0 + (pairs.len() + rows) as f64 * ROW;
    let right = WIDE - 250.0;
    let ends = || all().flat_map(|pair| [pair.table.low * 100.0, pair.table.high * 100.0]);
    let (low, high) = (ends().fold(0.0, f64::min), ends().fold(0.0, f64::max));
    let (scale, ticks) = Scale::nice(low, high, LABELS, right, 6);
    let mut svg = Svg::new(WIDE, bottom + 40.0);
    svg.x_axis(scale, &ticks, [8.0, bottom], "");
    svg.text("tick middle", [(LABELS + right) / 2.0, bottom + 34.0], "difference of success rates, percentage points");
    svg.line("zero", [scale.at(0.0), 8.0], [scale.at(0.0), bottom]);
    let mut y = 8.0;
    for (family, pairs) in &pairs {
        svg.text("head", [0.0, y + 21.0], &shorten(&family.name, 60));
        y += ROW;
        for pair in pairs {
            let Pair { a, b, table } = pair;
            let middle = y + ROW / 2.0;
            let names = format!("{} \u{2212} {}", shorten(&a.label, 22), shorten(&b.label, 22));
            svg.text("label end", [LABELS - 14.0, middle + 4.5], &names);
            let [low, high, at] = [table.low, table.high, table.difference].map(|fraction| scale.at(fraction * 100.0));
            let whisker = format!("whisker {}", a.class);
            svg.line(&whisker, [low, middle], [high, middle]);
            for x in [low, high] {
                svg.line(&whisker, [x, middle - 5.0], [x, middle + 5.0]);
            }
            svg.dot(&format!("point {}", a.class), [at, middle], 5.5, &words(pair));
            let [low, high] = [table.low, table.high].map(points);
            let value = format!("{} [{low}, {high}], {}", points(table.difference), table.verdict);
            svg.text("value", [right + 14.0, middle + 4.5], &value);
            y += ROW;
        }
    }
    let descriptions = all().map(words).collect::<Vec<_>>().join("; ");
    Some(svg.finish(&format!("Differences on the same starts: {descriptions}")))
}

/// The table of the counts from which the differences are computed, and what each family can show.
pub(crate) fn table(group: &Group<'_>) -> String {
    let mut html = "<div class=\"wide\" role=\"region\" aria-label=\"Paired comparisons\" tabindex=\"0\">\n<table>\n\
         <caption>The number of starts that both, one or neither of the policies solved. Only starts that exactly one \
         policy solved show a difference between the policies.</caption>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy A</th><th scope=\"col\">Policy B</th>\
         <th scope=\"col\" class=\"n\">Both</th><th scope=\"col\" class=\"n\">Only A</th>\
         <th scope=\"col\" class=\"n\">Only B</th><th scope=\"col\" class=\"n\">Neither</th>\
         <th scope=\"col\" class=\"n\">p, corrected</th>\
         <th scope=\"col\">Verdict on A</th></tr>\n</thead>\n"
        .to_owned();
    let families = pairs_by_condition(group);
    for (family, pairs) in &families {
        html.push_str("<tbody>\n");
        for (i, Pair { a, b, table }) in pairs.iter().enumerate() {
            html.push_str("<tr>");
            if i == 0 {
                let (rows, name) = (pairs.len(), escape(&family.name));
                let _ = write!(html, "<th scope=\"rowgroup\" rowspan=\"{rows}\">{name}</th>");
            }
            let Paired { both, only_a, only_b, neither, verdict, .. } = table;
            let name = |row: &Row<'_>| format!("<span class=\"swatch {}\"></span>{}", row.class, escape(&row.label));
            let p = p_value(table.p_corrected());
            let p = p.strip_prefix("p\u{a0}=\u{a0}").unwrap_or(p.trim_start_matches("p\u{a0}"));
            let _ = writeln!(
                html,
                "<th scope=\"row\">{}</th><td>{}</td><td class=\"n\">{both}</td><td class=\"n\"><b>{only_a}</b></td>\
                 <td class=\"n\"><b>{only_b}</b></td><td class=\"n\">{neither}</td><td class=\"n\">{}</td>\
                 <td>{verdict}</td></tr>",
                name(a),
                name(b),
                escape(p)
            );
        }
        html.push_str("</tbody>\n");
    }
    html.push_str("</table>\n</div>\n");
    for (family, _) in &families {
        let _ = writeln!(html, "<p class=\"note\">{}: {family}.</p>", escape(&family.name));
    }
    html
}

/// Every pair of policies, by condition, without conditions that have no pairs.
fn pairs_by_condition<'g, 'a>(group: &'g Group<'a>) -> Vec<(Family, Vec<Pair<'g, 'a>>)> {
    group.conditions.iter().filter_map(|condition| condition.pairs(group.counting)).collect()
}

/// A comparison as a sentence.
fn words(pair: &Pair<'_, '_>) -> String {
    let Pair { a, b, table } = pair;
    format!(
        "{} minus {}: {} percentage points, 95 % confidence interval {} to {}, {}",
        a.label,
        b.label,
        points(table.difference),
        points(table.low),
        points(table.high),
        match table.verdict {
            Verdict::TooFew => "too few starts differ to tell them apart".to_owned(),
            verdict => verdict.to_string(),
        }
    )
}
