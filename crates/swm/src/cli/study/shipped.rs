//! The studies of this program: one file in `studies/` and one row each.

use super::any_file::{AnyFile, Size};
use std::path::{Path, PathBuf};
use swm_core::{Error, Origin, Result, files};

/// The names and files of all studies of this program.
const STUDIES: &[(&str, &str)] = &[
    ("paper/factors", include_str!("../../../studies/paper/factors.toml")),
    ("paper/distractors", include_str!("../../../studies/paper/distractors.toml")),
    ("paper/colour-wheel", include_str!("../../../studies/paper/colour-wheel.toml")),
    ("paper/baselines", include_str!("../../../studies/paper/baselines.toml")),
    ("paper/shift", include_str!("../../../studies/paper/shift.toml")),
    ("paper/online", include_str!("../../../studies/paper/online.toml")),
    ("paper/drift", include_str!("../../../studies/paper/drift.toml")),
    ("paper/data", include_str!("../../../studies/paper/data.toml")),
    ("paper/factors-per-env", include_str!("../../../studies/paper/factors-per-env.toml")),
    ("two-room/shift", include_str!("../../../studies/two-room/shift.toml")),
    ("two-room/colour-wheel", include_str!("../../../studies/two-room/colour-wheel.toml")),
];

/// The largest file of a study, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Returns all studies of this program.
///
/// # Errors
/// When a file is invalid, which is a bug.
pub fn all() -> Result<Vec<(&'static str, AnyFile)>> {
    STUDIES.iter().map(|(name, text)| Ok((*name, AnyFile::parse(text, &PathBuf::from(name), Size::Paper)?))).collect()
}

/// Returns the study of this program with a name, or the study in the file at a path, at a size, and who chose its names.
/// `trust` is whether the user trusts the file.
///
/// # Errors
/// When there is no such study or file, or the file is invalid.
pub fn find(given: &str, size: Size, trust: bool) -> Result<(AnyFile, Origin)> {
    if let Some((_, text)) = STUDIES.iter().find(|(name, _)| *name == given) {
        return Ok((AnyFile::parse(text, Path::new(given), size)?, Origin::User));
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
    Ok((AnyFile::parse(&text, Path::new(given), size)?, Origin::file(given, trust)))
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
    fn every_study_of_this_program_is_valid_at_both_sizes() {
        for (name, text) in STUDIES {
            for size in [Size::Paper, Size::Small] {
                let file = AnyFile::parse(text, Path::new(name), size).expect(name);
                let [title, question] = file.texts();
                assert!(!title.is_empty() && question.ends_with('?'), "{name}");
                let cells = match file {
                    AnyFile::Table(file) => file.study(size, &[], &Origin::User).expect(name).cells.len(),
                    AnyFile::Evaluations(file) => {
                        let resolver = HomeResolver::new(Origin::User);
                        super::super::expand::commands(&file, &[], &resolver).expect(name).len()
                    }
                };
                assert!(cells > 1, "{name}");
            }
        }
    }
}
