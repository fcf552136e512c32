//! [`frequent_colours`]: the colours of a dataset's frames.

use crate::dataset::{Reader, StepRange};
use rand::Rng as _;
use swm_core::columns::PIXELS;
use swm_core::{Error, Key, Result};

/// The most frames that are read.
const FRAMES: usize = 256;
/// The frames that are read together.
const BLOCK: usize = 32;
/// The pixels that are drawn from each frame.
const PIXELS_OF_FRAME: usize = 256;
/// The iterations of k-means.
const ITERATIONS: usize = 30;

/// Returns `count` colours (red, green, blue, each 0 to 1) of the frames of a dataset, the most frequent first: the centres of k-means,
/// whose first centres are those of k-means++ (Arthur and Vassilvitskii 2007), so that rare colours are found that differ from the
/// frequent ones. Returns fewer if the frames have fewer colours. Reads at most 256 frames of the given episodes, or of all, and is
/// deterministic.
///
/// # Errors
/// When the dataset has no RGB frames in the column `pixels`, or no frame at all, or reading fails.
pub fn frequent_colours(reader: &dyn Reader, count: usize, episodes: Option<&[usize]>) -> Result<Vec<[f32; 3]>> {
    let column = reader.schema().column(PIXELS)?;
    let all: Vec<usize> = (0..reader.episodes().len()).collect();
    let episodes = episodes.unwrap_or(&all);
    let lengths: Vec<usize> = episodes.iter().map(|&episode| reader.episodes()[episode].length).collect();
    let rows: usize = lengths.iter().sum();
    if !column.is_image() || column.is_empty() || rows == 0 {
        let given = format!("{rows} frames of {:?} {}", column.shape, column.dtype.name());
        return Err(Error::mismatch("finding the colours of frames", given, "RGB frames, uint8 [height, width, 3]"));
    }
    let mut ranges = vec![];
    let (mut episode, mut before) = (0, 0);
    for frame in 0..rows.min(FRAMES) {
        let row = frame * rows / rows.min(FRAMES);
        while row - before >= lengths[episode] {
            before += lengths[episode];
            episode += 1;
        }
        ranges.push(StepRange::new(episodes[episode], row - before, 1));
    }
    let (mut pixels, key) = (vec![], Key::new(0).with("frequent colours"));
    for (block, ranges) in ranges.chunks(BLOCK).enumerate() {
        let frames = reader.read(&[PIXELS], ranges)?;
        for (index, values) in frames.get::<u8>(PIXELS)?.chunks_exact(column.len()).enumerate() {
            let mut rng = key.at((block * BLOCK + index) as u64).rng();
            pixels.extend((0..PIXELS_OF_FRAME).map(|_| {
                let at = 3 * rng.random_range(0..values.len() / 3);
                [0, 1, 2].map(|channel| f32::from(values[at + channel]) / 255.0)
            }));
        }
    }
    Ok(means(&pixels, count, key))
}

/// Returns the centres of k-means, those of the largest clusters first.
fn means(pixels: &[[f32; 3]], count: usize, key: Key) -> Vec<[f32; 3]> {
    let mut rng = key.rng();
    let mut centres: Vec<[f32; 3]> = vec![];
    while centres.len() < count {
        let weights: Vec<f32> = pixels.iter().map(|pixel| nearest(pixel, &centres).1).collect();
        let total: f32 = weights.iter().sum();
        let mut drawn = rng.random::<f32>() * total;
        // The last pixel with a weight stands in where rounding leaves a rest.
        let last = weights.iter().rposition(|weight| *weight > 0.0);
        let Some(last) = last else { break };
        let chosen = weights.iter().position(|weight| {
            drawn -= weight;
            drawn < 0.0
        });
        centres.push(pixels[chosen.unwrap_or(last)]);
    }
    let mut sizes = vec![0_usize; centres.len()];
    for _ in 0..ITERATIONS {
        let mut sums = vec![[0.0_f64; 3]; centres.len()];
        sizes.fill(0);
        for pixel in pixels {
            let (index, _) = nearest(pixel, &centres);
            sizes[index] += 1;
            sums[index].iter_mut().zip(pixel).for_each(|(sum, value)| *sum += f64::from(*value));
        }
        for ((centre, sum), size) in centres.iter_mut().zip(sums).zip(&sizes).filter(|(_, size)| **size > 0) {
            *centre = sum.map(|sum| (sum / *size as f64) as f32);
        }
    }
    let mut ordered: Vec<([f32; 3], usize)> = centres.into_iter().zip(sizes).filter(|(_, size)| *size > 0).collect();
    ordered.sort_by_key(|(_, size)| std::cmp::Reverse(*size));
    ordered.into_iter().map(|(centre, _)| centre).collect()
}

/// Returns the index of the nearest centre and the squared distance to it; a distance of 1 if there is none.
fn nearest(pixel: &[f32; 3], centres: &[[f32; 3]]) -> (usize, f32) {
    let distance = |centre: &[f32; 3]| pixel.iter().zip(centre).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    let distances = centres.iter().map(distance).enumerate();
    distances.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn k_means_finds_frequent_and_rare_colours() {
        let colours = [[1.0, 1.0, 1.0], [0.2, 0.4, 0.9], [0.5, 0.6, 0.7]];
        let pixels: Vec<[f32; 3]> = (0..5000)
            .map(|i: usize| {
                let colour = if i.is_multiple_of(500) { 1 } else { 2 * usize::from(i.is_multiple_of(7)) };
                colours[colour].map(|value| value - 0.01 * (i % 3) as f32)
            })
            .collect();
        let found = means(&pixels, 3, Key::new(0));
        for (found, expected) in found.iter().zip([colours[0], colours[2], colours[1]]) {
            let error = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(error < 0.02, "{found:?}, expected {expected:?}");
        }
        // No more colours than there are.
        assert_eq!(means(&[[0.0; 3], [1.0; 3], [0.0; 3]], 5, Key::new(0)), [[0.0; 3], [1.0; 3]]);
        assert!(means(&[], 5, Key::new(0)).is_empty());
    }
}
