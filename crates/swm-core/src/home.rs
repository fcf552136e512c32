//! The home folder: datasets and checkpoints by name, pretrained weights, and assets.

use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A folder that cannot exist. Lookups of assets in it find nothing, wherever the program runs.
const NOWHERE: &str = "/dev/null/assets";

/// Returns the home folder: `$STABLEWM_HOME`, else `~/.stable_worldmodel`.
///
/// # Errors
/// When neither `STABLEWM_HOME` nor `HOME` is set, or `STABLEWM_HOME` is a URI. The current folder is no substitute: data would go to wherever the
/// program happens to run.
pub fn folder() -> Result<PathBuf> {
    let user = || of_user().map(|home| home.join(".stable_worldmodel"));
    variable("STABLEWM_HOME")?.or_else(user).ok_or_else(|| {
        let fix = "set STABLEWM_HOME to the folder of datasets and checkpoints";
        Error::config("home folder", "neither STABLEWM_HOME nor HOME is set", fix)
    })
}

/// Returns the home folder of the user, `$HOME`.
pub fn of_user() -> Option<PathBuf> {
    std::env::var_os("HOME").filter(|value| !value.is_empty()).map(PathBuf::from)
}

/// Returns the folder of assets: `$SWM_ASSETS`, else `assets` in the home folder.
///
/// # Errors
/// As [`folder`], unless `SWM_ASSETS` is set; when it is a URI.
pub fn assets() -> Result<PathBuf> {
    variable("SWM_ASSETS")?.map_or_else(|| folder().map(|home| home.join("assets")), Ok)
}

/// Returns the folder of installed assets; a folder that does not exist if there is no home folder.
pub fn installed_assets() -> PathBuf {
    assets().unwrap_or_else(|_| Path::new(NOWHERE).to_owned())
}

/// Returns the folder in an environment variable that is not empty.
///
/// # Errors
/// When it is a URI.
fn variable(name: &str) -> Result<Option<PathBuf>> {
    let Some(path) = std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from) else {
        return Ok(None);
    };
    if path.to_string_lossy().contains("://") {
        let problem = format!("{} is a URI, and the files must be on this machine", path.display());
        return Err(Error::config(name, problem, "name a folder"));
    }
    Ok(Some(of_tilde(&path).unwrap_or(path)))
}

/// Returns the path that `~/…` stands for, which a shell replaces only at the start of a word; `None` for other paths.
pub fn of_tilde(path: &Path) -> Option<PathBuf> {
    Some(of_user()?.join(path.strip_prefix("~").ok()?))
}
