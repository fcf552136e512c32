//! [`AnyFile`]: the file of a study of any kind, at a [`Size`].

use super::file::StudyFile;
use super::tables::TableFile;
use std::path::Path;
use swm_core::Result;

/// The size of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Size {
    /// As the file describes it: that of the paper, for the paper's studies.
    Paper,
    /// With what the file's `small` tables replace: minutes on two cores, from an empty home.
    Small,
}

impl Size {
    /// The title of a study at this size, which keeps the folders of both apart.
    pub fn title(self, title: &str) -> String {
        match self {
            Self::Paper => title.to_owned(),
            Self::Small => format!("{title}, small"),
        }
    }
}

/// The file of a study.
#[derive(Debug)]
pub enum AnyFile {
    /// A study of evaluations.
    Evaluations(Box<StudyFile>),
    /// A study of another kind.
    Table(TableFile),
}

impl AnyFile {
    /// Parses a file at a size; `path` is named in errors.
    ///
    /// # Errors
    /// As [`StudyFile::parse`] and [`TableFile::parse`].
    pub fn parse(text: &str, path: &Path, size: Size) -> Result<Self> {
        let has_kind = toml::from_str::<toml::Table>(text).is_ok_and(|table| table.contains_key("kind"));
        if has_kind {
            return TableFile::parse(text, path).map(Self::Table);
        }
        StudyFile::parse(text, path, size).map(|file| Self::Evaluations(Box::new(file)))
    }

    /// The title and the question.
    pub fn texts(&self) -> [&str; 2] {
        match self {
            Self::Evaluations(file) => [&file.title, &file.question],
            Self::Table(file) => [&file.title, &file.question],
        }
    }
}
