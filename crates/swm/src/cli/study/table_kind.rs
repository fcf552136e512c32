//! [`TableKind`]: what the cells of a study are that evaluates nothing.

use serde::Deserialize;
use swm_core::{Error, Result};

/// What the cells of a study are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum TableKind {
    /// The factors of variation of every environment.
    Factors,
    /// The speed, latency and size of every format of datasets.
    Data,
    /// The latents of policies beside those that a model was trained on.
    Drift,
    /// Returns of models that train by interaction.
    Online,
}

impl TableKind {
    /// The name in files.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Factors => "factors",
            Self::Data => "data",
            Self::Drift => "drift",
            Self::Online => "online",
        }
    }

    /// Why all rows need one machine, and what to do instead of running them on a cluster; `None` if each can be filled on any.
    fn one_machine(self) -> Option<[&'static str; 2]> {
        match self {
            Self::Factors | Self::Online => None,
            Self::Data => Some([
                "compare speeds, which must be those of one machine",
                "run the study without --on, on each machine whose speed you want to know, with an --output of its own",
            ]),
            Self::Drift => Some([
                "share one training, whose model and dataset are on the machine that trains",
                "run the study without --on, on one machine: its training takes the most time, and only its rows are many",
            ]),
        }
    }

    /// Checks that the rows can be filled on several machines.
    ///
    /// # Errors
    /// When they need one machine.
    pub(super) fn check_several_machines(self) -> Result<()> {
        self.one_machine().map_or(Ok(()), |[why, fix]| {
            Err(Error::config("--on", format!("the rows of a study of the kind '{}' {why}", self.name()), fix))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_files_and_rows_that_need_one_machine_are_refused() {
        for kind in [TableKind::Factors, TableKind::Data, TableKind::Drift, TableKind::Online] {
            let text = format!("\"{}\"", kind.name());
            assert_eq!(serde_json::from_str::<TableKind>(&text).expect("a kind"), kind);
            match (kind, kind.check_several_machines()) {
                (TableKind::Factors | TableKind::Online, found) => found.expect("rows of any machine"),
                (_, found) => {
                    let error = found.expect_err("rows of one machine").to_string();
                    assert!(error.contains(kind.name()) && error.contains("without --on"), "{error}");
                }
            }
        }
    }
}
