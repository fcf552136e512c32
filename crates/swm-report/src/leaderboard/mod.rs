//! The pages of a leaderboard: one with a table for each task and condition, and one for each entry.
//!
//! The pages are static and link to each other only.

mod entry;
mod index;
mod moves;

pub use moves::Move;

use crate::text::{escape, shorten};
use moves::Built;
use std::path::{Path, PathBuf};
use swm_core::results::{Counting, Run};
use swm_core::{Error, Result, Results, files};

/// The style sheet of what only these pages have.
const STYLE: &str = include_str!("style.css");
/// The longest name in a table, in characters.
const NAME_CHARS: usize = 80;

/// The content of a leaderboard.
#[derive(Clone, Debug, Default)]
pub struct Leaderboard {
    /// The title.
    pub title: String,
    /// The tables; those of one environment follow each other.
    pub tables: Vec<BoardTable>,
    /// The entries.
    pub entries: Vec<BoardEntry>,
}

/// The policies that were evaluated on one task under one condition.
#[derive(Clone, Debug, Default)]
pub struct BoardTable {
    /// The id of the environment.
    pub env: String,
    /// The condition, in words.
    pub condition: String,
    /// What all policies have in common: names and values.
    pub task: Vec<(String, String)>,
    /// The rule that decides which episodes count.
    pub counting: Counting,
    /// Policies without weights, which have no rank.
    pub baselines: Vec<BoardRow>,
    /// The policies of entries, in any order.
    pub rows: Vec<BoardRow>,
}

/// A policy in a table.
#[derive(Clone, Debug)]
pub struct BoardRow {
    /// The name, which differs from those of other entries in the table.
    pub label: String,
    /// The index of its entry in [`Leaderboard::entries`].
    pub entry: Option<usize>,
    /// Its episodes.
    pub run: Run,
}

/// An entry, which has a page of its own.
#[derive(Clone, Debug, Default)]
pub struct BoardEntry {
    /// The name of the policy.
    pub policy: String,
    /// Who submitted it.
    pub author: String,
    /// The licence of the weights and of the results.
    pub licence: String,
    /// The processor that the results were made on.
    pub processor: String,
    /// The hash of the entry.
    pub hash: String,
    /// The hash of the weights.
    pub weights: String,
    /// The name of its page, without a suffix: letters, digits and hyphens.
    pub page: String,
    /// The command that verifies it.
    pub command: String,
    /// The results.
    pub results: Results,
}

impl Leaderboard {
    /// The paths of the pages in the folder of the leaderboard, that of the tables first.
    pub fn pages(&self) -> Vec<PathBuf> {
        let entries = self.entries.iter().map(|entry| Path::new("entries").join(format!("{}.html", entry.page)));
        std::iter::once(PathBuf::from("index.html")).chain(entries).collect()
    }
}

/// What a build wrote and deleted.
#[derive(Clone, Debug)]
pub struct BoardPages {
    /// The path of the page with the tables.
    pub first: PathBuf,
    /// What moved since the last build in the folder.
    pub moves: Vec<Move>,
    /// The deleted pages of entries that are gone, relative to the folder.
    pub deleted: Vec<PathBuf>,
}

/// Writes the pages of a leaderboard to a folder: `index.html`, and `entries/PAGE.html` for each entry. The first shows what moved
/// since the last build in the folder, which `last-build` remembers. Pages of the last build whose entries are gone are deleted,
/// unless their content has changed since.
///
/// Equal leaderboards after equal builds give equal bytes, and a build without changes changes no byte.
///
/// # Errors
/// When the name of a page has other characters than letters, digits and hyphens, `last-build` is not that of a build, or a file
/// cannot be written or deleted.
pub fn write_leaderboard(board: &Leaderboard, out_dir: &Path) -> Result<BoardPages> {
    let is_plain =
        |page: &str| !page.is_empty() && page.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
    if let Some(entry) = board.entries.iter().find(|entry| !is_plain(&entry.page)) {
        let problem = format!("the name of a page is '{}'", entry.page);
        return Err(Error::config("leaderboard", problem, "use letters, digits and hyphens"));
    }
    let folder = out_dir.join("entries");
    files::check_no_link(&folder)?;
    std::fs::create_dir_all(&folder).map_err(|source| Error::io(&folder, "creating the folder of entries", source))?;
    // What a kill left of an earlier build, whose pages may have been others.
    files::delete_temporary(out_dir, |name| name == "index.html" || name == moves::FILE)?;
    files::delete_temporary(&folder, |name| name.strip_suffix(".html").is_some_and(is_plain))?;
    let last = Built::read(out_dir)?;
    let mut pages = vec![];
    for (entry, page) in board.entries.iter().zip(board.pages().into_iter().skip(1)) {
        pages.push((page, entry::render(entry)?));
    }
    let built = Built::new(board, &pages, last.as_ref());
    let first = out_dir.join("index.html");
    files::write(&first, index::render(board, built.moves())?.as_bytes())?;
    for (page, content) in &pages {
        files::write(&out_dir.join(page), content.as_bytes())?;
    }
    let deleted = last.map_or(Ok(vec![]), |last| built.delete_gone(&last, out_dir))?;
    // Last, so that a build that was interrupted is compared with the one before it.
    built.write(out_dir)?;
    Ok(BoardPages { first, moves: built.moves().to_vec(), deleted })
}

/// A name in a table, escaped.
fn name(words: &str) -> String {
    escape(&shorten(words, NAME_CHARS))
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{EpisodeResult, Timing};

    /// A run that solves the first of 60 starts.
    fn run(policy: &str, solved: u64) -> Run {
        let episodes = (0..60).map(|i| EpisodeResult { success: i < solved, steps: 9, ..EpisodeResult::new(i) });
        Run::new("in distribution", policy, Counting::default(), episodes.collect(), Timing::default())
    }

    fn board() -> Leaderboard {
        let row = |policy: &str, solved, entry| BoardRow { label: policy.to_owned(), entry, run: run(policy, solved) };
        let table = BoardTable {
            env: "swm/TwoRoom-v1".to_owned(),
            condition: "in distribution".to_owned(),
            task: vec![("episodes".to_owned(), "60".to_owned())],
            baselines: vec![row("no-op", 1, None), row("random", 6, None)],
            rows: vec![row("low", 20, Some(0)), row("a<b>", 50, Some(1)), row("close", 48, Some(2))],
            ..BoardTable::default()
        };
        let entry = |page: &str, policy: &str| BoardEntry {
            policy: policy.to_owned(),
            author: "Ada & <i>Co</i>".to_owned(),
            page: page.to_owned(),
            command: "swm leaderboard verify x.json".to_owned(),
            results: Results { env: table.env.clone(), runs: vec![run(policy, 30)], ..Results::default() },
            ..BoardEntry::default()
        };
        let entries = vec![entry("low-1", "low"), entry("ab-2", "a<b>"), entry("close-3", "close")];
        Leaderboard { title: "Rooms".to_owned(), tables: vec![table], entries }
    }

    /// The texts of the cells with a class in a page.
    fn cells<'a>(html: &'a str, class: &str) -> Vec<&'a str> {
        let start = format!("<td class=\"{class}\"");
        let parts = html.split(start.as_str()).skip(1);
        parts.filter_map(|part| part.split_once('>')?.1.split_once("</td>")).map(|(text, _)| text).collect()
    }

    #[test]
    fn rows_are_sorted_and_ranked_as_far_as_they_are_told_apart() {
        let html = index::render(&board(), &[]).expect("a page");
        let order: Vec<usize> = ["a&lt;b&gt;</a>", ">close</a>", ">low</a>", "</span>no-op", "</span>random"]
            .map(|name| html.find(name).unwrap_or_else(|| panic!("{name}")))
            .to_vec();
        assert!(order.is_sorted(), "{order:?}");
        // 50 and 48 of 60 differ in two starts; both differ from 20 in at least 28.
        let none = "<span class=\"quiet\">–</span>";
        assert_eq!(cells(&html, "rank"), ["1–2", "1–2", "3", none, none]);
        assert!(html.contains("3 comparisons of 60 pairs"));
        // No verification plays an episode in the time that an entry states.
        assert!(html.contains("Planning latency (stated)") && html.contains("stated by the submitter"));
        assert!(html.contains("href=\"entries/ab-2.html\"") && !html.contains("<i>Co"));
    }

    #[test]
    fn every_entry_has_a_page_with_its_results() {
        let folder = tempfile::tempdir().expect("a folder");
        let board = board();
        std::fs::create_dir(folder.path().join("entries")).expect("a folder");
        let killed =
            [".index.html.7.tmp", ".last-build.7.tmp", "entries/.ab-2.html.7.tmp"].map(|name| folder.path().join(name));
        killed.iter().for_each(|path| std::fs::write(path, "<").expect("what a kill leaves"));
        write_leaderboard(&board, folder.path()).expect("pages");
        assert!(!killed.iter().any(|path| path.exists()));
        for page in board.pages() {
            assert!(folder.path().join(page).is_file());
        }
        let html = std::fs::read_to_string(folder.path().join("entries/ab-2.html")).expect("a page");
        for part in [
            "a&lt;b&gt; in swm/TwoRoom-v1",
            "swm leaderboard verify x.json",
            "../index.html",
            "50.0\u{a0}%",
            "stated by the submitter",
        ] {
            assert!(html.contains(part), "{part}");
        }
        assert!(!html.contains("<script") && !html.contains("<i>Co"));
        let mut wrong = board;
        wrong.entries[1].page = "../../evil".to_owned();
        assert!(write_leaderboard(&wrong, folder.path()).is_err());
    }

    #[test]
    fn a_build_shows_what_moved_and_deletes_the_pages_that_it_wrote() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut board = board();
        for (entry, hash) in board.entries.iter_mut().zip(["h0", "h1", "h2"]) {
            entry.hash = hash.to_owned();
        }
        let path = |name: &str| folder.path().join(name);
        let read = |name: &str| std::fs::read_to_string(path(name)).expect("a file");
        let first = write_leaderboard(&board, folder.path()).expect("pages");
        assert!(first.moves.is_empty() && first.deleted.is_empty() && !read("index.html").contains("What moved"));
        let (page, known) = (read("index.html"), read("last-build"));
        let again = write_leaderboard(&board, folder.path()).expect("pages");
        assert!(again.moves.is_empty() && read("index.html") == page && read("last-build") == known);
        std::fs::write(path("entries/own.html"), "a page of the user").expect("a file");
        // The entry `a<b>` leaves, and `low` moves up.
        let gone = board.tables[0].rows.remove(1);
        board.entries.remove(1);
        board.tables[0].rows[1].entry = Some(1);
        let later = write_leaderboard(&board, folder.path()).expect("pages");
        assert_eq!(later.deleted, [PathBuf::from("entries/ab-2.html")]);
        assert!(!path("entries/ab-2.html").exists() && path("entries/own.html").exists());
        let moved = |policy: &str| later.moves.iter().find(|moved| moved.policy == policy).expect("a move").clone();
        assert_eq!((moved("low").from.as_deref(), moved("low").to.as_deref()), (Some("3"), Some("2")));
        assert_eq!((moved("a<b>").from.as_deref(), moved("a<b>").to), (Some("1–2"), None));
        let shown = read("index.html");
        assert!(shown.contains("What moved") && shown.contains("a&lt;b&gt;") && shown.contains("gone"), "{shown}");
        assert_eq!(write_leaderboard(&board, folder.path()).expect("pages").moves, later.moves);
        assert_eq!(read("index.html"), shown);
        // A page whose content has changed since stays.
        std::fs::write(path("entries/close-3.html"), "changed").expect("a file");
        board.entries.truncate(1);
        board.tables[0].rows = vec![gone];
        board.tables[0].rows[0].entry = Some(0);
        let last = write_leaderboard(&board, folder.path()).expect("pages");
        assert!(last.deleted.is_empty() && path("entries/close-3.html").exists(), "{:?}", last.deleted);
        std::fs::write(path("last-build"), "{}").expect("a file");
        assert!(write_leaderboard(&board, folder.path()).expect_err("no build").to_string().contains("remove it"));
        let evil = known.replace("entries/ab-2.html", "../ab-2.html");
        std::fs::write(path("last-build"), evil).expect("a file");
        assert!(write_leaderboard(&board, folder.path()).expect_err("another folder").to_string().contains("../ab-2"));
    }

    #[test]
    fn too_many_entries_of_a_table_are_refused() {
        let mut board = board();
        let row = board.tables[0].rows[0].clone();
        board.tables[0].rows = vec![row; 201];
        let error = index::render(&board, &[]).expect_err("too many").to_string();
        assert!(error.contains("201 entries") && error.contains("200"), "{error}");
    }
}
