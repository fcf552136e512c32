//! Deletes a dataset of column files, and nothing else in its folder.

use super::images::uncommitted;
use super::reader::stored_metadata;
use super::{ImageFiles, OFFSETS, TEMPORARY, check_name, journal};
use crate::formats::replacing::check_no_links;
use crate::formats::set_aside::{self, DatasetFiles, Places};
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{ColumnSpec, Error, Result, Schema};

/// Deletes the dataset in a folder: the files of its own columns and episodes, as `ep_len.npz` and the journal name them.
///
/// Images are deleted first, then column files, then the journal, and `ep_len.npz` last. So after a kill at any time the
/// remaining files still have the metadata that names them: readers report the missing files, and the next removal deletes
/// the rest.
///
/// # Errors
/// If the metadata cannot be read or records no columns, the dataset has the other format, or a file is a symbolic link;
/// then nothing is deleted. Also if a file cannot be deleted, or another process writes to the dataset.
pub(crate) fn remove(folder: &Path, images: ImageFiles) -> Result<()> {
    let _lock = Lock::folder(folder)?;
    set_aside::recover(folder, images)?;
    let names = images.names(folder)?;
    images.remove_empty_folders(folder)?;
    files::delete_named(folder, &names)
}

impl DatasetFiles for ImageFiles {
    const PLACES: Places = set_aside::COLUMN_FILES;

    fn names(self, folder: &Path) -> Result<Vec<PathBuf>> {
        let (_, mut names) = stored_files(folder, self)?;
        names.push(Self::PLACES.metadata.into());
        Ok(names)
    }

    fn committed(self, folder: &Path) -> Result<usize> {
        Ok(stored_episodes(folder)?.1.len())
    }

    fn unfinished(self) -> Vec<PathBuf> {
        vec![format!("{OFFSETS}.npz").into(), TEMPORARY.into()]
    }

    fn remove_empty_folders(self, folder: &Path) -> Result<()> {
        let (schema, ..) = stored_episodes(folder)?;
        let mut columns = schema.columns().iter().filter(|column| column.is_image());
        columns.try_for_each(|column| files::remove_empty_folder(&folder.join(&column.name)))
    }
}

/// Checks that the dataset in a folder can be replaced.
///
/// # Errors
/// As [`remove`].
pub(super) fn check_replaceable(folder: &Path, images: ImageFiles) -> Result<()> {
    let (_, names) = stored_files(folder, images)?;
    check_no_links(folder, &names)
}

/// The columns, and the files apart from `ep_len.npz`, in the order of deletion.
fn stored_files(folder: &Path, images: ImageFiles) -> Result<(Schema, Vec<PathBuf>)> {
    let (schema, rows, killed) = stored_episodes(folder)?;
    let mut names = vec![];
    for column in schema.columns().iter().filter(|column| column.is_image()) {
        let files = images.list(folder, &column.name)?;
        check_format(folder, &column.name, images, files.is_empty())?;
        let stored = files.iter().filter(|file| rows.get(file.episode).is_some_and(|&rows| file.step < rows));
        // The journal shows that the writer was killed.
        let left = if killed { uncommitted(&files, rows.len()) } else { vec![] };
        names.extend(left.into_iter().chain(stored).map(|file| file.name.clone()));
    }
    names.extend(own_files(&schema));
    Ok((schema, names))
}

/// Checks that the files of a new dataset, which replaces the one in `folder`, replace no file that is not part of it.
///
/// # Errors
/// If a file has the name of a new column file or of the folder of an image column.
pub(super) fn check_new_files(folder: &Path, new: &Schema) -> Result<()> {
    let (old, ..) = stored_episodes(folder)?;
    let old: Vec<PathBuf> = own_files(&old).collect();
    own_files(new).filter(|name| !old.contains(name)).try_for_each(|name| files::check_free(&folder.join(name)))?;
    let folders = new.columns().iter().filter(|column| column.is_image()).map(|column| folder.join(&column.name));
    folders.filter(|path| !path.is_dir()).try_for_each(|path| files::check_free(&path))
}

/// The columns, the number of rows of each episode, and whether a writer was killed.
fn stored_episodes(folder: &Path) -> Result<(Schema, Vec<usize>, bool)> {
    let refused = |problem: String| {
        let problem = format!("the names of its files are unknown: {problem}");
        Error::corrupt(folder, problem, "delete the dataset by hand, or choose another path")
    };
    let (lengths, recorded) = stored_metadata(folder).map_err(|error| refused(error.to_string()))?;
    let schema = recorded.schema.ok_or_else(|| refused("another program wrote it".to_owned()))?;
    schema.columns().iter().try_for_each(|column| check_name(&column.name)).map_err(|e| refused(e.to_string()))?;
    let mut rows: Vec<usize> = lengths.iter().map(|&length| usize::try_from(length).unwrap_or(0)).collect();
    let path = journal::path(folder);
    let killed = path.exists();
    if killed {
        let columns: Vec<&ColumnSpec> = schema.columns().iter().filter(|column| !column.is_image()).collect();
        let pending = files::read(&path, u64::MAX)
            .and_then(|bytes| journal::replay(&path, &bytes, &columns, rows.len()))
            .map_err(|error| refused(error.to_string()))?;
        rows.extend(pending.iter().map(|episode| episode.rows));
    }
    Ok((schema, rows, killed))
}

/// The files of a dataset apart from images and `ep_len.npz`, in the order of deletion.
fn own_files(schema: &Schema) -> impl Iterator<Item = PathBuf> {
    let columns =
        schema.columns().iter().filter(|column| !column.is_image()).map(|column| format!("{}.npz", column.name));
    let others = [format!("{OFFSETS}.npz"), TEMPORARY.to_owned(), journal::NAME.to_owned()];
    columns.chain(others).map(PathBuf::from)
}

/// Checks that a column has the image files of this format. A column without files may be left by a kill.
fn check_format(folder: &Path, column: &str, images: ImageFiles, is_empty: bool) -> Result<()> {
    let (other, name) = match images {
        ImageFiles::Images => (ImageFiles::Videos, "video"),
        ImageFiles::Videos => (ImageFiles::Images, "folder"),
    };
    if is_empty && !other.list(folder, column)?.is_empty() {
        let problem = format!("{} is a dataset of the format {name}", folder.display());
        return Err(Error::config("dataset", problem, format!("give --format {name}, or choose another path")));
    }
    Ok(())
}
