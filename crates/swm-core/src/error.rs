//! [`Error`]: the one error type, its variants grouped by cause: user input, data, or the run.
//!
//! Every message states what was given, what was expected, and what to do. The command line maps variants to exit
//! codes, and the Python package maps them to exceptions.

use std::path::{Path, PathBuf};

/// The result of every fallible function of the workspace.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    // ---- user input ----
    /// A name that matches no registry row, column, factor or setting.
    #[error("unknown {kind} '{given}'{}; {hint}", nearest_clause(.nearest))]
    UnknownName {
        /// The kind of name: "environment", "column", "factor of variation".
        kind: &'static str,
        /// The name as given.
        given: String,
        /// The most similar valid names, best first.
        nearest: Vec<String>,
        /// A hint that names the list of valid names.
        hint: String,
    },
    /// A value outside its space.
    #[error("{what} = {given} is outside its space: expected {expected}")]
    OutOfSpace {
        /// The value's name.
        what: String,
        /// The value.
        given: String,
        /// The space, in words.
        expected: String,
    },
    /// An invalid setting, or one that contradicts another.
    #[error("{what}: {problem}; {fix}")]
    Config {
        /// The setting.
        what: String,
        /// The reason that the setting is invalid.
        problem: String,
        /// The recommended fix.
        fix: String,
    },
    /// No sample satisfied a constraint within the bounded number of tries.
    #[error(
        "no value of '{factor}' satisfied its constraint ({constraint}) in {tries} tries; pin the factors that the constraint reads to compatible values, or vary fewer factors"
    )]
    Unsatisfiable {
        /// The factor that was being sampled.
        factor: String,
        /// The constraint, in words.
        constraint: String,
        /// The number of rejected samples.
        tries: usize,
    },

    // ---- data ----
    /// Two shapes, sizes or types that do not fit each other.
    #[error("{operation}: got {given}, expected {expected}")]
    Mismatch {
        /// The operation that failed.
        operation: String,
        /// The given value.
        given: String,
        /// The expected value.
        expected: String,
    },
    /// A file, dataset or checkpoint that is damaged or does not have the expected format.
    #[error("{}: {problem}; {fix}", .path.display())]
    Corrupt {
        /// The file or folder.
        path: PathBuf,
        /// The damage.
        problem: String,
        /// The recommended fix.
        fix: String,
    },
    /// A file operation failed.
    #[error("{}: {action}: {}{}", .path.display(), without_code(.source), hint(.path, .source))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The operation, such as "creating the folder".
        action: String,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A value that must be finite is infinite or NaN.
    #[error("{what} is not finite: {given}; {fix}")]
    NotFinite {
        /// The value's name.
        what: String,
        /// The value and its position.
        given: String,
        /// The recommended fix.
        fix: String,
    },

    // ---- the run ----
    /// The user interrupted the run; work that was finished before is saved.
    #[error("interrupted; work that was finished before is saved")]
    Interrupted,
    /// A third-party library failed.
    #[error("{context}: {message}")]
    External {
        /// The operation and the library.
        context: String,
        /// The library's message.
        message: String,
    },
    /// An error of the embedding program, such as a Python exception. A policy, model or environment that the embedding
    /// program defines raised the error, and the embedding program receives it unchanged.
    #[error("{0}")]
    Embedder(Box<dyn std::error::Error + Send + Sync>),
}

impl Error {
    /// An [`Error::Config`].
    pub fn config(what: impl Into<String>, problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Config { what: shortened(what.into()), problem: shortened(problem.into()), fix: fix.into() }
    }

    /// An [`Error::Mismatch`].
    pub fn mismatch(operation: impl Into<String>, given: impl Into<String>, expected: impl Into<String>) -> Self {
        let (given, expected) = (shortened(given.into()), shortened(expected.into()));
        Self::Mismatch { operation: operation.into(), given, expected }
    }

    /// An [`Error::Corrupt`].
    pub fn corrupt(path: impl Into<PathBuf>, problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Corrupt { path: path.into(), problem: shortened(problem.into()), fix: fix.into() }
    }

    /// An [`Error::Io`].
    pub fn io(path: impl Into<PathBuf>, action: impl Into<String>, source: std::io::Error) -> Self {
        Self::Io { path: path.into(), action: action.into(), source }
    }

    /// An [`Error::External`].
    pub fn external(context: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self::External { context: context.into(), message: shortened(message.to_string()) }
    }

    /// An [`Error::Config`] for a setting that is given twice.
    pub fn twice(what: impl Into<String>, first: impl std::fmt::Display, second: impl std::fmt::Display) -> Self {
        Self::config(what, format!("is given twice: '{first}' and '{second}'"), "leave one of them out")
    }

    /// An [`Error::UnknownName`] that suggests the most similar names of `known`.
    pub fn unknown<'a>(
        kind: &'static str,
        given: &str,
        known: impl IntoIterator<Item = &'a str>,
        hint: impl Into<String>,
    ) -> Self {
        Self::UnknownName {
            kind,
            given: shortened(given.to_owned()),
            nearest: nearest(given, known),
            hint: hint.into(),
        }
    }

    /// An [`Error::External`] for a panic, as `catch_unwind` and a joined thread return it. `context` says what panicked.
    pub fn panicked(context: &str, panic: &(dyn std::any::Any + Send)) -> Self {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Self::external(context, text.unwrap_or("the panic has no message"))
    }

    /// Whether user input caused the error, which is exit code 2 of the command line. A file that does not exist is one
    /// that the user named.
    pub fn is_usage(&self) -> bool {
        match self {
            Self::UnknownName { .. } | Self::OutOfSpace { .. } | Self::Config { .. } => true,
            Self::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
            _ => false,
        }
    }
}

/// The most bytes of a text in an error. A longer one, such as a value in a damaged file, loses its middle.
const MAX_TEXT: usize = 2000;

fn shortened(text: String) -> String {
    if text.len() <= MAX_TEXT {
        return text;
    }
    let (start, end) = (text.floor_char_boundary(MAX_TEXT / 2), text.floor_char_boundary(text.len() - MAX_TEXT / 4));
    format!("{} [{} bytes left out] {}", &text[..start], end - start, &text[end..])
}

/// The names most similar to `given`, best first, at most three.
pub fn nearest<'a>(given: &str, known: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    let fold = |s: &str| s.to_lowercase().replace(['-', '_', '.', '/'], "");
    let mut scored: Vec<(f64, &str)> = known
        .into_iter()
        // Something of this very name may be known in another place.
        .filter(|name| *name != given)
        .map(|name| {
            // A shared beginning, such as `model.` or `swm/`, alone makes no name similar.
            let shared = shared_parts(given, name);
            let (wanted, folded) = (fold(&given[shared..]), fold(&name[shared..]));
            let contains = folded.contains(&wanted) || wanted.contains(&folded);
            let (short, long) = (wanted.len().min(folded.len()), wanted.len().max(folded.len()).max(1));
            // The score of a substring grows with the fraction of the name that it covers.
            let bonus = if contains { 0.15 * short as f64 / long as f64 } else { 0.0 };
            // Jaro-Winkler scores one typing error in a very short name too low.
            let typo = if strsim::osa_distance(&wanted, &folded) == 1 { 0.9 } else { 0.0 };
            ((strsim::jaro_winkler(&wanted, &folded) + bonus).max(typo), name)
        })
        .filter(|(score, _)| *score > 0.75)
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(b.1)));
    // Names far behind the best one distract from it.
    let best = scored.first().map_or(0.0, |(score, _)| *score);
    scored.retain(|(score, _)| *score > best - 0.2);
    // Experts of several environments have one name.
    scored.dedup_by(|a, b| a.1 == b.1);
    scored.into_iter().take(3).map(|(_, name)| name.to_owned()).collect()
}

/// The length of the parts, each with its `.` or `/`, with which both names begin.
fn shared_parts(a: &str, b: &str) -> usize {
    let same = a.bytes().zip(b.bytes()).take_while(|(a, b)| a == b).count();
    a.as_bytes()[..same].iter().rposition(|byte| b"./".contains(byte)).map_or(0, |at| at + 1)
}

fn nearest_clause(names: &[String]) -> String {
    match names {
        [] => String::new(),
        names => format!(" (did you mean {}?)", names.join(", ")),
    }
}

/// The message of the operating system without its number.
fn without_code(source: &std::io::Error) -> String {
    let text = source.to_string();
    text.split_once(" (os error ").map_or_else(|| text.clone(), |(message, _)| message.to_owned())
}

/// What to do about an error of the operating system.
fn hint(path: &Path, source: &std::io::Error) -> &'static str {
    use std::io::ErrorKind;
    match source.kind() {
        ErrorKind::NotFound | ErrorKind::PermissionDenied if path.is_relative() && std::env::current_dir().is_err() => {
            "; the current folder was deleted: change to one that exists"
        }
        ErrorKind::NotFound => "; check the path",
        ErrorKind::PermissionDenied => "; change the permissions, or choose another path",
        ErrorKind::InvalidFilename => "; choose a shorter name or path (temporary files add to the name)",
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => " (free some space, then continue)",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_values_lose_their_middle() {
        let message =
            Error::corrupt("config.json", format!("invalid value \"{}\" of 'a'", "é".repeat(100_000)), "copy it");
        let message = message.to_string();
        assert!(message.len() < 2000 && message.ends_with("\" of 'a'; copy it"), "{message}");
        assert!(
            message.starts_with("config.json: invalid value") && message.contains(" bytes left out] "),
            "{message}"
        );
    }

    #[test]
    fn missing_files_are_usage_errors_in_words() {
        let error = Error::io("a.json", "opening the file", std::io::Error::from_raw_os_error(2));
        assert_eq!(error.to_string(), "a.json: opening the file: No such file or directory; check the path");
        assert!(error.is_usage());
        assert!(!Error::io("a", "writing", std::io::Error::from_raw_os_error(28)).is_usage());
        let error = Error::io("a", "writing", std::io::Error::from_raw_os_error(36)).to_string();
        assert_eq!(
            error,
            "a: writing: File name too long; choose a shorter name or path (temporary files add to the name)"
        );
    }

    #[test]
    fn unknown_names_suggest_similar_names() {
        let known = ["swm/PushT-v1", "swm/TwoRoom-v1"];
        assert_eq!(nearest("pusht", known), ["swm/PushT-v1"]);
        assert_eq!(nearest("swm/TowRoom-v1", known)[0], "swm/TwoRoom-v1");
        assert!(nearest("quux", known).is_empty());
        assert_eq!(nearest("swm/TwoRoom", ["swm/AcrobotDMControl-v0", "swm/TwoRoom-v1"]), ["swm/TwoRoom-v1"]);
        assert!(nearest("model.foo", ["model.smoothed", "model.projector", "model.encoder.conv.dim"]).is_empty());
        assert_eq!(nearest("rooms", ["rooms", "rooms2"]), ["rooms2"]);
        assert_eq!(nearest("exprt", ["expert", "explore", "expert"])[..2], ["expert", "explore"]);
        let message = Error::unknown("environment", "pusht", known, "`swm envs` lists them").to_string();
        assert_eq!(message, "unknown environment 'pusht' (did you mean swm/PushT-v1?); `swm envs` lists them");
    }
}
