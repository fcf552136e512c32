//! The sections of the page, one file each.

mod cards;
mod comparisons;
pub(crate) mod group;
pub(crate) mod provenance;
mod runs_table;
pub(crate) mod training;
pub(crate) mod verdict;
pub(crate) mod videos;

use crate::limits;
use std::fmt::Write as _;
use swm_core::Result;

/// The room that the page has left for its charts and tables, in bytes.
pub(crate) struct Room {
    charts: usize,
    tables: usize,
}

impl Default for Room {
    fn default() -> Self {
        Self { charts: limits::CHARTS_BYTES, tables: limits::TABLES_BYTES }
    }
}

impl Room {
    /// Writes a figure with a heading and a caption; a sentence replaces its content if the page has no room for it.
    fn figure(&mut self, html: &mut String, heading: &str, caption: &str, content: &str) {
        let fits = content.len() <= self.charts;
        self.charts -= if fits { content.len() } else { 0 };
        let content = if fits { content } else { "<p class=\"note\">The page has no room for this chart.</p>\n" };
        let _ = write!(
            html,
            "<figure class=\"plot\">\n<h3>{heading}</h3>\n{content}<figcaption>{caption}</figcaption>\n</figure>\n"
        );
    }

    /// Writes a figure of panels, as many as the page has room for; nothing without panels.
    ///
    /// # Errors
    /// When drawing fails.
    fn panels(
        &mut self,
        html: &mut String,
        [heading, caption]: [&str; 2],
        charts: impl Iterator<Item = Result<Vec<String>>>,
    ) -> Result<()> {
        let (mut panels, mut cut) = (String::new(), "");
        for charts in charts {
            let charts = charts?.concat();
            if panels.len() + charts.len() > self.charts {
                cut = "<p class=\"note\">The page has no room for further panels.</p>\n";
                break;
            }
            panels += &charts;
        }
        if !panels.is_empty() || !cut.is_empty() {
            self.figure(html, heading, caption, &format!("<div class=\"panels\">\n{panels}</div>\n{cut}"));
        }
        Ok(())
    }

    /// Writes a row of a table; returns whether the page had room for it.
    fn row(&mut self, html: &mut String, row: &str) -> bool {
        let fits = row.len() <= self.tables;
        if fits {
            self.tables -= row.len();
            html.push_str(row);
        }
        fits
    }
}
