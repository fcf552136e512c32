//! [`FixedFeatures`]: a dataset whose frames are replaced by the features of the part of an encoder that is not trained.

use crate::nn::keypoints::KeypointKernels;
use crate::pixels::{self, ImageNormalization};
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, columns::PIXELS};
use swm_data::{Constants, Episode, Irregularity, Reader, StepRange};

/// The stage in the events of a run.
const STAGE: &str = "encode";
/// The most bytes of features that are kept in memory; for a larger dataset, every batch is encoded anew.
const MOST_BYTES: u64 = 6 << 30;
/// The frames that are encoded together.
const BLOCK: usize = 1024;

/// The part of an encoder that is not trained, with the normalisation of its images.
pub struct FixedPart {
    /// Computes the features.
    pub kernels: KeypointKernels,
    /// The images.
    pub images: ImageNormalization,
}

/// A reader whose column of frames holds features, `[1, features]`, of the type float32.
pub(crate) struct FixedFeatures {
    inner: Arc<dyn Reader>,
    schema: Schema,
    /// The first row of each episode.
    first_rows: Vec<usize>,
    /// The features of a row.
    width: usize,
    features: Vec<f32>,
}

impl FixedFeatures {
    /// Encodes the frames of a dataset. Returns the reader unchanged if `part` is `None` or the features of the dataset are
    /// larger than 6 GiB.
    ///
    /// # Errors
    /// When reading fails, or `control` stops the run.
    pub fn of(reader: Arc<dyn Reader>, part: Option<FixedPart>, control: &mut Control<'_>) -> Result<Arc<dyn Reader>> {
        let Some(FixedPart { kernels, images }) = part else { return Ok(reader) };
        let (width, mut first_rows, mut rows) = (kernels.count(), vec![], 0);
        for episode in reader.episodes() {
            first_rows.push(rows);
            rows += episode.length;
        }
        if (rows * width * size_of::<f32>()) as u64 > MOST_BYTES {
            return Ok(reader);
        }
        control.emit(Event::Started(Stage { name: STAGE, subject: &[], total: rows, unit: "frames" }));
        let mut features = Vec::with_capacity(rows * width);
        for ranges in blocks(reader.episodes()) {
            control.check()?;
            let batch = reader.read(&[PIXELS], &ranges)?;
            let pixels = pixels::normalised(&images, 1, batch.get::<u8>(PIXELS)?)?;
            features.extend(kernels.features(&pixels));
            let done = features.len() / width;
            control.progress(Progress { stage: STAGE, done, total: rows, unit: "frames", metrics: &[] });
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[] });
        let column = |column: &ColumnSpec| match column.name.as_str() {
            PIXELS => ColumnSpec::new(PIXELS, DType::Float32, [1, width]),
            _ => column.clone(),
        };
        let schema = Schema::new(reader.schema().columns().iter().map(column).collect::<Vec<_>>())?;
        Ok(Arc::new(Self { inner: reader, schema, first_rows, width, features }))
    }
}

/// Returns the rows of all episodes, in blocks of at most [`BLOCK`] rows.
fn blocks(episodes: &[Episode]) -> Vec<Vec<StepRange>> {
    let (mut blocks, mut block, mut rows) = (vec![], vec![], 0);
    for (index, episode) in episodes.iter().enumerate() {
        let mut start = 0;
        while start < episode.length {
            let length = (episode.length - start).min(BLOCK - rows);
            block.push(StepRange::new(index, start, length));
            start += length;
            rows += length;
            if rows == BLOCK {
                blocks.push(std::mem::take(&mut block));
                rows = 0;
            }
        }
    }
    blocks.extend((!block.is_empty()).then_some(block));
    blocks
}

impl Reader for FixedFeatures {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.inner.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        if column != PIXELS {
            return self.inner.read_column(column, ranges, out);
        }
        let bytes: &[u8] = bytemuck::cast_slice(&self.features);
        let row = self.width * size_of::<f32>();
        let exists = |range: &StepRange| {
            let end = range.start.checked_add(range.length);
            let episode = self.episodes().get(range.episode);
            end.zip(episode).is_some_and(|(end, episode)| end <= episode.length)
        };
        if !ranges.iter().all(exists) || out.len() != ranges.iter().map(|range| range.length).sum::<usize>() * row {
            let given = format!("{ranges:?} for {} bytes", out.len());
            return Err(Error::mismatch(
                "reading the features of frames",
                given,
                "rows of the dataset, and their bytes",
            ));
        }
        let mut out = out;
        for range in ranges {
            let first = (self.first_rows[range.episode] + range.start) * row;
            let (slot, rest) = out.split_at_mut(range.length * row);
            slot.copy_from_slice(&bytes[first..first + range.length * row]);
            out = rest;
        }
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.inner.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        self.inner.irregularities()
    }

    fn sources(&self) -> Vec<PathBuf> {
        self.inner.sources()
    }

    fn unread(&self) -> Vec<String> {
        self.inner.unread()
    }

    fn manifest(&self) -> Option<Manifest> {
        self.inner.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.inner.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        self.inner.content_hash()
    }
}
