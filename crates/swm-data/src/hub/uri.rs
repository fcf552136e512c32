//! [`HubUri`]: what `hf://` and `lerobot://` name.

use std::collections::HashSet;
use std::fmt;
use swm_core::{Error, Result};

/// The kinds of repositories.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepoKind {
    /// Checkpoints: `hf://OWNER/NAME`.
    Model,
    /// Datasets: `hf://datasets/OWNER/NAME`.
    Dataset,
}

/// A file, a folder or a whole repository of the hub: `hf://[datasets/]OWNER/NAME[@REVISION][/PATH]`, or
/// `lerobot://OWNER/NAME` for `hf://datasets/OWNER/NAME`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HubUri {
    /// The kind of the repository.
    pub kind: RepoKind,
    /// `OWNER/NAME`.
    pub repo: String,
    /// A branch, a tag or a commit.
    pub revision: String,
    /// The path in the repository; empty for all of it.
    pub path: String,
}

/// The schemes.
const SCHEME: &str = "hf://";
const LEROBOT: &str = "lerobot://";
/// The branch that is used without a revision.
const MAIN: &str = "main";

impl HubUri {
    /// Whether a text is meant as such a URI.
    pub fn is_uri(given: &str) -> bool {
        given.starts_with(SCHEME) || given.starts_with(LEROBOT)
    }

    /// Parses a URI. `kind` is that of a repository without a prefix: `hf://OWNER/NAME` is a dataset where a dataset is asked for.
    ///
    /// # Errors
    /// When the text is no such URI, or a name could lead out of the cache.
    pub fn parse(given: &str, kind: RepoKind) -> Result<Self> {
        let invalid = |problem: &str| {
            let fix = "write hf://OWNER/NAME, hf://OWNER/NAME@REVISION/PATH or hf://datasets/OWNER/NAME/PATH";
            Error::config(given, problem, fix)
        };
        let (rest, kind) = match (given.strip_prefix(SCHEME), given.strip_prefix(LEROBOT)) {
            (Some(rest), _) => match (rest.strip_prefix("datasets/"), rest.strip_prefix("models/")) {
                (Some(rest), _) => (rest, RepoKind::Dataset),
                (_, Some(rest)) => (rest, RepoKind::Model),
                _ => (rest, kind),
            },
            (_, Some(rest)) => (rest, RepoKind::Dataset),
            _ => return Err(invalid("is no URI of the hub")),
        };
        let mut parts = rest.trim_end_matches('/').splitn(3, '/');
        let (Some(owner), Some(name)) = (parts.next(), parts.next()) else {
            return Err(invalid("names no repository"));
        };
        let path = parts.next().unwrap_or_default();
        let (name, revision) = name.split_once('@').unwrap_or((name, MAIN));
        // A revision such as refs/pr/1 is written with %2F.
        let revision = revision.replace("%2F", "/").replace("%2f", "/");
        let uri = Self { kind, repo: format!("{owner}/{name}"), revision, path: path.to_owned() };
        let path_is_inside = uri.path.is_empty() || is_inside(&uri.path);
        if !is_inside(&uri.repo) || !is_inside(&uri.revision) || !path_is_inside || owner.contains('@') {
            return Err(invalid("has a part that no repository has"));
        }
        Ok(uri)
    }

    /// This URI at a commit.
    #[must_use]
    pub fn at(&self, commit: &str) -> Self {
        Self { revision: commit.to_owned(), ..self.clone() }
    }

    /// Whether the revision is a commit, which never changes.
    pub fn is_pinned(&self) -> bool {
        is_commit(&self.revision)
    }

    /// Whether a file of the repository is named, or lies in the folder that is.
    pub(super) fn contains(&self, file: &str) -> bool {
        self.path.is_empty()
            || file.strip_prefix(&self.path).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    }
}

impl fmt::Display for HubUri {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { repo, revision, path, .. } = self;
        write!(f, "{SCHEME}{}{repo}", if self.kind == RepoKind::Dataset { "datasets/" } else { "" })?;
        if revision != MAIN {
            write!(f, "@{}", revision.replace('/', "%2F"))?;
        }
        if path.is_empty() { Ok(()) } else { write!(f, "/{path}") }
    }
}

/// Whether a text is the hash of a commit.
pub(super) fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Whether a text is a SHA-256 hash in lower-case hexadecimal digits.
pub(super) fn is_sha256(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// Whether a name, which may have several parts, stays inside the folder that it is joined to, and is no file of Git's or Mercurial's
/// own, whose settings name programs to start.
pub(super) fn is_inside(name: &str) -> bool {
    name.split('/').all(|part| !matches!(part, "" | "." | "..") && !is_of_version_control(part))
        && !name.contains(['\\', '\0', '\n', '\t', '?', '#', ':'])
        && swm_core::text::printable(name) == name
}

/// Whether some file system takes a name for that of the folder in which Git or Mercurial keeps its settings: those of Windows end a
/// name before dots and spaces and have short names, that of macOS leaves out some characters, and both ignore the case.
fn is_of_version_control(name: &str) -> bool {
    let is_left_out =
        |c: char| matches!(c, '\u{200c}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{206a}'..='\u{206f}' | '\u{feff}');
    let plain: String = name.chars().filter(|c| !is_left_out(*c)).collect();
    let plain = plain.trim_end_matches(['.', ' ']);
    [".git", ".hg", "git~1", "hg~1"].iter().any(|own| plain.eq_ignore_ascii_case(own))
}

/// The folder of a list of files, in lower case, that Git takes for a repository of its own, whose settings name programs to start: it
/// holds `HEAD`, and `objects` or the name of the folder that has them. `None` if there is none.
pub(super) fn git_folder<'a>(names: impl Iterator<Item = &'a str>) -> Option<String> {
    // File systems of other operating systems ignore the case. Sets, because a hub may list many files.
    let (mut heads, mut stores) = (HashSet::new(), HashSet::new());
    for name in names.map(str::to_ascii_lowercase) {
        let mut start = 0;
        for part in name.split('/') {
            let folder = name[..start].trim_end_matches('/');
            let last = start + part.len() == name.len();
            match (part, last) {
                ("head", true) => heads.insert(folder.to_owned()),
                ("commondir", true) | ("objects", false) => stores.insert(folder.to_owned()),
                _ => false,
            };
            start += part.len() + 1;
        }
    }
    heads.into_iter().filter(|folder| stores.contains(folder)).min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repositories_of_git_are_found() {
        let found = |names: &[&str]| git_folder(names.iter().copied());
        assert_eq!(found(&["HEAD", "config", "objects/x", "refs/heads/x"]).as_deref(), Some(""));
        assert_eq!(found(&["a/b/config", "a/b/HEAD", "a/b/commondir"]).as_deref(), Some("a/b"));
        assert_eq!(found(&["A/head", "a/Objects/pack/x"]).as_deref(), Some("a"));
        assert_eq!(found(&["a/HEAD", "objects/x", "b/objects/x", "ab/objects/x"]), None);
        assert_eq!(found(&["objects/x", "refs/heads/x", "config", "HEAD.md"]), None);
    }

    #[test]
    fn uris_name_repositories_revisions_and_paths() {
        let parse = |given: &str| HubUri::parse(given, RepoKind::Model).expect(given);
        let uri = parse("hf://lab/rooms@v1.0/data/rooms.lance");
        assert_eq!(
            (uri.repo.as_str(), uri.revision.as_str(), uri.path.as_str()),
            ("lab/rooms", "v1.0", "data/rooms.lance")
        );
        assert_eq!((uri.kind, parse("hf://datasets/lab/rooms").kind), (RepoKind::Model, RepoKind::Dataset));
        assert_eq!(parse("lerobot://lerobot/pusht").to_string(), "hf://datasets/lerobot/pusht");
        assert_eq!(parse("hf://a/b/").path, "");
        for same in [
            "hf://a/b",
            "hf://a/b/.gitattributes",
            "hf://a/b/.hgignore",
            "hf://a/b/git~2/x",
            "hf://a/b@v2",
            "hf://datasets/a/b@refs%2Fpr%2F1/c/d.json",
        ] {
            assert_eq!(parse(same).to_string(), same);
        }
        let commit = "0123456789abcdef0123456789abcdef01234567";
        assert!(parse("hf://a/b").at(commit).is_pinned() && !parse("hf://a/b").is_pinned());
        let file = parse("hf://a/b/data");
        assert!(file.contains("data") && file.contains("data/x") && !file.contains("data2/x"));
        for wrong in [
            "hf://",
            "hf://a",
            "hf://a/../b",
            "hf://a/b/../../c",
            "hf://a/b/c\\d",
            "hf://a//b",
            "s3://a/b",
            "hf://a@b/c",
            "hf://a/b?x",
            "hf://a/b\n",
            "hf://a/b/\u{1b}[2J",
            "hf://a/b/c\u{202e}d",
            "hf://a/b/.git/config",
            "hf://a/b/data/.GIT",
            "hf://a/b/.Hg/hgrc",
            "hf://a/b/x/GIT~1/config",
            "hf://a/b/hg~1/hgrc",
            "hf://a/b/.g\u{200c}it/config",
            "hf://a/b/\u{feff}.git/config",
            "hf://a/b/.git. /config",
        ] {
            assert!(HubUri::parse(wrong, RepoKind::Model).is_err(), "{wrong}");
        }
    }
}
