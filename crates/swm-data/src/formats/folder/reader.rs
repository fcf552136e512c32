//! Reads a folder: numeric columns from column files, images from image files.

use crate::dataset::Location;
use crate::dataset::episodes::{EpisodeRows, content_hash};
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::column_files::{ColumnFiles, SUFFIXES, check_exists, check_unchanged, image_path, state_of};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema, files};

/// Maximum compression ratio of an image file (deflate's limit). A file with a higher ratio is damaged.
const MAX_COMPRESSION: usize = 1032;

/// Opens a dataset of the format `folder`.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    Ok(Arc::new(FolderReader::open(location.local("folder")?)?))
}

pub(super) struct FolderReader {
    files: ColumnFiles,
    schema: Schema,
    /// The state of some images when the dataset was opened.
    opened: blake3::Hash,
}

impl FolderReader {
    pub fn open(folder: &Path) -> Result<Self> {
        check_exists(folder)?;
        let files = ColumnFiles::open(folder)?;
        let images = match files.recorded() {
            Some(recorded) => recorded.columns().iter().filter(|column| column.is_image()).cloned().collect(),
            None => infer_image_columns(&files)?,
        };
        let schema = files.schema(images)?;
        let opened = state_of(|visit| sampled_images(&files, &schema, visit));
        Ok(Self { files, schema, opened })
    }

    fn read_images(&self, column: &ColumnSpec, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let mut slots = self.files.rows().row_slots(column, ranges, out)?;
        let (height, width) = (column.shape[0], column.shape[1]);
        // Each group holds the output slots of one image, which is decoded once.
        slots.par_chunk_by_mut(|a, b| a.0 == b.0).try_for_each(|group| {
            let Some((((episode, step), first), others)) = group.split_first_mut() else { return Ok(()) };
            let bytes = read_image(self.files.folder(), &column.name, *episode, *step)?;
            swm_image::decode(&bytes, height, width, first).map_err(|problem| {
                let path = image_path(self.files.folder(), &column.name, *episode, *step, SUFFIXES[0]);
                Error::corrupt(path, problem.to_string(), "restore it from a copy, or rebuild the dataset")
            })?;
            others.iter_mut().for_each(|(_, slot)| slot.copy_from_slice(first));
            Ok(())
        })?;
        self.files.check()
    }
}

impl Reader for FolderReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.files.rows().episodes()
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let column = self.schema.column(name)?;
        let read = if self.files.has(name) {
            self.files.read(column, ranges, out)
        } else {
            self.read_images(column, ranges, out)
        };
        read.or_else(|error| self.files.check().and(Err(error)))
    }

    fn identity(&self, _: usize) -> Result<String> {
        self.files.identity()
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.files.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        self.files.excess_rows()
    }

    fn sources(&self) -> Vec<PathBuf> {
        vec![self.files.folder().to_owned()]
    }

    fn manifest(&self) -> Option<Manifest> {
        self.files.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.files.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        let rows: &EpisodeRows = self.files.rows();
        let images = |visit: &mut dyn FnMut(&Path)| {
            for column in self.schema.columns()[2..].iter().filter(|column| column.is_image()) {
                for (position, episode) in rows.episodes().iter().enumerate() {
                    for (step, suffix) in (0..episode.length).flat_map(|step| SUFFIXES.map(|suffix| (step, suffix))) {
                        visit(&image_path(self.files.folder(), &column.name, position, step, suffix));
                    }
                }
            }
        };
        let before = state_of(images);
        let hash = content_hash(rows, &self.schema.columns()[2..], |column, add| {
            let data = if self.files.has(&column.name) { self.files.data(&column.name)? } else { &[] };
            for (position, episode) in rows.episodes().iter().enumerate() {
                if column.is_image() {
                    for step in 0..episode.length {
                        add(&read_image(self.files.folder(), &column.name, position, step)?);
                    }
                } else {
                    let rows = rows.range(&StepRange::new(position, 0, episode.length))?;
                    let size = column.row_bytes();
                    data[rows.start as usize * size..rows.end as usize * size].chunks_exact(size).for_each(&mut *add);
                }
            }
            Ok(())
        });
        self.files.check()?;
        check_unchanged(self.files.folder(), before, images)?;
        check_unchanged(self.files.folder(), self.opened, |visit| sampled_images(&self.files, &self.schema, visit))?;
        hash
    }
}

/// Visits the paths of an image in up to 16 episodes at equal distances.
fn sampled_images(files: &ColumnFiles, schema: &Schema, visit: &mut dyn FnMut(&Path)) {
    let episodes = files.rows().episodes().len();
    let sampled = episodes.min(16);
    for column in schema.columns().iter().filter(|column| column.is_image()) {
        for position in (0..sampled).map(|i| i * episodes / sampled) {
            for suffix in SUFFIXES {
                visit(&image_path(files.folder(), &column.name, position, 0, suffix));
            }
        }
    }
}

/// The image columns of a third-party folder: one column per subfolder. The first image of a subfolder determines the
/// image size.
fn infer_image_columns(files: &ColumnFiles) -> Result<Vec<ColumnSpec>> {
    let folder = files.folder();
    let Some(first) = files.rows().episodes().iter().position(|episode| episode.length > 0) else { return Ok(vec![]) };
    let io = |e| Error::io(folder, "listing the folder", e);
    let mut columns = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        if !entry.path().is_dir() {
            continue;
        }
        let bytes = read_image(folder, &name, first, 0)?;
        let damaged = |problem: String| {
            let path = image_path(folder, &name, first, 0, SUFFIXES[0]);
            Error::corrupt(path, problem, "restore it from a copy, or rebuild the dataset")
        };
        let (height, width) = swm_image::image_size(&bytes).map_err(|problem| damaged(problem.to_string()))?;
        let column = ColumnSpec::image(&name, height, width);
        if column.is_empty() || column.row_bytes() / MAX_COMPRESSION > bytes.len() {
            return Err(damaged(format!("{} bytes cannot be an image of {height} x {width}", bytes.len())));
        }
        columns.push(column);
    }
    Ok(columns)
}

/// The limit of the size of an image file: the pixels of the largest image, with opacity.
const MAX_FILE_BYTES: u64 = 8 * swm_image::MAX_PIXELS as u64;

/// Reads the image file of a step, with any suffix of [`SUFFIXES`].
fn read_image(folder: &Path, column: &str, episode: usize, step: usize) -> Result<Vec<u8>> {
    for suffix in SUFFIXES {
        let path = image_path(folder, column, episode, step, suffix);
        match files::read(&path, MAX_FILE_BYTES) {
            Err(Error::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
            read => return read,
        }
    }
    let path = image_path(folder, column, episode, step, SUFFIXES[0]);
    Err(Error::corrupt(path, "the image is missing", "restore it from a copy, or rebuild the dataset"))
}
