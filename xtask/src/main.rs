//! Checks of the workspace.
//!
//! `cargo xtask check` runs all checks that a change must pass, except the tests. The cheapest check runs first, and
//! the command stops at the first failure. Every check is also a separate command.

// The printing lints are for libraries; this is a command-line program.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command-line program prints")]

mod book;
mod columns;
mod cycles;
mod deletes;
mod features;
mod graph;
mod layers;
mod links;
mod nightly;
mod registries;
mod sizes;
mod source;
mod table;
mod words;

use anyhow::{Context as _, Result, bail};
use graph::Graph;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// A check: the name, the checked property, and the function that runs the check.
type Check = (&'static str, &'static str, fn() -> Result<()>);

/// The checks, cheapest first.
const CHECKS: &[Check] = &[
    ("fmt", "the code is formatted", fmt),
    ("words", "no refused word (words.toml)", || verdict("words", &word_list()?.violations(&prose()?))),
    ("typos", "no misspelt word (the program `typos`)", typos),
    ("links", "every link of a page leads to a file and a heading", || {
        verdict("links", &links::violations(&root(), &source::files(&root(), &[".md"])?))
    }),
    ("sizes", "no file of more than 500 lines", || verdict("sizes", &sizes::violations(&sources()?))),
    ("cycles", "no import cycle of more than four files", || verdict("cycles", &cycles::violations(&sources()?))),
    ("columns", "only swm-core spells the standard columns", || verdict("columns", &columns::violations(&sources()?))),
    ("deletes", "only swm_core::files deletes files and folders", || {
        verdict("deletes", &deletes::violations(&source::files(&root(), &[".rs", ".py"])?))
    }),
    ("registries", "every ENTRY is in a registry list", || verdict("registries", &registries::violations(&sources()?))),
    ("layers", "no crate depends on a package that its layer forbids", || {
        verdict("layers", &layers::violations(&graph()?, layers::RULES))
    }),
    ("table", "the crate table of ARCHITECTURE.md matches the workspace", table),
    ("features", "every build compiles a library with the same features", || {
        verdict("features", &features::violations(&root())?)
    }),
    ("clippy", "no warning", clippy),
];

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["check"] => CHECKS.iter().try_for_each(|(_, _, run)| run()),
        ["book", folder] => book::book(&root(), Path::new(folder)),
        ["nightly"] => nightly::nightly(None),
        ["nightly", part] => nightly::nightly(Some(part)),
        ["help" | "--help" | "-h"] => {
            println!("{}", usage());
            Ok(())
        }
        [name] if CHECKS.iter().any(|(check, ..)| *check == name) => {
            CHECKS.iter().filter(|(check, ..)| *check == name).try_for_each(|(_, _, run)| run())
        }
        _ => {
            eprintln!("{}", usage());
            return ExitCode::from(2);
        }
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn usage() -> String {
    let rows: Vec<String> = CHECKS.iter().map(|(name, proves, _)| format!("  {name:<11}{proves}")).collect();
    format!(
        "usage: cargo xtask COMMAND\n\n  book       the documentation as static pages: `book DIR` (`make docs`)\n  nightly    long checks, in parts; `nightly PART` runs one (docs/nightly.md)\n  \
         check      all of the following, cheapest first\n{}",
        rows.join("\n")
    )
}

fn fmt() -> Result<()> {
    cargo(&["fmt", "--all", "--", "--check"], "run `cargo fmt --all`")?;
    verdict("fmt", &[])
}

fn clippy() -> Result<()> {
    cargo(
        &[
            "clippy",
            "--release",
            "--workspace",
            "--all-targets",
            "--features",
            "swm-fuzz/libfuzzer",
            "--",
            "-D",
            "warnings",
        ],
        "fix what clippy names above",
    )?;
    verdict("clippy", &[])
}

fn typos() -> Result<()> {
    let program = std::env::var_os("SWM_TYPOS").unwrap_or_else(|| "typos".into());
    let status = Command::new(&program).args(["--config", "xtask/typos.toml"]).current_dir(root()).status();
    let status = status.with_context(|| {
        format!("starting {}: install it with `pip install typos`, or name it in SWM_TYPOS", program.display())
    })?;
    if !status.success() {
        bail!("typos: correct the words above, or add names to xtask/typos.toml");
    }
    verdict("typos", &[])
}

fn table() -> Result<()> {
    let path = root().join("ARCHITECTURE.md");
    let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    verdict("table", &table::violations(&graph()?, &table::parse(&text)?))
}

fn graph() -> Result<Graph> {
    Graph::load(&root())
}

/// Rust sources of libraries and programs, without integration tests.
fn sources() -> Result<Vec<source::File>> {
    let mut files = source::files(&root(), &[".rs"])?;
    files.retain(|file| file.path.contains("/src/"));
    Ok(files)
}

/// All text files: code, documents, Python, presets. The files of `xtask` are omitted, because they list refused words.
fn prose() -> Result<Vec<source::File>> {
    let mut files = source::files(&root(), &[".rs", ".md", ".py", ".toml", "Makefile"])?;
    files.retain(|file| !file.path.starts_with("xtask/"));
    Ok(files)
}

fn word_list() -> Result<words::Words> {
    let path = root().join("xtask/words.toml");
    words::Words::parse(&std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?)
}

fn verdict(what: &str, violations: &[String]) -> Result<()> {
    if violations.is_empty() {
        println!("{what}: passed");
        return Ok(());
    }
    bail!("{what}: {} found\n  {}", violations.len(), violations.join("\n  "))
}

fn cargo(arguments: &[&str], fix: &str) -> Result<()> {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let words = arguments.join(" ");
    let mut command = Command::new(program);
    forget_own_package(&mut command);
    let status =
        command.args(arguments).current_dir(root()).status().with_context(|| format!("starting `cargo {words}`"))?;
    if !status.success() {
        bail!("`cargo {words}` failed ({status}); {fix}");
    }
    Ok(())
}

/// Removes the variables about this package that `cargo run` sets. In the inner cargo, they would cause build scripts
/// that depend on these variables (such as ring's) to run again, and all dependent crates to be compiled again.
fn forget_own_package(command: &mut Command) {
    let own = std::env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name == "OUT_DIR" || name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_")
    });
    own.for_each(|name| {
        command.env_remove(name);
    });
}

/// The folder of the workspace in which cargo runs this program. If two checkouts share a target folder, the program
/// may have been compiled in another folder.
fn root() -> PathBuf {
    // Checkouts may share a target folder, and with it this program: the folder that it was compiled in may be another one.
    let here = std::env::current_dir().unwrap_or_default();
    let found = here.ancestors().find(|folder| folder.join("xtask/Cargo.toml").is_file());
    found.or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).parent()).map(PathBuf::from).unwrap_or_default()
}
