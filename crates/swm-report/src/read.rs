//! Reads and checks result files.

use crate::limits;
use serde::Deserialize;
use std::path::Path;
use swm_core::{Error, Result, Results, files};

/// The fix for an unusable results file.
const FIX: &str = "write it again with this version (`swm eval`), or read it with the version that wrote it";

/// The part of a results file that determines its layout.
#[derive(Deserialize)]
struct Head {
    manifest: HeadManifest,
}

#[derive(Deserialize)]
struct HeadManifest {
    swm_version: String,
}

/// Reads a `results.json`.
///
/// # Errors
/// When the file cannot be read, is not a regular file, is larger than a report shows, is not JSON, was written by a
/// version with another layout, lacks a field, or states statistics that its episodes do not have. Such a file was edited
/// or damaged; it is refused instead of shown with other values, because its episodes may be wrong as well.
pub fn read_results(path: &Path) -> Result<Results> {
    parse_results(path, &files::read(path, limits::RESULTS_BYTES)?)
}

/// Reads results from the content of a file, as [`read_results`] does.
///
/// # Errors
/// As [`read_results`].
pub fn parse_results(path: &Path, bytes: &[u8]) -> Result<Results> {
    let theirs = match serde_json::from_slice::<Head>(bytes) {
        Ok(head) => head.manifest.swm_version,
        Err(error) if error.is_data() => {
            let problem = "is not a results file: it has no manifest.swm_version";
            return Err(Error::corrupt(path, problem, "give a results.json that `swm eval` wrote"));
        }
        Err(error) => return Err(Error::corrupt(path, format!("is not a JSON document ({error})"), FIX)),
    };
    let ours = env!("CARGO_PKG_VERSION");
    if series(&theirs) != series(ours) {
        let problem = format!("was written by stable-worldmodel {theirs}; this version is {ours}");
        return Err(Error::corrupt(path, problem, FIX));
    }
    let mut results: Results = serde_json::from_slice(bytes).map_err(|error| {
        Error::corrupt(path, format!("has a layout that this version does not read ({error})"), FIX)
    })?;
    check_size(path, &results)?;
    results.check().map_err(|problem| {
        let fix = "its parts contradict each other: evaluate again (`swm eval`)";
        Error::corrupt(path, format!("is inconsistent: {problem}"), fix)
    })?;
    // Older versions wrote intervals that take starts from one recorded episode as independent.
    if results.stopping.is_none() {
        results.runs.iter_mut().for_each(|run| run.success = results.counting.rate(&run.episodes));
    }
    Ok(results)
}

/// Checks the number of runs and the lengths of names, which the page repeats.
fn check_size(path: &Path, results: &Results) -> Result<()> {
    if results.runs.len() > limits::RUNS {
        let problem = format!("has {} runs, more than {}", results.runs.len(), limits::RUNS);
        return Err(Error::corrupt(path, problem, "evaluate fewer policies or conditions at a time"));
    }
    let of_runs = results.runs.iter().flat_map(|run| [&run.condition, &run.policy].into_iter().chain(&run.videos));
    let mut names = [&results.env, &results.protocol].into_iter().chain(of_runs);
    match names.find(|name| name.len() > limits::NAME_BYTES) {
        None => Ok(()),
        Some(name) => {
            let start: String = name.chars().take(40).collect();
            let problem = format!("has a name of {} bytes, more than {}: '{start}…'", name.len(), limits::NAME_BYTES);
            Err(Error::corrupt(path, problem, "give shorter names"))
        }
    }
}

/// The part of a version that determines the layout: `major.minor`.
fn series(version: &str) -> Option<&str> {
    version.match_indices('.').nth(1).map(|(end, _)| &version[..end])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_layout_is_the_major_and_minor_version() {
        assert_eq!(
            [series("0.1.0"), series("0.1.7-rc.1"), series("1"), series("")],
            [Some("0.1"), Some("0.1"), None, None]
        );
    }
}
