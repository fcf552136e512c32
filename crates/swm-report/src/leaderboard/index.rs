//! The page of all tables.

use super::moves::{self, Move, range};
use super::{BoardRow, BoardTable, Leaderboard, STYLE, name};
use crate::charts;
use crate::group::{Condition, Group, Row, Task};
use crate::limits;
use crate::page::{Head, document};
use crate::plot::Ink;
use crate::text::{duration, escape, number, percent, shorten};
use std::fmt::Write as _;
use swm_core::results::{Counting, Proportion, Rank, Ranking, Run};
use swm_core::{Error, Result};

const NONE: &str = "<span class=\"quiet\">–</span>";
/// The column of a time that no verification covers.
const LATENCY: &str = "Planning latency (stated)";

/// Renders the page, with what moved since the last build.
///
/// # Errors
/// When a table has too many entries to compare, or drawing a chart fails.
pub(super) fn render(board: &Leaderboard, moves: &[Move]) -> Result<String> {
    let (entries, tables) = (board.entries.len(), board.tables.len());
    let counted = |n: usize, one: &str, many: &str| format!("{n} {}", if n == 1 { one } else { many });
    let mut envs: Vec<&str> = board.tables.iter().map(|table| table.env.as_str()).collect();
    envs.dedup();
    let lede = format!(
        "{} in {} and {}. Everybody can play their episodes again.",
        counted(entries, "entry", "entries"),
        counted(tables, "table", "tables"),
        counted(envs.len(), "environment", "environments"),
    );
    let title = shorten(&board.title, limits::TEXT_CHARS);
    document(&Head { title: &title, lede: &lede, style: STYLE }, |html| {
        html.push_str(HOW);
        moves::write(html, moves);
        if envs.len() > 1 {
            html.push_str("<ul>\n");
            for (i, env) in envs.iter().enumerate() {
                let _ = writeln!(html, "<li><a href=\"#env-{i}\">{}</a></li>", name(env));
            }
            html.push_str("</ul>\n");
        }
        let mut last = None;
        for (i, table) in board.tables.iter().enumerate() {
            if html.len() > limits::LEADERBOARD_BYTES {
                let _ = writeln!(html, "<p class=\"note\">The page has no room for {} more tables.</p>", tables - i);
                break;
            }
            if last != Some(&table.env) {
                let at = envs.iter().position(|env| *env == table.env).unwrap_or_default();
                let _ = writeln!(html, "<h2 id=\"env-{at}\">{}</h2>", name(&table.env));
                last = Some(&table.env);
            }
            write_table(html, board, table)?;
        }
        Ok(())
    })
}

/// What ranks mean, above all tables.
const HOW: &str = "<p>A rank is a range: it begins behind the entries that are told apart as better, and ends before those that are \
                   told apart as worse, by paired comparisons on the same starts. All ranks of a table hold together with a \
                   probability of 95 %. Policies without weights have no rank: the random-policy floor says what chance \
                   solves, and the other baselines what needs no model.</p>\n";

/// A row with its rank; `None` for a baseline.
struct Ranked<'a> {
    row: &'a BoardRow,
    rank: Option<Rank>,
    ink: Ink,
}

fn write_table(html: &mut String, board: &Leaderboard, table: &BoardTable) -> Result<()> {
    if table.rows.len() > limits::LEADERBOARD_ROWS {
        let problem = format!("{} entries of {} under one condition", table.rows.len(), table.env);
        let fix = format!("build several leaderboards of at most {} each", limits::LEADERBOARD_ROWS);
        return Err(Error::config("leaderboard", problem, fix));
    }
    let runs: Vec<&Run> = table.rows.iter().map(|row| &row.run).collect();
    let Ranking { ranks, family } = Ranking::of(&runs, table.counting);
    let mut rows: Vec<(&BoardRow, Rank)> = table.rows.iter().zip(ranks).collect();
    // Stable: equal rates stay in the order of the entries.
    rows.sort_by(|(a, _), (b, _)| b.run.success.rate.total_cmp(&a.run.success.rate));
    let mut ranked: Vec<Ranked<'_>> = vec![];
    for (row, rank) in rows {
        // A policy has one colour in the whole page.
        ranked.push(Ranked { row, rank: Some(rank), ink: Ink::Policy(row.entry.unwrap_or_default()) });
    }
    let ink = |row: &BoardRow| match row.run.policy.as_str() {
        "random" => Ink::Floor,
        "expert" => Ink::Expert,
        _ => Ink::Soft,
    };
    ranked.extend(table.baselines.iter().map(|row| Ranked { row, rank: None, ink: ink(row) }));

    let _ = writeln!(html, "<section>\n<h3>{}</h3>", name(&table.condition));
    let facts = table.task.iter().map(|(term, value)| format!("{}: {}", escape(term), name(value)));
    let _ = writeln!(html, "<p class=\"facts\">{}</p>", facts.collect::<Vec<_>>().join(" · "));
    write_rows(html, board, &ranked);
    let sentence = match family {
        Some(family) => format!("{family}."),
        None => "Nothing to compare with yet.".to_owned(),
    };
    let _ = writeln!(html, "<p class=\"note\">{}</p>", escape(&sentence));
    write_chart(html, table, &ranked)?;
    html.push_str("</section>\n");
    Ok(())
}

fn write_rows(html: &mut String, board: &Leaderboard, rows: &[Ranked<'_>]) {
    html.push_str("<div class=\"wide stack board\">\n<table>\n<thead>\n<tr>");
    for (column, class) in [
        ("Policy", ""),
        ("Rank", ""),
        ("Success rate", " class=\"n\""),
        ("Episodes", " class=\"n\""),
        ("Time to goal", " class=\"n\""),
        (LATENCY, " class=\"n\""),
        ("Author", ""),
        ("Licence", ""),
    ] {
        let _ = write!(html, "<th scope=\"col\"{class}>{column}</th>");
    }
    html.push_str("</tr>\n</thead>\n<tbody>\n");
    for Ranked { row, rank, ink } in rows {
        let entry = row.entry.and_then(|entry| board.entries.get(entry));
        let label = name(&row.label);
        let label = match entry {
            Some(entry) => format!("<a href=\"entries/{}.html\">{label}</a>", entry.page),
            None => label,
        };
        let class = if rank.is_some() { "" } else { " class=\"baseline\"" };
        let _ = write!(html, "<tr{class}><th scope=\"row\"><span class=\"swatch {}\"></span>{label}</th>", ink.class());
        let mut cell = |label: &str, class: &str, words: &str| {
            let _ = write!(html, "<td class=\"{class}\" data-label=\"{label}\">{words}</td>");
        };
        cell("Rank", "rank", &rank.map_or_else(|| NONE.to_owned(), range));
        cell("Success rate", "n", &rate(&row.run.success));
        cell("Episodes", "n", &row.run.success.n.to_string());
        let steps = row.run.time_to_goal.map(|steps| number(steps.median));
        cell("Time to goal", "n", steps.as_deref().unwrap_or(NONE));
        let latency = row.run.timing.plan_seconds.map(|seconds| duration(seconds.median));
        cell(LATENCY, "n", latency.as_deref().unwrap_or(NONE));
        cell("Author", "", &entry.map_or_else(|| NONE.to_owned(), |entry| name(&entry.author)));
        cell("Licence", "", &entry.map_or_else(|| NONE.to_owned(), |entry| name(&entry.licence)));
        html.push_str("</tr>\n");
    }
    html.push_str(
        "</tbody>\n<caption>Success rates with their 95 % Wilson intervals; time to goal in steps and planning latency: \
         medians. No verification covers the latency: it is stated by the submitter, and no rank depends on it.</caption>\n</table>\n</div>\n",
    );
}

/// A rank: one number if nothing else is possible.
fn rate(p: &Proportion) -> String {
    if p.n == 0 {
        return NONE.to_owned();
    }
    format!("<b>{}</b><span class=\"interval\">[{:.0}, {:.0}]</span>", percent(p.rate), 100.0 * p.low, 100.0 * p.high)
}

/// Draws the success rates of a table.
fn write_chart(html: &mut String, table: &BoardTable, rows: &[Ranked<'_>]) -> Result<()> {
    let group = Group {
        env: &table.env,
        protocol: "",
        counting: Counting::default(),
        task: Task::default(),
        has_twin: false,
        stopped: vec![],
        conditions: vec![Condition { name: "", rows: rows_to_draw(rows).map(chart_row).collect() }],
    };
    let chart = charts::success::chart(&group)?;
    let _ = write!(
        html,
        "<figure class=\"plot\">\n{chart}<figcaption>Points are success rates, whiskers their 95 % Wilson intervals. The band is \
         the interval of the random-policy floor.</figcaption>\n</figure>\n"
    );
    Ok(())
}

fn chart_row<'a>(ranked: &Ranked<'a>) -> Row<'a> {
    let label = shorten(&ranked.row.label, super::NAME_CHARS);
    Row { run: &ranked.row.run, file: 0, label, ink: ranked.ink }
}

/// The rows of a chart, the random-policy floor first, whose interval is the band.
fn rows_to_draw<'a, 'b>(rows: &'a [Ranked<'b>]) -> impl Iterator<Item = &'a Ranked<'b>> {
    let is_floor = |row: &&Ranked<'_>| row.ink == Ink::Floor;
    rows.iter().filter(is_floor).chain(rows.iter().filter(move |row| !is_floor(row)))
}
