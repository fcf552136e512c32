//! Reading: numbers from the column files, frames from the videos.

use super::file;
use crate::dataset::Location;
use crate::dataset::episodes::content_hash;
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::column_files::{ColumnFiles, is_there};
use std::path::Path;
use std::sync::Arc;
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};
use swm_video::{Source, VideoCache};

/// Opens a folder of videos.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    Ok(Arc::new(VideoReader::open(location.local("video")?)?))
}

pub(super) struct VideoReader {
    files: ColumnFiles,
    schema: Schema,
    /// By column and episode.
    library: VideoCache<(usize, usize)>,
}

impl VideoReader {
    pub fn open(folder: &Path) -> Result<Self> {
        if !is_there(folder) {
            let problem = if folder.exists() { "it holds no ep_len.npz" } else { "there is no such dataset" };
            return Err(Error::corrupt(folder, problem, "check the path; `swm datasets` lists those at home"));
        }
        let files = ColumnFiles::open(folder)?;
        let pictures = match files.recorded() {
            Some(recorded) => recorded.columns().iter().filter(|column| column.is_image()).cloned().collect(),
            None => foreign_pictures(&files)?,
        };
        let schema = files.schema(pictures)?;
        Ok(Self { files, schema, library: VideoCache::default() })
    }

    fn source(&self, &(column, episode): &(usize, usize)) -> Result<Source> {
        Ok(Source::File(file(self.files.folder(), &self.schema.columns()[column].name, episode)))
    }
}

impl Reader for VideoReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.files.rows().episodes()
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.schema.index(name)?;
        let column = &self.schema.columns()[index];
        if self.files.has(name) {
            return self.files.read(column, ranges, out);
        }
        let wanted = self.files.rows().wanted(column, ranges, out)?;
        let wanted = wanted.into_iter().map(|((episode, step), place)| ((index, episode), step, place)).collect();
        self.library.read(wanted, |key| self.source(key), |_, &step| Ok(step))
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.files.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let cameras = self.schema.columns().iter().enumerate().filter(|(_, column)| column.is_image());
        let found = cameras.flat_map(|(index, column)| {
            self.episodes().iter().enumerate().filter_map(move |(position, episode)| {
                let key = (index, position);
                let what = self.library.irregularity(&key, || self.source(&key), &column.name, episode.length)?;
                Some(Irregularity { episode: Some(position), what })
            })
        });
        Ok(found.collect())
    }

    fn manifest(&self) -> Option<Manifest> {
        self.files.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.files.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        let rows = self.files.rows();
        content_hash(rows, &self.schema.columns()[2..], |column, add| {
            if !self.files.has(&column.name) {
                let index = self.schema.index(&column.name)?;
                for (position, episode) in rows.episodes().iter().enumerate() {
                    let key = (index, position);
                    self.library.get(&key, || self.source(&key))?.coded(0..episode.length, &mut *add)?;
                }
                return Ok(());
            }
            let (data, size) = (self.files.data(&column.name)?, column.row_bytes());
            for (position, episode) in rows.episodes().iter().enumerate() {
                let rows = rows.range(&StepRange::new(position, 0, episode.length))?;
                #[allow(clippy::cast_possible_truncation)] // as many rows as the data in memory have
                data[rows.start as usize * size..rows.end as usize * size].chunks_exact(size).for_each(&mut *add);
            }
            Ok(())
        })
    }
}

/// The columns of pictures of a folder that another program wrote: its subfolders, by name. The first video says how
/// large all pictures are.
fn foreign_pictures(files: &ColumnFiles) -> Result<Vec<ColumnSpec>> {
    let folder = files.folder();
    let Some(first) = files.rows().episodes().iter().position(|episode| episode.length > 0) else { return Ok(vec![]) };
    let io = |e| Error::io(folder, "listing the folder", e);
    let mut columns = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        if entry.path().is_dir() {
            let source = Source::File(file(folder, &name, first));
            let (height, width) = VideoCache::default().frame_size(&(), || Ok(source))?;
            columns.push(ColumnSpec::image(name, height, width));
        }
    }
    Ok(columns)
}
