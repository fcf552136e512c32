//! Entries of a leaderboard, and all its pages.

#![no_main]

use serde::Deserialize;
use serde_json::Value;
use swm::leaderboard::{Entry, board, entries};
use swm_core::files;
use swm_report::{parse_results, write_leaderboard};

/// The content of an entry, without the hash, which the fuzzer computes.
#[derive(Deserialize)]
struct Content {
    version: u32,
    policy: String,
    author: String,
    licence: String,
    processor: String,
    results: Value,
}

libfuzzer_sys::fuzz_target!(
    init: {
        let mut entry = swm_fuzz::entry();
        swm_fuzz::seed("one", &swm_fuzz::json(&entry));
        entry.results.manifest.config["conditions"][0]["variation"]["variation_values"]["agent.color"] =
            serde_json::json!([0, 9, 255]);
        swm_fuzz::seed("shifted", &swm_fuzz::json(&entry));
    },
    |bytes: &[u8]| {
        let (folder, pages) = (swm_fuzz::scratch().join("entries"), swm_fuzz::scratch().join("pages"));
        std::fs::create_dir_all(&folder).expect("a folder in memory");
        // As it is, which is refused at a wrong hash.
        let path = swm_fuzz::file("entries/entry.json", bytes);
        let _ = Entry::read(&path);
        let Ok(Content { version, policy, author, licence, processor, results }) = serde_json::from_slice(bytes) else {
            return;
        };
        let Ok(results) = parse_results(&path, results.to_string().as_bytes()) else { return };
        let entry = Entry { version, policy, author, licence, processor, results, hash: String::new() };
        entry.sealed().and_then(|entry| entry.write(&path)).expect("a file in memory");
        let Ok(found) = entries(&folder) else { return };
        let board = board(&found, "fuzz").expect("tables of valid entries");
        write_leaderboard(&board, &pages).expect("pages of valid entries");
        assert!(board.pages().iter().all(|page| files::read(&pages.join(page), 5_000_000).is_ok()));
    }
);
