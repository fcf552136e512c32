//! Files of a repository that a push would leave beside its own, and that a reader would take for a part of what was pushed.

use super::{HubFile, HubUri};
use std::collections::BTreeSet;
use swm_core::{Error, Result};

/// The folder of a Lance dataset with a file for each commit, of which readers take the newest.
const VERSIONS: &str = "_versions/";
/// The file of every LeRobot dataset, and its folders of tables, of which readers may take all.
const LEROBOT: &str = "meta/info.json";
const TABLES: [&str; 2] = ["meta/episodes/", "data/"];

/// Whether files of another dataset in a repository could become a part of what is pushed.
pub fn may_mix(pushed: &BTreeSet<&str>) -> bool {
    pushed.iter().any(|path| [VERSIONS, LEROBOT].iter().any(|part| root_before(path, part).is_some()))
}

/// Checks that files of another dataset in the repository do not become a part of the one that is pushed.
///
/// # Errors
/// When the repository has commits of a Lance dataset, or tables of a LeRobot dataset, that the pushed one lacks.
pub fn check(to: &HubUri, listed: &[HubFile], pushed: &BTreeSet<&str>) -> Result<()> {
    let others = listed.iter().map(|file| file.path.as_str()).filter(|path| !pushed.contains(path));
    let remains = others.into_iter().find(|path| {
        if let Some(root) = root_before(path, VERSIONS) {
            let own = pushed.iter().filter(|own| root_before(own, VERSIONS) == Some(root));
            // Of an equal version with another name, readers would see both.
            return own.filter_map(|own| version(own)).max().is_some_and(|newest| version(path) >= Some(newest));
        }
        TABLES
            .iter()
            .filter_map(|folder| root_before(path, folder))
            .any(|root| pushed.contains(&*format!("{root}{LEROBOT}")))
    });
    let Some(path) = remains else { return Ok(()) };
    let problem =
        format!("has another dataset there, or newer episodes of this one: '{path}' is not part of what is pushed");
    let fix = "push to another path or repository, or delete the old dataset on the hub first";
    Err(Error::config(to.to_string(), problem, fix))
}

/// The path before a folder, or a file, of this name.
fn root_before<'a>(path: &'a str, folder: &str) -> Option<&'a str> {
    let at = path.rfind(folder)?;
    (at == 0 || path[..at].ends_with('/')).then(|| &path[..at])
}

/// The version that the name of a Lance manifest states. In newer tables 20 digits state the distance from the largest version.
fn version(path: &str) -> Option<u64> {
    let digits = path.rsplit('/').next()?.strip_suffix(".manifest")?;
    let number = digits.parse::<u64>().ok()?;
    Some(if digits.len() == 20 { u64::MAX - number } else { number })
}

#[cfg(test)]
mod tests {
    use super::super::RepoKind;
    use super::*;

    fn checked(listed: &[&str], pushed: &[&str]) -> Result<()> {
        let uri = HubUri::parse("hf://datasets/lab/rooms", RepoKind::Dataset).expect("a URI");
        let file = |path: &&str| HubFile { path: (*path).to_owned(), size: 1, sha256: None, git_id: None };
        check(&uri, &listed.iter().map(file).collect::<Vec<_>>(), &pushed.iter().copied().collect())
    }

    #[test]
    fn newer_commits_and_other_tables_of_episodes_are_refused() {
        let manifest = |version: u64| format!("rooms.lance/_versions/{:020}.manifest", u64::MAX - version);
        let (one, two, three) = (manifest(1), manifest(2), manifest(3));
        assert!(checked(&[&one, &two, "rooms.lance/data/old.lance"], &[&two, "rooms.lance/data/new.lance"]).is_ok());
        assert!(checked(&[&one, &three], &[&one, &two]).is_err());
        assert!(checked(&["a/_versions/3.manifest"], &["a/_versions/2.manifest"]).is_err());
        assert!(checked(&["a/_versions/2.manifest"], &["a/_versions/10.manifest"]).is_ok());
        assert!(checked(&[&three], &["other.lance/_versions/1.manifest"]).is_ok());
        let tables = ["meta/episodes/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-001.parquet"];
        let pushed = |path| ["meta/info.json", path];
        assert!(checked(&tables, &pushed(tables[0])).is_err());
        assert!(checked(&["data/chunk-000/file-001.parquet"], &pushed(tables[0])).is_err());
        assert!(checked(&tables[..1], &pushed(tables[0])).is_ok());
        assert!(checked(&["README.md", ".gitattributes", "other/data/a.parquet"], &pushed(tables[0])).is_ok());
        assert!(
            checked(&["a/_versions/2.manifest"], &[&format!("a/_versions/{:020}.manifest", u64::MAX - 2)]).is_err()
        );
        assert!(!may_mix(&["weights.safetensors", "data/a.csv"].into()) && may_mix(&[&*one].into()));
    }
}
