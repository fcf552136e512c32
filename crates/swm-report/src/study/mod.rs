//! The page of a study: an answer, figures, a table, and published values beside ours.
//!
//! - `table_page` is the page of a study whose cells are no evaluations.
//! - `sheet` arranges the rows; `answer` says what they show in one sentence; `table`, `over_seeds`, `published`,
//!   `prediction`, `displacement`, `image_distance` and `breaking` write tables; `figures` chooses and draws the figures; `decay` fits a curve; this module
//!   writes the files.

mod answer;
mod breaking;
mod decay;
mod displacement;
mod figures;
mod image_distance;
mod over_seeds;
mod prediction;
mod published;
mod sheet;
mod table;
mod table_page;

pub use table_page::{TablePage, write_table};

use crate::limits;
use crate::page::{Head, document};
use crate::text::{escape, shorten};
use sheet::Sheet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::results::{Paired, Published, StudyResults, Verdict};
use swm_core::{Error, Result, files};

/// The style sheet of what only this page has.
const STYLE: &str = include_str!("style.css");

/// What the page of a study shows.
#[derive(Clone, Debug, Default)]
pub struct StudyPage {
    /// The rows of the study.
    pub results: StudyResults,
    /// Values to show beside ours.
    pub published: Vec<Published>,
    /// The title; that of the study by default.
    pub title: Option<String>,
    /// The command that runs the study again, if it is known.
    pub command: Option<String>,
}

/// Writes the page of a study to `out_dir/index.html`, and its figures to `out_dir/figures/` as SVG and PNG. Returns the path
/// of the page.
///
/// Equal results give equal bytes. The caller holds the [`Lock`](files::Lock) of `out_dir`, because files that a kill left in
/// `out_dir/figures/` are deleted.
///
/// # Errors
/// When a file cannot be written.
pub fn write_study(page: &StudyPage, out_dir: &Path) -> Result<PathBuf> {
    let sheets = Sheet::all(&page.results);
    let mut figures = draw(&sheets)?;
    for drawn in figures::density::draw(&page.results)? {
        let number = 1 + figures.iter().filter(|other| other.drawn.name == drawn.name).count();
        let file = format!("{}-{number}", drawn.name);
        figures.push(Placed { drawn, file, label: String::new(), folded: false });
    }
    figures.truncate(limits::FIGURES);
    write_files(out_dir, &render(page, &sheets, &figures)?, &figures)
}

/// Writes a page and the files of its figures. Returns the path of the page.
fn write_files(out_dir: &Path, html: &str, figures: &[Placed]) -> Result<PathBuf> {
    let folder = out_dir.join("figures");
    files::check_no_link(&folder)?;
    // The page is written first: it tells that the folder is this program's own.
    let path = out_dir.join("index.html");
    files::write(&path, html.as_bytes())?;
    std::fs::create_dir_all(&folder).map_err(|source| Error::io(&folder, "creating the folder of figures", source))?;
    // What a kill left of an earlier page, whose figures may have been others.
    files::delete_temporary(&folder, is_figure)?;
    for figure in figures {
        files::write(&folder.join(format!("{}.svg", figure.file)), figure.drawn.drawing.svg.as_bytes())?;
        files::write(&folder.join(format!("{}.png", figure.file)), &figure.drawn.drawing.png)?;
    }
    Ok(path)
}

/// Whether a file has a name as the files of figures have it, such as `drop-1.svg`.
fn is_figure(name: &str) -> bool {
    let stem = name.strip_suffix(".svg").or_else(|| name.strip_suffix(".png"));
    let number = stem.and_then(|stem| stem.rsplit_once('-')).map(|(_, number)| number);
    number.is_some_and(|number| !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit()))
}

/// A figure of a sheet.
struct Placed {
    drawn: figures::Drawn,
    /// The name of its files, without their suffixes.
    file: String,
    /// The sheet and the counting, if there are several.
    label: String,
    /// Whether the figure is folded: it repeats one above for another counting or sheet.
    folded: bool,
}

/// Draws the figures of all sheets, up to [`limits::FIGURES`].
fn draw(sheets: &[Sheet<'_>]) -> Result<Vec<Placed>> {
    let mut placed = vec![];
    for (i, sheet) in sheets.iter().enumerate() {
        for (j, counting) in sheet.countings.iter().enumerate() {
            if placed.len() >= limits::FIGURES {
                return Ok(placed);
            }
            let counting = (sheet.countings.len() > 1).then(|| format!("{} counting", counting.name()));
            let parts = [Some(sheet.label.clone()).filter(|label| !label.is_empty()), counting];
            let label = parts.into_iter().flatten().collect::<Vec<_>>().join(", ");
            for drawn in figures::draw(sheet, j)? {
                let number = 1 + placed.iter().filter(|other: &&Placed| other.drawn.name == drawn.name).count();
                let file = format!("{}-{number}", drawn.name);
                placed.push(Placed { drawn, file, label: label.clone(), folded: i + j > 0 });
            }
        }
    }
    Ok(placed)
}

/// Renders the page.
///
/// # Errors
/// Those of [`document`].
fn render(page: &StudyPage, sheets: &[Sheet<'_>], figures: &[Placed]) -> Result<String> {
    let StudyPage { results, published, title, command } = page;
    let title = shorten(title.as_deref().unwrap_or(&results.title), limits::STUDY_NAME_CHARS);
    let question = escape(&shorten(&results.question, limits::STUDY_TEXT_CHARS));
    document(&Head { title: &title, lede: &question, style: STYLE }, |html| {
        let _ = write!(
            html,
            "<section>\n<p class=\"answer\">{}</p>\n<dl>\n<div><dt>cells done</dt><dd>{} of {}</dd></div>\n\
             <div><dt>hash of the study (BLAKE3)</dt><dd class=\"hash\">{}</dd></div>\n</dl>\n",
            escape(&answer::sentence(results)),
            results.done,
            results.cells,
            escape(&shorten(&results.hash, limits::STUDY_NAME_CHARS))
        );
        if let Some(registration) = &results.registration {
            let words = escape(&shorten(&registration.to_string(), limits::STUDY_TEXT_CHARS));
            let (open, close) = if registration.is_same { ("", "") } else { ("<b>", "</b>") };
            let _ = writeln!(html, "<p>{open}This study {words}.{close}</p>");
        }
        for note in results.notes_on_rule() {
            let _ = writeln!(html, "<p class=\"note\">{}</p>", escape(&note));
        }
        if let Some(command) = command {
            let command = escape(&shorten(command, limits::STUDY_TEXT_CHARS));
            let _ =
                write!(html, "<p>The command that runs the study again, or continues it:</p>\n<pre>{command}</pre>\n");
        }
        html.push_str("</section>\n");
        breaking::write(html, results);
        write_figures(html, figures);
        table::write(html, sheets, results);
        image_distance::write(html, results);
        prediction::write(html, results);
        displacement::write(html, results);
        over_seeds::write(html, &results.over_seeds);
        published::write(html, sheets, published);
        Ok(())
    })
}

/// Writes the figures, up to [`limits::STUDY_FIGURES_BYTES`].
fn write_figures(html: &mut String, figures: &[Placed]) {
    if figures.is_empty() {
        return;
    }
    html.push_str("<section>\n<h2>Figures</h2>\n");
    let mut bytes = 0;
    for figure in figures {
        let inline = &figure.drawn.drawing.inline;
        let fits = bytes + inline.len() <= limits::STUDY_FIGURES_BYTES;
        bytes += if fits { inline.len() } else { 0 };
        let content =
            if fits { inline } else { "<p class=\"note\">The page has no room for it; its files have it.</p>\n" };
        let label = escape(&shorten(&figure.label, limits::STUDY_NAME_CHARS));
        let comma = if label.is_empty() { "" } else { " · " };
        let heading = format!("{}{comma}{label}", figure.drawn.heading);
        let (open, close) = if figure.folded {
            (format!("<details>\n<summary>{heading}</summary>\n<figure class=\"plot\">\n"), "</figure>\n</details>\n")
        } else {
            (format!("<figure class=\"plot\">\n<h3>{heading}</h3>\n"), "</figure>\n")
        };
        let (caption, file) = (&figure.drawn.caption, &figure.file);
        let _ = write!(
            html,
            "{open}{content}<figcaption>{caption} <span class=\"files\">Files: <code>figures/{file}.svg</code>, \
             <code>figures/{file}.png</code>.</span></figcaption>\n{close}"
        );
    }
    html.push_str("</section>\n");
}

/// Whether a gap is told apart from zero.
fn told_apart(gap: &Paired) -> bool {
    matches!(gap.verdict, Verdict::Lower | Verdict::Higher)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use swm_core::results::{Counting, Paired, Proportion, StudyResults, StudyRow};

    /// A row of a study: `successes` of 10 episodes, of which the condition `plain` solves 9.
    pub(super) fn row(condition: &str, policy: &str, variables: &[(&str, &str)], successes: usize) -> StudyRow {
        StudyRow {
            cell: "00".to_owned(),
            starts: "held-out".to_owned(),
            condition: condition.to_owned(),
            variables: variables
                .iter()
                .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
                .collect::<BTreeMap<_, _>>(),
            policy: policy.to_owned(),
            any_seed: None,
            counting: Counting::default(),
            seed: 0,
            success: Proportion::wilson(successes, 10),
            solved_at_start: 0,
            floor: Proportion::wilson(1, 10),
            gap: (condition != "plain").then(|| Paired::of(successes.min(9), 0, 9 - successes.min(9), 1)),
            trained_on_starts: None,
            image_distance: None,
            prediction: None,
            played: None,
            by_displacement: vec![],
        }
    }

    pub(super) fn study(rows: Vec<StudyRow>) -> StudyResults {
        let (cells, done) = (rows.len(), rows.len());
        let [title, question, hash] = ["t", "q?", "h"].map(str::to_owned);
        StudyResults { title, question, hash, cells, done, rows, ..StudyResults::default() }
    }
}
