//! [`ConvGradient`]: features and gradients of a training batch.
//!
//! The forward pass stores the outputs of the convolutions before their normalisations. The next layer normalises them
//! while it copies them to its padded input, in the forward pass and again in the backward pass. The batch is cut into
//! chunks of images, which threads compute in parallel; sums over chunks are added in the order of the chunks, so no byte
//! depends on the number of threads.

use super::layer::{Layer, empty};
use super::maps::{Activation, GradientCoefficients, Moments, add_norm_gradient};
use super::{ChannelStatistics, ConvParameters, ConvSizes, ConvStage, EPSILON};
use crate::functions::add;
use crate::{Affine, Panels, ScratchPool, grown};
use rayon::prelude::*;
use std::ops::Range;

/// The smallest number of images in a chunk, and the largest number of chunks.
const CHUNK: usize = 32;
const CHUNKS: usize = 16;

/// A convolutional encoder and the activations of a training batch. The memory is reused from batch to batch.
pub struct ConvGradient {
    sizes: ConvSizes,
    layers: Vec<Layer>,
    /// The state of the last batch for each layer.
    states: Vec<State>,
    /// The gradients of the outputs of the current and of the previous layer.
    gradients: [Vec<f32>; 2],
    /// The gradients of weights and bias of each chunk.
    sums: Vec<Vec<f32>>,
    scratch: ScratchPool<Scratch>,
}

/// The output of a layer for a batch, and what follows the layer.
struct State {
    /// The output before normalisation and activation, `[images, pixels, width]`.
    y: Vec<f32>,
    norm: Option<Norm>,
    activation: Activation,
    coefficients: GradientCoefficients,
}

/// Batch normalisation of the output of a layer.
struct Norm {
    parameters: Affine,
    moments: Moments,
    /// The gradients of scale and shift.
    gradient: Affine,
}

/// Memory of one thread.
#[derive(Default)]
struct Scratch {
    /// The padded inputs of each layer.
    inputs: Vec<Vec<f32>>,
    /// The padded gradients of the outputs of each layer.
    gradients: Vec<Vec<f32>>,
    /// Panels with as many columns as each layer has outputs.
    panels: Vec<Panels>,
}

impl Scratch {
    fn prepare(&mut self, layers: &[Layer]) {
        if self.inputs.is_empty() {
            self.inputs = layers.iter().map(|layer| vec![0.0; layer.block * layer.geometry.padded_input()]).collect();
            self.gradients =
                layers.iter().map(|layer| vec![0.0; layer.block * layer.geometry.padded_gradient()]).collect();
            self.panels = layers.iter().map(|layer| empty(layer.geometry.outputs)).collect();
        }
    }
}

/// The maps that a layer reads.
#[derive(Clone, Copy)]
enum Source<'a> {
    /// Normalised images, `[images, side, side, 3]`.
    Images(&'a [f32]),
    /// The output of the previous layer.
    Layer(&'a State),
}

impl Source<'_> {
    /// Writes the padded inputs of images `first .. first + images`.
    fn read(self, layer: &Layer, first: usize, images: usize, padded: &mut [f32]) {
        let length = layer.geometry.input();
        match self {
            Self::Images(all) => layer.geometry.pad(&all[first * length..][..images * length], padded),
            Self::Layer(state) => {
                state.activation.apply(&state.y[first * length..][..images * length], &layer.geometry, padded)
            }
        }
    }
}

impl ConvGradient {
    /// Creates an encoder without weights; [`ConvGradient::load`] sets the weights.
    pub fn new(sizes: &ConvSizes) -> Self {
        let mut layers = vec![];
        for (index, layer) in sizes.layers(CHUNK).into_iter().enumerate() {
            layers.push(if index == 0 { layer } else { layer.with_input_gradient() });
        }
        let states = layers.iter().map(|layer| State::new(layer.geometry.outputs)).collect();
        Self {
            sizes: sizes.clone(),
            layers,
            states,
            gradients: [vec![], vec![]],
            sums: vec![],
            scratch: ScratchPool::default(),
        }
    }

    /// The sizes of the encoder.
    pub fn sizes(&self) -> &ConvSizes {
        &self.sizes
    }

    /// The number of features of an image.
    pub fn dim(&self) -> usize {
        if self.sizes.dim > 0 { self.sizes.dim } else { self.sizes.map().pow(2) * self.sizes.outputs() }
    }

    /// Whether the encoder has no linear layers, so that the last layer is normalised.
    fn ends_in_cells(&self) -> bool {
        self.sizes.dim == 0
    }

    /// Lays out the parameters for the passes over a batch.
    pub fn load(&mut self, parameters: &ConvParameters) {
        let stages = parameters.stages.iter().map(|stage| (&stage.weight, &[][..], Some(&stage.norm)));
        let linear = parameters.linear.iter().map(|affine| (&affine.weight, &affine.bias[..], None));
        let parameters: Vec<_> = stages.chain(linear).collect();
        let layers = self.layers.par_iter_mut().zip(&mut self.states).zip(parameters);
        layers.for_each(|((layer, state), (weight, bias, norm))| {
            layer.load(weight, bias);
            state.norm = norm.map(|norm| Norm::new(norm, layer.geometry.outputs));
        });
    }

    /// Computes the features of a batch.
    ///
    /// # Shapes
    /// `images`, normalised, is `[images, side, side, 3]`; returns `[images, dim]`, without linear layers
    /// `[images, map, map, channels]`.
    pub fn forward(&mut self, images: &[f32]) -> Vec<f32> {
        let count = images.len() / self.layers[0].geometry.input();
        for index in 0..self.layers.len() {
            let (before, rest) = self.states.split_at_mut(index);
            let source = before.last().map_or(Source::Images(images), Source::Layer);
            let (layer, layers, scratch) = (&self.layers[index], &self.layers, &self.scratch);
            let (chunk, length, width) = (chunk_size(count), layer.geometry.output(), layer.geometry.outputs);
            let State { y, norm, .. } = &mut rest[0];
            let normalised = norm.is_some();
            let chunks = grown(y, count * length).par_chunks_mut(chunk * length).enumerate();
            let moments: Vec<Moments> = chunks
                .map(|(number, y)| {
                    scratch.with(|scratch| {
                        scratch.prepare(layers);
                        let (padded, mut moments) = (&mut scratch.inputs[index], Moments::new(width));
                        for (block, y) in y.chunks_mut(layer.block * length).enumerate() {
                            let images = y.len() / length;
                            source.read(layer, number * chunk + block * layer.block, images, padded);
                            layer.forward(padded, y);
                            if normalised {
                                moments.add_map(y);
                            }
                        }
                        moments
                    })
                })
                .collect();
            rest[0].finish_forward(moments);
        }
        self.features(count)
    }

    /// Returns the features of the `count` images of a forward pass.
    fn features(&self, count: usize) -> Vec<f32> {
        let (last, dim) = (self.layers.len() - 1, self.sizes.outputs());
        let (State { y, activation, .. }, geometry) = (&self.states[last], &self.layers[last].geometry);
        let mut features = vec![0.0; count * self.dim()];
        let pixels = features.par_chunks_mut(dim * geometry.pixels()).zip(y.par_chunks(geometry.output()));
        pixels.for_each(|(to, from)| {
            for (to, from) in to.chunks_exact_mut(dim).zip(from.chunks_exact(geometry.outputs)) {
                to.copy_from_slice(&from[..dim]);
                if self.ends_in_cells() {
                    let coefficients = activation.scale.iter().zip(&activation.shift);
                    to.iter_mut().zip(coefficients).for_each(|(y, (scale, shift))| *y = (*y * scale + shift).max(0.0));
                }
            }
        });
        features
    }

    /// Returns mean and unbiased variance of every channel over the last batch, for each convolution.
    pub fn statistics(&self) -> Vec<ChannelStatistics> {
        let norms = self.states.iter().filter_map(|state| state.norm.as_ref());
        norms
            .map(|Norm { moments, parameters, .. }| {
                let channels = parameters.bias.len();
                let unbiased = |squares: &f64| (squares / (moments.count - 1.0).max(1.0)) as f32;
                ChannelStatistics {
                    mean: moments.mean[..channels].iter().map(|mean| *mean as f32).collect(),
                    variance: moments.squares[..channels].iter().map(unbiased).collect(),
                }
            })
            .collect()
    }

    /// Returns the gradients of the parameters for the batch of the last forward pass.
    ///
    /// # Shapes
    /// `images` is `[images, side, side, 3]` as in the forward pass; `d`, the gradient of the features, has the shape of the
    /// features.
    pub fn backward(&mut self, images: &[f32], d: &[f32]) -> ConvParameters {
        let count = images.len() / self.layers[0].geometry.input();
        self.load_gradient(count, d);
        let mut gradients = ConvParameters { stages: vec![], linear: vec![] };
        for index in (0..self.layers.len()).rev() {
            let [weight, bias] = self.layer_backward(index, images, count);
            match &self.states[index].norm {
                Some(norm) => {
                    let channels = norm.parameters.bias.len();
                    let cut = |values: &[f32]| values[..channels].to_vec();
                    let norm = Affine { weight: cut(&norm.gradient.weight), bias: cut(&norm.gradient.bias) };
                    gradients.stages.insert(0, ConvStage { weight, norm });
                }
                None => gradients.linear.insert(0, Affine { weight, bias }),
            }
        }
        gradients
    }

    /// Copies the gradient of the features of `count` images to the gradient of the last layer's output.
    fn load_gradient(&mut self, count: usize, d: &[f32]) {
        let (dim, cells, last) = (self.sizes.outputs(), self.ends_in_cells(), self.layers.len() - 1);
        let (geometry, chunk) = (&self.layers[last].geometry, chunk_size(count));
        let (width, length) = (geometry.outputs, geometry.output());
        let output = grown(&mut self.gradients[0], count * length);
        for (to, from) in output.chunks_exact_mut(width).zip(d.chunks_exact(dim)) {
            to[..dim].copy_from_slice(from);
            to[dim..].fill(0.0);
        }
        if cells {
            let State { y, activation, .. } = &self.states[last];
            let chunks = output.par_chunks(chunk * length).zip(y[..count * length].par_chunks(chunk * length));
            let sums = |(d, y): (&[f32], &[f32])| {
                let mut sums = vec![0.0; 2 * width];
                let images = d.chunks_exact(length).zip(y.chunks_exact(length));
                images.for_each(|(d, y)| add_norm_gradient(activation, d, y, &mut sums));
                sums
            };
            let sums: Vec<Vec<f64>> = chunks.map(sums).collect();
            self.states[last].finish_backward(&sums);
        }
    }

    /// Returns the gradients of the weights and of the bias of a layer, and replaces the gradient of the layer's output by
    /// the gradient of the layer's input.
    fn layer_backward(&mut self, index: usize, images: &[f32], count: usize) -> [Vec<f32>; 2] {
        let (before, rest) = self.states.split_at_mut(index);
        let (layers, scratch, chunk) = (&self.layers, &self.scratch, chunk_size(count));
        let (input, output) = (layers[index].geometry.input(), layers[index].geometry.output());
        let [d, dx] = &mut self.gradients;
        let backward = Backward {
            layer: &layers[index],
            state: (index + 1 < layers.len() || self.sizes.dim == 0).then_some(&rest[0]),
            source: before.last().map_or(Source::Images(images), Source::Layer),
            d: &d[..count * output],
        };
        let dx: Vec<&mut [f32]> = match index {
            0 => (0..count).step_by(chunk).map(|_| &mut [][..]).collect(),
            _ => grown(dx, count * input).chunks_mut(chunk * input).collect(),
        };
        self.sums.resize(dx.len(), vec![]);
        let norm_sums: Vec<Vec<f64>> = (dx.into_par_iter().zip(&mut self.sums).enumerate())
            .map(|(number, (dx, sums))| {
                let range = number * chunk..((number + 1) * chunk).min(count);
                scratch.with(|scratch| {
                    scratch.prepare(layers);
                    backward.chunk(
                        range,
                        [&mut scratch.inputs[index], &mut scratch.gradients[index]],
                        &mut scratch.panels[index],
                        sums,
                        dx,
                    )
                })
            })
            .collect();
        if let Some(previous) = before.last_mut() {
            previous.finish_backward(&norm_sums);
        }
        self.gradients.swap(0, 1);
        layers[index].gradients(add_in_order(&mut self.sums))
    }
}

/// The backward pass of a layer.
#[derive(Clone, Copy)]
struct Backward<'a> {
    layer: &'a Layer,
    /// The state of the layer; `None` for the last linear layer, which has no activation.
    state: Option<&'a State>,
    source: Source<'a>,
    /// The gradient of the activations of the layer, `[images, pixels, width]`.
    d: &'a [f32],
}

impl Backward<'_> {
    /// Writes the gradients of weights and bias for a range of images to `sums`, and the gradient of the input to `dx`.
    /// Returns the sums over the images that the gradient of the normalisation before the layer needs.
    fn chunk(
        self,
        range: Range<usize>,
        [padded, gradient]: [&mut [f32]; 2],
        panels: &mut Panels,
        sums: &mut Vec<f32>,
        dx: &mut [f32],
    ) -> Vec<f64> {
        let Self { layer, state, source, d } = self;
        let (input, output) = (layer.geometry.input(), layer.geometry.output());
        let mut norm_sums = vec![0.0; 2 * layer.geometry.inputs];
        sums.clear();
        sums.resize(layer.sums(), 0.0);
        for first in range.clone().step_by(layer.block) {
            let images = layer.block.min(range.end - first);
            let d = &d[first * output..][..images * output];
            match state {
                Some(State { y, activation, coefficients, .. }) => {
                    let y = &y[first * output..][..images * output];
                    coefficients.apply(activation, d, y, &layer.geometry, gradient);
                }
                None => gradient[..d.len()].copy_from_slice(d),
            }
            source.read(layer, first, images, padded);
            layer.add_weight_gradient(images, padded, gradient, panels, sums);
            if let Source::Layer(State { y, activation, .. }) = source {
                let dx = &mut dx[(first - range.start) * input..][..images * input];
                layer.input_gradient(gradient, dx);
                add_norm_gradient(activation, dx, &y[first * input..][..images * input], &mut norm_sums);
            }
        }
        norm_sums
    }
}

/// Returns the sum of all arrays, added in order, in the memory of the first.
fn add_in_order(all: &mut [Vec<f32>]) -> &[f32] {
    /// The number of elements that a thread adds at once.
    const PART: usize = 1 << 14;
    let Some((sum, others)) = all.split_first_mut() else { return &[] };
    sum.par_chunks_mut(PART).enumerate().for_each(|(part, sum)| {
        for other in &*others {
            add(sum, &other[part * PART..][..sum.len()]);
        }
    });
    sum
}

/// Returns the number of images of a chunk, given the number of images of a batch.
fn chunk_size(images: usize) -> usize {
    images.div_ceil(CHUNKS).max(CHUNK)
}

impl Norm {
    fn new(parameters: &Affine, width: usize) -> Self {
        Self { parameters: parameters.clone(), moments: Moments::new(width), gradient: Affine::zeros(1, width) }
    }
}

impl State {
    fn new(width: usize) -> Self {
        let (activation, coefficients) = (Activation::relu(width), GradientCoefficients::relu(width));
        Self { y: vec![], norm: None, activation, coefficients }
    }

    /// Computes the coefficients of the normalisation from the moments of the chunks.
    fn finish_forward(&mut self, chunks: Vec<Moments>) {
        let (Some(norm), Some(moments)) = (&mut self.norm, chunks.into_iter().reduce(|a, b| a.merge(&b))) else {
            return;
        };
        for (channel, (weight, bias)) in norm.parameters.weight.iter().zip(&norm.parameters.bias).enumerate() {
            let scale = f64::from(*weight) / (moments.squares[channel] / moments.count + EPSILON).sqrt();
            self.activation.scale[channel] = scale as f32;
            self.activation.shift[channel] = (f64::from(*bias) - moments.mean[channel] * scale) as f32;
            self.activation.mean[channel] = moments.mean[channel] as f32;
        }
        norm.moments = moments;
    }

    /// Computes the gradients of scale and shift, and the coefficients of the gradient of `y`, from the sums of the chunks.
    fn finish_backward(&mut self, chunks: &[Vec<f64>]) {
        let Some(Norm { parameters, moments, gradient }) = &mut self.norm else { return };
        let width = self.activation.scale.len();
        for (channel, weight) in parameters.weight.iter().enumerate() {
            let sum = |at: usize| chunks.iter().map(|sums| sums[at]).sum::<f64>();
            let (shift, products) = (sum(channel), sum(width + channel));
            let inverse = 1.0 / (moments.squares[channel] / moments.count + EPSILON).sqrt();
            let factor = f64::from(*weight) * inverse;
            gradient.bias[channel] = shift as f32;
            gradient.weight[channel] = (products * inverse) as f32;
            self.coefficients.factor[channel] = factor as f32;
            self.coefficients.slope[channel] = (-factor * inverse * inverse * products / moments.count) as f32;
            self.coefficients.offset[channel] = (-factor * shift / moments.count) as f32;
        }
    }
}
