//! [`check_text`]: what is known of the file of a study by its text alone.

use super::any_file::{AnyFile, Size};
use super::expand;
use crate::resolver::HomeResolver;
use std::path::Path;
use swm_core::{Origin, Result};

/// Cells whose options are checked.
const CELLS: usize = 50;

/// Checks the file of a study that a stranger may have written, at its small size or as it is; `path` is named in errors. Makes
/// no environment but those of the crate `swm-envs`, and reads no other file.
///
/// # Errors
/// When the text is not a study, names what only the user may name, or has an unknown or invalid option.
pub fn check_text(text: &str, path: &Path, small: bool) -> Result<()> {
    let size = if small { Size::Small } else { Size::Paper };
    let origin = Origin::file(path, false);
    match AnyFile::parse(text, path, size)? {
        AnyFile::Table(file) => {
            file.datasets(size)?.check_origin(&origin)?;
            let study = file.study(size, &[], &origin)?;
            file.cluster_cells(&study).map(drop)
        }
        AnyFile::Evaluations(file) => {
            file.datasets.check_origin(&origin)?;
            if file.defaults.option("env").is_some_and(|env| swm_envs::ENVS.choose(env).is_err()) {
                return Ok(());
            }
            let resolver = HomeResolver::new(origin);
            expand::options(&file, CELLS, &resolver)?.iter().try_for_each(|cell| cell.check_options(&resolver))
        }
    }
}
