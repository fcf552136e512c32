//! Reconstruction of images from latents, which shows the information that an encoder preserves.

use super::ImageEncoder;
use super::fit::{FitConfig, fit, rows};
use super::samples::{self, Samples};
use super::scale::Scale;
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Activation, Init, Linear};
use crate::train::{StepOutput, check_sizes, limits, shards};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::run::Control;
use swm_core::{Error, Key, Result};
use swm_data::{Part, Reader, RgbImage, contact_sheet};

/// The settings of a decoder and of the decoder's training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReconstructionConfig {
    /// The seed of sampled frames, initial weights and batches.
    pub seed: u64,
    /// The largest number of frames to fit on, from the training episodes.
    pub frames: usize,
    /// The largest number of frames to score on, from the validation episodes.
    pub held_out: usize,
    /// The number of hidden features before the first feature map.
    pub hidden: usize,
    /// Channels of the feature maps, coarsest first; each map has twice the side of the map before.
    pub channels: Vec<usize>,
    /// Shards of a batch, which can run in parallel.
    pub shards: usize,
    /// Images on the contact sheet.
    pub shown: usize,
    /// The training of the decoder.
    pub fit: FitConfig,
}

impl Default for ReconstructionConfig {
    fn default() -> Self {
        let fit = FitConfig { steps: 1500, batch_size: 64, lr: 2e-3 };
        let channels = vec![64, 32, 16];
        Self { seed: 0, frames: 4000, held_out: 500, hidden: 256, channels, shards: 2, shown: 8, fit }
    }
}

impl ReconstructionConfig {
    /// Checks the ranges of all settings.
    fn check(&self) -> Result<()> {
        check_sizes(&[
            ("frames", self.frames, 2, limits::BATCH),
            ("held_out", self.held_out, 2, limits::BATCH),
            ("hidden", self.hidden, 1, limits::FEATURES),
            ("channels", self.channels.len(), 2, limits::FEATURES),
            ("channels", self.channels.iter().copied().min().unwrap_or(0), 1, limits::FEATURES),
            ("shards", self.shards, 1, limits::LAYERS),
            ("shown", self.shown, 1, limits::BATCH),
            ("fit.steps", self.fit.steps, 1, limits::STEPS),
            ("fit.batch_size", self.fit.batch_size, 1, limits::BATCH),
        ])
    }
}

/// The errors of a decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReconstructionReport {
    /// The dimension of a latent.
    pub latent: usize,
    /// Frames that were fitted on.
    pub frames: usize,
    /// Frames that were scored on.
    pub held_out: usize,
    /// The root mean squared error of pixel values from 0 to 255 on held-out episodes.
    pub rmse: f64,
    /// The root mean squared error of the mean training image, a baseline without latents.
    pub rmse_of_mean: f64,
    /// The fraction of the pixels' variance that the reconstruction explains.
    pub explained: f64,
}

/// The side of the blocks of pixels that the last layer returns, in pixels.
const BLOCK: usize = 4;

/// A decoder from latents to the difference between an image and the mean image. A small network computes a feature
/// map, which transposed convolutions enlarge; the last layer returns blocks of pixels. The stride of each convolution
/// equals the kernel size, so each convolution is one matrix product.
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
                    "{} feature maps need images whose side is a multiple of {coarsest}, not {image}",
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

    /// Decodes latents.
    ///
    /// # Shapes
    /// Maps `[frames, latent]` to `[frames, image * image * 3]`, the elements of `[image, image, 3]`.
    fn forward(&self, latents: Tensor<2>) -> Tensor<2> {
        let [frames, _] = latents.dims();
        let relu = |x: Tensor<2>| Activation::Relu.forward(x);
        let mut x = relu(self.map.forward(relu(self.hidden.forward(latents))));
        let mut side = self.side;
        let mut enlarge = |layer: &Linear, x: Tensor<2>, factor: usize| {
            let [_, width] = x.dims();
            let cells = layer.forward(x.reshape([frames * side * side, width / (side * side)]));
            let [_, outputs] = cells.dims();
            let channels = outputs / (factor * factor);
            // The features of a cell become a square of cells.
            let squares = cells.reshape([frames * side, side, factor, factor * channels]).swap_dims(1, 2);
            side *= factor;
            squares.reshape([frames, side * side * channels])
        };
        for layer in &self.finer {
            x = relu(enlarge(layer, x, 2));
        }
        enlarge(&self.blocks, x, BLOCK)
    }
}

/// A decoder that was fitted to an encoder's latents.
pub struct ImageDecoder {
    decoder: Decoder,
    scale: Scale,
    mean: Vec<f32>,
    latent: usize,
}

impl ImageDecoder {
    /// Decodes latents to images with values from 0 to 1.
    ///
    /// # Shapes
    /// Maps `[count, latent]` to `[count, image, image, 3]`.
    pub fn decode(&self, latents: &[f32]) -> Vec<f32> {
        let images: Vec<Vec<f32>> = self
            .scale
            .apply(latents)
            .par_chunks(64 * self.latent)
            .map(|latents| {
                let x = TensorData::new(latents.to_vec(), [latents.len() / self.latent, self.latent]);
                let x = Tensor::from_data(x, &Device::flex());
                let mut decoded = self.decoder.forward(x).into_data().into_f32_vec();
                let with_mean = decoded.iter_mut().zip(self.mean.iter().cycle());
                with_mean.for_each(|(value, mean)| *value = (*value + mean).clamp(0.0, 1.0));
                decoded
            })
            .collect();
        images.concat()
    }
}

/// Rounds values from 0 to 1 to bytes.
pub fn to_bytes(decoded: &[f32]) -> Vec<u8> {
    decoded.iter().map(|value| (value * 255.0).round() as u8).collect()
}

/// What [`reconstruct_images`] returns.
pub struct Reconstruction {
    /// The decoder.
    pub decoder: ImageDecoder,
    /// Its errors.
    pub report: ReconstructionReport,
    /// Held-out images in pairs of rows: the originals, then the reconstructions.
    pub sheet: RgbImage,
}

/// Fits a decoder to an encoder's latents, and measures its errors.
///
/// # Errors
/// When the images do not have the encoder's image size, the side is not divisible into the decoder's blocks, no
/// episode is held out, a setting is out of range, or the run is stopped ([`Error::Interrupted`]).
pub fn reconstruct_images(
    encoder: &dyn ImageEncoder,
    reader: &dyn Reader,
    config: &ReconstructionConfig,
    control: &mut Control<'_>,
) -> Result<Reconstruction> {
    config.check()?;
    let key = Key::new(config.seed).with("probe");
    let sample = |part, count| samples::sample(encoder, reader, part, &[], true, (count, key.with("frames")));
    let train = sample(Part::Train, config.frames)?;
    let held_out = sample(Part::Validation, config.held_out)?;
    let decoder = fit_decoder((encoder.latent_dim(), encoder.image_size()), &train, config, control)?;

    let decoded = decoder.decode(&held_out.latents);
    let rmse = root_mean_square(decoded.iter().copied(), &held_out.images);
    let rmse_of_mean = root_mean_square(decoder.mean.iter().copied().cycle(), &held_out.images);
    let report = ReconstructionReport {
        latent: encoder.latent_dim(),
        frames: train.count,
        held_out: held_out.count,
        rmse,
        rmse_of_mean,
        explained: if rmse_of_mean > 0.0 { 1.0 - (rmse / rmse_of_mean).powi(2) } else { 0.0 },
    };
    let sheet = sheet(&held_out.images, &decoded, encoder.image_size(), config.shown)?;
    Ok(Reconstruction { decoder, report, sheet })
}

/// Trains a decoder on latents and their images.
fn fit_decoder(
    (latent, image): (usize, usize),
    train: &Samples,
    config: &ReconstructionConfig,
    control: &mut Control<'_>,
) -> Result<ImageDecoder> {
    let (key, bytes) = (Key::new(config.seed).with("probe"), image * image * 3);
    let mean = mean_image(&train.images, bytes);
    let scale = Scale::of(&train.latents, train.count);
    let latents = scale.apply(&train.latents);
    let decoder = Decoder::new(&Init::new(key.with("init"), &Device::flex()), latent, image, config)?;
    let step = |model: &Decoder, indices: &[usize]| {
        shards::mean(indices.len(), config.shards, |range| {
            let (indices, trained) = (&indices[range], model.clone().train());
            let targets: Vec<f32> = indices
                .iter()
                .flat_map(|&index| train.images[index * bytes..(index + 1) * bytes].iter().zip(&mean))
                .map(|(&byte, mean)| f32::from(byte) / 255.0 - mean)
                .collect();
            let targets = Tensor::<2>::from_data(TensorData::new(targets, [indices.len(), bytes]), &Device::flex());
            let decoded = trained.forward(rows(&latents, latent, indices).autodiff());
            let loss = (decoded - targets.autodiff()).square().mean();
            let metrics = vec![("loss", f64::from(loss.clone().inner().into_scalar::<f32>()))];
            let gradients = parameters::gradients(&trained, &loss.backward());
            Ok(StepOutput { metrics, gradients, ..StepOutput::default() })
        })
    };
    let (decoder, _) = fit(decoder, config.fit, train.count, key.with("batches"), step, |_, _| (), control)?;
    Ok(ImageDecoder { decoder, scale, mean, latent })
}

/// Returns the mean image, with values from 0 to 1.
///
/// # Shapes
/// Maps `[count, bytes]` to `[bytes]`.
fn mean_image(images: &[u8], bytes: usize) -> Vec<f32> {
    let mut sums = vec![0u32; bytes];
    for image in images.chunks_exact(bytes) {
        sums.iter_mut().zip(image).for_each(|(sum, &byte)| *sum += u32::from(byte));
    }
    let count = (images.len() / bytes) as f32 * 255.0;
    sums.into_iter().map(|sum| sum as f32 / count).collect()
}

/// Returns the root mean squared error of pixel values from 0 to 255; `decoded` has values from 0 to 1.
fn root_mean_square(decoded: impl Iterator<Item = f32>, images: &[u8]) -> f64 {
    let square: f64 = decoded.zip(images).map(|(a, &b)| (f64::from(a) * 255.0 - f64::from(b)).powi(2)).sum();
    (square / images.len() as f64).sqrt()
}

/// Returns a contact sheet in which every row of images is followed by the row of reconstructions.
fn sheet(images: &[u8], decoded: &[f32], image: usize, shown: usize) -> Result<RgbImage> {
    const COLUMNS: usize = 8;
    let bytes = image * image * 3;
    let count = images.len() / bytes;
    // The images are evenly spaced over the held-out frames.
    let indices: Vec<usize> = (0..shown.min(count)).map(|i| i * count / shown.min(count)).collect();
    let mut frames: Vec<Vec<u8>> = vec![];
    for indices in indices.chunks(COLUMNS) {
        frames.extend(indices.iter().map(|i| images[i * bytes..(i + 1) * bytes].to_vec()));
        frames.extend(indices.iter().map(|i| to_bytes(&decoded[i * bytes..(i + 1) * bytes])));
        // Padding aligns the images of an incomplete last row with the reconstructions.
        if indices.len() < COLUMNS && shown > COLUMNS {
            let blank = vec![u8::MAX; bytes];
            let at = frames.len() - indices.len();
            frames.splice(at..at, std::iter::repeat_n(blank, COLUMNS - indices.len()));
        }
    }
    contact_sheet(image, image, &frames, COLUMNS.min(indices.len()), (128 / image).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decoder_enlarges_each_cell_to_a_square() {
        // With one channel and weights of 1, every cell of the 2 x 2 map becomes an 8 x 8 square of the cell's value.
        let config = ReconstructionConfig { hidden: 4, channels: vec![1, 1], ..ReconstructionConfig::default() };
        let init = Init::new(Key::new(0), &Device::flex());
        let mut decoder = Decoder::new(&init, 4, 16, &config).expect("creating the decoder");
        let identity: Vec<f32> = (0..16).map(|i| if i % 5 == 0 { 1.0 } else { 0.0 }).collect();
        let layer = |weight: Vec<f32>, [outputs, inputs]: [usize; 2]| {
            let mut layer = Linear::zeros(&init, inputs, outputs);
            let weight = Tensor::<2>::from_data(TensorData::new(weight, [outputs, inputs]), &Device::flex());
            layer.weight = burn::module::Param::from_tensor(weight);
            layer
        };
        decoder.hidden = layer(identity.clone(), [4, 4]);
        decoder.map = layer(identity, [4, 4]);
        decoder.finer = vec![layer(vec![1.0; 4], [4, 1])];
        decoder.blocks = layer(vec![1.0; BLOCK * BLOCK * 3], [BLOCK * BLOCK * 3, 1]);
        let latent = Tensor::<2>::from_floats([[1.0, 2.0, 3.0, 4.0]], &Device::flex());
        let decoded: Vec<f32> = decoder.forward(latent).into_data().into_f32_vec();
        assert_eq!(decoded.len(), 16 * 16 * 3);
        for (i, value) in decoded.iter().enumerate() {
            let (y, x) = (i / 48, i / 3 % 16);
            let quadrant = y / 8 * 2 + x / 8;
            assert!((value - (quadrant as f32 + 1.0)).abs() < 1e-6, "{y} {x}: {value}");
        }
    }

    #[test]
    fn image_sides_that_are_no_multiple_of_16_are_refused() {
        let init = Init::new(Key::new(0), &Device::flex());
        let error = Decoder::new(&init, 3, 65, &ReconstructionConfig::default())
            .expect_err("a side of 65 pixels is accepted")
            .to_string();
        assert!(error.contains("multiple of 16"), "{error}");
    }
}
