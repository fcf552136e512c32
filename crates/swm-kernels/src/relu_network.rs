//! [`ReluNetwork`]: forward and backward pass of linear layers with ReLU between them, on rows in blocks.
//!
//! A call computes one part of a batch on one thread, in memory that is reused. Products of the forward pass and of the gradient of the
//! inputs read weights and rows where they lie; the gradient of the weights transposes the inputs of a layer first.

use crate::blocks::{BLOCK, transpose};
use crate::panels::{Panels, WIDTH};
use crate::product::{Columns, Rows, Segment, Then, multiply, multiply_panel};
use crate::scratch::grown;
use std::ops::{Deref, Range};

/// A linear layer, or its gradient.
#[derive(Clone, Debug)]
pub struct ReluLayer<T = Vec<f32>> {
    /// The weights, `[outputs, inputs]`.
    pub weight: T,
    /// The bias, `[outputs]`.
    pub bias: T,
}

impl<T: Deref<Target = [f32]>> ReluLayer<T> {
    fn outputs(&self) -> usize {
        self.bias.len()
    }

    fn inputs(&self) -> usize {
        self.weight.len() / self.bias.len()
    }
}

/// Linear layers with ReLU between them.
#[derive(Clone, Debug)]
pub struct ReluNetwork<T = Vec<f32>> {
    layers: Vec<ReluLayer<T>>,
}

/// The outputs of every layer, after ReLU, `[blocks, outputs, BLOCK]`.
#[derive(Debug, Default)]
pub struct ReluTape(Vec<Vec<f32>>);

/// Memory of [`ReluNetwork::backward`].
#[derive(Debug, Default)]
pub struct ReluScratch {
    /// The gradients of the outputs of every layer before ReLU.
    gradients: Vec<Vec<f32>>,
    /// The gradient of the inputs of the network, or of some of them.
    inputs: Vec<f32>,
    /// The transposed inputs of a layer, by the number of inputs.
    panels: Vec<Panels>,
}

impl<T: Deref<Target = [f32]>> ReluNetwork<T> {
    /// Creates a network.
    ///
    /// # Panics
    /// If the inputs of a layer are not the outputs of the layer before, or there is no layer.
    pub fn new(layers: Vec<ReluLayer<T>>) -> Self {
        assert!(!layers.is_empty(), "a network has a layer");
        assert!(layers.windows(2).all(|pair| pair[1].inputs() == pair[0].outputs()), "layers of a network fit");
        Self { layers }
    }

    /// Computes the outputs of the network.
    ///
    /// # Shapes
    /// `x` is `[blocks, inputs, BLOCK]`; returns `[blocks, outputs, BLOCK]`.
    pub fn forward<'a>(&self, x: &[f32], tape: &'a mut ReluTape) -> &'a [f32] {
        let blocks = x.len() / (self.layers[0].inputs() * BLOCK);
        tape.0.resize_with(self.layers.len(), Vec::new);
        for (layer, outputs) in self.layers.iter().zip(&mut tape.0) {
            outputs.resize(blocks * layer.outputs() * BLOCK, 0.0);
        }
        for block in 0..blocks {
            for (index, layer) in self.layers.iter().enumerate() {
                let (before, after) = tape.0.split_at_mut(index);
                let x = part(before.last().map_or(x, Vec::as_slice), block, layer.inputs());
                let segments = [Segment { offset: 0, length: layer.inputs() }];
                let weight = Rows { values: &layer.weight, starts: layer.inputs(), segments: &segments };
                let is_last = index + 1 == self.layers.len();
                let then = if is_last { Then::Bias(&layer.bias) } else { Then::BiasRelu(&layer.bias) };
                multiply_panel(weight, x, part_mut(&mut after[0], block, layer.outputs()), then);
            }
        }
        self.outputs(tape)
    }

    /// Returns the outputs of the last forward pass.
    pub fn outputs<'a>(&self, tape: &'a ReluTape) -> &'a [f32] {
        &tape.0[self.layers.len() - 1]
    }

    /// Computes the gradient of a range of the inputs of the network from the gradient `d` of its outputs.
    ///
    /// # Shapes
    /// `d` is `[blocks, outputs, BLOCK]`; returns `[blocks, range.len(), BLOCK]`.
    pub fn input_gradient<'a>(
        &self,
        tape: &ReluTape,
        d: &[f32],
        range: Range<usize>,
        scratch: &'a mut ReluScratch,
    ) -> &'a [f32] {
        self.output_gradients(tape, d, scratch);
        let layer = &self.layers[0];
        let blocks = d.len() / (self.layers[self.layers.len() - 1].outputs() * BLOCK);
        let inputs = grown(&mut scratch.inputs, blocks * range.len() * BLOCK);
        let of_outputs = scratch.gradients.first().map_or(d, Vec::as_slice);
        for block in 0..blocks {
            let weight = Columns { values: &layer.weight[range.start..], starts: layer.inputs() };
            let d = part(of_outputs, block, layer.outputs());
            multiply_panel(weight, d, part_mut(inputs, block, range.len()), Then::Nothing);
        }
        inputs
    }

    /// Computes the gradients of weights and biases from the gradient `d` of the outputs, for the inputs `x` of the forward pass.
    ///
    /// # Shapes
    /// `x` is `[blocks, inputs, BLOCK]`, `d` `[blocks, outputs, BLOCK]`; returns as many layers.
    pub fn weight_gradients(&self, x: &[f32], tape: &ReluTape, d: &[f32], scratch: &mut ReluScratch) -> Vec<ReluLayer> {
        self.output_gradients(tape, d, scratch);
        let ReluScratch { gradients, panels, .. } = scratch;
        let inputs = std::iter::once(x).chain(tape.0.iter().map(Vec::as_slice));
        let gradients = gradients.iter().map(Vec::as_slice).chain([d]);
        let layers = self.layers.iter().zip(inputs).zip(gradients);
        layers.map(|((layer, x), d)| layer_gradient([layer.outputs(), layer.inputs()], x, d, panels)).collect()
    }

    /// Writes the gradients of the outputs of all layers but the last, before ReLU.
    fn output_gradients(&self, tape: &ReluTape, d: &[f32], scratch: &mut ReluScratch) {
        let hidden = self.layers.len() - 1;
        let blocks = d.len() / (self.layers[hidden].outputs() * BLOCK);
        scratch.gradients.resize_with(hidden, Vec::new);
        for (layer, gradient) in self.layers.iter().zip(&mut scratch.gradients) {
            gradient.resize(blocks * layer.outputs() * BLOCK, 0.0);
        }
        for block in 0..blocks {
            for index in (0..hidden).rev() {
                let (before, after) = scratch.gradients.split_at_mut(index + 1);
                let layer = &self.layers[index + 1];
                let d = part(after.first().map_or(d, Vec::as_slice), block, layer.outputs());
                let weight = Columns { values: &layer.weight, starts: layer.inputs() };
                let outputs = part(&tape.0[index], block, layer.inputs());
                let gradient = part_mut(&mut before[index], block, layer.inputs());
                multiply_panel(weight, d, gradient, Then::WherePositive(outputs));
            }
        }
    }
}

/// Returns a block.
fn part(values: &[f32], block: usize, features: usize) -> &[[f32; BLOCK]] {
    &values.as_chunks().0[block * features..][..features]
}

fn part_mut(values: &mut [f32], block: usize, features: usize) -> &mut [[f32; BLOCK]] {
    &mut values.as_chunks_mut().0[block * features..][..features]
}

/// Computes the gradients of a layer from its inputs and the gradient `d` of its products.
fn layer_gradient([outputs, inputs]: [usize; 2], x: &[f32], d: &[f32], scratch: &mut Vec<Panels>) -> ReluLayer {
    let index = scratch.iter().position(|panels| panels.outputs() == inputs).unwrap_or_else(|| {
        scratch.push(Panels::new(0, inputs, |_, _| 0.0));
        scratch.len() - 1
    });
    let panels = &mut scratch[index];
    panels.fill_blocks(x);
    let segment = |block| Segment { offset: block * outputs * BLOCK, length: BLOCK };
    let segments: Vec<Segment> = (0..d.len() / (outputs * BLOCK)).map(segment).collect();
    let mut gradient = ReluLayer { weight: vec![0.0; outputs * inputs], bias: vec![0.0; outputs] };
    let rows = Rows { values: d, starts: BLOCK, segments: &segments };
    multiply(outputs, rows, panels, (&mut gradient.weight, inputs));
    for block in d.as_chunks::<BLOCK>().0.chunks_exact(outputs) {
        for (sum, values) in gradient.bias.iter_mut().zip(block) {
            *sum = values.iter().fold(*sum, |sum, value| sum + value);
        }
    }
    gradient
}

impl Panels {
    /// Replaces the matrix by the rows of blocks, whose features are the columns.
    ///
    /// # Shapes
    /// `blocks` is `[blocks, outputs, BLOCK]`; the matrix has `blocks * BLOCK` rows.
    fn fill_blocks(&mut self, blocks: &[f32]) {
        let size = self.outputs() * BLOCK;
        self.resize(blocks.len() / self.outputs());
        let (outputs, inputs) = (self.outputs(), self.inputs());
        for (index, panel) in self.elements.chunks_exact_mut(inputs.max(1)).enumerate() {
            let first = index * WIDTH;
            let width = WIDTH.min(outputs - first);
            for (block, rows) in blocks.chunks_exact(size).zip(panel.as_chunks_mut::<BLOCK>().0) {
                let mut square = [0.0; BLOCK * WIDTH];
                transpose((&block[first * BLOCK..][..width * BLOCK], BLOCK), (&mut square, WIDTH));
                for (lanes, values) in rows.as_flattened_mut().iter_mut().zip(square.as_chunks().0) {
                    lanes.0 = *values;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blocks::write_blocks;

    fn values(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7 + seed) * 37 % 101) as f32 / 50.0 - 1.0).collect()
    }

    fn blocks(rows: &[f32], features: usize) -> Vec<f32> {
        let mut blocks = vec![0.0; rows.len().div_ceil(features * BLOCK) * features * BLOCK];
        write_blocks(rows, features, &mut blocks, features, 0);
        blocks
    }

    /// The element of blocks at a row.
    fn at(blocks: &[f32], features: usize, row: usize, feature: usize) -> f64 {
        f64::from(blocks[(row / BLOCK * features + feature) * BLOCK + row % BLOCK])
    }

    /// The outputs of a row in double precision.
    fn outputs(layers: &[ReluLayer], x: &[f64]) -> Vec<f64> {
        layers.iter().enumerate().fold(x.to_vec(), |x, (index, layer)| {
            let product = |(row, bias): (&[f32], &f32)| {
                let sum = row.iter().zip(&x).map(|(w, x)| f64::from(*w) * x).sum::<f64>() + f64::from(*bias);
                if index + 1 < layers.len() { sum.max(0.0) } else { sum }
            };
            layer.weight.chunks(x.len()).zip(&layer.bias).map(product).collect()
        })
    }

    /// The sum of all outputs, each times its gradient.
    fn objective(layers: &[ReluLayer], x: &[f32], d: &[f32], widths: [usize; 2]) -> f64 {
        let rows = x.chunks(widths[0]).zip(d.chunks(widths[1]));
        let row = |(x, d): (&[f32], &[f32])| -> f64 {
            let x: Vec<f64> = x.iter().map(|x| f64::from(*x)).collect();
            outputs(layers, &x).iter().zip(d).map(|(y, d)| y * f64::from(*d)).sum()
        };
        rows.map(row).sum()
    }

    #[test]
    fn outputs_and_gradients_match_the_definition() {
        for (rows, widths) in [(1, vec![1, 1]), (33, vec![5, 37, 3]), (70, vec![33, 20, 49, 2])] {
            let layer =
                |pair: &[usize]| ReluLayer { weight: values(pair[0] * pair[1], pair[1]), bias: values(pair[1], 5) };
            let layers: Vec<ReluLayer> = widths.windows(2).map(layer).collect();
            let [inputs, last] = [widths[0], widths[widths.len() - 1]];
            let (x, d) = (values(rows * inputs, 1), values(rows * last, 2));
            let (in_blocks, d_blocks) = (blocks(&x, inputs), blocks(&d, last));
            let network = ReluNetwork::new(layers.clone());
            let (mut tape, mut scratch) = (ReluTape::default(), ReluScratch::default());
            // The second pass uses the memory of the first.
            for _ in 0..2 {
                let y = network.forward(&in_blocks, &mut tape);
                for (row, x) in x.chunks(inputs).enumerate() {
                    let x: Vec<f64> = x.iter().map(|x| f64::from(*x)).collect();
                    for (output, expected) in outputs(&layers, &x).iter().enumerate() {
                        assert!((at(y, last, row, output) - expected).abs() < 1e-3, "row {row}, output {output}");
                    }
                }
            }
            let base = |layers: &[ReluLayer], x: &[f32]| objective(layers, x, &d, [inputs, last]);
            let step = 1e-3f32;
            let close = |found: f64, more: f64, less: f64| {
                let expected = (more - less) / (2.0 * f64::from(step));
                // A step across the edge of a ReLU changes the quotient.
                assert!((found - expected).abs() < 2e-2 * expected.abs().max(5.0), "{found}, expected {expected}");
            };
            let of_x = network.input_gradient(&tape, &d_blocks, 0..inputs, &mut scratch).to_vec();
            let last_inputs = inputs / 2..inputs;
            let of_last = network.input_gradient(&tape, &d_blocks, last_inputs.clone(), &mut scratch);
            let blocks = of_x.chunks_exact(inputs * BLOCK).map(|block| &block[last_inputs.start * BLOCK..]);
            assert_eq!(of_last, blocks.collect::<Vec<_>>().concat(), "a range has the same values");
            for i in (0..x.len()).step_by(17) {
                let [mut more, mut less] = [x.clone(), x.clone()];
                more[i] += step;
                less[i] -= step;
                close(at(&of_x, inputs, i / inputs, i % inputs), base(&layers, &more), base(&layers, &less));
            }
            let gradients = network.weight_gradients(&in_blocks, &tape, &d_blocks, &mut scratch);
            for (index, gradient) in gradients.iter().enumerate() {
                let changed = |change: &dyn Fn(&mut ReluLayer)| {
                    let mut layers = layers.clone();
                    change(&mut layers[index]);
                    base(&layers, &x)
                };
                for i in (0..gradient.weight.len()).step_by(31) {
                    let [more, less] = [step, -step].map(|step| changed(&|layer| layer.weight[i] += step));
                    close(f64::from(gradient.weight[i]), more, less);
                }
                for i in 0..gradient.bias.len() {
                    let [more, less] = [step, -step].map(|step| changed(&|layer| layer.bias[i] += step));
                    close(f64::from(gradient.bias[i]), more, less);
                }
            }
        }
    }
}
