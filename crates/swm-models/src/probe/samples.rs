//! Frames drawn from a dataset, their latents, and columns beside them.

use super::ImageEncoder;
use crate::pixels;
use rand::Rng as _;
use rayon::prelude::*;
use swm_core::{Batch, Error, Key, Result};
use swm_data::{Part, Reader, Split, StepRange};

/// Frames and what belongs to them.
pub(super) struct Samples {
    /// Frames.
    pub count: usize,
    /// `[count, latent]`.
    pub latents: Vec<f32>,
    /// `[count, image, image, 3]`, where they were asked for.
    pub pictures: Vec<u8>,
    /// `[count, numbers]`: the numbers of all columns, beside each other.
    pub targets: Vec<f32>,
}

/// Frames read and encoded at once: a fixed number, so that latents do not depend on the number of threads.
const FRAMES: usize = 64;

/// Numbers of latents kept at once, at most: 1 GB of them in double precision.
const NUMBERS: usize = 1 << 27;

/// Draws up to `count` frames of a part of a dataset (fewer where latents are very large), without repetition, in stored
/// order. Frames at which a column holds something that is not finite are left out.
pub(super) fn draw(
    encoder: &dyn ImageEncoder,
    reader: &dyn Reader,
    part: Part,
    columns: &[String],
    keep_pictures: bool,
    (count, key): (usize, Key),
) -> Result<Samples> {
    pixels::check(encoder.image_size(), reader.schema(), "pixels")?;
    let rows: Vec<StepRange> = Split::default()
        .episodes(reader, part)?
        .into_iter()
        .flat_map(|episode| (0..reader.episodes()[episode].length).map(move |row| StepRange::new(episode, row, 1)))
        .collect();
    let rows = choose(rows, count.min(NUMBERS / encoder.latent_dim()), key.with(&part.to_string()));
    let names: Vec<&str> = std::iter::once("pixels").chain(columns.iter().map(String::as_str)).collect();
    let mut samples = Samples { count: 0, latents: vec![], pictures: vec![], targets: vec![] };
    // A few blocks at a time, each encoded by itself.
    for blocks in rows.chunks(FRAMES * 16) {
        let parts: Result<Vec<(Vec<f32>, Batch)>> = blocks
            .par_chunks(FRAMES)
            .map(|rows| {
                let batch = reader.read(&names, rows)?;
                Ok((encoder.encode(batch.get::<u8>("pixels")?)?, batch))
            })
            .collect();
        for (latents, batch) in parts? {
            samples.add(encoder, columns, keep_pictures, &latents, &batch)?;
        }
    }
    if samples.count < 2 {
        return Err(Error::config(
            format!("the {part} split"),
            format!("{} frames with finite numbers in {}", samples.count, columns.join(", ")),
            "choose columns that hold finite numbers, or a larger dataset",
        ));
    }
    Ok(samples)
}

impl Samples {
    fn add(
        &mut self,
        encoder: &dyn ImageEncoder,
        columns: &[String],
        keep_pictures: bool,
        latents: &[f32],
        batch: &Batch,
    ) -> Result<()> {
        let columns: Result<Vec<Vec<f32>>> = columns.iter().map(|name| batch.to_f32(name)).collect();
        let (columns, rows) = (columns?, batch.rows());
        let pictures = batch.get::<u8>("pixels")?;
        for row in 0..rows {
            let numbers = columns.iter().flat_map(|column| {
                let width = column.len() / rows;
                &column[row * width..(row + 1) * width]
            });
            if !numbers.clone().all(|number| number.is_finite()) {
                continue;
            }
            self.targets.extend(numbers);
            self.latents.extend_from_slice(&latents[row * encoder.latent_dim()..][..encoder.latent_dim()]);
            if keep_pictures {
                let bytes = pictures.len() / rows;
                self.pictures.extend_from_slice(&pictures[row * bytes..][..bytes]);
            }
            self.count += 1;
        }
        Ok(())
    }
}

/// `count` of the rows, in order: Floyd's choice without repetition.
fn choose(rows: Vec<StepRange>, count: usize, key: Key) -> Vec<StepRange> {
    if count >= rows.len() {
        return rows;
    }
    let mut rng = key.rng();
    let mut chosen = std::collections::BTreeSet::new();
    for last in rows.len() - count..rows.len() {
        let place = usize::try_from(rng.random_range(0..=last as u64)).unwrap_or(last);
        if !chosen.insert(place) {
            chosen.insert(last);
        }
    }
    chosen.into_iter().map(|place| rows[place]).collect()
}
