//! The page: renders all sections in reading order and writes the file.

use crate::group::Group;
use crate::limits;
use crate::plot;
use crate::sections::group::Shown;
use crate::sections::videos::{Poster, Videos};
use crate::sections::{self, Room};
use crate::text::{escape, shorten};
use crate::training_log::Training;
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
    /// The training logs of the policies.
    pub training: Vec<Training>,
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

/// Writes a page as [`write_report`] does, with a title, training curves, or a command.
///
/// # Errors
/// As [`write_report`].
pub fn write_report_with(results: &[(PathBuf, Results)], options: &ReportOptions, out_dir: &Path) -> Result<PathBuf> {
    if results.is_empty() {
        return Err(Error::config("report", "there are no results to report", "give at least one results.json"));
    }
    let runs: usize = results.iter().map(|(_, results)| results.runs.len()).sum();
    if runs > limits::RUNS {
        let problem = format!("the files have {runs} runs, more than {}", limits::RUNS);
        return Err(Error::config("report", problem, "give fewer results files"));
    }
    let page = render(results, options)?;
    std::fs::create_dir_all(out_dir).map_err(|source| Error::io(out_dir, "creating the report's folder", source))?;
    let path = out_dir.join("index.html");
    files::write(&path, page.as_bytes())?;
    Ok(path)
}

/// Renders the page.
///
/// # Errors
/// When drawing a chart fails, which is a bug.
pub fn render(results: &[(PathBuf, Results)], options: &ReportOptions) -> Result<String> {
    let mut envs: Vec<&str> = vec![];
    for (_, result) in results {
        if !envs.contains(&result.env.as_str()) {
            envs.push(&result.env);
        }
    }
    let title = options.title.clone().unwrap_or_else(|| format!("Evaluation in {}", envs.join(", ")));
    let title = shorten(&title, limits::TEXT_CHARS);
    let head = Head { title: &title, lede: &summary(results), style: "" };
    document(&head, |html| write_content(html, results, options))
}

/// Writes everything that a page of results has below its heading.
///
/// # Errors
/// When drawing a chart fails, which is a bug.
pub(crate) fn write_content(html: &mut String, results: &[(PathBuf, Results)], options: &ReportOptions) -> Result<()> {
    let groups = Group::all(results);
    let mut videos = Videos::default();
    let shown: Vec<Shown<'_, '_>> =
        groups.iter().map(|group| Shown::new(group, results, videos.gallery(group, results))).collect();
    let inks = plot::inks(results.iter().flat_map(|(_, result)| &result.runs).map(|run| run.policy.as_str()));
    answer(html, &shown, videos.task.as_ref());
    let mut room = Room::default();
    for (i, group) in shown.iter().enumerate() {
        if html.len() > limits::GROUPS_BYTES {
            let _ = writeln!(html, "<p class=\"note\">The page has no room for {} more groups.</p>", shown.len() - i);
            break;
        }
        group.write(html, shown.len() > 1, &mut room)?;
    }
    sections::training::write(html, &options.training, &inks, &mut room)?;
    sections::provenance::write(html, results, options.command.as_deref());
    Ok(())
}

/// Writes a frame of the task, and what every group shows in one sentence.
fn answer(html: &mut String, shown: &[Shown<'_, '_>], task: Option<&Poster>) {
    html.push_str("<section class=\"top\">\n");
    if let Some(Poster { uri, .. }) = task {
        let _ = write!(
            html,
            "<figure class=\"task\">\n<img alt=\"The task: a start and its goal\" src=\"{uri}\"/>\n\
             <figcaption>A start, and its goal.</figcaption>\n</figure>\n"
        );
    }
    html.push_str("<div>\n");
    for group in shown.iter().take(limits::SENTENCES) {
        let title = if shown.len() > 1 { format!("<b>{}</b><br/>", group.title()) } else { String::new() };
        if let Some(sentence) = group.sentence() {
            let _ = writeln!(html, "<p class=\"answer\">{title}{}</p>", escape(&sentence));
        }
    }
    html.push_str("</div>\n</section>\n");
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
///
/// # Errors
/// Those of `write`.
pub(crate) fn document(head: &Head<'_>, write: impl FnOnce(&mut String) -> Result<()>) -> Result<String> {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; \
         img-src data:; media-src data:; font-src data:\"/>\n<link rel=\"icon\" href=\"data:,\"/>\n\
         <title>{title}</title>\n<style>\n{}{}{STYLE}{}</style>\n</head>\n<body>\n<header>\n\
         <p class=\"eyebrow\">stable-worldmodel</p>\n<h1>{title}</h1>\n<p class=\"lede\">{}</p>\n</header>\n<main>\n",
        plot::font_rule(),
        plot::theme_rules(),
        head.style,
        head.lede,
        title = escape(head.title),
    );
    write(&mut html)?;
    let _ = write!(
        html,
        "</main>\n<footer>Written by stable-worldmodel {}. This page is self-contained: no scripts, no \
         network access.</footer>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION")
    );
    Ok(html)
}

/// Protocol, counting, number of runs, seed and device of all results, in one line.
fn summary(results: &[(PathBuf, Results)]) -> String {
    let shared = |of: fn(&Results) -> String| {
        let mut values: Vec<String> = results.iter().map(|(_, r)| of(r)).collect();
        values.sort();
        values.dedup();
        escape(&shorten(&values.join(", "), limits::TEXT_CHARS))
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
