//! Reads numeric columns from column files, and frames from videos.

use crate::dataset::Location;
use crate::dataset::episodes::content_hash;
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::column_files::{ColumnFiles, check_exists, check_unchanged, state_of, video_path};
use crate::formats::opened;
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};
use swm_video::{Source, VideoCache};

/// Opens a dataset of the format `video`.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    let reader = VideoReader::open(location.local("video")?)?;
    swm_video::load()?;
    Ok(Arc::new(reader))
}

pub(super) struct VideoReader {
    files: ColumnFiles,
    schema: Schema,
    /// Videos by column index and episode position.
    videos: VideoCache<(usize, usize)>,
}

impl VideoReader {
    pub fn open(folder: &Path) -> Result<Self> {
        check_exists(folder)?;
        let files = ColumnFiles::open(folder)?;
        let images = match files.recorded() {
            Some(recorded) => recorded.columns().iter().filter(|column| column.is_image()).cloned().collect(),
            None => infer_image_columns(&files)?,
        };
        let schema = files.schema(images)?;
        Ok(Self { files, schema, videos: VideoCache::default() })
    }

    fn source(&self, &(column, episode): &(usize, usize)) -> Result<Source> {
        Ok(Source::File(video_path(self.files.folder(), &self.schema.columns()[column].name, episode)))
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
        let slots = self.files.rows().row_slots(column, ranges, out)?;
        let requests = slots.into_iter().map(|((episode, step), slot)| ((index, episode), step, slot)).collect();
        let read = self.videos.read(requests, |key| self.source(key), |_, &step| Ok(step));
        self.files.check()?;
        let videos = ranges.iter().map(|range| Cow::Owned(video_path(self.files.folder(), name, range.episode)));
        read.map_err(|error| opened::or_missing(error, videos))
    }

    fn identity(&self, _: usize) -> Result<String> {
        self.files.identity()
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.files.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let cameras = self.schema.columns().iter().enumerate().filter(|(_, column)| column.is_image());
        let found = cameras.flat_map(|(index, column)| {
            self.episodes().iter().enumerate().filter_map(move |(position, episode)| {
                let key = (index, position);
                let what = self.videos.irregularity(&key, || self.source(&key), &column.name, episode.length)?;
                Some(Irregularity { episode: Some(position), what })
            })
        });
        Ok(self.files.excess_rows()?.into_iter().chain(found).collect())
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
        let rows = self.files.rows();
        let videos = |visit: &mut dyn FnMut(&Path)| {
            for column in self.schema.columns()[2..].iter().filter(|column| !self.files.has(&column.name)) {
                (0..rows.episodes().len())
                    .for_each(|position| visit(&video_path(self.files.folder(), &column.name, position)));
            }
        };
        let before = state_of(videos);
        let hash = content_hash(rows, &self.schema.columns()[2..], |column, add| {
            if !self.files.has(&column.name) {
                let index = self.schema.index(&column.name)?;
                for (position, episode) in rows.episodes().iter().enumerate() {
                    let key = (index, position);
                    self.videos.get(&key, || self.source(&key))?.coded(0..episode.length, &mut *add)?;
                }
                return Ok(());
            }
            let (data, size) = (self.files.data(&column.name)?, column.row_bytes());
            for (position, episode) in rows.episodes().iter().enumerate() {
                let rows = rows.range(&StepRange::new(position, 0, episode.length))?;
                data[rows.start as usize * size..rows.end as usize * size].chunks_exact(size).for_each(&mut *add);
            }
            Ok(())
        });
        self.files.check()?;
        check_unchanged(self.files.folder(), before, videos)?;
        hash
    }
}

/// The image columns of a third-party folder: one column per subfolder. The first video of a subfolder determines the
/// frame size.
fn infer_image_columns(files: &ColumnFiles) -> Result<Vec<ColumnSpec>> {
    let folder = files.folder();
    let Some(first) = files.rows().episodes().iter().position(|episode| episode.length > 0) else { return Ok(vec![]) };
    let io = |e| Error::io(folder, "listing the folder", e);
    let mut columns = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        if entry.path().is_dir() {
            let source = Source::File(video_path(folder, &name, first));
            let (height, width) = VideoCache::default().frame_size(&(), || Ok(source))?;
            columns.push(ColumnSpec::image(name, height, width));
        }
    }
    Ok(columns)
}
