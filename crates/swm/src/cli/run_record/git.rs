//! The commit of the repository around the current folder.
//!
//! A repository may come from a stranger, in an archive. Its configuration can name programs that git starts: monitors of the
//! file system, hooks, filters of contents, and transports that fetch missing objects. None of them is started here.

use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Settings that override those of the repository.
const SETTINGS: [&str; 3] = ["core.fsmonitor=false", "core.hooksPath=/dev/null", "protocol.allow=never"];

/// How long git may take. A configuration that includes a pipe would keep it for ever.
const LONGEST: Duration = Duration::from_secs(5);

/// Returns the commit, with `-dirty` if tracked files, apart from submodules, differ from it; `None` outside of a repository. In a repository with
/// filters of its own, which a comparison of files would start, it says nothing of differences.
pub fn commit() -> Option<String> {
    let describe = ["describe", "--always", "--abbrev=40", "--exclude=*"];
    let output = git(&describe).filter(|output| output.status.success())?;
    let commit = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    Some(if !has_filters() && differs() { format!("{commit}-dirty") } else { commit })
}

/// Whether tracked files differ from the commit. Submodules are left out: their own configuration may have filters.
fn differs() -> bool {
    let compare = ["diff", "--quiet", "--no-ext-diff", "--no-textconv", "--ignore-submodules=all", "HEAD", "--"];
    git(&compare).is_some_and(|output| output.status.code() == Some(1))
}

/// Whether the configuration of the repository itself has filters, or cannot be read. Those of the user are the user's own.
fn has_filters() -> bool {
    let list = ["config", "--includes", "--show-scope", "--name-only", "--get-regexp", r"^filter\."];
    let Some(output) = git(&list) else { return true };
    match output.status.code() {
        // Nothing matches.
        Some(1) => false,
        Some(0) => {
            let text = String::from_utf8_lossy(&output.stdout);
            !text.lines().all(|line| line.starts_with("global") || line.starts_with("system"))
        }
        _ => true,
    }
}

/// Runs git. `None` if it cannot be started or takes too long.
fn git(arguments: &[&str]) -> Option<Output> {
    let mut git = Command::new("git");
    git.args(SETTINGS.iter().flat_map(|setting| ["-c", setting])).args(arguments).stdin(Stdio::null());
    // Without these, git writes the index, for which a hook runs, and fetches objects that are missing.
    git.env("GIT_OPTIONAL_LOCKS", "0").env("GIT_NO_LAZY_FETCH", "1").env("GIT_TERMINAL_PROMPT", "0");
    let mut child = git.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().ok()?;
    if ended(&mut child) {
        return child.wait_with_output().ok();
    }
    let _ = child.kill();
    let _ = child.wait();
    None
}

/// Waits until the process ends; returns whether it did in time.
fn ended(child: &mut Child) -> bool {
    let begun = Instant::now();
    while begun.elapsed() < LONGEST {
        match child.try_wait() {
            Ok(None) => std::thread::sleep(Duration::from_millis(2)),
            ended => return ended.is_ok(),
        }
    }
    false
}
