//! The episodes a model is trained on or validated with.

use swm_core::{Error, Result};
use swm_data::{Part, Reader, Split};

/// Returns the indices of the episodes of a part of the dataset, or `None` (all episodes) without `hold_out`.
///
/// # Errors
/// When no episode is left for the part.
pub(crate) fn episodes(hold_out: bool, part: Part, reader: &dyn Reader) -> Result<Option<Vec<usize>>> {
    if !hold_out {
        return Ok(None);
    }
    match Split::default().episodes(reader, part) {
        Ok(episodes) => Ok(Some(episodes)),
        Err(_) => Err(Error::config(
            "data.hold_out",
            format!("of the {} episodes of the dataset, none is left for {part:?}", reader.episodes().len())
                .to_lowercase(),
            "collect more episodes, or train on all episodes with data.hold_out=false validation.every=0",
        )),
    }
}
