//! The page: renders all sections in reading order and writes the file.

use crate::group::Group;
use crate::limits;
use crate::sections;
use crate::text::escape;
use crate::training_log::{Metrics, read_metrics};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, Results, files};

/// The style sheet, for light and dark screens and for print.
const STYLE: &str = include_str!("style.css");

/// Options of a page.
#[derive(Clone, Debug, Default)]
pub struct ReportOptions {
    /// The title; by default, it contains the environments' ids.
    pub title: Option<String>,
    /// The training log (`train.jsonl`) whose metrics the page shows.
    pub metrics: Option<PathBuf>,
    /// The command that reproduces the results; by default, the command in the manifest, if there is one.
    pub command: Option<String>,
}

/// Writes a page of results to `out_dir/index.html` and returns the path of the page. `results` are pairs of a results
/// file and its content; paths of videos are relative to the folder of the results file.
///
/// # Errors
/// When there are no results or too many, or the page cannot be written.
pub fn write_report(results: &[(PathBuf, Results)], out_dir: &Path) -> Result<PathBuf> {
    write_report_with(results, &ReportOptions::default(), out_dir)
}

/// Writes a page as [`write_report`] does, with a title, training metrics, or a command.
///
/// # Errors
/// As [`write_report`], and when the training log cannot be read.
pub fn write_report_with(results: &[(PathBuf, Results)], options: &ReportOptions, out_dir: &Path) -> Result<PathBuf> {
    if results.is_empty() {
        return Err(Error::config("report", "there are no results to report", "give at least one results.json"));
    }
    let runs: usize = results.iter().map(|(_, results)| results.runs.len()).sum();
    if runs > limits::RUNS {
        let problem = format!("the files have {runs} runs, more than {}", limits::RUNS);
        return Err(Error::config("report", problem, "give fewer results files"));
    }
    let metrics = options.metrics.as_deref().map(read_metrics).transpose()?;
    let page = render(results, options, metrics.as_ref());
    std::fs::create_dir_all(out_dir).map_err(|source| Error::io(out_dir, "creating the report's folder", source))?;
    let path = out_dir.join("index.html");
    files::write(&path, page.as_bytes())?;
    Ok(path)
}

/// Renders the page; `metrics` replaces the training log that `options` names.
pub fn render(results: &[(PathBuf, Results)], options: &ReportOptions, metrics: Option<&Metrics>) -> String {
    let groups = Group::all(results);
    let mut envs: Vec<&str> = vec![];
    for group in &groups {
        if !envs.contains(&group.env) {
            envs.push(group.env);
        }
    }
    let title = options.title.clone().unwrap_or_else(|| format!("Evaluation in {}", envs.join(", ")));
    document(&Head { title: &title, lede: &summary(results), style: "" }, |html| {
        let mut videos = sections::videos::Videos::default();
        for group in &groups {
            sections::group::write(html, group, (results, &mut videos), groups.len() > 1);
        }
        if let Some(metrics) = metrics {
            sections::training::write(html, metrics);
        }
        sections::provenance::write(html, results, options.command.as_deref());
    })
}

/// The head of a page.
pub(crate) struct Head<'a> {
    /// The title, not escaped.
    pub title: &'a str,
    /// The line below the title, as HTML.
    pub lede: &'a str,
    /// What is added to the style sheet.
    pub style: &'a str,
}

/// Returns a page whose main part `write` appends.
pub(crate) fn document(head: &Head<'_>, write: impl FnOnce(&mut String)) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; \
         img-src data:; media-src data:; font-src data:\"/>\n<link rel=\"icon\" href=\"data:,\"/>\n\
         <title>{title}</title>\n<style>\n{STYLE}{}</style>\n</head>\n<body>\n<header>\n\
         <p class=\"eyebrow\">stable-worldmodel</p>\n<h1>{title}</h1>\n<p class=\"lede\">{}</p>\n</header>\n<main>\n",
        head.style,
        head.lede,
        title = escape(head.title),
    );
    write(&mut html);
    let _ = write!(
        html,
        "</main>\n<footer>Written by stable-worldmodel {}. This page is self-contained: no scripts, no \
         network access.</footer>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION")
    );
    html
}

/// Protocol, counting, number of runs, seed and device of all results, in one line.
fn summary(results: &[(PathBuf, Results)]) -> String {
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
