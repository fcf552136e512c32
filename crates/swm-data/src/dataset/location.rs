//! [`Location`]: a path on this machine, or a URI of an object store.

use std::fmt;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result};
use url::Url;

/// URI schemes of object stores.
const SCHEMES: [&str; 5] = ["s3", "gs", "az", "http", "https"];

/// The location of a dataset.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Location {
    /// A path on this machine.
    Path(PathBuf),
    /// A URI of an object store: `s3://bucket/key`, `gs://bucket/key`, `az://container/key`, `http(s)://host/path`.
    Uri(Url),
}

impl Location {
    /// Parses a path or a URI. `file://` URIs become paths.
    ///
    /// # Errors
    /// If `given` is a malformed URI, or a URI with an unknown scheme.
    pub fn parse(given: &str) -> Result<Self> {
        let Some((scheme, _)) = given.split_once("://") else { return Ok(Self::Path(given.into())) };
        if scheme == "file" {
            return file_of(given).map(Self::Path);
        }
        if !SCHEMES.contains(&scheme) {
            let fix = "use a path, or a URI that begins with s3://, gs://, az://, http:// or https://";
            return Err(Error::config("dataset", format!("the scheme {scheme}:// is not supported"), fix));
        }
        // The parser of URIs leaves such characters out, so that another dataset would be meant.
        if given.contains(|c: char| c.is_control()) || given.trim_end() != given {
            let problem = format!(
                "the URI {:?} has a line feed, another control character, or a space at its end",
                without_secrets(given)
            );
            return Err(Error::config("dataset", problem, "leave these characters out"));
        }
        let named = without_secrets(given);
        let url = Url::parse(given).map_err(|error| {
            Error::config("dataset", format!("{named} is not a valid URI: {error}"), "check its spelling")
        })?;
        // Names of objects end there for the parser, so that another dataset would be read or replaced. The rest can also be a secret,
        // which would be in every record of this location.
        if url.query().is_some() || url.fragment().is_some() {
            let fix = "leave out what follows, or write %3F and %23 if the name has these characters; signed addresses are not supported";
            return Err(Error::config("dataset", format!("{named}: it has a '?' or '#'"), fix));
        }
        if !url.username().is_empty() || url.password().is_some() {
            let fix = "leave them out; object stores read credentials from environment variables, web servers get none";
            return Err(Error::config("dataset", format!("{named}: it has a user name or a password"), fix));
        }
        Ok(Self::Uri(url))
    }

    /// The path; `None` for a URI.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Path(path) => Some(path),
            Self::Uri(_) => None,
        }
    }

    /// The path, or an error for a URI.
    ///
    /// # Errors
    /// If the location is a URI, which `format` cannot read or write.
    pub fn local(&self, format: &str) -> Result<&Path> {
        self.path().ok_or_else(|| {
            let fix = "copy the dataset to this machine, or use the format lance or hdf5, which support object stores";
            Error::config("dataset", format!("the format {format} does not support object stores: {self}"), fix)
        })
    }

    /// The location as error messages show it.
    pub fn label(&self) -> PathBuf {
        match self {
            Self::Path(path) => path.clone(),
            Self::Uri(url) => url.as_str().into(),
        }
    }

    /// The last component of the path or URI: the name of a file or folder.
    pub fn name(&self) -> &str {
        match self {
            Self::Path(path) => path.file_name().and_then(|name| name.to_str()).unwrap_or_default(),
            Self::Uri(url) => url.path().trim_end_matches('/').rsplit('/').next().unwrap_or_default(),
        }
    }

    /// The location of an entry of this folder.
    #[must_use]
    pub fn child(&self, name: &str) -> Self {
        match self {
            Self::Path(path) => Self::Path(path.join(name)),
            Self::Uri(url) => {
                let mut url = url.clone();
                // A URI without segments names no folder, so that it has no entries.
                if let Ok(mut segments) = url.path_segments_mut() {
                    segments.pop_if_empty().push(name);
                }
                Self::Uri(url)
            }
        }
    }

    /// Whether the name ends in `.suffix`, ignoring case.
    pub fn has_suffix(&self, suffix: &str) -> bool {
        self.name().rsplit_once('.').is_some_and(|(stem, end)| !stem.is_empty() && end.eq_ignore_ascii_case(suffix))
    }
}

/// A URI for an error: without a user name, a password, a query and a fragment, which can be secrets. A password may have any of the
/// characters that end the other parts, so that nothing is shown before the last `@`.
fn without_secrets(given: &str) -> String {
    let (scheme, rest) = given.split_once("://").unwrap_or(("", given));
    let named = rest.split(['?', '#']).next().unwrap_or_default();
    match rest.rfind('@') {
        Some(at) if at >= named.len() => format!("{scheme}://…"),
        Some(at) => format!("{scheme}://…{}", &named[at..]),
        None => format!("{scheme}://{named}"),
    }
}

/// The path of a `file://` URI, in which percent signs are decoded.
fn file_of(given: &str) -> Result<PathBuf> {
    let no_file = |given: &str| {
        let problem = format!("{} names no file of this machine by its whole path", without_secrets(given));
        Error::config(
            "dataset",
            problem,
            "give a path, or file:///and/the/whole/path, with %23 and %3F for '#' and '?'",
        )
    };
    match Url::parse(given) {
        Ok(url) if url.query().is_none() && url.fragment().is_none() => url.to_file_path().map_err(|()| no_file(given)),
        _ => Err(no_file(given)),
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path(path) => write!(f, "{}", path.display()),
            Self::Uri(url) => write!(f, "{url}"),
        }
    }
}

impl From<&Path> for Location {
    fn from(path: &Path) -> Self {
        Self::Path(path.to_owned())
    }
}

impl From<&PathBuf> for Location {
    fn from(path: &PathBuf) -> Self {
        Self::Path(path.clone())
    }
}

impl From<PathBuf> for Location {
    fn from(path: PathBuf) -> Self {
        Self::Path(path)
    }
}

impl From<&Self> for Location {
    fn from(location: &Self) -> Self {
        location.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_paths_and_uris() -> Result<()> {
        let path = Location::parse("runs/pusht.lance")?;
        assert_eq!(path.path(), Some(Path::new("runs/pusht.lance")));
        assert_eq!(Location::parse("file:///tmp/a.h5")?, Location::Path("/tmp/a.h5".into()));
        let uri = Location::parse("s3://bucket/runs/pusht.LANCE/")?;
        assert!(uri.path().is_none() && uri.has_suffix("lance") && uri.name() == "pusht.LANCE");
        assert_eq!(uri.to_string(), "s3://bucket/runs/pusht.LANCE/");
        assert!(!Location::parse("runs/.lance")?.has_suffix("lance"), "`.lance` is a hidden file, not a suffix");
        Ok(())
    }

    #[test]
    fn entries_of_a_folder_keep_their_names() -> Result<()> {
        let of = |folder: &str, name: &str| Ok::<_, Error>(Location::parse(folder)?.child(name).to_string());
        assert_eq!(of("s3://bucket/sets", "a.lance")?, "s3://bucket/sets/a.lance");
        assert_eq!(of("s3://bucket", "a.lance")?, of("s3://bucket/", "a.lance")?);
        assert_eq!(of("s3://bucket/sets/", "50 %2f?x.lance")?, "s3://bucket/sets/50%20%252f%3Fx.lance");
        assert_eq!(of("/sets", "a.lance")?, "/sets/a.lance");
        Ok(())
    }

    #[test]
    fn rejects_characters_that_the_parser_leaves_out() {
        for given in ["s3://b/a\nb.lance", "s3://b/a\tb.lance", "s3://b/a.lance\r", "s3://b/a.lance ", "s3://b/\u{1b}a"]
        {
            let error = Location::parse(given).expect_err(given).to_string();
            assert!(error.contains("control character") && !error.contains(['\n', '\u{1b}']), "{error}");
        }
        assert!(Location::parse("runs/a\nb.lance").is_ok(), "the name of a file");
    }

    #[test]
    fn rejects_what_is_no_part_of_a_name() {
        for (given, problem) in [
            ("s3://b/rooms.lance#small", "'?' or '#'"),
            ("s3://b/sweep#1/rooms.lance", "%23"),
            ("http://host/d.h5?X-Amz-Signature=SECRET", "'?' or '#'"),
            ("https://me:SECRET@host/d.h5", "password"),
            ("https://SECRET@host/d.h5", "user name"),
            ("https://me:SECRET@host:port/d.h5", "not a valid URI"),
            ("https://me:SECRET@ho st/d.h5", "not a valid URI"),
            ("https://me:SECRET/SECRET@host/d.h5", "not a valid URI"),
            ("https://me:SECRET#SECRET@host/d.h5", "not a valid URI"),
            ("https://me:SECRET@host/d.h5\n", "control character"),
            ("file:///x.h5?sig=SECRET", "file:///"),
        ] {
            let error = Location::parse(given).expect_err(given).to_string();
            assert!(error.contains(problem) && !error.contains("SECRET"), "{error}");
        }
        assert!(Location::parse("s3://b/sweep%231/rooms.lance").is_ok());
    }

    #[test]
    fn file_uris_are_paths() -> Result<()> {
        for (given, path) in [
            ("file:///tmp/my%20rooms.lance", "/tmp/my rooms.lance"),
            ("file://localhost/tmp/a.h5", "/tmp/a.h5"),
            ("file:///tmp/a.lance/", "/tmp/a.lance/"),
        ] {
            assert_eq!(Location::parse(given)?, Location::Path(path.into()), "{given}");
        }
        for given in ["file://host/tmp/a.h5", "file://runs/a.h5"] {
            assert!(Location::parse(given).is_err_and(|error| error.to_string().contains("file:///")), "{given}");
        }
        Ok(())
    }

    #[test]
    fn rejects_unknown_schemes() {
        let error = Location::parse("ftp://host/a.lance").expect_err("an unknown scheme").to_string();
        assert!(error.contains("ftp://") && error.contains("s3://"), "{error}");
    }
}
