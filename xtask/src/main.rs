//! Checks and chores of the workspace.
//!
//! `cargo xtask check` runs everything a change must pass apart from the tests, cheapest first, and stops at the
//! first failure. `cargo xtask layers` and `cargo xtask table` run one check each.

// A program that talks to people; the lint guards the libraries.
#![allow(clippy::print_stdout, clippy::print_stderr)]

mod graph;
mod layers;
mod table;

use anyhow::{Context as _, Result, bail};
use graph::Graph;
use std::path::PathBuf;
use std::process::{Command, ExitCode};

const USAGE: &str = "usage: cargo xtask COMMAND

  check    everything below and more, cheapest first: fmt, layers, table, clippy
  layers   no crate reaches what its layer must not know
  table    the crate table of ARCHITECTURE.md is true";

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["check"] => check(),
        ["layers"] => Graph::load(&root()).and_then(|graph| layers(&graph)),
        ["table"] => Graph::load(&root()).and_then(|graph| table(&graph)),
        ["help" | "--help" | "-h"] => {
            println!("{USAGE}");
            Ok(())
        }
        _ => {
            eprintln!("{USAGE}");
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

fn check() -> Result<()> {
    cargo(&["fmt", "--all", "--", "--check"], "run `cargo fmt --all`")?;
    println!("fmt: fine");
    let graph = Graph::load(&root())?;
    layers(&graph)?;
    table(&graph)?;
    cargo(
        &["clippy", "--release", "--workspace", "--all-targets", "--", "-D", "warnings"],
        "mend what clippy names above",
    )?;
    println!("clippy: fine");
    Ok(())
}

fn layers(graph: &Graph) -> Result<()> {
    verdict("layers", &layers::violations(graph, layers::RULES))
}

fn table(graph: &Graph) -> Result<()> {
    let path = root().join("ARCHITECTURE.md");
    let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    verdict("table", &table::violations(graph, &table::parse(&text)?))
}

fn verdict(what: &str, violations: &[String]) -> Result<()> {
    if violations.is_empty() {
        println!("{what}: fine");
        return Ok(());
    }
    bail!("{what}: {} found\n  {}", violations.len(), violations.join("\n  "))
}

fn cargo(arguments: &[&str], fix: &str) -> Result<()> {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let words = arguments.join(" ");
    let mut command = Command::new(program);
    // What `cargo run` told this program about itself is not for others: build scripts that watch these variables (ring's)
    // would run again, and everything above them be compiled again, at every change between check and build.
    let own = std::env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name == "OUT_DIR" || name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_")
    });
    own.for_each(|name| {
        command.env_remove(name);
    });
    let status =
        command.args(arguments).current_dir(root()).status().with_context(|| format!("starting `cargo {words}`"))?;
    if !status.success() {
        bail!("`cargo {words}` failed ({status}); {fix}");
    }
    Ok(())
}

/// The workspace's folder: the one that cargo runs this in, which need not be the one it was compiled in when two
/// checkouts share a target folder.
fn root() -> PathBuf {
    let here = std::env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    let here = PathBuf::from(here);
    here.parent().map(PathBuf::from).unwrap_or(here)
}
