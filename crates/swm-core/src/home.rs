//! The home folder: datasets and checkpoints by name, pretrained weights, and assets.

use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A folder that cannot exist. Lookups of assets in it find nothing, wherever the program runs.
const NOWHERE: &str = "/dev/null/assets";

/// Returns the home folder: `$STABLEWM_HOME`, else `~/.stable_worldmodel`.
///
/// # Errors
/// When neither `STABLEWM_HOME` nor `HOME` is set. The current folder is no substitute: data would go to wherever the
/// program happens to run.
pub fn folder() -> Result<PathBuf> {
    let user = || of_user().map(|home| home.join(".stable_worldmodel"));
    variable("STABLEWM_HOME").or_else(user).ok_or_else(|| {
        let fix = "set STABLEWM_HOME to the folder of datasets and checkpoints";
        Error::config("home folder", "neither STABLEWM_HOME nor HOME is set", fix)
    })
}

/// Returns the home folder of the user, `$HOME`.
pub fn of_user() -> Option<PathBuf> {
    variable("HOME")
}

/// Returns the folder of assets: `$SWM_ASSETS`, else `assets` in the home folder.
///
/// # Errors
/// As [`folder`], unless `SWM_ASSETS` is set.
pub fn assets() -> Result<PathBuf> {
    variable("SWM_ASSETS").map_or_else(|| folder().map(|home| home.join("assets")), Ok)
}

/// Returns the folder of installed assets; a folder that does not exist if there is no home folder.
pub fn installed_assets() -> PathBuf {
    assets().unwrap_or_else(|_| Path::new(NOWHERE).to_owned())
}

/// Returns the path in an environment variable that is not empty.
fn variable(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}
