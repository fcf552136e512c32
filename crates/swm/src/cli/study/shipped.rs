//! The studies of this program: one file in `studies/` and one row each.

use super::file::StudyFile;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// The names and files of all studies of this program.
const STUDIES: &[(&str, &str)] = &[
    ("paper/factors", include_str!("../../../studies/paper/factors.toml")),
    ("paper/distractors", include_str!("../../../studies/paper/distractors.toml")),
    ("paper/colour-wheel", include_str!("../../../studies/paper/colour-wheel.toml")),
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

/// Returns the study of this program with a name, or the study in the file at a path.
///
/// # Errors
/// When there is no such study or file, or the file is invalid.
pub fn find(given: &str) -> Result<StudyFile> {
    if let Some((_, text)) = STUDIES.iter().find(|(name, _)| *name == given) {
        return StudyFile::parse(text, Path::new(given));
    }
    if Path::new(given).extension().is_none_or(|suffix| suffix != "toml") {
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
    StudyFile::parse(&text, Path::new(given))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_study_of_this_program_is_valid() {
        for (name, file) in all().expect("parsing the studies") {
            assert!(!file.title.is_empty() && file.question.ends_with('?'), "{name}");
            let commands = super::super::expand::commands(&file, &[]).expect(name);
            assert!(commands.len() > 1, "{name}");
        }
    }
}
