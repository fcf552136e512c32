//! Frames sampled from a dataset, with the latents of the frames and the columns to predict.

use super::ImageEncoder;
use crate::pixels;
use rand::Rng as _;
use rayon::prelude::*;
use swm_core::columns::PIXELS;
use swm_core::precision::Spread;
use swm_core::{Batch, Error, Key, Result, limits};
use swm_data::{Part, Reader, Split, StepRange};

/// Frames sampled from a dataset.
pub(super) struct Samples {
    /// The number of frames.
    pub count: usize,
    /// The latents of the frames, `[count, latent_dim]`.
    pub latents: Vec<f32>,
    /// The images, `[count, image_size, image_size, 3]`, or empty if images are not kept.
    pub images: Vec<u8>,
    /// The elements of all columns to predict, concatenated: `[count, targets]`.
    pub targets: Vec<f32>,
}

/// The spreads of the elements of the columns that a probe reads.
pub(super) struct Spreads<'a>(Vec<(&'a str, Vec<Spread>)>);

impl<'a> Spreads<'a> {
    /// Spreads of columns of which no value is known.
    pub fn new(columns: &'a [String]) -> Self {
        Self(columns.iter().map(|column| (column.as_str(), vec![])).collect())
    }

    /// Adds the values of a batch.
    ///
    /// # Errors
    /// When the batch lacks a column.
    pub fn add(&mut self, batch: &Batch) -> Result<()> {
        for (column, spreads) in &mut self.0 {
            if !Spread::is_needed(batch.schema().column(column)?.dtype) {
                continue;
            }
            for row in 0..batch.rows() {
                let values = batch.row(row).to_f64(column)?;
                spreads.resize(values.len(), Spread::default());
                spreads.iter_mut().zip(values).for_each(|(spread, value)| spread.add(value));
            }
        }
        Ok(())
    }

    /// Checks that single precision, in which probes compute, tells the values of every element apart.
    ///
    /// # Errors
    /// As [`Spread::check`].
    pub fn check(&self) -> Result<()> {
        let elements = self.0.iter().flat_map(|(column, spreads)| {
            spreads.iter().enumerate().map(move |(index, spread)| spread.check(column, index))
        });
        elements.collect()
    }
}

/// The number of frames that are read and encoded together: a constant, so that latents do not depend on the number of
/// threads.
const BLOCK_FRAMES: usize = 64;

/// The largest number of latent elements held in memory: 1 GB in double precision.
const MAX_ELEMENTS: usize = 1 << 27;

/// Samples up to `count` frames of the split `part` of a dataset (fewer if latents or kept images are very large) without replacement,
/// in stored order. Frames whose columns are not finite are skipped.
///
/// # Errors
/// When a column is missing, single precision does not tell its values apart, images have another size than the encoder's, or
/// fewer than two frames are left.
pub(super) fn sample(
    encoder: &dyn ImageEncoder,
    reader: &dyn Reader,
    part: Part,
    columns: &[String],
    keep_images: bool,
    (count, key): (usize, Key),
) -> Result<Samples> {
    pixels::check(encoder.image_size(), reader.schema(), PIXELS)?;
    let rows: Vec<StepRange> = Split::default()
        .episodes(reader, part)?
        .into_iter()
        .flat_map(|episode| (0..reader.episodes()[episode].length).map(move |row| StepRange::new(episode, row, 1)))
        .collect();
    let mut most = MAX_ELEMENTS / encoder.latent_dim().max(1);
    if keep_images {
        most =
            most.min(limits::BATCH_BYTES.max / limits::product([encoder.image_size(), encoder.image_size(), 3]).max(1));
    }
    let rows = choose(rows, count.min(most), key.with(&part.to_string()));
    let mut names = vec![PIXELS];
    for name in columns {
        // A column may be predicted and in the baseline.
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let mut samples = Samples { count: 0, latents: vec![], images: vec![], targets: vec![] };
    let mut spreads = Spreads::new(columns);
    // Several blocks are read and encoded in parallel.
    for blocks in rows.chunks(BLOCK_FRAMES * 16) {
        let encoded: Result<Vec<(Vec<f32>, Batch)>> = blocks
            .par_chunks(BLOCK_FRAMES)
            .map(|rows| {
                let batch = reader.read(&names, rows)?;
                Ok((encoder.encode(batch.get::<u8>(PIXELS)?)?, batch))
            })
            .collect();
        for (latents, batch) in encoded? {
            spreads.add(&batch)?;
            samples.add(encoder, columns, keep_images, &latents, &batch)?;
        }
    }
    // The standard deviation of a small part may be small.
    if part == Part::Train {
        spreads.check()?;
    }
    if samples.count < 2 {
        return Err(Error::config(
            format!("the {part} split"),
            format!("{} frames with finite values in {}", samples.count, columns.join(", ")),
            "choose columns with finite values, or a larger dataset",
        ));
    }
    Ok(samples)
}

impl Samples {
    fn add(
        &mut self,
        encoder: &dyn ImageEncoder,
        columns: &[String],
        keep_images: bool,
        latents: &[f32],
        batch: &Batch,
    ) -> Result<()> {
        let columns: Result<Vec<Vec<f32>>> = columns.iter().map(|name| batch.to_f32(name)).collect();
        let (columns, rows) = (columns?, batch.rows());
        let images = batch.get::<u8>(PIXELS)?;
        for row in 0..rows {
            let targets = columns.iter().flat_map(|column| {
                let width = column.len() / rows;
                &column[row * width..(row + 1) * width]
            });
            if !targets.clone().all(|value| value.is_finite()) {
                continue;
            }
            self.targets.extend(targets);
            self.latents.extend_from_slice(&latents[row * encoder.latent_dim()..][..encoder.latent_dim()]);
            if keep_images {
                let bytes = images.len() / rows;
                self.images.extend_from_slice(&images[row * bytes..][..bytes]);
            }
            self.count += 1;
        }
        Ok(())
    }
}

/// Samples `count` of the rows without replacement, in order (Floyd's algorithm).
fn choose(rows: Vec<StepRange>, count: usize, key: Key) -> Vec<StepRange> {
    if count >= rows.len() {
        return rows;
    }
    let mut rng = key.rng();
    let mut chosen = std::collections::BTreeSet::new();
    for last in rows.len() - count..rows.len() {
        let index = usize::try_from(rng.random_range(0..=last as u64)).unwrap_or(last);
        if !chosen.insert(index) {
            chosen.insert(last);
        }
    }
    chosen.into_iter().map(|index| rows[index]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{ColumnSpec, DType, Schema};

    #[test]
    fn columns_that_single_precision_does_not_tell_apart_are_refused() {
        let doubles = |name: &str| ColumnSpec::new(name, DType::Float64, [2]);
        let schema = Schema::new([doubles("near"), doubles("far")]).expect("a schema");
        let mut batch = Batch::zeros(&schema, 8);
        for (name, offset) in [("near", 0.0), ("far", 1e9)] {
            let values = batch.get_mut::<f64>(name).expect("a column of doubles");
            values.iter_mut().enumerate().for_each(|(i, value)| *value = i as f64 + offset * (i % 2) as f64);
        }
        let check = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
            let mut spreads = Spreads::new(&names);
            spreads.add(&batch)?;
            spreads.check()
        };
        check(&["near"]).expect("moderate values");
        let error = check(&["near", "far"]).expect_err("an offset of 1e9").to_string();
        assert!(error.contains("column 'far', element 1"), "{error}");
    }
}
