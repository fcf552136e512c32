//! The list of dataset formats, and [`open`] and [`create`], which choose a format by a dataset's location.

use super::entry::FormatEntry;
use super::{folder, hdf5, lance, lance_video, lerobot, set_aside, video};
use crate::dataset::{Location, Reader, WriteOptions, Writer};
use std::sync::Arc;
use swm_core::{Error, Named, Registry, Result, Schema, files};

/// All dataset formats. The suffix of a location determines its format; without a suffix, the first format that detects it.
pub static FORMATS: Registry<FormatEntry> = Registry {
    kind: "dataset format",
    hint: "`swm formats` lists them",
    rows: &[
        // Precedes `lance`, which also detects folders that contain Lance tables.
        lance_video::ENTRY,
        lance::ENTRY,
        video::ENTRY,
        folder::ENTRY,
        hdf5::ENTRY,
        lerobot::ENTRY,
    ],
};

/// The format of an existing dataset, or of a dataset to create, at this location.
pub fn detect(location: &Location) -> Option<&'static FormatEntry> {
    let by_suffix = FORMATS.rows.iter().find(|format| format.has_suffix(location));
    by_suffix.or_else(|| FORMATS.rows.iter().find(|format| (format.detect)(location)))
}

/// Opens a dataset of any format.
///
/// # Errors
/// If there is no dataset, its format is unknown, or it is damaged.
pub fn open(location: impl Into<Location>) -> Result<Arc<dyn Reader>> {
    let location = location.into();
    if let Some(format) = detect(&location) {
        return format.open(&location);
    }
    if let Some(error) = interrupted(&location) {
        return Err(error);
    }
    let problem = match location.path() {
        Some(path) if !files::exists(path)? => "there is no such dataset",
        Some(path) => {
            // A folder that may not be read may be a dataset.
            let listed = std::fs::read_dir(path).map(drop);
            listed.map_err(|error| Error::io(path, "listing the folder", error))?;
            "it is not a dataset"
        }
        None => "it is not a dataset",
    };
    let known: Vec<&str> = FORMATS.rows.iter().map(Named::id).collect();
    let fix = format!("`swm formats` describes the formats: {}", known.join(", "));
    Err(Error::corrupt(location.label(), problem, fix))
}

/// The error of a location whose dataset is being replaced and has no episode yet, or of which that was interrupted.
pub fn interrupted(location: &Location) -> Option<Error> {
    set_aside::interrupted(location, false)
}

/// Completes or undoes the replacement of a dataset that was interrupted, if there is one: what writes to a dataset that it
/// reads before calls this first.
///
/// # Errors
/// If another process writes to the dataset, or files cannot be moved or deleted.
pub fn recover(location: &Location) -> Result<()> {
    let Some((path, folder)) = location.path().and_then(|path| Some((path, set_aside::folder(path)?))) else {
        return Ok(());
    };
    let named = FORMATS.rows.iter().find(|format| format.has_suffix(location));
    named.or_else(|| detect(&Location::from(folder))).map_or(Ok(()), |format| format.recover(path))
}

/// Creates, continues or replaces a dataset whose episodes have the columns of `schema`, in the format that the
/// location's suffix names. Use [`FormatEntry::create`] for locations without such a suffix.
///
/// # Errors
/// If the location names no known format, the dataset exists and `options.mode` forbids it, the schema differs from
/// that of the dataset to continue, or writing fails.
pub fn create(location: impl Into<Location>, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let location = location.into();
    let named = || FORMATS.rows.iter().find(|format| format.has_suffix(&location));
    let Some(format) = detect(&location).or_else(named) else {
        let problem = format!("{location} has no suffix of a known format");
        let suffixes: Vec<String> = FORMATS.rows.iter().map(|format| format!(".{}", format.suffixes[0])).collect();
        let fix = format!("use a name that ends in {}, or name the format (--format)", suffixes.join(", "));
        return Err(Error::config("dataset path", problem, fix));
    };
    format.create(&location, schema, options)
}
