//! Tests of the `swm` command as a process: arguments, output, exit codes and files.
#![allow(missing_docs, clippy::print_stdout, reason = "a test crate has no public items; skipped tests print why")]

mod autopsy;
mod capsules;
mod collecting;
mod data;
mod deletion;
mod export;
mod finite;
mod foreign;
mod gym;
mod hostile;
mod hub;
mod hub_server;
mod kills;
mod lab;
mod leaderboard;
mod limits;
mod listing;
mod messages;
mod on_ray;
mod output;
mod pipeline;
mod python;
mod recipes;
mod study;
mod study_shipped;
mod terminal;
mod trackers;
mod trust;
mod zoo;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The `swm` command with a temporary home folder.
pub(crate) struct Swm {
    home: tempfile::TempDir,
}

impl Swm {
    pub fn new() -> Self {
        Self { home: tempfile::tempdir().expect("creating a temporary folder") }
    }

    pub fn home(&self) -> &Path {
        self.home.path()
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.home().join(name)
    }

    /// Returns the command with these arguments.
    pub fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_swm"));
        command.args(args).env("STABLEWM_HOME", self.home()).current_dir(self.home());
        command
    }

    pub fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().expect("swm starts")
    }

    /// Runs the command with `--json`, expects success, and parses its JSON document.
    pub fn json(&self, args: &[&str]) -> serde_json::Value {
        let args: Vec<&str> = args.iter().copied().chain(["--json"]).collect();
        let output = self.run(&args);
        assert!(output.status.success(), "swm {args:?}: {}", text(&output.stderr));
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|error| panic!("swm {args:?} printed no JSON: {error}: {}", text(&output.stdout)))
    }

    /// Runs the command; expects this exit code, and an error message with all `parts`, without a panic.
    pub fn fails(&self, args: &[&str], code: i32, parts: &[&str]) {
        let output = self.run(args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "swm {args:?}: {error}");
        assert!(!error.contains("panicked") && !error.contains("internal error"), "swm {args:?}: {error}");
        for part in parts {
            assert!(error.contains(part), "swm {args:?}: no '{part}' in: {error}");
        }
    }
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
