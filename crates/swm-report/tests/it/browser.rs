//! Tests of pages in headless Chromium: no text is cut off or overlaps another at 400, 800 and 1400 pixels, light and dark.
//!
//! `make test-browser` installs Chromium and runs them.

use super::{results, results_with_all_parts, run, study};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_core::Results;
use swm_core::results::{Comparison, Counting};
use swm_report::{BoardEntry, BoardRow, BoardTable, Leaderboard, Metrics, ReportOptions, Series, Training};
use swm_report::{write_leaderboard, write_report_with, write_study, write_table};

/// Measures pages; returns whether all are without faults, and what was printed.
fn check(pages: &[PathBuf]) -> (bool, String) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser/check.py");
    let output = Command::new("python3").arg(script).args(pages).output().expect("running python3");
    let [printed, errors] = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert!(errors.is_empty(), "{errors}");
    assert_eq!(printed.lines().count(), 6 * pages.len(), "{printed}");
    (output.status.success(), printed)
}

/// Names that are long, without spaces, or of another script.
const NAMES: [&str; 4] = [
    "random",
    "checkpoints/a-policy-whose-name-has-no-spaces-and-is-much-longer-than-any-column-of-a-table-or-a-chart",
    "光源の位置と背景の色が同時に変わる条件のとても長い名前",
    "a policy with a long name of several words that can be broken over lines",
];

/// Results with long names under many conditions.
fn long_names() -> Results {
    let conditions = ["in distribution", NAMES[1], NAMES[2], "agent.color=0,0,255, agent.size=12"];
    let each = conditions.iter().enumerate().flat_map(|(i, condition)| {
        NAMES
            .iter()
            .enumerate()
            .map(move |(j, policy)| run(condition, policy, 300, (i * 97 + j * 61) % 300, Some(1.25)))
    });
    let runs: Vec<_> = each.collect();
    let mut found = results();
    found.env = "ALE/ThirdPartyEnvironmentWithALongName-v5,frameskip=4,repeat_action_probability=0.25".to_owned();
    found.manifest.device = NAMES[1].to_owned();
    found.manifest.config = serde_json::json!({"note": NAMES[1].repeat(5)});
    Results { comparisons: Comparison::all(&runs, Counting::default()), runs, ..found }
}

/// Training curves of several metrics.
fn training() -> Training {
    let series = |name: &str, size: f64| Series {
        name: name.to_owned(),
        points: (0..500).map(|i| (f64::from(i * 200), size / f64::from(i + 1))).collect(),
    };
    let series = ["loss", "loss/a-very-long-name-of-a-metric/of-a-part", "optimizer/lr"].map(|name| series(name, 1e-3));
    let metrics = Metrics { over: "step".to_owned(), series: series.to_vec() };
    Training { policy: "lewm-tiny".to_owned(), metrics: Ok(metrics) }
}

/// A leaderboard with long names.
fn leaderboard() -> Leaderboard {
    let row = |policy: &str, i: usize, entry| BoardRow {
        label: policy.to_owned(),
        entry,
        run: run("in distribution", policy, 300, 70 * (i + 1), Some(1.25)),
    };
    let task = [("dataset (BLAKE3)", "ab".repeat(32)), ("starts", "rows of the test part of a dataset".to_owned())];
    let table = |condition: &str| BoardTable {
        env: "swm/TwoRoom-v1".to_owned(),
        condition: condition.to_owned(),
        task: task.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect(),
        baselines: ["random", "no-op"].iter().enumerate().map(|(i, name)| row(name, i, None)).collect(),
        rows: NAMES[1..].iter().enumerate().map(|(i, name)| row(name, i + 1, Some(i))).collect(),
        ..BoardTable::default()
    };
    let entry = |(i, name): (usize, &&str)| BoardEntry {
        policy: (*name).to_owned(),
        author: NAMES[i + 1].to_owned(),
        licence: "MIT OR Apache-2.0".to_owned(),
        processor: "x86_64 avx512".to_owned(),
        hash: "cd".repeat(32),
        weights: "ef".repeat(32),
        page: format!("entry-{i}"),
        command: format!("swm leaderboard verify {}.json", NAMES[1]),
        results: long_names(),
    };
    Leaderboard {
        title: "Leaderboard".to_owned(),
        tables: vec![table("in distribution"), table(NAMES[1])],
        entries: NAMES[1..].iter().enumerate().map(entry).collect(),
    }
}

#[test]
#[ignore = "needs Chromium: make test-browser"]
fn texts_of_pages_are_whole_in_a_browser() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut pages = vec![];
    let all = [
        ("plain", vec![results()]),
        ("parts", vec![results_with_all_parts()]),
        ("long", vec![long_names(), results()]),
    ];
    for (name, found) in all {
        let files: Vec<_> = found.into_iter().map(|results| (PathBuf::from("a/results.json"), results)).collect();
        let options = ReportOptions { training: vec![training()], ..ReportOptions::default() };
        pages.push(write_report_with(&files, &options, &folder.path().join(name)).expect("writing the page"));
    }
    for (i, page) in study::pages().iter().enumerate() {
        pages.push(write_study(page, &folder.path().join(format!("study-{i}"))).expect("writing the page"));
    }
    pages.push(write_table(&study::table(), &folder.path().join("table")).expect("writing the page"));
    let (board, site) = (leaderboard(), folder.path().join("site"));
    write_leaderboard(&board, &site).expect("writing the pages");
    pages.extend(board.pages().iter().take(2).map(|page| site.join(page)));
    let (fine, printed) = check(&pages);
    assert!(fine, "{printed}");
}

#[test]
#[ignore = "needs Chromium: make test-browser"]
fn faults_of_a_page_are_found() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = folder.path().join("index.html");
    let body = "<p style=\"margin: 0\">the first line</p><p style=\"position: absolute; top: 8px\">another</p>\
                <div style=\"width: 40px; overflow: hidden; white-space: nowrap\">a long text in a small box</div>\
                <p style=\"margin-left: 1390px\">far to the right</p>";
    fs::write(&page, format!("<!DOCTYPE html><html><body>{body}</body></html>")).expect("writing the page");
    let (fine, printed) = check(&[page]);
    assert!(!fine);
    for kind in ["overlap", "cut off", "outside the page", "wide page"] {
        assert!(printed.lines().all(|line| line.contains(&format!("\"kind\": \"{kind}\""))), "{kind}: {printed}");
    }
}
