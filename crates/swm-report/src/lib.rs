//! One self-contained HTML page from result files: tables, plots, videos and provenance.
//!
//! [`read_results`] reads what an evaluation wrote, [`write_report`] turns any number of such files into a page
//! that needs no network, no script and no other file, so it can be mailed, archived and printed. The page
//! is decided by its inputs: equal results give equal bytes.
//!
//! - `page` puts the sections together, by the groups of `group`; `plots` draws on the primitives of `chart`, and so do
//!   `paired` (policies on the same starts), `searches` (how plans came about) and `prediction` (how well models predict).
//! - `films` embeds videos; `read` reads files; `text` writes numbers and escapes words.

mod chart;
mod films;
mod group;
mod page;
mod paired;
mod plots;
mod prediction;
mod read;
mod searches;
mod text;

pub use page::{ReportOptions, render, write_report, write_report_with};
pub use read::{Metrics, Series, read_metrics, read_results};
