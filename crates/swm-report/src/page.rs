//! The page: its sections in reading order, and the writing of it.

use crate::group::{Condition, Group, Row};
use crate::read::Metrics;
use crate::text::{duration, escape, number, p_value, percent};
use crate::{films, paired, plots, prediction, read_metrics, searches};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::results::{Comparison, Counting};
use swm_core::{Error, Manifest, Result, Results};

/// Looks, light and dark, on screens and paper.
const STYLE: &str = include_str!("style.css");
/// Curves of a training log that are shown; losses come first.
const CURVES: usize = 8;

/// Metrics that say how fast a training went, which is no business of a page about how well.
const CLOCKS: [&str; 3] = ["seconds", "clips_per_second", "data_wait"];

/// What a page says beyond its results.
#[derive(Clone, Debug, Default)]
pub struct ReportOptions {
    /// The headline; without one the environments are named.
    pub title: Option<String>,
    /// A training log (`train.jsonl`) whose curves are shown.
    pub metrics: Option<PathBuf>,
    /// The command that makes the results again; without one `command` in the manifest's configuration is
    /// shown, where it is there.
    pub command: Option<String>,
}

/// Writes the page of these result files to `out_dir/index.html` and returns its path. Videos are looked up
/// beside the results file that names them.
///
/// # Errors
/// When there are no results, or the page cannot be written.
pub fn write_report(results: &[(PathBuf, Results)], out_dir: &Path) -> Result<PathBuf> {
    write_report_with(results, &ReportOptions::default(), out_dir)
}

/// As [`write_report`], with a headline, training curves, or a command to show.
///
/// # Errors
/// As [`write_report`], and when the training log cannot be read.
pub fn write_report_with(results: &[(PathBuf, Results)], options: &ReportOptions, out_dir: &Path) -> Result<PathBuf> {
    if results.is_empty() {
        return Err(Error::config("report", "there are no results to report", "give at least one results.json"));
    }
    let metrics = options.metrics.as_deref().map(read_metrics).transpose()?;
    let page = render(results, options, metrics.as_ref());
    std::fs::create_dir_all(out_dir).map_err(|source| Error::io(out_dir, "making the report's folder", source))?;
    let path = out_dir.join("index.html");
    let partial = out_dir.join(format!(".index.html.{}.partial", std::process::id()));
    let written = std::fs::write(&partial, page).and_then(|()| std::fs::rename(&partial, &path));
    written.map_err(|source| {
        // Whatever is left of it is of no use; the first error is the one to tell.
        let _ = std::fs::remove_file(&partial);
        Error::io(&path, "writing the report", source)
    })?;
    Ok(path)
}

/// The page as text; `metrics` takes the place of the log that `options` names.
pub fn render(results: &[(PathBuf, Results)], options: &ReportOptions, metrics: Option<&Metrics>) -> String {
    let groups = Group::all(results);
    let mut envs: Vec<&str> = vec![];
    for group in &groups {
        if !envs.contains(&group.env) {
            envs.push(group.env);
        }
    }
    let title = options.title.clone().unwrap_or_else(|| format!("Evaluation in {}", envs.join(", ")));
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; \
         img-src data:; media-src data:\"/>\n<link rel=\"icon\" href=\"data:,\"/>\n\
         <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<header>\n\
         <p class=\"eyebrow\">stable-worldmodel</p>\n<h1>{title}</h1>\n<p class=\"lede\">{}</p>\n</header>\n<main>\n",
        facts(results),
        title = escape(&title),
    );
    for group in &groups {
        group_section(&mut html, group, results, groups.len() > 1);
    }
    if let Some(metrics) = metrics {
        training_section(&mut html, metrics);
    }
    provenance_section(&mut html, results, options);
    let _ = write!(
        html,
        "</main>\n<footer>Written by stable-worldmodel {}. This page holds everything it shows: no script, no \
         network.</footer>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION")
    );
    html
}

/// What all results share, in a line.
fn facts(results: &[(PathBuf, Results)]) -> String {
    let shared = |of: fn(&Results) -> String| {
        let mut values: Vec<String> = results.iter().map(|(_, r)| of(r)).collect();
        values.sort();
        values.dedup();
        escape(&values.join(", "))
    };
    let runs: usize = results.iter().map(|(_, r)| r.runs.len()).sum();
    let episodes: usize = results.iter().flat_map(|(_, r)| &r.runs).map(|run| run.episodes.len()).sum();
    format!(
        "{} protocol · counting: {} · {runs} runs, {episodes} episodes · seed {} · {}",
        shared(|r| r.protocol.clone()),
        shared(|r| r.counting.to_string()),
        shared(|r| r.manifest.seed.to_string()),
        shared(|r| r.manifest.device.clone())
    )
}

fn group_section(html: &mut String, group: &Group<'_>, results: &[(PathBuf, Results)], several: bool) {
    let _ = write!(html, "<section>\n<h2>{}</h2>\n", if several { group.title() } else { "Success".to_owned() });
    if group.rows().next().is_none() {
        html.push_str("<p class=\"note\">These results hold no run.</p>\n</section>\n");
        return;
    }
    html.push_str("<div class=\"cards\">\n");
    for condition in &group.conditions {
        for row in condition.rows.iter().filter(|row| row.class.starts_with('c')) {
            card(html, group, condition, row);
        }
    }
    html.push_str("</div>\n");
    let _ = writeln!(html, "<p class=\"note\">{}</p>", counting_words(group));
    figure(
        html,
        "Success rates",
        "Points are success rates, whiskers their 95 % Wilson intervals. The band is the interval of the random \
         policy under the same condition, the dashed line its rate: the floor that a model has to clear.",
        &plots::success(group),
    );
    table(html, group);
    if let Some(plot) = paired::plot(group) {
        figure(
            html,
            "On the same starts",
            "Points are differences of success rates over starts that both played, whiskers their 95 % intervals \
             (Newcombe’s square-and-add), p-values those of McNemar’s exact test. They are not corrected for how many pairs \
             there are.",
            &plot,
        );
        html.push_str(&paired::table(group));
    }
    let longest = group.rows().flat_map(|row| &row.run.episodes).map(|episode| episode.steps).max().unwrap_or(0);
    if longest > 0 {
        let curves: String =
            group.conditions.iter().map(|condition| plots::progress(condition, group.counting, longest)).collect();
        figure(
            html,
            "Time to goal",
            "The share of the episodes that count that had reached the goal after so many steps.",
            &format!("<div class=\"pair\">\n{curves}</div>\n{}", legend(group)),
        );
        figure(
            html,
            "Every episode",
            "One square an episode, in order: filled where the goal was reached, hollow where it was not, a faint \
             square where the start already satisfied it.",
            &plots::episodes(group),
        );
    }
    if let Some(plot) = plots::latency(group) {
        figure(
            html,
            "Planning latency",
            "How long one planning call took: the bar ends at the median, the whisker at the 95th percentile; both are \
             written beside it.",
            &plot,
        );
    }
    let traced: String = group.conditions.iter().map(searches::plots).collect();
    if !traced.is_empty() {
        figure(
            html,
            "Searches",
            "How plans came about: lines are medians over all plans of a run, bands reach from the 10th to the 90th \
             percentile. A search whose cost still falls at the end was cut short; one whose spread is gone long before \
             wasted its last iterations.",
            &format!("<div class=\"pair\">\n{traced}</div>\n"),
        );
    }
    let predicted: String = group.conditions.iter().map(prediction::plots).collect();
    if !predicted.is_empty() {
        figure(
            html,
            "Prediction errors",
            "Mean squared errors of latents predicted open loop along recorded trajectories, in units of the latents’ \
             variance: 1 is the error of always predicting the mean. Apart for starts that were solved and starts that were \
             not; dots are medians.",
            &format!("<div class=\"pair\">\n{predicted}</div>\n"),
        );
    }
    let videos: String = group
        .rows()
        .map(|row| films::figures(row.run, results[row.file].0.parent().unwrap_or_else(|| Path::new(""))))
        .collect();
    if !videos.is_empty() {
        let _ = write!(
            html,
            "<h3>Videos</h3>\n<p class=\"note\">The agent on the left, the goal on the right.</p>\n\
             <div class=\"films\">\n{videos}</div>\n"
        );
    }
    html.push_str("</section>\n");
}

/// How episodes were counted, in a sentence or two.
fn counting_words(group: &Group<'_>) -> String {
    // Every policy of a condition met the same ones.
    let most = |condition: &Condition<'_>| condition.rows.iter().map(|row| row.run.solved_at_start).max();
    let solved: usize = group.conditions.iter().filter_map(most).sum();
    match group.counting {
        Counting::Strict { hold } => {
            let held = match hold {
                1 => "at the first step that satisfies the goal".to_owned(),
                _ => format!("once the goal was satisfied for {hold} steps in a row"),
            };
            let left = match solved {
                0 => "No start was solved already.".to_owned(),
                1 => "One start was solved already; it was not played and does not count.".to_owned(),
                _ => format!("{solved} starts were solved already; they were not played and do not count."),
            };
            format!("Strict counting: an episode succeeds {held}. {left}")
        }
        Counting::Compat { envs } => {
            let first = match group.protocol {
                "episodic" => format!(
                    " The first to finish of {envs} environments side by side count, so policies need not play the same \
                     starts; only those that do are compared start by start."
                ),
                _ => String::new(),
            };
            format!(
                "Compat counting, as the Python package stable-worldmodel counts: every start counts, solved \
                 already or not ({solved} were), and an episode succeeds when the world terminates.{first}"
            )
        }
    }
}

/// The finding of one policy under one condition, beside its floor: on the same starts where both played these, else by
/// their intervals.
fn card(html: &mut String, group: &Group<'_>, condition: &Condition<'_>, row: &Row<'_>) {
    let p = row.run.success;
    let floor = condition.floor_of(row);
    let paired = floor.and_then(|floor| Comparison::of(row.run, floor.run, group.counting)).map(|found| found.table);
    let verdict = match (floor.map(|floor| floor.run.success), paired) {
        (None, _) => ("unknown", "no random floor was measured".to_owned()),
        (Some(floor), _) if p.n == 0 || floor.n == 0 => ("unknown", "no episode counted".to_owned()),
        (Some(floor), paired) => {
            let (above, below) = match paired {
                Some(table) => (table.p < 0.05 && table.difference > 0.0, table.p < 0.05 && table.difference < 0.0),
                None => (p.low > floor.high, p.high < floor.low),
            };
            let (class, words) = match (above, below) {
                (true, _) => ("above", "above"),
                (_, true) => ("below", "below"),
                _ => ("within", "not told apart from"),
            };
            let test = paired.map_or(String::new(), |table| format!(" ({})", p_value(table.p)));
            (class, format!("{words} the random floor of {}{}", percent(floor.rate), escape(&test)))
        }
    };
    let _ = write!(
        html,
        "<div class=\"card\">\n<p class=\"what\"><span class=\"swatch {}\"></span>{} · {}</p>\n\
         <p class=\"big\">{}</p>\n<p class=\"range\">95 % interval {} to {}</p>\n<p class=\"verdict {}\">{}</p>\n</div>\n",
        row.class,
        escape(&row.label),
        escape(condition.name),
        if p.n == 0 { "–".to_owned() } else { percent(p.rate) },
        percent(p.low),
        percent(p.high),
        verdict.0,
        verdict.1
    );
}

fn figure(html: &mut String, heading: &str, caption: &str, content: &str) {
    let _ = write!(
        html,
        "<figure class=\"plot\">\n<h3>{heading}</h3>\n<div class=\"wide\">\n{content}</div>\n\
         <figcaption>{caption}</figcaption>\n</figure>\n"
    );
}

/// Which line is whose, once for all conditions.
fn legend(group: &Group<'_>) -> String {
    let mut seen: Vec<(&str, &str)> = vec![];
    for row in group.rows() {
        if !seen.contains(&(&row.class, &row.run.policy)) {
            seen.push((&row.class, &row.run.policy));
        }
    }
    let mut html = "<ul class=\"legend\">\n".to_owned();
    for (class, policy) in seen {
        let _ = writeln!(
            html,
            "<li><svg viewBox=\"0 0 28 8\" width=\"28\" height=\"8\" aria-hidden=\"true\"><line class=\"curve {class}\" \
             x1=\"0\" y1=\"4\" x2=\"28\" y2=\"4\"/></svg> {}</li>",
            escape(policy)
        );
    }
    html.push_str("</ul>\n");
    html
}

fn table(html: &mut String, group: &Group<'_>) {
    html.push_str(
        "<div class=\"wide\" role=\"region\" aria-label=\"All runs\" tabindex=\"0\">\n<table>\n\
         <caption>All runs. Time to goal and latency: median (95th percentile).</caption>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy</th><th scope=\"col\" class=\"n\">Success</th>\
         <th scope=\"col\" class=\"n\">95 % interval</th><th scope=\"col\" class=\"n\">Episodes</th>\
         <th scope=\"col\" class=\"n\">Solved at start</th><th scope=\"col\" class=\"n\">Steps to goal</th>\
         <th scope=\"col\" class=\"n\">Plan latency</th><th scope=\"col\" class=\"n\">Wall time</th></tr>\n</thead>\n",
    );
    for condition in &group.conditions {
        html.push_str("<tbody>\n");
        for (i, row) in condition.rows.iter().enumerate() {
            html.push_str("<tr>");
            if i == 0 {
                let (rows, name) = (condition.rows.len(), escape(condition.name));
                let _ = write!(html, "<th scope=\"rowgroup\" rowspan=\"{rows}\">{name}</th>");
            }
            cells(html, row);
            html.push_str("</tr>\n");
        }
        html.push_str("</tbody>\n");
    }
    html.push_str("</table>\n</div>\n");
}

fn cells(html: &mut String, row: &Row<'_>) {
    let (run, p) = (row.run, row.run.success);
    const NONE: &str = "<span class=\"quiet\">–</span>";
    // Where compat counting ran, what strict counting makes of the same episodes is beside it.
    let strict =
        run.strict.map_or(String::new(), |p| format!("<br/><span class=\"quiet\">strict {}</span>", percent(p.rate)));
    let rate = if p.n == 0 { NONE.to_owned() } else { format!("<b>{}</b>{strict}", percent(p.rate)) };
    let steps = run.time_to_goal.map(|s| format!("{} ({})", number(s.median), number(s.p95)));
    let latency = run.timing.plan_seconds.map(|s| format!("{} ({})", duration(s.median), duration(s.p95)));
    let _ = write!(
        html,
        "<th scope=\"row\"><span class=\"swatch {}\"></span>{}</th><td class=\"n\">{rate}</td>\
         <td class=\"n\">{:.1} – {}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>\
         <td class=\"n\">{}</td><td class=\"n\">{}</td>",
        row.class,
        escape(&row.label),
        p.low * 100.0,
        percent(p.high),
        p.n,
        run.solved_at_start,
        steps.as_deref().unwrap_or(NONE),
        latency.as_deref().unwrap_or(NONE),
        // A run that was not timed has a wall time of 0.
        if run.timing.wall_seconds > 0.0 { duration(run.timing.wall_seconds) } else { NONE.to_owned() }
    );
}

fn training_section(html: &mut String, metrics: &Metrics) {
    let mut series: Vec<_> = metrics.series.iter().filter(|series| !CLOCKS.contains(&series.name.as_str())).collect();
    series.sort_by_key(|series| (!series.name.contains("loss"), series.name.clone()));
    let curves: Vec<String> =
        series.into_iter().filter_map(|series| plots::training(metrics, series)).take(CURVES).collect();
    html.push_str("<section>\n<h2>Training</h2>\n");
    if curves.is_empty() {
        html.push_str("<p class=\"note\">The training log holds no metric with two points or more.</p>\n");
    } else {
        let caption =
            "Means over neighbouring points where the log is long; the last value is written above its curve.";
        figure(html, "Metrics", caption, &format!("<div class=\"pair\">\n{}</div>\n", curves.concat()));
    }
    html.push_str("</section>\n");
}

fn provenance_section(html: &mut String, results: &[(PathBuf, Results)], options: &ReportOptions) {
    html.push_str("<section>\n<h2>Provenance</h2>\n");
    if let Some(command) = &options.command {
        let _ = write!(html, "<p>The command that makes these results again:</p>\n<pre>{}</pre>\n", escape(command));
    }
    for (i, (path, result)) in results.iter().enumerate() {
        let number = if results.len() > 1 { format!("[{}] ", i + 1) } else { String::new() };
        let _ = writeln!(html, "<h3>{number}<code>{}</code></h3>", escape(&short_path(path)));
        let config = &result.manifest.config;
        let told = config.get("command").and_then(serde_json::Value::as_str).map(str::to_owned);
        // A request of a known layout is all that is needed.
        let again = config.get("version").map(|_| format!("swm reproduce {}", short_path(path)));
        match (told.or(again), &options.command) {
            (Some(command), None) => {
                let _ = write!(
                    html,
                    "<p>The command that makes it again and says what differs:</p>\n<pre>{}</pre>\n",
                    escape(&command)
                );
            }
            (None, None) => html.push_str(
                "<p class=\"note\">The configuration below, with these versions and hashes, decides every number but \
                 the times.</p>\n",
            ),
            (_, Some(_)) => {}
        }
        manifest(html, &result.manifest);
    }
    html.push_str("</section>\n");
}

/// The file and its folder: enough to tell files apart, and silent about whose machine it was.
fn short_path(path: &Path) -> String {
    let parts: Vec<_> = path.components().rev().take(2).collect();
    parts.into_iter().rev().collect::<PathBuf>().display().to_string()
}

fn manifest(html: &mut String, manifest: &Manifest) {
    html.push_str("<dl>\n");
    let mut entry = |name: &str, value: &str, class: &str| {
        let _ = writeln!(html, "<div><dt>{}</dt><dd{class}>{}</dd></div>", escape(name), escape(value));
    };
    entry("made by", &manifest.kind, "");
    entry("stable-worldmodel", &manifest.swm_version, "");
    entry("seed", &manifest.seed.to_string(), "");
    entry("device", &manifest.device, "");
    for (library, version) in &manifest.libraries {
        entry(library, version, "");
    }
    for (what, hash) in &manifest.hashes {
        entry(&format!("{what} (BLAKE3)"), hash, " class=\"hash\"");
    }
    html.push_str("</dl>\n");
    if !manifest.config.is_null() {
        // Pretty-printing a JSON value cannot fail; its compact form is there all the same.
        let config = serde_json::to_string_pretty(&manifest.config).unwrap_or_else(|_| manifest.config.to_string());
        let _ =
            write!(html, "<details>\n<summary>Configuration</summary>\n<pre>{}</pre>\n</details>\n", escape(&config));
    }
}
