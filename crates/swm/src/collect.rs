//! What a collection may be added to.

use swm_core::{Error, Manifest, Result};
use swm_data::lance::shard_manifests;
use swm_data::{Location, WriteMode};
use swm_eval::collect::check_continues;

/// Checks that episodes of this manifest may be written to a place, before anything is played: that nothing is there, that
/// it may go, or that the same collection began there. `mix_renderers` lets pictures of another renderer follow.
///
/// # Errors
/// When they may not; says what to do.
pub fn check(location: &Location, mode: WriteMode, wanted: &Manifest, mix_renderers: bool) -> Result<()> {
    let there = match location.path() {
        Some(path) => path.exists(),
        None => swm_data::open(location.clone()).is_ok(),
    };
    if !there {
        return Ok(());
    }
    match mode {
        WriteMode::Overwrite => Ok(()),
        WriteMode::Append => {
            let Some(stored) = swm_data::open(location.clone())?.manifest() else { return Ok(()) };
            check_continues(&stored, wanted)?;
            if !mix_renderers {
                check_renderer("continuing a collection", &stored, wanted)?;
            }
            let (stored, wanted) = (&stored.config["codec"], &wanted.config["codec"]);
            if stored == wanted {
                return Ok(());
            }
            Err(Error::config(
                "codec (--codec)",
                format!("the dataset's pictures are {stored}, not {wanted}"),
                "ask for the same again, or collect into another dataset",
            ))
        }
        WriteMode::Create => Err(Error::config(
            format!("dataset {location}"),
            "there is one already",
            "continue it (--resume, mode=\"append\"), replace it (--overwrite, mode=\"overwrite\"), or name another",
        )),
    }
}

/// Checks that the parts of a dataset which several machines collected, and the episodes that are there already, have
/// pictures of one renderer.
///
/// # Errors
/// When they have not; says what to do.
pub fn check_parts(location: &Location) -> Result<()> {
    let stored = swm_data::open(location.clone()).ok().and_then(|reader| reader.manifest());
    let parts = shard_manifests(location)?;
    let mut all = stored.iter().chain(&parts);
    let Some(first) = all.next() else { return Ok(()) };
    all.try_for_each(|other| check_renderer("committing a part", first, other))
}

/// Checks that the pictures of a dataset were drawn as those to come were or will be: by the same renderer, on whichever
/// device.
fn check_renderer(doing: &str, stored: &Manifest, wanted: &Manifest) -> Result<()> {
    fn kind(manifest: &Manifest) -> Option<&str> {
        manifest.libraries.get("renderer")?.split(' ').next()
    }
    match (kind(stored), kind(wanted)) {
        (Some(stored), Some(wanted)) if stored != wanted => Err(Error::config(
            format!("{doing} with the renderer {wanted}"),
            format!("the dataset's other pictures were drawn by {stored}"),
            format!("--renderer {stored} draws like them; --mix-renderers adds pictures that look a little different"),
        )),
        _ => Ok(()),
    }
}
