//! The files that the cells of an evaluation left, by the index of their condition: `results/INDEX.json`,
//! `traces/INDEX.json`, and the folders `videos/INDEX`.

use serde_json::Value;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, Results, files};
use swm_eval::EvalRequest;

/// The largest results of a condition, in bytes.
const MAX_RESULTS: u64 = 256 << 20;
/// The largest traces of a condition, in bytes.
const MAX_TRACES: u64 = 1 << 30;
/// The largest video, in bytes.
const MAX_VIDEO: u64 = 1 << 30;

/// Reads the results of all conditions.
pub(super) fn results_in(parts: &Path, request: &EvalRequest) -> Result<Vec<Results>> {
    let read = |index: usize| {
        let path = parts.join(format!("results/{index:06}.json"));
        let invalid = |problem: String| Error::corrupt(&path, problem, "remove it and run the command again");
        let results: Results = serde_json::from_slice(&files::read(&path, MAX_RESULTS)?)
            .map_err(|error| invalid(format!("is not a results file ({error})")))?;
        results.check().map_err(|problem| invalid(format!("is inconsistent: {problem}")))?;
        Ok(results)
    };
    (0..request.conditions.len()).map(read).collect()
}

/// Returns the traced plans of all conditions, in order.
pub(super) fn joined_traces(parts: &Path, conditions: usize) -> Result<Vec<Value>> {
    let mut plans = vec![];
    for index in 0..conditions {
        let path = parts.join(format!("traces/{index:06}.json"));
        let found: Vec<Value> = serde_json::from_slice(&files::read(&path, MAX_TRACES)?).map_err(|error| {
            let fix = "remove it and run the command again";
            Error::corrupt(&path, format!("has no traces of plans ({error})"), fix)
        })?;
        plans.extend(found);
    }
    Ok(plans)
}

/// Copies the videos of all conditions, and their posters, to the folder `videos` of an output. If two conditions have videos
/// of one name, those of the later one are kept, as when one process evaluates both.
pub(super) fn copy_videos(parts: &Path, conditions: usize, output: &Path) -> Result<()> {
    let target = output.join("videos");
    for index in 0..conditions {
        let folder = parts.join(format!("videos/{index:06}"));
        for (name, path) in files_in(&folder)? {
            std::fs::create_dir_all(&target)
                .map_err(|error| Error::io(&target, "creating the folder of videos", error))?;
            files::write(&target.join(name), &files::read(&path, MAX_VIDEO)?)?;
        }
    }
    Ok(())
}

/// The names and paths of the files of a folder, in order; none without the folder.
fn files_in(folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    if !folder.exists() {
        return Ok(vec![]);
    }
    let io = |error| Error::io(folder, "reading the folder", error);
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        if entry.file_type().map_err(io)?.is_file() {
            found.push((entry.file_name().to_string_lossy().into_owned(), entry.path()));
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn later_conditions_replace_videos_of_the_same_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let (parts, output) = (folder.path().join("parts"), folder.path().join("out"));
        for (name, text) in [("000000/a-0.mp4", "first"), ("000000/b-0.mp4", "b"), ("000001/a-0.mp4", "second")] {
            let path = parts.join("videos").join(name);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            std::fs::write(path, text).expect("a file");
        }
        copy_videos(&parts, 3, &output).expect("videos");
        let read = |name: &str| std::fs::read_to_string(output.join("videos").join(name)).expect("a video");
        assert_eq!((read("a-0.mp4"), read("b-0.mp4")), ("second".to_owned(), "b".to_owned()));
        copy_videos(&parts, 0, &folder.path().join("none")).expect("no videos");
        assert!(!folder.path().join("none").exists());
    }
}
