//! [`FixedFeatures`]: a dataset whose frames are replaced by the features of the part of an encoder that is not trained.

use crate::nn::keypoints::KeypointKernels;
use crate::pixels::{self, ImageNormalization};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, columns::PIXELS};
use swm_data::{CacheConfig, Constants, Episode, Irregularity, Reader, StepRange};

/// The stage in the events of a run.
const STAGE: &str = "encode";
/// The most bytes of features that are kept in memory; for a larger dataset, every batch is encoded anew.
const MOST_BYTES: u64 = 6 << 30;
/// The frames that are encoded together.
const BLOCK: usize = 256;

/// The part of an encoder that is not trained, with the normalisation of its images.
pub struct FixedPart {
    /// Computes the features.
    pub kernels: KeypointKernels,
    /// The images.
    pub images: ImageNormalization,
}

/// A reader whose column of frames holds features, `[1, features]`, of the type float32. Each read encodes the frames.
pub(crate) struct FixedFeatures {
    inner: Arc<dyn Reader>,
    schema: Schema,
    part: FixedPart,
}

impl FixedFeatures {
    /// Encodes the frames of a dataset, into files in `folder`, where later runs find them, or in memory. Returns the reader
    /// unchanged if `part` is `None`, or the features are larger than 6 GiB and there is no folder.
    ///
    /// # Errors
    /// When reading fails, the folder cannot be written, or `control` stops the run.
    pub fn of(
        reader: Arc<dyn Reader>,
        part: Option<FixedPart>,
        folder: Option<&Path>,
        control: &mut Control<'_>,
    ) -> Result<Arc<dyn Reader>> {
        let Some(part) = part else { return Ok(reader) };
        let width = part.kernels.count();
        let rows: usize = reader.episodes().iter().map(|episode| episode.length).sum();
        let bytes = rows * width * size_of::<f32>();
        let cache = match folder {
            // The files are as large as the features, whatever the limit; damaged rows are computed and stored again.
            Some(folder) => CacheConfig::Disk { folder: folder.to_owned(), bytes: usize::MAX },
            None if bytes as u64 <= MOST_BYTES => CacheConfig::Memory { bytes },
            None => return Ok(reader),
        };
        let column = |column: &ColumnSpec| match column.name.as_str() {
            PIXELS => ColumnSpec::new(PIXELS, DType::Float32, [1, width]),
            _ => column.clone(),
        };
        let schema = Schema::new(reader.schema().columns().iter().map(column).collect::<Vec<_>>())?;
        let features = cache.by_row(Arc::new(Self { inner: reader, schema, part }), &[PIXELS])?;
        control.emit(Event::Started(Stage { name: STAGE, subject: &[], total: rows, unit: "frames" }));
        let (mut block, mut done) = (vec![], 0);
        for ranges in blocks(features.episodes()) {
            control.check()?;
            let count: usize = ranges.iter().map(|range| range.length).sum();
            block.resize(count * width * size_of::<f32>(), 0);
            features.read_column(PIXELS, &ranges, &mut block)?;
            done += count;
            control.progress(Progress { stage: STAGE, done, total: rows, unit: "frames", metrics: &[] });
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[] });
        Ok(features)
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
        let FixedPart { kernels, images } = &self.part;
        let frames = self.inner.read(&[PIXELS], ranges)?;
        let features = kernels.features(&pixels::normalised(images, 1, frames.get::<u8>(PIXELS)?)?);
        let bytes: &[u8] = bytemuck::cast_slice(&features);
        if out.len() != bytes.len() {
            let (given, expected) = (format!("{} bytes", out.len()), format!("{} bytes", bytes.len()));
            return Err(Error::mismatch("reading the features of frames", given, expected));
        }
        out.copy_from_slice(bytes);
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.inner.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        self.inner.irregularities()
    }

    fn check_files(&self) -> Result<()> {
        self.inner.check_files()
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

    /// The hash of the frames and of what encodes them.
    fn content_hash(&self) -> Result<String> {
        Ok(self.hash_with(self.inner.content_hash()?))
    }

    fn cache_key(&self) -> Result<String> {
        Ok(self.hash_with(self.inner.cache_key()?))
    }
}

impl FixedFeatures {
    /// A hash of a hash of the frames and of what encodes them.
    fn hash_with(&self, frames: String) -> String {
        let FixedPart { kernels, images } = &self.part;
        let ImageNormalization { side, mean, std } = images;
        let content = (frames, kernels.hash(), side, mean, std);
        swm_core::manifest::hash(&serde_json::to_vec(&content).expect("numbers and text serialize"))
    }
}
