//! [`Chosen`]: who chose the settings of a study with a kind; and the bound of its cells.

use crate::cli::recipes::is_preset_name;
use std::collections::BTreeSet;
use swm_core::{Error, Origin, Result, limits};
use swm_eval::Study;

/// Who chose the settings of a study.
pub(super) struct Chosen<'a> {
    /// Who chose the file.
    origin: &'a Origin,
    /// The settings of the command line, which are the user's own.
    own: BTreeSet<&'a str>,
}

impl<'a> Chosen<'a> {
    /// `own` are the settings of the command line.
    pub(super) fn new(origin: &'a Origin, own: BTreeSet<&'a str>) -> Self {
        Self { origin, own }
    }

    /// The user chose all of them.
    #[cfg(test)]
    pub(super) fn by_user() -> Self {
        Self { origin: &Origin::User, own: BTreeSet::new() }
    }

    /// Who chose a setting.
    pub(super) fn by(&self, key: &str) -> &Origin {
        if self.own.contains(key) { &Origin::User } else { self.origin }
    }

    /// Checks that a preset is one of the program, or that the user chose its file.
    ///
    /// # Errors
    /// When a file chose the file of a preset.
    pub(super) fn check_preset(&self, preset: &str) -> Result<()> {
        if is_preset_name(preset) {
            return Ok(());
        }
        self.by("preset").check_user(&format!("the preset '{preset}'"), "which is a file", Some("preset=FILE"))
    }
}

/// Checks the number of cells, which lists of these lengths have, before they are made.
///
/// # Errors
/// When there are more than [`Study::MAX_CELLS`].
pub(super) fn check_cells(lengths: &[usize]) -> Result<()> {
    let cells = limits::product(lengths.iter().copied());
    if cells > Study::MAX_CELLS {
        let problem = format!("its lists have {cells} combinations");
        return Err(Error::config("the study", problem, format!("give at most {}", Study::MAX_CELLS)));
    }
    Ok(())
}
