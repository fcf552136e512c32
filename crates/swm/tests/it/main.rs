//! The `swm` command from outside, as a user meets it.
#![allow(missing_docs, clippy::print_stdout)]

mod collecting;
mod data;
mod gym;
mod listing;
mod pipeline;
mod python;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A `swm` with a home of its own.
pub(crate) struct Swm {
    home: tempfile::TempDir,
}

impl Swm {
    pub fn new() -> Self {
        Self { home: tempfile::tempdir().expect("a temporary folder") }
    }

    pub fn home(&self) -> &Path {
        self.home.path()
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.home().join(name)
    }

    /// The command, ready to run.
    pub fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_swm"));
        command.args(args).env("STABLEWM_HOME", self.home()).current_dir(self.home());
        command
    }

    pub fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().expect("swm starts")
    }

    /// Runs it, expects success, and reads its one JSON document.
    pub fn json(&self, args: &[&str]) -> serde_json::Value {
        let args: Vec<&str> = args.iter().copied().chain(["--json"]).collect();
        let output = self.run(&args);
        assert!(output.status.success(), "swm {args:?}: {}", text(&output.stderr));
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|error| panic!("swm {args:?} printed no JSON: {error}: {}", text(&output.stdout)))
    }

    /// Runs it, expects this exit code and an error that says all of `words`, without a panic.
    pub fn refuses(&self, args: &[&str], code: i32, words: &[&str]) {
        let output = self.run(args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "swm {args:?}: {error}");
        assert!(!error.contains("panicked"), "swm {args:?}: {error}");
        for word in words {
            assert!(error.contains(word), "swm {args:?} does not say '{word}': {error}");
        }
    }
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
