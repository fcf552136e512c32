//! Conversion of layers to the parameter layouts of the CPU kernels in `swm-kernels`.

use super::norm::BatchNorm;
use super::parameters::{Named, host};
use super::positions::{Resampling, positions};
use super::vit::{Layer, Projection};
use super::{BatchStatistics, Conv, LayerNorm, Linear, Projector, Vit};
use burn::tensor::{Device, Tensor, TensorData};
use swm_kernels::{
    Affine, ChannelStatistics, ConvEncoder, ConvParameters, ConvSizes, ConvStage, Norm, Panels, VitEncoder,
    VitGradient, VitLayerParameters, VitParameters,
};

/// Converts a linear layer to [`Panels`].
pub(crate) fn panels(layer: &Linear) -> Panels {
    let [outputs, _] = layer.weight.dims();
    output_panels(layer, 0..outputs)
}

/// Converts a range of the outputs of a linear layer to [`Panels`].
pub(crate) fn output_panels(layer: &Linear, range: std::ops::Range<usize>) -> Panels {
    let ([_, inputs], weight) = (layer.weight.dims(), host(layer.weight.val()));
    let panels = Panels::new(inputs, range.len(), |i, o| weight[(range.start + o) * inputs + i]);
    match &layer.bias {
        Some(bias) => panels.with_bias(&host(bias.val())[range]),
        None => panels,
    }
}

/// Converts the two layers of a projector to [`Panels`]. The first layer includes the batch normalisation.
pub(crate) fn projector_panels(projector: &Projector) -> [Panels; 2] {
    let (first, norm) = (&projector.net._0, &projector.net._1);
    let scale = host(norm.weight.val() / (norm.running_var.val() + BatchNorm::EPSILON).sqrt());
    let shift = match &first.bias {
        Some(bias) => bias.val() - norm.running_mean.val(),
        None => -norm.running_mean.val(),
    };
    let bias: Vec<f32> = (host(shift).iter().zip(&scale).zip(host(norm.bias.val())))
        .map(|((shift, scale), bias)| shift * scale + bias)
        .collect();
    let ([outputs, inputs], weight) = (first.weight.dims(), host(first.weight.val()));
    [Panels::new(inputs, outputs, |i, o| weight[o * inputs + i] * scale[o]).with_bias(&bias), panels(&projector.net._3)]
}

/// Converts a layer normalisation.
pub(crate) fn norm(layer: &LayerNorm) -> Norm {
    Norm::new(norm_parameters(layer), layer.epsilon() as f32)
}

/// Converts a vision transformer for images of `patches` patches; returns `None` for a transformer without layers.
pub(crate) fn vit_encoder(vit: &Vit, patches: usize) -> Option<VitEncoder> {
    let heads = vit.encoder.layer.first()?.attention.heads();
    Some(VitEncoder::new(&vit_parameters(vit, patches), heads, vit.layernorm.epsilon() as f32))
}

/// Converts a vision transformer for training on images of `patches` patches; returns `None` if the learnt position
/// embeddings are for another number of patches.
pub(crate) fn vit_gradient(vit: &Vit, patches: usize) -> Option<VitGradient> {
    let [_, learnt, _] = vit.embeddings.position_embeddings.dims();
    let heads = vit.encoder.layer.first()?.attention.heads();
    (learnt == 1 + patches)
        .then(|| VitGradient::new(&vit_parameters(vit, patches), heads, vit.layernorm.epsilon() as f32))
}

/// Returns the gradients of a vision transformer under the parameter names of [`Vit`].
pub(crate) fn named_vit_gradients(gradients: VitParameters) -> Named<Vec<f32>> {
    let dim = gradients.norm.bias.len();
    let mut named = Named::new();
    named.insert("embeddings.cls_token".to_owned(), gradients.positions[..dim].to_vec());
    named.insert("embeddings.position_embeddings".to_owned(), gradients.positions);
    let mut insert = |name: &str, affine: Affine| {
        named.insert(format!("{name}.weight"), affine.weight);
        named.insert(format!("{name}.bias"), affine.bias);
    };
    insert("embeddings.patch_embeddings.projection", gradients.patches);
    insert("layernorm", gradients.norm);
    for (index, layer) in gradients.layers.into_iter().enumerate() {
        for (part, affine) in [
            ("layernorm_before", layer.norm_before),
            ("attention.attention.query", layer.query),
            ("attention.attention.key", layer.key),
            ("attention.attention.value", layer.value),
            ("attention.output.dense", layer.attention_output),
            ("layernorm_after", layer.norm_after),
            ("intermediate.dense", layer.intermediate),
            ("output.dense", layer.output),
        ] {
            insert(&format!("encoder.layer.{index}.{part}"), affine);
        }
    }
    named
}

fn vit_parameters(vit: &Vit, patches: usize) -> VitParameters {
    let embeddings = &vit.embeddings;
    let Projection { weight, bias } = &embeddings.patch_embeddings.projection;
    let mut learnt = host(positions(embeddings.position_embeddings.val(), patches, Resampling::Bicubic));
    swm_kernels::functions::add(&mut learnt, &host(embeddings.cls_token.val()));
    VitParameters {
        patches: Affine { weight: host(weight.val()), bias: host(bias.val()) },
        positions: learnt,
        layers: vit.encoder.layer.iter().map(layer_parameters).collect(),
        norm: norm_parameters(&vit.layernorm),
    }
}

fn layer_parameters(layer: &Layer) -> VitLayerParameters {
    let parts = &layer.attention.attention;
    VitLayerParameters {
        norm_before: norm_parameters(&layer.layernorm_before),
        query: linear_parameters(&parts.query),
        key: linear_parameters(&parts.key),
        value: linear_parameters(&parts.value),
        attention_output: linear_parameters(&layer.attention.output.dense),
        norm_after: norm_parameters(&layer.layernorm_after),
        intermediate: linear_parameters(&layer.intermediate.dense),
        output: linear_parameters(&layer.output.dense),
    }
}

/// Converts a convolutional encoder for images with a side of `side` pixels.
pub(crate) fn conv_encoder(conv: &Conv, side: usize) -> ConvEncoder {
    let running = conv.stages.iter().map(|stage| ChannelStatistics {
        mean: host(stage.norm.running_mean.val()),
        variance: host(stage.norm.running_var.val()),
    });
    ConvEncoder::new(&conv_sizes(conv, side), &conv_parameters(conv), &running.collect::<Vec<_>>())
}

/// Returns the sizes of a convolutional encoder for images with a side of `side` pixels.
pub(crate) fn conv_sizes(conv: &Conv, side: usize) -> ConvSizes {
    ConvSizes {
        side,
        channels: conv.stages.iter().map(|stage| stage.conv.weight.dims()[0]).collect(),
        hidden: conv.hidden.as_ref().map_or(0, |hidden| hidden.weight.dims()[0]),
        dim: conv.out.weight.dims()[0],
    }
}

/// Returns the sizes of the convolutions of an encoder, without its linear layers.
pub(crate) fn cell_sizes(conv: &Conv, side: usize) -> ConvSizes {
    ConvSizes { hidden: 0, dim: 0, ..conv_sizes(conv, side) }
}

/// Copies the parameters of a convolutional encoder.
pub(crate) fn conv_parameters(conv: &Conv) -> ConvParameters {
    let stages = conv.stages.iter().map(|stage| ConvStage {
        weight: host(stage.conv.weight.val()),
        norm: Affine { weight: host(stage.norm.weight.val()), bias: host(stage.norm.bias.val()) },
    });
    let linear = conv.hidden.iter().chain([&conv.out]).map(linear_parameters);
    ConvParameters { stages: stages.collect(), linear: linear.collect() }
}

/// Returns the gradients of a convolutional encoder under the parameter names of [`Conv`].
pub(crate) fn named_conv_gradients(gradients: ConvParameters) -> Named<Vec<f32>> {
    let mut named = Named::new();
    for (index, stage) in gradients.stages.into_iter().enumerate() {
        named.insert(format!("stages.{index}.conv.weight"), stage.weight);
        named.insert(format!("stages.{index}.norm.weight"), stage.norm.weight);
        named.insert(format!("stages.{index}.norm.bias"), stage.norm.bias);
    }
    for (name, layer) in ["out", "hidden"].into_iter().zip(gradients.linear.into_iter().rev()) {
        named.insert(format!("{name}.weight"), layer.weight);
        named.insert(format!("{name}.bias"), layer.bias);
    }
    named
}

/// Converts batch statistics to tensors.
pub(crate) fn batch_statistics(all: Vec<ChannelStatistics>, device: &Device) -> Vec<BatchStatistics> {
    let tensor = |values: Vec<f32>| {
        let shape = [values.len()];
        Tensor::from_data(TensorData::new(values, shape), device)
    };
    all.into_iter().map(|batch| BatchStatistics::new(tensor(batch.mean), tensor(batch.variance))).collect()
}

fn norm_parameters(layer: &LayerNorm) -> Affine {
    Affine { weight: host(layer.weight.val()), bias: host(layer.bias.val()) }
}

fn linear_parameters(layer: &Linear) -> Affine {
    let [outputs, _] = layer.weight.dims();
    let bias = layer.bias.as_ref().map_or_else(|| vec![0.0; outputs], |bias| host(bias.val()));
    Affine { weight: host(layer.weight.val()), bias }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{ConvConfig, Init, VitConfig, conv::store, parameters};
    use burn::module::Module;
    use swm_core::Key;

    #[test]
    fn cpu_vit_encoder_matches_the_module_for_one_and_three_threads() {
        let sizes = VitConfig { patch: 2, dim: 24, depth: 2, heads: 3, mlp: 40 };
        // The 50 tokens need two blocks of the kernel. The image has more patches than there are learnt positions, so
        // the positions are resampled.
        let (patches, elements) = (49, 12);
        let vit = sizes.init(&Init::new(Key::new(1), &Device::flex()), 12);
        let encoder = vit_encoder(&vit, patches).expect("creating the CPU encoder");
        let image: Vec<f32> = (0..patches * elements).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
        let on = |threads: usize| {
            swm_core::pool::threads(threads).expect("creating the thread pool").install(|| encoder.encode(&image))
        };
        let class = on(1);
        assert_eq!(class, on(3));
        let input = Tensor::from_data(TensorData::new(image.clone(), [1, patches, elements]), &Device::flex());
        for (actual, expected) in class.iter().zip(host(vit.forward(input))) {
            assert!((actual - expected).abs() < 1e-4, "{actual}, expected {expected}");
        }
    }

    #[test]
    fn cpu_kernels_of_a_convolutional_encoder_match_the_module() {
        let (side, images) = (10, 5);
        for hidden in [0, 7] {
            let sizes = ConvConfig { channels: vec![5, 18], hidden, dim: 6 };
            let mut conv = sizes.init(&Init::new(Key::new(1), &Device::flex()), side);
            let pixels: Vec<f32> = (0..images * side * side * 3).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
            let input =
                Tensor::<3>::from_data(TensorData::new(pixels.clone(), [images, side * side, 3]), &Device::flex());
            let close = |name: &str, actual: &[f32], expected: Vec<f32>| {
                let largest = expected.iter().fold(1e-6f32, |largest, value| largest.max(value.abs()));
                assert_eq!(actual.len(), expected.len(), "{name}");
                for (actual, expected) in actual.iter().zip(expected) {
                    assert!((actual - expected).abs() < 1e-4 * largest, "{name}: {actual}, expected {expected}");
                }
            };
            // The features and the gradients of a training batch.
            let mut kernels = conv.kernels(side);
            kernels.load(&conv_parameters(&conv));
            let trained = conv.clone().train();
            let (features, statistics) = trained.forward_train(input.clone().autodiff());
            close("features", &kernels.forward(&pixels), host(features.clone().inner()));
            let gradients = parameters::gradients(&trained, &features.clone().square().sum().backward());
            let d: Vec<f32> = host(features.inner()).iter().map(|feature| 2.0 * feature).collect();
            let actual = named_conv_gradients(kernels.backward(&pixels, &d));
            assert_eq!(actual.keys().collect::<Vec<_>>(), gradients.keys().collect::<Vec<_>>());
            for (name, gradient) in gradients {
                close(&name, &actual[&name], host(gradient));
            }
            let (mut actual, mut expected) = (Named::new(), Named::new());
            store(batch_statistics(kernels.statistics(), &Device::flex()), "", &mut actual);
            store(statistics, "", &mut expected);
            for (name, expected) in &expected {
                close(name, &host(actual[name].clone()), host(expected.clone()));
            }
            // The features of single images with the running statistics.
            conv.track("", &mut actual);
            let encoder = conv_encoder(&conv, side);
            let features: Vec<f32> = pixels.chunks(side * side * 3).flat_map(|image| encoder.encode(image)).collect();
            close("features with running statistics", &features, host(conv.forward(input)));
        }
    }

    #[test]
    fn cpu_kernels_of_the_cells_of_a_feature_map_match_the_module() {
        let (side, images) = (10, 40);
        let conv = ConvConfig { channels: vec![5, 18], hidden: 0, dim: 6 };
        let conv = conv.init(&Init::new(Key::new(2), &Device::flex()), side).train();
        let pixels: Vec<f32> = (0..images * side * side * 3).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
        let input = Tensor::<3>::from_data(TensorData::new(pixels.clone(), [images, side * side, 3]), &Device::flex());
        let close = |name: &str, actual: &[f32], expected: Vec<f32>| {
            let largest = expected.iter().fold(1e-6f32, |largest, value| largest.max(value.abs()));
            assert_eq!(actual.len(), expected.len(), "{name}");
            for (actual, expected) in actual.iter().zip(expected) {
                assert!((actual - expected).abs() < 1e-4 * largest, "{name}: {actual}, expected {expected}");
            }
        };
        let (cells, _) = conv.cells_train(input.autodiff());
        let values = host(cells.clone().inner());
        let mut kernels = conv.cell_kernels(side);
        kernels.load(&conv_parameters(&conv));
        close("cells", &kernels.forward(&pixels), values.clone());
        let d: Vec<f32> = values.iter().map(|cell| 2.0 * cell + 1.0).collect();
        let actual = named_conv_gradients(kernels.backward(&pixels, &d));
        let expected = parameters::gradients(&conv, &(cells.clone().square().sum() + cells.sum()).backward());
        assert_eq!(actual.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
        for (name, gradient) in expected {
            close(&name, &actual[&name], host(gradient));
        }
    }
}
