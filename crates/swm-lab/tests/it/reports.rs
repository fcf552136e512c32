//! Results and studies: their list, and pages under a policy of their own.

use super::{TOKEN, TestLab};
use serde_json::json;
use std::fs;
use std::io::{Read as _, Write as _};
use std::path::Path;
use swm_core::{Error, Result};
use swm_lab::reports::{Kind, Reports, Summary};

/// Shows the files as they are.
pub struct Files;

impl Reports for Files {
    fn summary(&self, kind: Kind, folder: &Path) -> Result<Summary> {
        let title = self.page(kind, folder)?;
        if title.is_empty() {
            return Err(Error::corrupt(folder, "it is empty", "evaluate again"));
        }
        Ok(Summary { title, lines: vec![] })
    }

    fn page(&self, kind: Kind, folder: &Path) -> Result<String> {
        let file = folder.join(kind.file());
        fs::read_to_string(&file).map_err(|error| Error::io(file, "reading", error))
    }
}

#[test]
fn pages_of_a_leaderboard_are_shown_and_no_other_file() {
    let lab = TestLab::start();
    let board = lab.home.path().join("boards/site");
    fs::create_dir_all(board.join("entries")).expect("folders");
    let files = [
        ("last-build", "{}"),
        ("index.html", "<a href=\"entries/a.html\">tables</a>"),
        ("entries/a.html", "entry a"),
        ("entries/b.txt", "no page"),
    ];
    for (file, text) in files {
        fs::write(board.join(file), text).expect("a file");
    }
    fs::write(lab.home.path().join("secret.html"), "secret").expect("a file");
    std::os::unix::fs::symlink(lab.home.path().join("secret.html"), board.join("entries/link.html")).expect("a link");
    let listed = &lab.json("api/reports")["reports"][0];
    assert_eq!((&listed["kind"], &listed["title"]), (&json!("leaderboard"), &json!("1 entries")));
    assert_eq!(listed["pages"], json!(["a.html"]));
    let page = |entry: &str| lab.get(&format!("api/report?name=boards/site&entry={entry}"));
    assert_eq!(page(""), (200, b"<a data-entry=\"a.html\">tables</a>".to_vec()));
    assert_eq!(page("a.html"), (200, b"entry a".to_vec()));
    let linked = lab.home.path().join("boards/linked");
    fs::create_dir(&linked).expect("a folder");
    fs::write(linked.join("last-build"), "{}").expect("a file");
    std::os::unix::fs::symlink(board.join("entries"), linked.join("entries")).expect("a link");
    fs::create_dir(lab.home.path().join("boards/link")).expect("a folder");
    std::os::unix::fs::symlink(board.join("last-build"), lab.home.path().join("boards/link/last-build"))
        .expect("a link");
    let reports = &lab.json("api/reports")["reports"];
    assert_eq!((&reports[0]["name"], &reports[0]["pages"]), (&json!("boards/linked"), &json!([])));
    assert_eq!(reports.as_array().map(Vec::len), Some(2), "a folder whose file is a link is no report");
    for entry in ["b.txt", "link.html", "../index.html", "../../../secret.html", "/etc/passwd", "..%2Flast-build"] {
        assert_eq!(page(entry).0, 400, "{entry}");
    }
}

#[test]
fn reports_are_listed_and_cannot_reach_the_lab() {
    let lab = TestLab::start();
    let write = |file: &str, text: &str| {
        let file = lab.home.path().join(file);
        fs::create_dir_all(file.parent().expect("a parent")).expect("a folder");
        fs::write(file, text).expect("a file");
    };
    write("results/lewm/results.json", "<script>alert(1)</script>");
    write("studies/factors/study.json", "factors");
    write("studies/broken/results.json", "");
    write("studies/why/autopsy.json", "why it fails");
    write("studies/why/study.json", "the arms");
    write("datasets/raw/results.json", "no report");
    fs::create_dir_all(lab.home.path().join("secret")).expect("a folder");
    std::os::unix::fs::symlink("/etc", lab.home.path().join("results/link")).expect("a link");
    let listed = lab.json("api/reports");
    let rows = listed["reports"].as_array().expect("reports").iter();
    let rows: Vec<_> = rows.map(|row| (row["name"].clone(), row["kind"].clone(), row["error"].is_string())).collect();
    let row = |name, kind, is_broken| (json!(name), json!(kind), is_broken);
    assert_eq!(
        rows,
        [
            row("results/lewm", "results", false),
            row("studies/broken", "results", true),
            row("studies/factors", "study", false),
            row("studies/why", "autopsy", false)
        ]
    );
    let mut stream = lab.connect();
    let head = format!(
        "GET /{TOKEN}/api/report?name=results/lewm HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
        lab.host()
    );
    stream.write_all(head.as_bytes()).expect("sending");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
    let head = head.to_lowercase();
    assert_eq!(body, "<script>alert(1)</script>");
    let policies: Vec<&str> = head.lines().filter(|line| line.starts_with("content-security-policy")).collect();
    assert!(
        policies.len() == 1
            && policies[0].contains("sandbox allow-popups")
            && policies[0].contains("default-src 'none'")
    );
    for part in ["allow-scripts", "allow-same-origin", "script-src", "connect-src"] {
        assert!(!policies[0].contains(part), "{part}");
    }
    assert!(head.contains("nosniff") && head.contains("no-referrer"));
    for name in ["../results/lewm", "results", "results/link", "datasets", "/etc", "", "secret"] {
        assert_eq!(lab.get(&format!("api/report?name={name}")).0, 400, "{name}");
    }
}
