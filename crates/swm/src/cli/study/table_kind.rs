//! [`TableKind`]: what the cells of a study are that evaluates nothing.

use serde::Deserialize;

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

    /// Whether one cell of a cluster fills all rows: because it takes no time, or because they compare speeds, which must be
    /// those of one machine.
    pub(super) fn is_one_cell(self) -> bool {
        matches!(self, Self::Factors | Self::Data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_files() {
        for kind in [TableKind::Factors, TableKind::Data, TableKind::Drift, TableKind::Online] {
            let text = format!("\"{}\"", kind.name());
            assert_eq!(serde_json::from_str::<TableKind>(&text).expect("a kind"), kind);
        }
    }
}
