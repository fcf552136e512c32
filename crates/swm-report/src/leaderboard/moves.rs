//! What a build of a leaderboard leaves for the next one, and what moved between the two.

use super::{BoardTable, Leaderboard, name};
use crate::limits;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::results::{Rank, Ranking, Run};
use swm_core::{Error, Result, files, manifest};

/// The file of a build. It does not end in `.json`, as entries do.
pub(super) const FILE: &str = "last-build";
/// The largest file of a build, and the largest page, in bytes.
const MAX_BYTES: u64 = 64 << 20;
/// The most changes that the page lists.
const SHOWN: usize = 100;

/// A build of a leaderboard.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Built {
    version: u32,
    tables: Vec<BuiltTable>,
    /// The pages of entries and the BLAKE3 hashes of their contents.
    pages: BTreeMap<String, String>,
    /// What moved since a build with other tables.
    moves: Vec<Move>,
}

/// The entries of a table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct BuiltTable {
    env: String,
    condition: String,
    task: Vec<(String, String)>,
    rows: Vec<BuiltRow>,
}

/// An entry in a table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct BuiltRow {
    /// The hash of the entry.
    entry: String,
    label: String,
    rank: String,
}

/// A change between two builds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Move {
    /// The environment and the condition of the table.
    pub table: String,
    /// The policy.
    pub policy: String,
    /// The rank before, such as `2–3`; `None` for a new entry.
    pub from: Option<String>,
    /// The rank now; `None` for an entry that is gone.
    pub to: Option<String>,
}

impl Built {
    /// Reads the last build in a folder; `None` if there is none.
    ///
    /// # Errors
    /// When the file is not that of a build.
    pub(super) fn read(out_dir: &Path) -> Result<Option<Self>> {
        let path = out_dir.join(FILE);
        if !path.exists() {
            return Ok(None);
        }
        let fix = "remove it: what moved is then not shown, and pages of entries that are gone stay";
        let wrong = |problem: String| Error::corrupt(&path, problem, fix);
        let found: Self = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| wrong(format!("is not the build of a leaderboard ({error})")))?;
        match found.pages.keys().find(|page| !is_page(page)) {
            Some(page) => Err(wrong(format!("names the page '{page}'"))),
            None => Ok(Some(found)),
        }
    }

    /// The build of a leaderboard with these pages, paths and contents, after the last one. A leaderboard with the tables of
    /// the last build keeps what moved before it.
    pub(super) fn new(board: &Leaderboard, pages: &[(PathBuf, String)], last: Option<&Self>) -> Self {
        let tables: Vec<BuiltTable> = board.tables.iter().map(|table| built(board, table)).collect();
        let moves = match last {
            None => vec![],
            Some(last) if last.tables == tables => last.moves.clone(),
            Some(last) => moves(&last.tables, &tables),
        };
        let hashed = |(path, content): &(PathBuf, String)| {
            (path.to_string_lossy().replace('\\', "/"), manifest::hash(content.as_bytes()))
        };
        Self { version: 1, tables, pages: pages.iter().map(hashed).collect(), moves }
    }

    /// What moved since the last build with other tables.
    pub(super) fn moves(&self) -> &[Move] {
        &self.moves
    }

    /// Deletes the pages of the last build that this one does not have. A page that was changed since stays. Returns the deleted
    /// pages.
    ///
    /// # Errors
    /// When a page cannot be read or deleted.
    pub(super) fn delete_gone(&self, last: &Self, out_dir: &Path) -> Result<Vec<PathBuf>> {
        let mut deleted = vec![];
        for (page, hash) in last.pages.iter().filter(|(page, _)| !self.pages.contains_key(*page)) {
            let path = out_dir.join(page);
            if path.is_file() && !path.is_symlink() && manifest::hash(&files::read(&path, MAX_BYTES)?) == *hash {
                files::delete_file(&path)?;
                deleted.push(PathBuf::from(page));
            }
        }
        Ok(deleted)
    }

    /// Writes the file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(super) fn write(&self, out_dir: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).map_err(|error| Error::external("writing a build", error))?;
        files::write(&out_dir.join(FILE), (text + "\n").as_bytes())
    }
}

/// Whether a text is the path of a page of an entry.
fn is_page(text: &str) -> bool {
    let name = text.strip_prefix("entries/").and_then(|name| name.strip_suffix(".html"));
    name.is_some_and(|name| !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-'))
}

fn built(board: &Leaderboard, table: &BoardTable) -> BuiltTable {
    let runs: Vec<&Run> = table.rows.iter().map(|row| &row.run).collect();
    // A table with too many entries is refused when it is drawn.
    let ranks = if runs.len() > limits::LEADERBOARD_ROWS { vec![] } else { Ranking::of(&runs, table.counting).ranks };
    let hash = |entry: Option<usize>| entry.and_then(|entry| board.entries.get(entry)).map(|entry| entry.hash.clone());
    let rows = table.rows.iter().zip(ranks).map(|(row, rank)| BuiltRow {
        entry: hash(row.entry).unwrap_or_default(),
        label: row.label.clone(),
        rank: range(rank),
    });
    BuiltTable {
        env: table.env.clone(),
        condition: table.condition.clone(),
        task: table.task.clone(),
        rows: rows.collect(),
    }
}

/// A rank in words: one number, or a range.
pub(super) fn range(Rank { best, worst }: Rank) -> String {
    if best == worst { best.to_string() } else { format!("{best}–{worst}") }
}

fn moves(last: &[BuiltTable], now: &[BuiltTable]) -> Vec<Move> {
    let mut found = vec![];
    let same = |a: &BuiltTable, b: &BuiltTable| (&a.env, &a.condition, &a.task) == (&b.env, &b.condition, &b.task);
    let rows = |tables: &[BuiltTable], table: &BuiltTable| {
        tables.iter().find(|other| same(other, table)).map_or(vec![], |table| table.rows.clone())
    };
    let gone_tables = last.iter().filter(|table| !now.iter().any(|other| same(other, table)));
    for table in now.iter().chain(gone_tables) {
        let title = format!("{}, {}", table.env, table.condition);
        let (before, after) = (rows(last, table), rows(now, table));
        let mut add = |policy: &str, from: Option<&String>, to: Option<&String>| {
            let (table, policy) = (title.clone(), policy.to_owned());
            found.push(Move { table, policy, from: from.cloned(), to: to.cloned() });
        };
        for row in &after {
            match before.iter().find(|other| other.entry == row.entry) {
                None => add(&row.label, None, Some(&row.rank)),
                Some(other) if other.rank != row.rank => add(&row.label, Some(&other.rank), Some(&row.rank)),
                Some(_) => {}
            }
        }
        for row in before.iter().filter(|row| !after.iter().any(|other| other.entry == row.entry)) {
            add(&row.label, Some(&row.rank), None);
        }
    }
    found
}

/// Writes what moved; nothing if nothing did.
pub(super) fn write(html: &mut String, moves: &[Move]) {
    if moves.is_empty() {
        return;
    }
    html.push_str(
        "<section>\n<h2>What moved since the last build</h2>\n<div class=\"wide stack board\">\n<table>\n<thead>\n<tr>\
         <th scope=\"col\">Policy</th><th scope=\"col\">Table</th><th scope=\"col\">Rank before</th>\
         <th scope=\"col\">Rank now</th></tr>\n</thead>\n<tbody>\n",
    );
    for Move { table, policy, from, to } in moves.iter().take(SHOWN) {
        let rank = |rank: &Option<String>, none: &str| {
            rank.as_ref().map_or_else(|| format!("<span class=\"quiet\">{none}</span>"), |rank| name(rank))
        };
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{}</th><td data-label=\"Table\">{}</td><td data-label=\"Rank before\">{}</td>\
             <td data-label=\"Rank now\">{}</td></tr>",
            name(policy),
            name(table),
            rank(from, "new"),
            rank(to, "gone")
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if moves.len() > SHOWN {
        let _ =
            writeln!(html, "<p class=\"note\">{} more changes are in <code>{FILE}</code>.</p>", moves.len() - SHOWN);
    }
    html.push_str("</section>\n");
}
