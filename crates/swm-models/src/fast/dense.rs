//! Linear layers as [`Panels`].

use super::Panels;
use super::numbers;
use crate::nn::norm::BatchNorm;
use crate::nn::{Linear, Projector};

/// The matrix and bias of a linear layer.
pub fn dense(layer: &Linear) -> Panels {
    let [outputs, _] = layer.weight.dims();
    part(layer, 0..outputs)
}

/// Some outputs of a linear layer.
pub fn part(layer: &Linear, range: std::ops::Range<usize>) -> Panels {
    let ([_, inputs], weight) = (layer.weight.dims(), numbers(layer.weight.val()));
    let panels = Panels::new(inputs, range.len(), |i, o| weight[(range.start + o) * inputs + i]);
    match &layer.bias {
        Some(bias) => panels.with_bias(&numbers(bias.val())[range]),
        None => panels,
    }
}

/// The two layers of a projection, the normalisation between them folded into the first.
pub fn folded(projector: &Projector) -> [Panels; 2] {
    let (first, norm) = (&projector.net._0, &projector.net._1);
    let scale = numbers(norm.weight.val() / (norm.running_var.val() + BatchNorm::EPSILON).sqrt());
    let shift = match &first.bias {
        Some(bias) => bias.val() - norm.running_mean.val(),
        None => -norm.running_mean.val(),
    };
    let bias: Vec<f32> = (numbers(shift).iter().zip(&scale).zip(numbers(norm.bias.val())))
        .map(|((shift, scale), bias)| shift * scale + bias)
        .collect();
    let ([outputs, inputs], weight) = (first.weight.dims(), numbers(first.weight.val()));
    [Panels::new(inputs, outputs, |i, o| weight[o * inputs + i] * scale[o]).with_bias(&bias), dense(&projector.net._3)]
}
