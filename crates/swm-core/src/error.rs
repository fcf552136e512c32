//! What can go wrong, grouped by who can mend it: the user's words, the data, or the code.
//!
//! Every message says what was given, what was wanted, and the next step. Front ends map variants to exit
//! codes and Python exceptions in one place each.

use std::path::PathBuf;

/// The result of everything in this workspace that can fail.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error of the platform.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    // ---- the user's words ----
    /// A name that no registry row, column, factor or key carries.
    #[error("unknown {kind} '{given}'{}; {hint}", nearest_clause(.nearest))]
    UnknownName {
        /// What kind of name: "environment", "column", "factor of variation".
        kind: &'static str,
        /// The name as given.
        given: String,
        /// The nearest right names, best first.
        nearest: Vec<String>,
        /// What lists the right names.
        hint: String,
    },
    /// A value outside what its space allows.
    #[error("{what} = {given} is outside its space: expected {expected}")]
    OutOfSpace {
        /// The value's name.
        what: String,
        /// The value given.
        given: String,
        /// The space, in words.
        expected: String,
    },
    /// A setting that contradicts another one or makes no sense.
    #[error("{what}: {problem}; {fix}")]
    Config {
        /// The setting.
        what: String,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// No value satisfied a constraint within the bounded number of tries.
    #[error(
        "no value of '{factor}' satisfied its constraint ({constraint}) in {tries} tries; pin the factors it depends on to compatible values, or vary fewer of them"
    )]
    Unsatisfiable {
        /// The factor that was being sampled.
        factor: String,
        /// The constraint, in words.
        constraint: String,
        /// How many samples were rejected.
        tries: usize,
    },

    // ---- the data ----
    /// Two shapes, sizes or types that should agree and do not.
    #[error("{operation}: got {given}, expected {expected}")]
    Mismatch {
        /// The operation that found it.
        operation: String,
        /// What came.
        given: String,
        /// What was expected.
        expected: String,
    },
    /// A file, dataset or checkpoint that is damaged or of another kind.
    #[error("{}: {problem}; {fix}", .path.display())]
    Corrupt {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// The operating system refused.
    #[error("{}: {action}: {source}{}", .path.display(), disk_hint(.source))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was being done.
        action: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A number that must be finite is not.
    #[error("{what} is not finite: {given}; {fix}")]
    NotFinite {
        /// What the number is.
        what: String,
        /// The number and where it stood.
        given: String,
        /// What to do.
        fix: String,
    },

    // ---- the run ----
    /// The user pressed Ctrl-C; what was finished before is kept.
    #[error("interrupted; everything finished before is kept")]
    Interrupted,
    /// A library underneath failed in a way it explains itself.
    #[error("{context}: {message}")]
    External {
        /// What was being done, with which library.
        context: String,
        /// The library's message.
        message: String,
    },
    /// An error of the program that embeds the platform, raised in something it lent (a policy, a model, an
    /// environment), and handed back to it as it was.
    #[error("{0}")]
    Foreign(Box<dyn std::error::Error + Send + Sync>),
}

impl Error {
    /// An [`Error::Config`].
    pub fn config(what: impl Into<String>, problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Config { what: what.into(), problem: problem.into(), fix: fix.into() }
    }

    /// An [`Error::Mismatch`].
    pub fn mismatch(operation: impl Into<String>, given: impl Into<String>, expected: impl Into<String>) -> Self {
        Self::Mismatch { operation: operation.into(), given: given.into(), expected: expected.into() }
    }

    /// An [`Error::Corrupt`].
    pub fn corrupt(path: impl Into<PathBuf>, problem: impl Into<String>, fix: impl Into<String>) -> Self {
        Self::Corrupt { path: path.into(), problem: problem.into(), fix: fix.into() }
    }

    /// An [`Error::Io`].
    pub fn io(path: impl Into<PathBuf>, action: impl Into<String>, source: std::io::Error) -> Self {
        Self::Io { path: path.into(), action: action.into(), source }
    }

    /// An [`Error::External`].
    pub fn external(context: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self::External { context: context.into(), message: message.to_string() }
    }

    /// An [`Error::UnknownName`] with the nearest of `known` filled in.
    pub fn unknown<'a>(
        kind: &'static str,
        given: &str,
        known: impl IntoIterator<Item = &'a str>,
        hint: impl Into<String>,
    ) -> Self {
        Self::UnknownName { kind, given: given.to_owned(), nearest: nearest(given, known), hint: hint.into() }
    }

    /// Whether the user's words (not the data, not the machine) are at fault: exit code 2.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::UnknownName { .. } | Self::OutOfSpace { .. } | Self::Config { .. })
    }
}

/// The names most like `given`, best first, at most three.
pub fn nearest<'a>(given: &str, known: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    let fold = |s: &str| s.to_lowercase().replace(['-', '_', '.', '/'], "");
    let wanted = fold(given);
    let mut scored: Vec<(f64, &str)> = known
        .into_iter()
        .map(|name| {
            let folded = fold(name);
            let contains = folded.contains(&wanted) || wanted.contains(&folded);
            let (short, long) = (wanted.len().min(folded.len()), wanted.len().max(folded.len()).max(1));
            // A part of a name is nearer the more of the name it covers.
            #[allow(clippy::cast_precision_loss)]
            let bonus = if contains { 0.15 * short as f64 / long as f64 } else { 0.0 };
            // Two letters swapped, or one wrong, say little about a name of three to the other measure.
            let slip = if strsim::osa_distance(&wanted, &folded) == 1 { 0.9 } else { 0.0 };
            ((strsim::jaro_winkler(&wanted, &folded) + bonus).max(slip), name)
        })
        .filter(|(score, _)| *score > 0.75)
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(b.1)));
    scored.into_iter().take(3).map(|(_, name)| name.to_owned()).collect()
}

fn nearest_clause(names: &[String]) -> String {
    match names {
        [] => String::new(),
        names => format!(" (did you mean {}?)", names.join(", ")),
    }
}

fn disk_hint(source: &std::io::Error) -> &'static str {
    match source.kind() {
        std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => {
            " (free some space, then continue: committed episodes are kept)"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_names_get_the_nearest_right_ones() {
        let known = ["swm/PushT-v1", "swm/TwoRoom-v1"];
        assert_eq!(nearest("pusht", known), ["swm/PushT-v1"]);
        assert_eq!(nearest("swm/TowRoom-v1", known)[0], "swm/TwoRoom-v1");
        assert!(nearest("quux", known).is_empty());
        let message = Error::unknown("environment", "pusht", known, "`swm envs` lists them").to_string();
        assert_eq!(message, "unknown environment 'pusht' (did you mean swm/PushT-v1?); `swm envs` lists them");
    }
}
