//! Drawing pictures again from latents: what an encoder kept of what it saw, for people to look at.

use super::fit::{FitConfig, fit, rows};
use super::scale::Scale;
use super::{ImageEncoder, samples};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Activation, Init, Linear};
use crate::train::{StepOutput, at_least, shards};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};
use swm_data::{Part, Reader, RgbImage, contact_sheet};

/// How a decoder is fitted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReconstructionConfig {
    /// Decides which frames are drawn, initial weights and batches.
    pub seed: u64,
    /// Frames to fit on, at most; from episodes that models are trained on.
    pub frames: usize,
    /// Frames to judge on, at most; from episodes held out for validation.
    pub held_out: usize,
    /// Hidden features in front of the first feature map.
    pub hidden: usize,
    /// Channels of the feature maps, coarsest first; every one has twice the side of that before it.
    pub channels: Vec<usize>,
    /// Parts a batch is cut into, which can run in parallel.
    pub shards: usize,
    /// Pictures on the contact sheet.
    pub shown: usize,
    /// How the decoder is fitted.
    pub fit: FitConfig,
}

impl Default for ReconstructionConfig {
    fn default() -> Self {
        let fit = FitConfig { steps: 1500, batch_size: 64, lr: 2e-3 };
        let channels = vec![64, 32, 16];
        Self { seed: 0, frames: 4000, held_out: 500, hidden: 256, channels, shards: 2, shown: 8, fit }
    }
}

/// What a decoder can draw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReconstructionReport {
    /// Numbers in a latent.
    pub latent: usize,
    /// Frames fitted on.
    pub frames: usize,
    /// Frames judged on.
    pub held_out: usize,
    /// The root of the mean squared error of a pixel on held-out episodes, of 255.
    pub rmse: f64,
    /// The same for the mean of all pictures, which needs no latent.
    pub rmse_of_mean: f64,
    /// The share of the pixels' variance that the latents explain.
    pub explained: f64,
}

/// ImageNormalization of the blocks that the finest feature map draws.
const BLOCK: usize = 4;

/// From latents to pictures: a feature map drawn by a small network, then transposed convolutions whose strides are their
/// kernels, each one matrix product; the last draws blocks of pixels. It draws what differs from the mean of all pictures.
#[derive(Module, Debug)]
struct Decoder {
    hidden: Linear,
    map: Linear,
    finer: Vec<Linear>,
    blocks: Linear,
    /// The side of the first feature map.
    side: usize,
}

impl Decoder {
    fn new(init: &Init, latent: usize, image: usize, config: &ReconstructionConfig) -> Result<Self> {
        let coarsest = BLOCK << (config.channels.len() - 1);
        if !image.is_multiple_of(coarsest) || image == 0 {
            return Err(Error::config(
                "channels",
                format!(
                    "{} feature maps draw pictures whose side is a multiple of {coarsest}, not {image}",
                    config.channels.len()
                ),
                "give fewer channels",
            ));
        }
        let side = image / coarsest;
        let [first, .., last] = config.channels[..] else { unreachable!("checked to be at least two") };
        let finer = config.channels.windows(2).enumerate();
        Ok(Self {
            hidden: Linear::new(&init.of("hidden"), latent, config.hidden),
            map: Linear::new(&init.of("map"), config.hidden, side * side * first),
            finer: finer.map(|(i, pair)| Linear::new(&init.of("finer").at(i), pair[0], 4 * pair[1])).collect(),
            blocks: Linear::new(&init.of("blocks"), last, BLOCK * BLOCK * 3),
            side,
        })
    }

    /// # Shapes
    /// `[frames, latent]` to `[frames, image * image * 3]`, rows of pixels, colours last.
    fn forward(&self, latents: Tensor<2>) -> Tensor<2> {
        let [frames, _] = latents.dims();
        let relu = |x: Tensor<2>| Activation::Relu.forward(x);
        let mut x = relu(self.map.forward(relu(self.hidden.forward(latents))));
        let mut side = self.side;
        let mut spread = |layer: &Linear, x: Tensor<2>, factor: usize| {
            let [_, numbers] = x.dims();
            let drawn = layer.forward(x.reshape([frames * side * side, numbers / (side * side)]));
            let [_, all] = drawn.dims();
            let channels = all / (factor * factor);
            // A cell's features become a square of cells.
            let squares = drawn.reshape([frames * side, side, factor, factor * channels]).swap_dims(1, 2);
            side *= factor;
            squares.reshape([frames, side * side * channels])
        };
        for layer in &self.finer {
            x = relu(spread(layer, x, 2));
        }
        spread(&self.blocks, x, BLOCK)
    }
}

/// Fits a decoder from an encoder's latents to the pictures they came from. The contact sheet shows held-out pictures in
/// pairs of rows: as they are, and as they are drawn again.
///
/// # Errors
/// When the pictures are of another size than the encoder sees, or of one that blocks do not fill, no episode is held out, or
/// a setting makes no sense.
pub fn reconstruct_images(
    encoder: &dyn ImageEncoder,
    reader: &dyn Reader,
    config: &ReconstructionConfig,
) -> Result<(ReconstructionReport, RgbImage)> {
    at_least(&[
        ("frames", config.frames, 2),
        ("held_out", config.held_out, 2),
        ("hidden", config.hidden, 1),
        ("channels", config.channels.len(), 2),
        ("channels", config.channels.iter().copied().min().unwrap_or(0), 1),
        ("shards", config.shards, 1),
        ("shown", config.shown, 1),
        ("fit.steps", config.fit.steps, 1),
        ("fit.batch_size", config.fit.batch_size, 1),
    ])?;
    let key = Key::new(config.seed).with("probe");
    let draw = |part, count| samples::draw(encoder, reader, part, &[], true, (count, key.with("frames")));
    let train = draw(Part::Train, config.frames)?;
    let held_out = draw(Part::Validation, config.held_out)?;
    let (latent, image) = (encoder.latent_dim(), encoder.image_size());
    let bytes = image * image * 3;
    let mean = mean_picture(&train.pictures, bytes);
    let scale = Scale::of(&train.latents, train.count);
    let latents = scale.apply(&train.latents);

    let decoder = Decoder::new(&Init::new(key.with("init"), &Device::flex()), latent, image, config)?;
    let step = |model: &Decoder, places: &[usize]| {
        shards::mean(places.len(), config.shards, |range| {
            let (places, trained) = (&places[range], model.clone().train());
            let wanted: Vec<f32> = places
                .iter()
                .flat_map(|&place| train.pictures[place * bytes..(place + 1) * bytes].iter().zip(&mean))
                .map(|(&byte, mean)| f32::from(byte) / 255.0 - mean)
                .collect();
            let wanted = Tensor::<2>::from_data(TensorData::new(wanted, [places.len(), bytes]), &Device::flex());
            let drawn = trained.forward(rows(&latents, latent, places).autodiff());
            let loss = (drawn - wanted.autodiff()).square().mean();
            let metrics = vec![("loss", f64::from(loss.clone().inner().into_scalar::<f32>()))];
            let gradients = parameters::gradients(&trained, &loss.backward());
            Ok(StepOutput { metrics, gradients, ..StepOutput::default() })
        })
    };
    let (decoder, _) = fit(decoder, config.fit, train.count, key.with("batches"), step)?;

    let drawn = redraw(&decoder, &scale.apply(&held_out.latents), latent, &mean);
    let rmse = root_mean_square(drawn.iter().copied(), &held_out.pictures);
    let rmse_of_mean = root_mean_square(mean.iter().copied().cycle(), &held_out.pictures);
    let report = ReconstructionReport {
        latent,
        frames: train.count,
        held_out: held_out.count,
        rmse,
        rmse_of_mean,
        explained: if rmse_of_mean > 0.0 { 1.0 - (rmse / rmse_of_mean).powi(2) } else { 0.0 },
    };
    Ok((report, sheet(&held_out.pictures, &drawn, image, config.shown)?))
}

/// The mean of pictures, of 0 ..= 1.
#[allow(clippy::cast_precision_loss)]
fn mean_picture(pictures: &[u8], bytes: usize) -> Vec<f32> {
    let mut sums = vec![0u32; bytes];
    for picture in pictures.chunks_exact(bytes) {
        sums.iter_mut().zip(picture).for_each(|(sum, &byte)| *sum += u32::from(byte));
    }
    let count = (pictures.len() / bytes) as f32 * 255.0;
    sums.into_iter().map(|sum| sum as f32 / count).collect()
}

/// Pictures from latents, of 0 ..= 1.
fn redraw(decoder: &Decoder, latents: &[f32], latent: usize, mean: &[f32]) -> Vec<f32> {
    let parts: Vec<Vec<f32>> = latents
        .par_chunks(64 * latent)
        .map(|latents| {
            let x = TensorData::new(latents.to_vec(), [latents.len() / latent, latent]);
            let mut drawn = decoder.forward(Tensor::from_data(x, &Device::flex())).into_data().into_f32_vec();
            drawn
                .iter_mut()
                .zip(mean.iter().cycle())
                .for_each(|(value, mean)| *value = (*value + mean).clamp(0.0, 1.0));
            drawn
        })
        .collect();
    parts.concat()
}

/// Of 255.
#[allow(clippy::cast_precision_loss)]
fn root_mean_square(drawn: impl Iterator<Item = f32>, pictures: &[u8]) -> f64 {
    let square: f64 = drawn.zip(pictures).map(|(a, &b)| (f64::from(a) * 255.0 - f64::from(b)).powi(2)).sum();
    (square / pictures.len() as f64).sqrt()
}

/// Rows of pictures, each above a row of how they were drawn again.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn sheet(pictures: &[u8], drawn: &[f32], image: usize, shown: usize) -> Result<RgbImage> {
    const COLUMNS: usize = 8;
    let bytes = image * image * 3;
    let count = pictures.len() / bytes;
    // Spread over the episodes.
    let places: Vec<usize> = (0..shown.min(count)).map(|i| i * count / shown.min(count)).collect();
    let mut frames: Vec<Vec<u8>> = vec![];
    for places in places.chunks(COLUMNS) {
        frames.extend(places.iter().map(|place| pictures[place * bytes..(place + 1) * bytes].to_vec()));
        frames.extend(places.iter().map(|place| {
            drawn[place * bytes..(place + 1) * bytes].iter().map(|v| (v * 255.0).round() as u8).collect()
        }));
        // A last row that is not full stays above its own drawings.
        if places.len() < COLUMNS && shown > COLUMNS {
            let blank = vec![u8::MAX; bytes];
            let at = frames.len() - places.len();
            frames.splice(at..at, std::iter::repeat_n(blank, COLUMNS - places.len()));
        }
    }
    contact_sheet(image, image, &frames, COLUMNS.min(places.len()), (128 / image).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_drawn_where_they_are() {
        // One channel, weights that copy: every cell of a 2 x 2 map becomes a 4 x 4 square of its value after two doublings.
        let config = ReconstructionConfig { hidden: 4, channels: vec![1, 1], ..ReconstructionConfig::default() };
        let init = Init::new(Key::new(0), &Device::flex());
        let mut decoder = Decoder::new(&init, 4, 16, &config).expect("a decoder");
        let eye: Vec<f32> = (0..16).map(|i| if i % 5 == 0 { 1.0 } else { 0.0 }).collect();
        let layer = |weight: Vec<f32>, [outputs, inputs]: [usize; 2]| {
            let mut layer = Linear::zeros(&init, inputs, outputs);
            let weight = Tensor::<2>::from_data(TensorData::new(weight, [outputs, inputs]), &Device::flex());
            layer.weight = burn::module::Param::from_tensor(weight);
            layer
        };
        decoder.hidden = layer(eye.clone(), [4, 4]);
        decoder.map = layer(eye, [4, 4]);
        decoder.finer = vec![layer(vec![1.0; 4], [4, 1])];
        decoder.blocks = layer(vec![1.0; BLOCK * BLOCK * 3], [BLOCK * BLOCK * 3, 1]);
        let latent = Tensor::<2>::from_floats([[1.0, 2.0, 3.0, 4.0]], &Device::flex());
        let drawn: Vec<f32> = decoder.forward(latent).into_data().into_f32_vec();
        assert_eq!(drawn.len(), 16 * 16 * 3);
        for (i, value) in drawn.iter().enumerate() {
            let (y, x) = (i / 48, i / 3 % 16);
            let quadrant = y / 8 * 2 + x / 8;
            assert!((value - (quadrant as f32 + 1.0)).abs() < 1e-6, "{y} {x}: {value}");
        }
    }

    #[test]
    fn odd_sizes_are_refused() {
        let init = Init::new(Key::new(0), &Device::flex());
        let wrong = Decoder::new(&init, 3, 65, &ReconstructionConfig::default()).expect_err("65 pixels").to_string();
        assert!(wrong.contains("multiple of 16"), "{wrong}");
    }
}
