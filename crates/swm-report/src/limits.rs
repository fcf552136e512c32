//! Limits of the files that a report reads and of the page that it writes.
//!
//! Results files and training logs may come from a stranger. With these limits they cost bounded time and memory, and the
//! page stays small enough for a browser. Real results are far below them.

/// The largest results file, in bytes: about 600 000 episodes.
pub(crate) const RESULTS_BYTES: u64 = 128 << 20;

/// The largest number of runs of one page.
pub(crate) const RUNS: usize = 5000;

/// The longest name of an environment, a condition, a policy or a video, in bytes.
pub(crate) const NAME_BYTES: usize = 1000;

/// The largest training log, in bytes.
pub(crate) const LOG_BYTES: u64 = 256 << 20;

/// The largest number of metrics of a training log.
pub(crate) const METRICS: usize = 1000;

/// The longest name of a metric, in bytes.
pub(crate) const METRIC_NAME_BYTES: usize = 200;

/// The largest video that is embedded, in bytes; base64 makes it a third larger.
pub(crate) const VIDEO_BYTES: u64 = 1 << 20;

/// The largest poster of a video, in bytes.
pub(crate) const POSTER_BYTES: u64 = 128 << 10;

/// The size of all embedded videos and posters together, in bytes.
pub(crate) const ALL_VIDEOS_BYTES: u64 = 1_800_000;

/// The largest number of videos that are embedded or listed with a reason.
pub(crate) const VIDEOS: usize = 200;

/// The largest number of rows of a chart with points.
pub(crate) const CHART_ROWS: usize = 60;

/// The largest number of squares of the chart of episodes.
pub(crate) const SQUARES: usize = 3000;

/// The largest number of strokes of a group of trajectories.
pub(crate) const STROKES: usize = 300;

/// The largest number of cards of a group of runs.
pub(crate) const CARDS: usize = 12;

/// The size of all charts of a page, in bytes.
pub(crate) const CHARTS_BYTES: usize = 1_400_000;

/// The size of all tables of a page beyond which further rows are left out, in bytes.
pub(crate) const TABLES_BYTES: usize = 500_000;

/// The size of the provenance of all results files of a page, in bytes.
pub(crate) const PROVENANCE_BYTES: usize = 150_000;

/// The size of the configuration of a results file in its page, in characters.
pub(crate) const CONFIG_CHARS: usize = 20_000;

/// The largest number of libraries, and of hashes, of a results file in its page.
pub(crate) const ENTRIES: usize = 40;

/// The longest name, title or value of the provenance, in characters.
pub(crate) const TEXT_CHARS: usize = 160;

/// The size of a page beyond which further groups of runs are left out, in bytes.
pub(crate) const GROUPS_BYTES: usize = 3_600_000;

/// The largest number of sentences at the top of a page, of headings, and of notes of a kind.
pub(crate) const SENTENCES: usize = 20;

/// The largest number of figures of a study.
pub(crate) const FIGURES: usize = 12;

/// The size of the figures of a study in its page, in bytes.
pub(crate) const STUDY_FIGURES_BYTES: usize = 1_900_000;

/// The size of the table of a study beyond which further rows are left out, in bytes.
pub(crate) const STUDY_TABLE_BYTES: usize = 2_600_000;

/// The number of published values beside those of a study.
pub(crate) const PUBLISHED: usize = 200;

/// The number of families, and of rows over training seeds, that the page of a study shows.
pub(crate) const FAMILIES: usize = 100;

/// The longest name in the page of a study, in characters.
pub(crate) const STUDY_NAME_CHARS: usize = 120;

/// The longest question or command in the page of a study, in characters.
pub(crate) const STUDY_TEXT_CHARS: usize = 2000;

/// The size of the tables of a leaderboard beyond which further tables are left out, in bytes.
pub(crate) const LEADERBOARD_BYTES: usize = 3_600_000;

/// The largest number of entries that one table of a leaderboard compares.
pub(crate) const LEADERBOARD_ROWS: usize = 200;

/// A size in mebibytes, as a text.
pub(crate) fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}
