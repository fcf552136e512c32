//! What a collection may be added to.

use swm_core::{Error, Manifest, Result};
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
                check_renderer(&stored, wanted)?;
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

/// Checks that the pictures of a dataset were drawn as those to come will be: by the same renderer, on whichever device.
fn check_renderer(stored: &Manifest, wanted: &Manifest) -> Result<()> {
    fn kind(manifest: &Manifest) -> Option<&str> {
        manifest.libraries.get("renderer")?.split(' ').next()
    }
    match (kind(stored), kind(wanted)) {
        (Some(stored), Some(wanted)) if stored != wanted => Err(Error::config(
            format!("continuing a collection with the renderer {wanted}"),
            format!("its pictures were drawn by {stored}"),
            format!("--renderer {stored} draws like them; --mix-renderers adds pictures that look a little different"),
        )),
        _ => Ok(()),
    }
}
