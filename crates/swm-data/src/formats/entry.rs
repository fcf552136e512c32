//! [`FormatEntry`]: the registry row of a dataset format.

use super::set_aside;
use crate::dataset::{Location, Reader, WriteMode, WriteOptions, Writer};
use std::path::Path;
use std::sync::Arc;
use swm_core::{Error, Named, Result, Schema, files};

/// A dataset format: its id, its suffixes, and the functions that detect, open and create its datasets.
pub struct FormatEntry {
    /// Id of the format, such as `lance`.
    pub id: &'static str,
    /// One-sentence description.
    pub summary: &'static str,
    /// File name suffixes of the format's datasets. New datasets get the first suffix.
    pub suffixes: &'static [&'static str],
    /// Whether images are stored as they are, unless the user chooses a lossy codec.
    pub exact_images: bool,
    /// Whether the user may choose the codec of images.
    pub codecs: bool,
    /// The Cargo feature of `swm-data` that this format requires, if any.
    pub feature: Option<&'static str>,
    /// Returns whether an existing dataset, or a dataset to create, at this location has this format.
    pub detect: fn(&Location) -> bool,
    /// The implementation; `None` if the program was built without [`FormatEntry::feature`].
    pub backend: Option<Backend>,
}

/// The functions that open, create and delete datasets of a format.
#[derive(Clone, Copy)]
pub struct Backend {
    /// Opens a dataset.
    pub open: fn(&Location) -> Result<Arc<dyn Reader>>,
    /// Creates, continues or replaces a dataset.
    pub create: fn(&Location, &Schema, WriteOptions) -> Result<Box<dyn Writer>>,
    /// Deletes a dataset on this machine: the files that its own metadata names, and no other file.
    pub remove: fn(&Path) -> Result<()>,
    /// Completes or undoes a replacement of a dataset that was interrupted, if replacing takes several steps.
    pub recover: Option<fn(&Path) -> Result<()>>,
}

impl Named for FormatEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

impl FormatEntry {
    /// Whether the location's name ends in one of the format's suffixes.
    pub fn has_suffix(&self, location: &Location) -> bool {
        self.suffixes.iter().any(|suffix| location.has_suffix(suffix))
    }

    /// Whether this build contains the format's implementation.
    pub const fn is_available(&self) -> bool {
        self.backend.is_some()
    }

    /// Opens a dataset.
    ///
    /// # Errors
    /// If there is no such dataset, it is damaged or being replaced, or this build lacks the format's feature.
    pub fn open(&self, location: &Location) -> Result<Arc<dyn Reader>> {
        let opened = (self.backend()?.open)(location);
        let has_episodes = opened.as_ref().is_ok_and(|reader| !reader.episodes().is_empty());
        if let Some(error) = set_aside::interrupted(location, has_episodes) {
            return Err(error);
        }
        let reader = opened?;
        check_sizes(&*reader, location)?;
        Ok(reader)
    }

    /// Creates, continues or replaces a dataset whose episodes have the columns of `schema`.
    ///
    /// # Errors
    /// If the dataset exists and `options.mode` forbids it, the dataset to replace is a symbolic link or the path a link to nothing, the schema differs
    /// from that of the dataset to continue, writing fails, or this build lacks the format's feature.
    pub fn create(&self, location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
        if let Some(path) = location.path() {
            // A link to nothing would place the files where the user may not expect them.
            if options.mode == WriteMode::Overwrite || !path.exists() {
                files::check_no_link(path)?;
            }
        }
        (self.backend()?.create)(location, schema, options)
    }

    /// Checks that a new dataset will be recognised at a location: for formats that are recognised by the suffix.
    ///
    /// # Errors
    /// If the location has no suffix of the format.
    pub(crate) fn check_suffix(&self, location: &Location) -> Result<()> {
        if (self.detect)(location) {
            return Ok(());
        }
        let suffix = self.suffixes[0];
        let problem = format!("{location} does not end in .{suffix}, by which the format {} is recognised", self.id);
        Err(Error::config("dataset path", problem, format!("use {location}.{suffix}")))
    }

    /// Deletes a dataset on this machine, and its folder if that is empty then.
    ///
    /// # Errors
    /// If the metadata of the dataset does not name its files, or a file cannot be deleted.
    pub fn remove(&self, path: &Path) -> Result<()> {
        files::check_no_link(path)?;
        (self.backend()?.remove)(path)?;
        files::remove_empty_folder(path)
    }

    /// Completes or undoes a replacement of a dataset on this machine that was interrupted.
    ///
    /// # Errors
    /// If another process writes to the dataset, or files cannot be moved or deleted.
    pub(crate) fn recover(&self, path: &Path) -> Result<()> {
        self.backend()?.recover.map_or(Ok(()), |recover| recover(path))
    }

    fn backend(&self) -> Result<Backend> {
        self.backend.ok_or_else(|| {
            let feature = self.feature.unwrap_or(self.id);
            let problem = format!("this build lacks the feature {feature}");
            Error::config(format!("format {}", self.id), problem, format!("build it with `--features {feature}`"))
        })
    }
}

/// The most bytes of a row of a stored column: an image of the largest size.
const MAX_ROW_BYTES: usize = 3 * swm_image::MAX_PIXELS;
/// The most rows of a dataset.
const MAX_ROWS: usize = 1 << 40;

/// Checks the sizes that a dataset states, before anything allocates memory for its rows.
///
/// # Errors
/// When a row of a column has more than [`MAX_ROW_BYTES`], or the episodes have more than [`MAX_ROWS`].
fn check_sizes(reader: &dyn Reader, location: &Location) -> Result<()> {
    let damaged = |problem: String| {
        Error::corrupt(location.label(), problem, "restore the dataset from a copy, or rebuild it with smaller rows")
    };
    if let Some(column) = reader.schema().columns().iter().find(|column| column.row_bytes() > MAX_ROW_BYTES) {
        let shape = &column.shape;
        return Err(damaged(format!("a row of column '{}' has the shape {shape:?}, which is too large", column.name)));
    }
    let rows = reader.episodes().iter().try_fold(0_usize, |rows, episode| rows.checked_add(episode.length));
    match rows {
        Some(rows) if rows <= MAX_ROWS => Ok(()),
        _ => Err(damaged("its episodes have more than 2^40 rows".to_owned())),
    }
}
