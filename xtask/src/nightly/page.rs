//! The page of the nightly checks, `docs/nightly.md`, which also holds their state: the rows of the last runs, and the
//! time that each fuzzer ran in all.

use anyhow::{Context as _, Result};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// The text before the tables.
const HEAD: &str = "# Nightly checks

`make nightly` runs what takes too long for `make test`, in parts of two hours together, and writes this page. A run that was
stopped continues with the first part that has not passed on the same commit; `make nightly PART=fuzz` runs one part. No
nightly toolchain is required.

The fuzzers and the part `asan` compile the crates of the workspace with AddressSanitizer, checks of overflow and coverage counters
(`xtask/instrument.sh`), and use the libraries of ordinary builds, which are not instrumented. AddressSanitizer does not run over
`swm-video`, `swm-mujoco` and the Python extension, whose `unsafe` code is calls of C libraries (FFmpeg, MuJoCo, EGL, Python).
";

/// The text before the table of the fuzzers.
const FUZZERS: &str = "
## Fuzzers

The time of all runs on the machine that writes this page. A night runs each for ten minutes, the shortest time first; the goal
is an hour each. A finding becomes a test of the crate that owns the parser.

| fuzzer | minutes | inputs | findings |
| --- | --- | --- | --- |
";

/// The result of a part.
pub struct Row<'a> {
    pub part: &'a str,
    pub what: &'a str,
    pub passed: bool,
    pub result: String,
    pub minutes: f64,
    pub commit: &'a str,
    pub date: String,
}

/// The totals of a fuzzer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Totals {
    pub minutes: f64,
    pub inputs: u64,
    pub findings: u64,
}

/// The page.
#[derive(Debug, Default, PartialEq)]
pub struct Page {
    /// The cells of the table of parts.
    parts: Vec<[String; 6]>,
    fuzzers: BTreeMap<String, Totals>,
}

impl Page {
    /// Reads the page; an empty one if there is no file.
    pub fn read(path: &Path) -> Result<Self> {
        match std::fs::read_to_string(path) {
            Ok(text) => Ok(Self::parse(&text)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error).with_context(|| format!("reading {}", path.display())),
        }
    }

    fn parse(text: &str) -> Self {
        let mut page = Self::default();
        for line in text.lines().filter(|line| line.starts_with("| ")) {
            let cells: Vec<String> = line.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect();
            match <[String; 6]>::try_from(cells) {
                Ok(cells) if cells[0] != "part" && cells[0] != "---" => page.parts.push(cells),
                Ok(_) => {}
                Err(cells) => {
                    let [name, minutes, inputs, findings] = &cells[..] else { continue };
                    let (Ok(minutes), Ok(inputs), Ok(findings)) = (minutes.parse(), inputs.parse(), findings.parse())
                    else {
                        continue;
                    };
                    page.fuzzers.insert(name.clone(), Totals { minutes, inputs, findings });
                }
            }
        }
        page
    }

    /// Whether a part passed on a commit.
    pub fn passed(&self, part: &str, commit: &str) -> bool {
        self.parts.iter().any(|cells| cells[0] == part && cells[2].starts_with("passed") && cells[4] == commit)
    }

    /// The time that a fuzzer ran in all.
    pub fn minutes(&self, fuzzer: &str) -> f64 {
        self.fuzzers.get(fuzzer).map_or(0.0, |totals| totals.minutes)
    }

    /// Replaces the row of a part.
    pub fn set(&mut self, row: Row<'_>) {
        let verdict = if row.passed { "passed" } else { "**failed**" };
        let cells = [
            row.part.to_owned(),
            row.what.to_owned(),
            format!("{verdict}: {}", row.result),
            format!("{:.1}", row.minutes),
            row.commit.to_owned(),
            row.date,
        ];
        match self.parts.iter_mut().find(|cells| cells[0] == row.part) {
            Some(old) => *old = cells,
            None => self.parts.push(cells),
        }
    }

    /// Adds a run of a fuzzer to its totals.
    pub fn add(&mut self, fuzzer: &str, run: Totals) {
        let totals = self.fuzzers.entry(fuzzer.to_owned()).or_default();
        totals.minutes += run.minutes;
        totals.inputs += run.inputs;
        totals.findings += run.findings;
    }

    /// Reads the page, changes it and writes it back.
    pub fn update(path: &Path, change: impl FnOnce(&mut Self)) -> Result<()> {
        let mut page = Self::read(path)?;
        change(&mut page);
        std::fs::write(path, page.text()).with_context(|| format!("writing {}", path.display()))
    }

    fn text(&self) -> String {
        let mut text = format!("{HEAD}\n| part | what ran | result | minutes | commit | date |\n");
        text.push_str("| --- | --- | --- | --- | --- | --- |\n");
        for cells in &self.parts {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        }
        text.push_str(FUZZERS);
        for (name, Totals { minutes, inputs, findings }) in &self.fuzzers {
            let _ = writeln!(text, "| {name} | {minutes:.1} | {inputs} | {findings} |");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_page_is_read_back() {
        let mut page = Page::default();
        let row = |passed, commit| Row {
            part: "loom",
            what: "models",
            passed,
            result: "5 tests".to_owned(),
            minutes: 1.25,
            commit,
            date: "2026-01-31".to_owned(),
        };
        page.set(row(false, "aaaa"));
        assert!(!page.passed("loom", "aaaa"));
        page.set(row(true, "bbbb"));
        page.add("jpeg", Totals { minutes: 2.5, inputs: 1000, findings: 1 });
        page.add("jpeg", Totals { minutes: 0.5, inputs: 10, findings: 0 });
        let read = Page::parse(&page.text());
        assert_eq!(read, page);
        assert!(read.passed("loom", "bbbb") && !read.passed("loom", "aaaa") && !read.passed("fuzz", "bbbb"));
        assert!(read.minutes("jpeg") == 3.0 && read.minutes("png") == 0.0);
        assert_eq!(read.fuzzers["jpeg"], Totals { minutes: 3.0, inputs: 1010, findings: 1 });
    }
}
