//! The page of a study whose cells are no evaluations: figures and one table.

use super::figures::{dots, paths};
use super::table::NONE;
use super::{Placed, STYLE, write_figures, write_files};
use crate::charts;
use crate::limits;
use crate::page::{Head, document};
use crate::text::{escape, number, shorten};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::Result;
use swm_core::results::StudyTable;

/// What the page shows.
#[derive(Clone, Debug, Default)]
pub struct TablePage {
    /// The rows of the study.
    pub results: StudyTable,
    /// The title; that of the study by default.
    pub title: Option<String>,
    /// The command that runs the study again, if it is known.
    pub command: Option<String>,
}

/// Writes the page of such a study as [`write_study`](super::write_study) writes that of evaluations, with the same
/// lock. Returns the path of the page.
///
/// # Errors
/// When a file cannot be written.
pub fn write_table(page: &TablePage, out_dir: &Path) -> Result<PathBuf> {
    let drawn =
        paths::draw(&page.results)?.into_iter().chain(dots::draw(&page.results)?).take(limits::FIGURES).enumerate();
    let placed = drawn.map(|(i, drawn)| Placed {
        file: format!("{}-{}", drawn.name, i + 1),
        drawn,
        label: String::new(),
        folded: false,
    });
    let figures: Vec<Placed> = placed.collect();
    write_files(out_dir, &render(page, &figures)?, &figures)
}

fn render(page: &TablePage, figures: &[Placed]) -> Result<String> {
    let TablePage { results, title, command } = page;
    let title = shorten(title.as_deref().unwrap_or(&results.title), limits::STUDY_NAME_CHARS);
    let text = |words: &str| escape(&shorten(words, limits::STUDY_TEXT_CHARS));
    document(&Head { title: &title, lede: &text(&results.question), style: STYLE }, |html| {
        let _ = write!(
            html,
            "<section>\n<dl>\n<div><dt>rows done</dt><dd>{} of {}</dd></div>\n<div><dt>hash of the study (BLAKE3)</dt>\
             <dd class=\"hash\">{}</dd></div>\n</dl>\n",
            results.done,
            results.cells,
            text(&results.hash)
        );
        if let Some(command) = command {
            let command = text(command);
            let _ =
                write!(html, "<p>The command that runs the study again, or continues it:</p>\n<pre>{command}</pre>\n");
        }
        html.push_str("</section>\n");
        write_figures(html, figures);
        write_curves(html, results)?;
        write_rows(html, results);
        Ok(())
    })
}

/// Writes the learning curves of models that train by interaction; nothing for other tables.
fn write_curves(html: &mut String, results: &StudyTable) -> Result<()> {
    let panels = charts::learning::panels(results)?.concat();
    if !panels.is_empty() && panels.len() <= limits::STUDY_FIGURES_BYTES {
        let _ = write!(
            html,
            "<section>\n<h2>Learning curves</h2>\n<figure class=\"plot\">\n<div class=\"panels\">\n{panels}</div>\n\
             <figcaption>Mean returns of evaluations without exploration, over the share of the optimizer steps. The dashed line \
             is the random policy.</figcaption>\n</figure>\n</section>\n"
        );
    }
    Ok(())
}

fn write_rows(html: &mut String, results: &StudyTable) {
    let name = |words: &str| escape(&shorten(words, limits::STUDY_NAME_CHARS));
    html.push_str("<section>\n<h2>Results</h2>\n");
    let source = Some(results.source.as_str()).filter(|source| !source.is_empty());
    if let Some(source) = source {
        let source = escape(&shorten(source, limits::STUDY_TEXT_CHARS));
        let _ = writeln!(html, "<p class=\"note\">Published values are those of {source}.</p>");
    }
    let mut machines: Vec<&str> = results.rows.iter().map(|row| row.machine.as_str()).collect();
    machines.sort_unstable();
    machines.dedup();
    for machine in machines.into_iter().filter(|machine| !machine.is_empty()).take(limits::FAMILIES) {
        let _ = writeln!(html, "<p class=\"note\">Measured on {}.</p>", name(machine));
    }
    html.push_str("<div class=\"wide stack study\">\n<table>\n<thead>\n<tr>");
    let _ = write!(html, "<th scope=\"col\">{}</th>", name(&results.subject));
    for column in &results.columns {
        let _ = write!(html, "<th scope=\"col\" class=\"n\">{}</th>", name(&column.label()));
    }
    html.push_str("</tr>\n</thead>\n<tbody>\n");
    let (start, mut left_out) = (html.len(), 0);
    for row in &results.rows {
        if html.len() - start > limits::STUDY_TABLE_BYTES {
            left_out += 1;
            continue;
        }
        let _ = write!(html, "<tr><th scope=\"row\">{}</th>", name(&row.name));
        for (value, column) in row.values.iter().zip(&results.columns) {
            let shown = match value {
                Some(value) => number(*value),
                None if column.published => NONE.to_owned(),
                None => "<span class=\"quiet\">not measured</span>".to_owned(),
            };
            let label = name(&column.label());
            let _ = write!(html, "<td class=\"n\" data-label=\"{label}\">{shown}</td>");
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if left_out > 0 {
        let _ = writeln!(html, "<p class=\"note\">{left_out} more rows are in <code>table.csv</code>.</p>");
    }
    html.push_str("</section>\n");
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{TableColumn, TableRow};

    #[test]
    fn page_escapes_names_and_says_what_is_not_measured() {
        let column = |name: &str, published| TableColumn { name: name.to_owned(), unit: "ms".to_owned(), published };
        let row = TableRow {
            cell: "00".to_owned(),
            name: "<b>evil</b>".to_owned(),
            values: vec![Some(1.5), None, None],
            machine: "a machine".to_owned(),
            paths: vec![],
        };
        let results = StudyTable {
            title: "Formats".to_owned(),
            columns: vec![column("latency", false), column("other", false), column("latency, published", true)],
            rows: vec![row],
            cells: 1,
            done: 1,
            ..StudyTable::default()
        };
        let folder = tempfile::tempdir().expect("a folder");
        let page = TablePage { results, ..TablePage::default() };
        let path = write_table(&page, folder.path()).expect("a page");
        let html = std::fs::read_to_string(path).expect("the page");
        assert!(html.contains("&lt;b&gt;evil") && !html.contains("<b>evil"));
        assert!(html.contains(">1.5</td>") && html.matches("not measured").count() == 1 && html.contains("a machine"));
        assert!(folder.path().join("figures/dots-1.png").exists());
    }
}
