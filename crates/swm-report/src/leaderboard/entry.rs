//! The page of an entry: who submitted it, what verifies it, and its results.

use super::{BoardEntry, STYLE, name};
use crate::page::{Head, ReportOptions, document, write_content};
use crate::text::{escape, shorten};
use std::fmt::Write as _;
use std::path::PathBuf;
use swm_core::Result;

/// Renders the page.
///
/// # Errors
/// When drawing a chart fails, which is a bug.
pub(super) fn render(entry: &BoardEntry) -> Result<String> {
    let title = shorten(&format!("{} in {}", entry.policy, entry.results.env), super::NAME_CHARS);
    let lede = format!("An entry of the leaderboard by {}", name(&entry.author));
    document(&Head { title: &title, lede: &lede, style: STYLE }, |html| {
        html.push_str("<p><a href=\"../index.html\">All entries</a></p>\n<section>\n<dl>\n");
        let mut fact = |term: &str, value: &str, class: &str| {
            let _ = writeln!(html, "<div><dt>{term}</dt><dd{class}>{}</dd></div>", name(value));
        };
        fact("author", &entry.author, "");
        fact("licence", &entry.licence, "");
        fact("made on", &entry.processor, "");
        fact("device", &entry.results.manifest.device, "");
        fact("stable-worldmodel", &entry.results.manifest.swm_version, "");
        fact("weights (BLAKE3)", &entry.weights, " class=\"hash\"");
        fact("entry (BLAKE3)", &entry.hash, " class=\"hash\"");
        let _ = write!(
            html,
            "</dl>\n<p class=\"note\">Times, the processor and the device below are stated by the submitter: verification does not cover \
             them. On another processor or device, verification tolerates 5 % of the episodes that end differently, and 1 % of the sum of \
             rewards of the others; with <code>--exact</code>, nothing.</p>\n<p>The command that plays all episodes again and refuses the entry if one differs; \
             <code>--share 0.1</code> plays a random tenth:</p>\n<pre>{}</pre>\n</section>\n",
            escape(&shorten(&entry.command, 4 * super::NAME_CHARS))
        );
        // The manifest is shown with a name that says what it is.
        let results = [(PathBuf::from(format!("{}.json", entry.page)), entry.results.clone())];
        let options = ReportOptions { command: Some(entry.command.clone()), ..ReportOptions::default() };
        write_content(html, &results, &options)
    })
}
