//! [`board`]: the tables of a folder of entries.

use super::Entry;
use super::entry::baseline;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::results::Run;
use swm_core::{Error, Result, VariationRequest};
use swm_eval::{Condition, EvalRequest, PolicyRequest, StartsRequest};
use swm_report::{BoardEntry, BoardRow, BoardTable, Leaderboard};

/// The most entries of a leaderboard.
const MAX_ENTRIES: usize = 1000;
/// The largest size of all entries together, in bytes.
const MAX_BYTES: u64 = 256 << 20;
/// The levels of folders that may have entries, with the folder itself.
const DEPTH: usize = 3;
/// The characters of a hash in the name of a page.
const SHORT_HASH: usize = 12;

/// An entry and its file.
#[derive(Clone, Debug)]
pub struct Found {
    /// The path of the file, relative to the folder.
    pub file: PathBuf,
    /// The entry.
    pub entry: Entry,
}

/// Reads all entries of a folder: its files `*.json` and those of its folders, by name. What would be left out is an error: a
/// symbolic link to an entry or a folder, a pipe or a device with such a name, and an entry too many folders below.
///
/// # Errors
/// When there is no entry, one would be left out, a file is no valid entry, two entries are equal, or there are too many.
pub fn entries(folder: &Path) -> Result<Vec<Found>> {
    let mut files = vec![];
    add(folder, DEPTH, &mut files)?;
    files.sort();
    if files.is_empty() || files.len() > MAX_ENTRIES {
        let problem = format!("it has {} entries (*.json)", files.len());
        let fix = format!("give a folder with 1 to {MAX_ENTRIES}; `swm leaderboard submit` writes them");
        return Err(Error::config(folder.display().to_string(), problem, fix));
    }
    let sizes = files.iter().map(|path| std::fs::metadata(path).map_or(0, |metadata| metadata.len()));
    let bytes = sizes.fold(0_u64, u64::saturating_add);
    if bytes > MAX_BYTES {
        let problem = format!("its entries have {bytes} bytes together, more than {MAX_BYTES}");
        return Err(Error::config(folder.display().to_string(), problem, "build several leaderboards"));
    }
    let mut found: Vec<Found> = vec![];
    for path in files {
        let file = path.strip_prefix(folder).unwrap_or(&path).to_owned();
        let name = file.to_string_lossy();
        if name.contains(|c: char| c.is_control()) {
            let problem = format!("the file name {name:?} has a line feed or another control character");
            return Err(Error::config("the entries", problem, "rename the file"));
        }
        let entry = Entry::read(&path)?;
        if let Some(same) = found.iter().find(|other| other.entry.hash == entry.hash) {
            let problem = format!("{} is the same entry", same.file.display());
            return Err(Error::config(path.display().to_string(), problem, "remove one of them"));
        }
        found.push(Found { file, entry });
    }
    Ok(found)
}

/// Adds the entries of a folder; hidden files and folders have none. `depth` is the number of levels of folders that may still have
/// some.
fn add(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<()> {
    let io = |error| Error::io(folder, "listing the entries", error);
    for item in std::fs::read_dir(folder).map_err(io)? {
        let item = item.map_err(io)?;
        // The type of the item itself, not that of the target of a link.
        let (kind, path) = (item.file_type().map_err(io)?, item.path());
        if item.file_name().as_encoded_bytes().starts_with(b".") {
            continue;
        }
        let is_entry = path.extension().is_some_and(|end| end == "json");
        let left_out = match kind {
            _ if kind.is_symlink() && (is_entry || path.is_dir()) => Some("is a symbolic link, which is not followed"),
            _ if kind.is_dir() || !is_entry => None,
            _ if !kind.is_file() => Some("is not a regular file"),
            _ if depth == 0 => Some("is too many folders below that of the entries"),
            _ => None,
        };
        if let Some(problem) = left_out {
            let fix = "copy the entries into the folder or at most two below, or move this out of it";
            return Err(Error::config(path.display().to_string(), problem, fix));
        }
        if kind.is_dir() {
            add(&path, depth.saturating_sub(1), files)?;
        } else if is_entry {
            files.push(path);
        }
        if files.len() > MAX_ENTRIES {
            break;
        }
    }
    Ok(())
}

/// Returns the tables of entries: one for each environment, task and condition. Entries share a table if their episodes have
/// the same starts, goals, time limit and counting; the resolution of frames is the model's own.
///
/// # Errors
/// When an entry has no request.
pub fn board(found: &[Found], title: &str) -> Result<Leaderboard> {
    let mut tables: Vec<BoardTable> = vec![];
    // The index of a table by what its entries have in common: there may be very many.
    let mut known: BTreeMap<String, usize> = BTreeMap::new();
    let mut pages = vec![];
    for (index, Found { file, entry }) in found.iter().enumerate() {
        let request = entry.request()?;
        pages.push(page(file, entry)?);
        for condition in &request.conditions {
            let at = *known.entry(key(entry, &request, condition)).or_insert_with(|| {
                tables.push(table(entry, &request, condition));
                tables.len() - 1
            });
            add_runs(&mut tables[at], index, entry, (&request, condition));
        }
    }
    // The tables of an environment stand together, in the order of their entries.
    tables.sort_by(|a, b| a.env.cmp(&b.env));
    for table in &mut tables {
        name_rows(table, &pages);
    }
    Ok(Leaderboard { title: title.to_owned(), tables, entries: pages })
}

/// Adds the runs of an entry under a condition to its table.
fn add_runs(table: &mut BoardTable, entry: usize, of: &Entry, (request, condition): (&EvalRequest, &Condition)) {
    for PolicyRequest { name, kind } in &request.policies {
        let is_run = |run: &&Run| run.policy == *name && run.condition == condition.name;
        let Some(run) = of.results.runs.iter().find(is_run) else { continue };
        let row = |label: String, entry| BoardRow { label, entry, run: run.clone() };
        match baseline(kind) {
            None => table.rows.push(row(name.clone(), Some(entry))),
            // Equal policies without weights have equal episodes.
            Some(_)
                if table.baselines.iter().any(|row| row.run.episodes == run.episodes && row.run.policy == *name) => {}
            Some(_) => table.baselines.push(row(name.clone(), None)),
        }
    }
}

/// Adds to names of policies that several entries have what distinguishes them.
fn name_rows(table: &mut BoardTable, pages: &[BoardEntry]) {
    let names: Vec<String> = table.rows.iter().map(|row| row.label.clone()).collect();
    for row in &mut table.rows {
        if names.iter().filter(|name| **name == row.label).count() > 1
            && let Some(page) = row.entry.and_then(|entry| pages.get(entry))
        {
            row.label = format!("{} ({})", row.label, page.hash.chars().take(6).collect::<String>());
        }
    }
}

/// What the entries of a table have in common, as a text.
fn key(entry: &Entry, request: &EvalRequest, condition: &Condition) -> String {
    let starts = match &request.starts {
        StartsRequest::Episodic => json!("episodic"),
        StartsRequest::Dataset { goal_offset, held_out, .. } => {
            json!([entry.results.manifest.hashes.get("dataset"), goal_offset, held_out])
        }
    };
    let frames = [json!(request.wrappers), json!(request.wrap_goal)];
    let episodes = [json!(request.episodes), json!(request.seed), json!(request.budget), json!(request.counting)];
    json!([request.env, starts, frames, episodes, condition.variation]).to_string()
}

/// An empty table.
fn table(entry: &Entry, request: &EvalRequest, condition: &Condition) -> BoardTable {
    let mut task = vec![];
    let mut fact = |name: &str, value: String| task.push((name.to_owned(), value));
    match &request.starts {
        StartsRequest::Episodic => fact("starts and goals", "drawn by the environment".to_owned()),
        StartsRequest::Dataset { goal_offset, held_out, .. } => {
            let part = held_out.map_or(String::new(), |held_out| format!(" of the {} part", held_out.part));
            fact("starts", format!("rows{part} of a dataset"));
            fact("goals", format!("{goal_offset} steps later in the recording"));
            let hash = entry.results.manifest.hashes.get("dataset").cloned().unwrap_or_default();
            fact("dataset (BLAKE3)", hash);
        }
    }
    fact("episodes", format!("{}, with the seed {}", request.episodes, request.seed));
    fact("time limit", request.budget.map_or("that of the environment".to_owned(), |steps| format!("{steps} steps")));
    fact("counting", request.counting.to_string());
    for wrapper in &request.wrappers {
        let settings = if wrapper.settings.is_null() { String::new() } else { format!(" {}", wrapper.settings) };
        fact("wrapper", format!("{}{settings}", wrapper.id));
    }
    BoardTable {
        env: request.env.clone(),
        condition: describe(&condition.variation, request),
        task,
        counting: request.counting,
        baselines: vec![],
        rows: vec![],
    }
}

/// The condition in words. The name of a condition is free, so that a stranger could name an easy one as another.
fn describe(variation: &VariationRequest, request: &EvalRequest) -> String {
    let sampled = match &variation.variation {
        None => vec![],
        Some(keys) if keys.is_empty() => vec!["no factor sampled".to_owned()],
        Some(keys) => keys.iter().map(|key| format!("{key} sampled")).collect(),
    };
    let value = |values: &Vec<f64>| values.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
    let pinned = variation.variation_values.iter().map(|(key, values)| format!("{key}={}", value(values)));
    let wrapped = request.wrappers.iter().map(|wrapper| wrapper.id.clone());
    let parts: Vec<String> = sampled.into_iter().chain(pinned).chain(wrapped).collect();
    if parts.is_empty() { "in distribution".to_owned() } else { parts.join(", ") }
}

/// The page of an entry.
fn page(file: &Path, entry: &Entry) -> Result<BoardEntry> {
    let words: String = entry.policy.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    let words = words.trim_matches('-').to_lowercase();
    let hash: String = entry.hash.chars().take(SHORT_HASH).collect();
    Ok(BoardEntry {
        policy: entry.policy.clone(),
        author: entry.author.clone(),
        licence: entry.licence.clone(),
        processor: entry.processor.clone(),
        hash: entry.hash.clone(),
        weights: entry.weights()?.to_owned(),
        page: format!("{}-{hash}", words.chars().take(40).collect::<String>()),
        command: format!("swm leaderboard verify {}", quoted(&file.to_string_lossy())),
        results: entry.results.clone(),
    })
}

/// A file name as one word of a shell.
fn quoted(name: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "._/-".contains(c);
    let name = if name.starts_with('-') { format!("./{name}") } else { name.to_owned() };
    if name.chars().all(is_plain) { name } else { format!("'{}'", name.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_are_words_of_a_shell() {
        for (name, word) in [
            ("sub/two-room.json", "sub/two-room.json"),
            ("a; rm -r x.json", "'a; rm -r x.json'"),
            ("it's.json", "'it'\\''s.json'"),
            ("--trust.json", "./--trust.json"),
        ] {
            assert_eq!(quoted(name), word);
        }
    }

    #[test]
    fn very_many_conditions_have_tables_at_once() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../leaderboard/two-room-lewm.json");
        let mut entry = Entry::read(&file).expect("an entry");
        entry.results.runs.clear();
        let found = (0..300).map(|i| {
            let mut entry = entry.clone();
            let values = |j: usize| json!({"variation": null, "variation_values": {"agent.color": [i, j, 0]}});
            let conditions: Vec<_> = (0..200).map(|j| json!({"name": "c", "variation": values(j)})).collect();
            entry.results.manifest.config["conditions"] = conditions.into();
            Found { file: file.clone(), entry }
        });
        let (found, start) = (Vec::from_iter(found), std::time::Instant::now());
        assert_eq!(board(&found, "b").expect("tables").tables.len(), 60_000);
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }
}
