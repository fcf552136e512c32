//! [`Keypoints`]: an image encoder: positions that a spatial softmax reads from filters with fixed random weights, moments of
//! colours, then trained linear layers.
//!
//! Filters and colours are not trained, so that their features are computed once per frame of a dataset, and a training step
//! computes the linear layers only.

use super::parameters::host;
use super::{Activation, BatchNorm, BatchStatistics, Init, Linear, Named};
use crate::train::{check_sizes, limits};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};
use swm_kernels::{ColourMoments, ColourScratch, FilterBank, KeypointScratch};

/// The most sizes of filters, and the most hidden layers.
const MOST_LAYERS: usize = 64;
/// The most colours.
const MOST_COLOURS: usize = 256;
/// The most pixels of an image times colours: 16 MiB for each thread.
const MOST_COLOURED: usize = 1 << 22;
/// The largest value of a colour; normalised images have smaller ones.
const LARGEST_COLOUR: f32 = 100.0;
/// The most weights of all filters: 256 MiB.
const MOST_WEIGHTS: usize = 1 << 26;

/// The size of a [`Keypoints`] encoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeypointsConfig {
    /// The filters.
    pub filters: Vec<FilterConfig>,
    /// The factor of the responses, in standard deviations over an image, before the softmax.
    pub sharpness: f32,
    /// Colours (red, green, blue) whose pixels are located: 0 to 1 where `pixel_mean` is 0 and `pixel_std` 1, otherwise normalised by them.
    #[serde(default)]
    pub colours: Vec<[f32; 3]>,
    /// How many colours to find in the frames of the training data (k-means), if `colours` is empty; 0 for none.
    #[serde(default, skip_serializing_if = "is_none")]
    pub find_colours: usize,
    /// The number of features of each hidden layer, first to last.
    pub hidden: Vec<usize>,
    /// The number of output features.
    pub dim: usize,
    /// The seed of the filters. It is not that of the training, so that runs with several seeds share the features.
    #[serde(default)]
    pub seed: u64,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde calls")]
const fn is_none(count: &usize) -> bool {
    *count == 0
}

/// Filters of one size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilterConfig {
    /// The side of the filters, in pixels; odd.
    pub kernel: usize,
    /// The distance between two positions of a filter, in pixels.
    pub stride: usize,
    /// The number of filters.
    pub channels: usize,
}

/// Random filters, the expected position of their responses, the moments of colours, and linear layers.
#[derive(Module, Debug)]
pub struct Keypoints {
    /// The filters of each size, which are not trained.
    pub filters: Vec<Filter>,
    /// The normalisation of the features of filters and colours.
    pub norm: BatchNorm,
    /// The hidden layers.
    pub hidden: Vec<Linear>,
    /// The output layer.
    pub out: Linear,
    #[module(skip)]
    config: KeypointsConfig,
}

/// Filters of one size.
#[derive(Module, Debug)]
pub struct Filter {
    /// The weights, `[channels, 3, kernel, kernel]`.
    pub weight: Param<Tensor<4>>,
}

impl KeypointsConfig {
    /// The number of features that are not trained: the expected x and y and the largest response of each filter, and the
    /// [moments](ColourMoments) of each colour.
    pub fn features(&self) -> usize {
        let of_filters: usize = self.filters.iter().map(|filter| 3 * filter.channels).sum();
        of_filters + ColourMoments::FEATURES * self.colours.len()
    }

    /// The number of colours, found or to be found.
    const fn count_of_colours(&self) -> usize {
        if self.colours.is_empty() { self.find_colours } else { self.colours.len() }
    }

    /// Checks the sizes. `at` is the dotted path of the settings, for errors.
    ///
    /// # Errors
    /// When there are neither filters nor colours, there is one colour, or a size is out of range.
    pub fn check(&self, at: &str, image: usize) -> Result<()> {
        if self.filters.is_empty() && self.count_of_colours() == 0 {
            return Err(Error::config(
                format!("{at}.filters"),
                "the list is empty",
                "give at least one size of filters, or colours, or a number of colours to find",
            ));
        }
        let lengths = [
            ("filters", self.filters.len(), MOST_LAYERS),
            ("hidden", self.hidden.len(), MOST_LAYERS),
            ("colours", self.colours.len(), MOST_COLOURS),
        ];
        check_sizes(&[(&format!("{at}.find_colours"), self.find_colours, 0, MOST_COLOURS)])?;
        for (name, count, most) in lengths {
            check_sizes(&[(&format!("the length of {at}.{name}"), count, 0, most)])?;
        }
        let coloured = image.saturating_mul(image).saturating_mul(self.count_of_colours());
        check_sizes(&[(&format!("the pixels times {at}.colours"), coloured, 0, MOST_COLOURED)])?;
        if self.count_of_colours() == 1 {
            let fix = "give at least two: a pixel belongs to the colours by their distances";
            return Err(Error::config(format!("{at}.colours"), "one colour", fix));
        }
        if let Some((index, colour)) =
            self.colours.iter().enumerate().find(|(i, colour)| self.colours[..*i].contains(colour))
        {
            let problem = format!("{colour:?} twice, the second time at {index}");
            let fix = "remove one: the pixels of equal colours cannot be told apart";
            return Err(Error::config(format!("{at}.colours"), problem, fix));
        }
        if let Some(colour) =
            self.colours.iter().find(|colour| !colour.iter().all(|value| value.abs() <= LARGEST_COLOUR))
        {
            let fix = "give normalised values, 0 to 1 with model.pixel_mean 0 and model.pixel_std 1, not bytes";
            return Err(Error::config(format!("{at}.colours"), format!("{colour:?}"), fix));
        }
        for FilterConfig { kernel, stride, channels } in &self.filters {
            check_sizes(&[
                (&format!("{at}.filters.kernel"), *kernel, 1, image),
                (&format!("{at}.filters.stride"), *stride, 1, image.div_ceil(2).max(1)),
                (&format!("{at}.filters.channels"), *channels, 1, limits::FEATURES),
            ])?;
            if kernel.is_multiple_of(2) {
                let fix = "choose an odd side, so that a filter has a centre";
                return Err(Error::config(format!("{at}.filters.kernel"), kernel.to_string(), fix));
            }
        }
        let weights = self.filters.iter().map(|filter| 3 * filter.channels * filter.kernel * filter.kernel).sum();
        check_sizes(&[(&format!("the weights of {at}.filters"), weights, 0, MOST_WEIGHTS)])?;
        if !(self.sharpness.is_finite() && self.sharpness > 0.0) {
            return Err(Error::config(format!("{at}.sharpness"), self.sharpness.to_string(), "give a number above 0"));
        }
        for hidden in &self.hidden {
            check_sizes(&[(&format!("{at}.hidden"), *hidden, 1, limits::FEATURES)])?;
        }
        check_sizes(&[(&format!("{at}.dim"), self.dim, 1, limits::FEATURES)])
    }

    /// Creates an encoder.
    pub fn init(&self, init: &Init) -> Keypoints {
        let key = Key::new(self.seed).with("init").with("encoder");
        let of_filters = Init { key, ..init.clone() };
        let filters = self.filters.iter().enumerate().map(|(index, filter)| {
            let FilterConfig { kernel, channels, .. } = *filter;
            let std = 1.0 / ((3 * kernel * kernel) as f32).sqrt();
            let weight = of_filters.of("filters").at(index).normal("weight", [channels, 3, kernel, kernel], std);
            Filter { weight: weight.set_require_grad(false) }
        });
        let inputs: Vec<usize> = std::iter::once(self.features()).chain(self.hidden.iter().copied()).collect();
        let hidden = self.hidden.iter().zip(&inputs).enumerate().map(|(index, (outputs, inputs))| {
            Linear::normal(&init.of("hidden").at(index), *inputs, *outputs, (2.0 / *inputs as f32).sqrt())
        });
        Keypoints {
            filters: filters.collect(),
            norm: BatchNorm::new(&init.of("norm"), self.features()),
            hidden: hidden.collect(),
            out: Linear::new(&init.of("out"), inputs[self.hidden.len()], self.dim),
            config: self.clone(),
        }
    }
}

impl Keypoints {
    /// Computes the features of images, with the running statistics.
    ///
    /// # Shapes
    /// Maps `[frames, side * side, 3]`, or the features of filters and colours `[frames, 1, features]`, to `[frames, dim]`.
    pub fn forward(&self, images: Tensor<3>) -> Tensor<2> {
        self.head(self.norm.forward(self.inputs(images)))
    }

    /// Computes the features of images with the statistics of the batch, which are returned.
    ///
    /// # Shapes
    /// As [`Keypoints::forward`].
    pub fn forward_train(&self, images: Tensor<3>) -> (Tensor<2>, BatchStatistics) {
        let (x, statistics) = self.norm.forward_train(self.inputs(images));
        (self.head(x), statistics)
    }

    fn head(&self, x: Tensor<2>) -> Tensor<2> {
        let hidden = self.hidden.iter().fold(x, |x, layer| Activation::Gelu.forward(layer.forward(x)));
        self.out.forward(hidden)
    }

    /// Returns the features of filters and colours, which are computed from pixels.
    ///
    /// # Shapes
    /// Maps the images of [`Keypoints::forward`] to `[frames, features]`.
    pub fn inputs(&self, images: Tensor<3>) -> Tensor<2> {
        let ([frames, rows, width], device) = (images.dims(), images.device());
        let features = self.config.features();
        if (rows, width) == (1, features) {
            return images.reshape([frames, features]);
        }
        let values = self.kernels(rows.isqrt()).features(&host(images));
        Tensor::from_data(TensorData::new(values, [frames, features]), &device)
    }

    /// Updates the running statistics with batch statistics that [`store`] inserted under `name`.
    pub fn track(&mut self, name: &str, buffers: &mut Named<Tensor<1>>) {
        if let Some(statistics) = BatchStatistics::take(&norm_name(name), buffers) {
            self.norm.track(statistics);
        }
    }

    /// Packs the filters for images with a side of `side` pixels.
    pub fn kernels(&self, side: usize) -> KeypointKernels {
        let banks = self.filters.iter().zip(&self.config.filters).map(|(filter, sizes)| FilterBank {
            kernel: sizes.kernel,
            stride: sizes.stride,
            weight: host(filter.weight.val()),
        });
        let banks: Vec<FilterBank> = banks.collect();
        let mut content =
            serde_json::to_vec(&(&self.config.filters, self.config.sharpness)).expect("a configuration serializes");
        banks.iter().for_each(|bank| content.extend_from_slice(bytemuck::cast_slice(&bank.weight)));
        content.extend_from_slice(bytemuck::cast_slice(self.config.colours.as_flattened()));
        KeypointKernels {
            pixels: side * side * 3,
            filters: swm_kernels::Keypoints::new(side, self.config.sharpness, &banks),
            colours: ColourMoments::new(side, &self.config.colours),
            hash: swm_core::manifest::hash(&content),
        }
    }
}

/// Inserts the statistics of an encoder's normalisation into `buffers` under `name`.
pub fn store(statistics: Vec<BatchStatistics>, name: &str, buffers: &mut Named<Tensor<1>>) {
    for statistics in statistics {
        statistics.store(&norm_name(name), buffers);
    }
}

fn norm_name(name: &str) -> String {
    format!("{name}.norm")
}

/// The filters and colours of an encoder, for images of one size.
pub struct KeypointKernels {
    pixels: usize,
    filters: swm_kernels::Keypoints,
    colours: ColourMoments,
    hash: String,
}

impl KeypointKernels {
    /// The hash of the filters, their settings and the colours.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The number of features of an image.
    pub fn count(&self) -> usize {
        self.filters.features() + self.colours.features()
    }

    /// Computes the features of images.
    ///
    /// # Shapes
    /// Maps `[images, side, side, 3]` normalised pixels to `[images, features]`.
    pub fn features(&self, pixels: &[f32]) -> Vec<f32> {
        let count = self.count();
        let mut features = vec![0.0; pixels.len() / self.pixels * count];
        (features.par_chunks_mut(count).zip(pixels.par_chunks(self.pixels))).for_each_init(
            <(KeypointScratch, ColourScratch)>::default,
            |(of_filters, of_colours), (features, image)| {
                let (filters, colours) = features.split_at_mut(self.filters.features());
                self.filters.features_of(image, of_filters, filters);
                self.colours.features_of(image, of_colours, colours);
            },
        );
        features
    }
}
