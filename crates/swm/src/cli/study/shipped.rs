//! The studies of this program: one file in `studies/` and one row each.

use super::file::StudyFile;
use std::path::{Path, PathBuf};
use swm_core::{Error, Origin, Result, files};

/// The names and files of all studies of this program.
const STUDIES: &[(&str, &str)] = &[
    ("paper/factors", include_str!("../../../studies/paper/factors.toml")),
    ("paper/distractors", include_str!("../../../studies/paper/distractors.toml")),
    ("paper/colour-wheel", include_str!("../../../studies/paper/colour-wheel.toml")),
    ("two-room/colour-wheel", include_str!("../../../studies/two-room/colour-wheel.toml")),
];

/// The largest file of a study, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Returns all studies of this program.
///
/// # Errors
/// When a file is invalid, which is a bug.
pub fn all() -> Result<Vec<(&'static str, StudyFile)>> {
    STUDIES.iter().map(|(name, text)| Ok((*name, StudyFile::parse(text, &PathBuf::from(name))?))).collect()
}

/// Returns the study of this program with a name, or the study in the file at a path, and who chose its names. `trust` is
/// whether the user trusts the file.
///
/// # Errors
/// When there is no such study or file, or the file is invalid.
pub fn find(given: &str, trust: bool) -> Result<(StudyFile, Origin)> {
    if let Some((_, text)) = STUDIES.iter().find(|(name, _)| *name == given) {
        return Ok((StudyFile::parse(text, Path::new(given))?, Origin::User));
    }
    if Path::new(given).extension().is_none_or(|suffix| suffix != "toml") {
        if Path::new(given).exists() {
            return Err(Error::config(
                given,
                "is no name of a study, and no path that ends in .toml",
                "rename the file",
            ));
        }
        let known = STUDIES.iter().map(|(name, _)| *name);
        return Err(Error::unknown(
            "study",
            given,
            known,
            "`swm study list` lists them; or give a path that ends in .toml",
        ));
    }
    let bytes = files::read(Path::new(given), MAX_BYTES)?;
    let text = String::from_utf8(bytes)
        .map_err(|error| Error::corrupt(given, format!("is not UTF-8 ({error})"), "give a TOML file"))?;
    Ok((StudyFile::parse(&text, Path::new(given))?, Origin::file(given, trust)))
}

/// The name of a study of this program, or the name of a file without its folders, which belong to one computer.
pub fn short_name(given: &str) -> String {
    if STUDIES.iter().any(|(name, _)| *name == given) {
        return given.to_owned();
    }
    Path::new(given).file_name().map_or_else(|| given.to_owned(), |name| name.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::resolver::HomeResolver;

    #[test]
    fn every_study_of_this_program_is_valid() {
        for (name, file) in all().expect("parsing the studies") {
            assert!(!file.title.is_empty() && file.question.ends_with('?'), "{name}");
            let resolver = HomeResolver::new(Origin::User);
            let commands = super::super::expand::commands(&file, &[], &resolver).expect(name);
            assert!(commands.len() > 1, "{name}");
        }
    }
}
