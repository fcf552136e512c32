//! [`Origin`]: who chose a name. Names that the user chose may load code and files; names in a file may not, because a
//! stranger may have written the file.

use crate::{Error, Result};
use std::path::PathBuf;

/// The origin of a name, such as the id of an environment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The user: the command line, or the program that calls the package.
    User,
    /// A file or a checkpoint.
    File(PathBuf),
}

impl Origin {
    /// The origin of the names in a file: [`Origin::User`] if the user trusts the file.
    pub fn file(path: impl Into<PathBuf>, trust: bool) -> Self {
        if trust { Self::User } else { Self::File(path.into()) }
    }

    /// Refuses `name` if a file chose it. `effect` is the reason, such as `which imports a Python module`; `option` is
    /// the option by which the user chooses the name instead.
    ///
    /// # Errors
    /// When a file chose the name. The message names the file, the name, and the two ways to allow it.
    pub fn check_user(&self, name: &str, effect: &str, option: Option<&str>) -> Result<()> {
        let Self::File(path) = self else { return Ok(()) };
        let own = option.map_or(String::new(), |option| format!("name it yourself ({option}), or "));
        Err(Error::config(
            path.display().to_string(),
            format!("it names {name}, {effect}, and a file may not choose that"),
            format!("{own}trust the file (--trust; trust=True in Python) if you know who wrote it"),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_files_are_refused() {
        let check =
            |origin: &Origin| origin.check_user("environment 'a:B-v0'", "which runs code", Some("--env a:B-v0"));
        assert!(check(&Origin::User).is_ok() && check(&Origin::file("results.json", true)).is_ok());
        let error = check(&Origin::file("results.json", false)).expect_err("a file").to_string();
        for part in ["results.json", "'a:B-v0'", "--env a:B-v0", "--trust", "trust=True"] {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
