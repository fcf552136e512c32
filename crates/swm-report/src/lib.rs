//! One self-contained HTML page from result files: tables, charts, videos and provenance.
//!
//! [`read_results`] reads a results file of an evaluation. [`write_report`] writes a page of any number of results. The
//! page needs no scripts, network access or other files, so it can be mailed, archived and printed. Equal results give
//! equal bytes.
//!
//! - `page` writes the page; `sections` has a file for each section; `charts` has a file for each chart; `style.css` is the
//!   style sheet.
//! - `study` writes the page of a study ([`write_study`]), with figures as SVG and PNG.
//! - `autopsy` writes the page of an autopsy ([`write_autopsy`]).
//! - `leaderboard` writes the pages of a leaderboard ([`write_leaderboard`]).
//! - `plot` draws charts and figures with `plotters`, and has the colours of policies.
//! - `group` groups runs by environment, protocol and counting, and compares them; `gap` compares conditions; `read` and
//!   `training_log` read files, within the `limits`; `text` formats numbers and escapes text.

mod autopsy;
mod charts;
mod gap;
mod group;
mod leaderboard;
mod limits;
mod page;
mod plot;
mod read;
mod sections;
mod study;
mod text;
mod training_log;

pub use autopsy::{AutopsyPage, FrameStrip, write_autopsy};
pub use charts::training::curves_svg;
pub use leaderboard::{BoardEntry, BoardPages, BoardRow, BoardTable, Leaderboard, Move, write_leaderboard};
pub use page::{ReportOptions, render, write_report, write_report_with};
pub use read::{parse_results, read_results};
pub use study::{StudyPage, TablePage, write_study, write_table};
pub use text::number;
pub use training_log::{Metrics, Series, Training, read_metrics};
