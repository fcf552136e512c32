//! [`Layer`]: the weights of a convolution, laid out for the passes over blocks of images.

use super::geometry::{Geometry, Phase};
use crate::Panels;
use crate::functions::add_rows;
use crate::panels::LANES;
use crate::product::{Columns, Rows, Segment, multiply};
use rayon::prelude::*;

/// The number of rows of a product at which the layer processes no further image together with the others: weights are
/// read once per block, and the maps of a block must fit into a core's cache.
const BLOCK: usize = 256;

/// A convolution, or a linear layer of a feature map, which is a convolution whose kernel is as large as the map.
pub(super) struct Layer {
    pub geometry: Geometry,
    /// The number of images that are computed together.
    pub block: usize,
    /// The number of input and output channels.
    channels: [usize; 2],
    patches: Vec<usize>,
    segments: Vec<Segment>,
    gradients: Vec<usize>,
    phases: Vec<Phase>,
    /// The matrix `[patch, outputs]`.
    forward: Panels,
    /// For each phase, the matrix from gradients of the output to gradients of the input.
    backward: Vec<Panels>,
}

impl Layer {
    /// Creates a layer without weights for blocks of at most `images` images.
    pub fn new(geometry: Geometry, channels: [usize; 2], images: usize) -> Self {
        let block = (BLOCK / geometry.pixels()).clamp(1, images);
        Self {
            block,
            channels,
            patches: geometry.patches(block),
            segments: geometry.segments(),
            gradients: geometry.gradients(block),
            phases: vec![],
            forward: empty(geometry.outputs),
            backward: vec![],
            geometry,
        }
    }

    /// Prepares the computation of the gradient of the input.
    #[must_use]
    pub fn with_input_gradient(mut self) -> Self {
        self.phases = self.geometry.phases(self.block);
        self.backward = self.phases.iter().map(|_| empty(self.geometry.inputs)).collect();
        self
    }

    /// Lays out weights and bias.
    ///
    /// # Shapes
    /// `weight` is `[outputs, inputs, kernel, kernel]`, `bias` is `[outputs]`, or empty for a layer without bias.
    pub fn load(&mut self, weight: &[f32], bias: &[f32]) {
        let ([inputs, _], kernel) = (self.channels, self.geometry.kernel);
        let taps = kernel.pow(2);
        let (all_inputs, all_outputs) = (self.geometry.inputs, self.geometry.outputs);
        let mut matrix = vec![0.0; taps * all_inputs * all_outputs];
        // Rows are filled in groups, so that the weights of neighbouring inputs are read together.
        matrix.par_chunks_mut(LANES * all_outputs).enumerate().for_each(|(group, rows)| {
            for (output, weights) in weight.chunks_exact(inputs * taps).enumerate() {
                for (row, values) in rows.chunks_exact_mut(all_outputs).enumerate() {
                    let (tap, input) = ((group * LANES + row) / all_inputs, (group * LANES + row) % all_inputs);
                    if input < inputs {
                        values[output] = weights[input * taps + tap];
                    }
                }
            }
        });
        self.forward.fill_rows(self.geometry.patch(), (&matrix, all_outputs));
        self.forward.set_bias(bias);
        if self.phases.is_empty() {
            return;
        }
        matrix.fill(0.0);
        matrix.par_chunks_mut(all_inputs).enumerate().for_each(|(row, values)| {
            let (tap, output) = (row / all_outputs, row % all_outputs);
            if let Some(weights) = weight.chunks_exact(inputs * taps).nth(output) {
                values.iter_mut().zip(weights.chunks_exact(taps)).for_each(|(value, weights)| *value = weights[tap]);
            }
        });
        let by_tap = |tap: usize| &matrix[tap * all_outputs * all_inputs..][..all_outputs * all_inputs];
        for (phase, panels) in self.phases.iter().zip(&mut self.backward) {
            let [ys, xs] = &phase.taps;
            let taps = ys.iter().flat_map(|y| xs.iter().map(move |x| y * kernel + x));
            let rows: Vec<f32> = taps.map(by_tap).collect::<Vec<_>>().concat();
            panels.fill_rows(rows.len() / all_inputs, (&rows, all_inputs));
        }
    }

    /// Computes the output maps of a block.
    ///
    /// # Shapes
    /// `x` is `[images, padded input]`, `y` is `[images, output]`.
    pub fn forward(&self, x: &[f32], y: &mut [f32]) {
        let rows = y.len() / self.geometry.outputs;
        let x = Rows { values: x, starts: &self.patches[..rows], segments: &self.segments };
        multiply(rows, x, &self.forward, (y, self.geometry.outputs));
    }

    /// Computes the gradient of the input maps of a block.
    ///
    /// # Shapes
    /// `dy` is `[images, padded gradient]`, `dx` is `[images, input]`.
    pub fn input_gradient(&self, dy: &[f32], dx: &mut [f32]) {
        let images = dx.len() / self.geometry.input();
        for (phase, panels) in self.phases.iter().zip(&self.backward) {
            let rows = phase.from.len() / self.block * images;
            let dy = Rows { values: dy, starts: &phase.from[..rows], segments: &phase.segments };
            multiply(rows, dy, panels, (&mut *dx, &phase.to[..rows]));
        }
    }

    /// Adds the gradient of the weights and of the bias for a block. `panels` is memory with as many columns as the
    /// layer has outputs.
    ///
    /// # Shapes
    /// `x` is `[images, padded input]`, `dy` is `[images, padded gradient]`, `sums` is `[patch + 1, outputs]` with the
    /// bias in the last row.
    pub fn add_weight_gradient(&self, images: usize, x: &[f32], dy: &[f32], panels: &mut Panels, sums: &mut [f32]) {
        let (rows, outputs) = (images * self.geometry.pixels(), self.geometry.outputs);
        panels.fill_starts(dy, &self.gradients[..rows]);
        let (weight, bias) = sums.split_at_mut(self.geometry.patch() * outputs);
        for (row, segment) in weight.chunks_exact_mut(self.segments[0].length * outputs).zip(&self.segments) {
            let x = Columns { values: &x[segment.offset..], starts: &self.patches[..rows] };
            multiply(segment.length, x, panels, (row, outputs));
        }
        if self.geometry.kernel == self.geometry.stride {
            add_rows(bias, &dy[..rows * outputs]);
        }
    }

    /// The number of elements of the sums of [`Layer::add_weight_gradient`].
    pub fn sums(&self) -> usize {
        (self.geometry.patch() + 1) * self.geometry.outputs
    }

    /// Returns the gradients of weights and bias in the layout of [`Layer::load`].
    pub fn gradients(&self, sums: &[f32]) -> [Vec<f32>; 2] {
        let ([inputs, outputs], taps) = (self.channels, self.geometry.kernel.pow(2));
        let mut weight = vec![0.0; outputs * inputs * taps];
        weight.par_chunks_mut(LANES * inputs * taps).enumerate().for_each(|(group, weight)| {
            let rows = sums.chunks_exact(self.geometry.outputs).enumerate().take(self.geometry.patch());
            for (row, values) in rows {
                let (tap, input) = (row / self.geometry.inputs, row % self.geometry.inputs);
                if input < inputs {
                    let weight = weight.chunks_exact_mut(inputs * taps).zip(&values[group * LANES..]);
                    weight.for_each(|(weight, value)| weight[input * taps + tap] = *value);
                }
            }
        });
        [weight, sums[self.geometry.patch() * self.geometry.outputs..][..outputs].to_vec()]
    }
}

/// Returns panels without rows.
pub(super) fn empty(columns: usize) -> Panels {
    Panels::new(0, columns, |_, _| 0.0)
}
