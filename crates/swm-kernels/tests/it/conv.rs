//! The convolutional encoder against its definition in double precision.

use swm_kernels::{Affine, ChannelStatistics, ConvEncoder, ConvGradient, ConvParameters, ConvSizes, ConvStage};
use swm_simd::{CpuLevel, limit_cpu_level};

/// A feature map in double precision, `[channels, side, side]`.
type Map = Vec<f64>;

/// Returns values between -0.5 and 0.5 without a simple period.
fn values(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f32 / 10_007.0 - 0.5).collect()
}

fn scaled(count: usize, seed: usize, scale: f32) -> Vec<f32> {
    values(count, seed).into_iter().map(|value| value * scale).collect()
}

fn parameters(sizes: &ConvSizes) -> ConvParameters {
    let mut inputs = 3;
    let stages = (sizes.channels.iter().enumerate())
        .map(|(index, &channels)| {
            let count = channels * inputs * 9;
            let scale = 4.0 / ((inputs * 9) as f32).sqrt();
            inputs = channels;
            let norm = Affine {
                weight: scaled(channels, index + 10, 0.6).into_iter().map(|value| value + 1.0).collect(),
                bias: scaled(channels, index + 20, 0.8),
            };
            ConvStage { weight: scaled(count, index, scale), norm }
        })
        .collect();
    let mut inputs = inputs * sizes.map().pow(2);
    let features = [sizes.hidden, sizes.dim].into_iter().filter(|features| *features > 0);
    let linear = features
        .map(|features| {
            let weight = scaled(features * inputs, features, 3.0 / (inputs as f32).sqrt());
            inputs = features;
            Affine { weight, bias: scaled(features, features + 1, 0.4) }
        })
        .collect();
    ConvParameters { stages, linear }
}

/// A 3 x 3 convolution with stride 2 and padding 1, by its definition.
fn convolve(x: &Map, side: usize, weight: &[f32], outputs: usize) -> (Map, usize) {
    let (inputs, out) = (x.len() / (side * side), side.div_ceil(2));
    let mut y = vec![0.0; outputs * out * out];
    for (index, y) in y.iter_mut().enumerate() {
        let (output, row, column) = (index / (out * out), index / out % out, index % out);
        for (tap, weight) in weight[output * inputs * 9..][..inputs * 9].iter().enumerate() {
            let (input, ky, kx) = (tap / 9, tap / 3 % 3, tap % 3);
            let (row, column) = ((2 * row + ky).wrapping_sub(1), (2 * column + kx).wrapping_sub(1));
            if row < side && column < side {
                *y += f64::from(*weight) * x[(input * side + row) * side + column];
            }
        }
    }
    (y, out)
}

/// Computes the features of a batch by their definition. Without `running` statistics, the normalisations use the
/// statistics of the batch, which are returned.
fn features(
    sizes: &ConvSizes,
    parameters: &ConvParameters,
    images: &[f32],
    running: Option<&[ChannelStatistics]>,
) -> (Vec<f64>, Vec<[Vec<f64>; 2]>) {
    let mut side = sizes.side;
    let pixels = side * side;
    let planes = |image: &[f32]| (0..3 * pixels).map(|i| f64::from(image[i % pixels * 3 + i / pixels])).collect();
    let mut maps: Vec<Map> = images.chunks(3 * pixels).map(planes).collect();
    let mut statistics = vec![];
    for (index, stage) in parameters.stages.iter().enumerate() {
        let channels = stage.norm.bias.len();
        let all: Vec<_> = maps.iter().map(|map| convolve(map, side, &stage.weight, channels)).collect();
        side = all[0].1;
        maps = all.into_iter().map(|(map, _)| map).collect();
        let count = (maps.len() * side * side) as f64;
        let mut both = [vec![], vec![]];
        for channel in 0..channels {
            let range = channel * side * side..(channel + 1) * side * side;
            let all = || maps.iter().flat_map(|map| map[range.clone()].iter());
            let (mean, variance) = match running {
                Some(running) => (f64::from(running[index].mean[channel]), f64::from(running[index].variance[channel])),
                None => {
                    let mean = all().sum::<f64>() / count;
                    (mean, all().map(|y| (y - mean).powi(2)).sum::<f64>() / count)
                }
            };
            both[0].push(mean);
            both[1].push(variance * count / (count - 1.0));
            let scale = f64::from(stage.norm.weight[channel]) / (variance + 1e-5).sqrt();
            for y in maps.iter_mut().flat_map(|map| map[range.clone()].iter_mut()) {
                *y = ((*y - mean) * scale + f64::from(stage.norm.bias[channel])).max(0.0);
            }
        }
        statistics.push(both);
    }
    for (index, affine) in parameters.linear.iter().enumerate() {
        for map in &mut maps {
            *map = (affine.weight.chunks(map.len()).zip(&affine.bias))
                .map(|(row, bias)| {
                    f64::from(*bias) + row.iter().zip(map.iter()).map(|(w, x)| f64::from(*w) * x).sum::<f64>()
                })
                .map(|y| if index + 1 < parameters.linear.len() { y.max(0.0) } else { y })
                .collect();
        }
    }
    (maps.concat(), statistics)
}

fn sizes(side: usize, channels: &[usize], hidden: usize, dim: usize) -> ConvSizes {
    ConvSizes { side, channels: channels.to_vec(), hidden, dim }
}

/// Sizes with odd sides, channels that are no multiple of a SIMD vector, one layer, and several chunks of images.
fn cases() -> Vec<(ConvSizes, usize)> {
    vec![
        (sizes(16, &[16, 32], 0, 24), 7),
        (sizes(13, &[5, 33, 20], 11, 3), 9),
        (sizes(6, &[4], 0, 1), 2),
        (sizes(4, &[3, 3], 5, 2), 70),
    ]
}

fn assert_close(what: &str, actual: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(actual.len(), expected.len(), "{what}");
    let largest = expected.iter().fold(1e-3f64, |largest, value| largest.max(value.abs()));
    for (index, (actual, expected)) in actual.iter().zip(expected).enumerate() {
        let error = (f64::from(*actual) - expected).abs() / largest;
        assert!(error < tolerance, "{what} {index}: {actual}, expected {expected}");
    }
}

fn network(sizes: &ConvSizes, parameters: &ConvParameters) -> ConvGradient {
    let mut network = ConvGradient::new(sizes);
    network.load(parameters);
    network
}

#[test]
fn features_and_statistics_of_a_batch_match_the_definition() {
    for (sizes, images) in cases() {
        let (parameters, images) = (parameters(&sizes), values(images * sizes.side.pow(2) * 3, 1));
        let mut network = network(&sizes, &parameters);
        let (expected, statistics) = features(&sizes, &parameters, &images, None);
        assert_close("feature", &network.forward(&images), &expected, 1e-5);
        for (actual, [mean, variance]) in network.statistics().iter().zip(&statistics) {
            assert_close("mean", &actual.mean, mean, 1e-5);
            assert_close("variance", &actual.variance, variance, 1e-5);
        }
        // A second batch in the same memory, with fewer images, gives the same result as the first batch alone.
        let fewer = &images[..2 * sizes.side.pow(2) * 3];
        let (expected, _) = features(&sizes, &parameters, fewer, None);
        assert_close("feature of the second batch", &network.forward(fewer), &expected, 1e-5);
    }
}

#[test]
fn encoder_matches_the_definition_with_running_statistics() {
    for (sizes, _) in cases() {
        let (parameters, image) = (parameters(&sizes), values(sizes.side.pow(2) * 3, 2));
        let running: Vec<ChannelStatistics> = (sizes.channels.iter().enumerate())
            .map(|(index, &channels)| ChannelStatistics {
                mean: scaled(channels, index, 0.5),
                variance: values(channels, index + 5).into_iter().map(|value| value + 0.8).collect(),
            })
            .collect();
        let encoder = ConvEncoder::new(&sizes, &parameters, &running);
        let (expected, _) = features(&sizes, &parameters, &image, Some(&running));
        assert_close("feature", &encoder.encode(&image), &expected, 1e-5);
        assert_close("feature of a second call", &encoder.encode(&image), &expected, 1e-5);
    }
}

/// Every array of the parameters, by name.
fn arrays(parameters: &mut ConvParameters) -> Vec<(String, &mut Vec<f32>)> {
    let mut all = vec![];
    for (index, ConvStage { weight, norm }) in parameters.stages.iter_mut().enumerate() {
        all.push((format!("stage {index} weight"), weight));
        all.push((format!("stage {index} scale"), &mut norm.weight));
        all.push((format!("stage {index} shift"), &mut norm.bias));
    }
    for (index, Affine { weight, bias }) in parameters.linear.iter_mut().enumerate() {
        all.push((format!("linear {index} weight"), weight));
        all.push((format!("linear {index} bias"), bias));
    }
    all
}

#[test]
fn gradients_match_finite_differences() {
    /// The change of a parameter: small enough that few activations change their sign.
    const STEP: f32 = 3e-6;
    for (sizes, images) in cases() {
        let (mut changed, images) = (parameters(&sizes), values(images * sizes.side.pow(2) * 3, 3));
        let mut network = network(&sizes, &changed);
        let count = network.forward(&images).len();
        let d = scaled(count, 4, 2.0);
        let mut gradients = network.backward(&images, &d);
        let loss = |parameters: &ConvParameters| -> f64 {
            let (features, _) = features(&sizes, parameters, &images, None);
            features.iter().zip(&d).map(|(feature, d)| feature * f64::from(*d)).sum()
        };
        for (array, (name, gradient)) in arrays(&mut gradients).into_iter().enumerate() {
            let largest = gradient.iter().fold(1e-3f32, |largest, value| largest.max(value.abs()));
            let count = gradient.len();
            for index in [0, count / 3, count / 2, count - 1] {
                let mut change = |by: f32| {
                    let mut all = arrays(&mut changed);
                    let old = all[array].1[index];
                    let new = old + by;
                    all[array].1[index] = new;
                    let loss = loss(&changed);
                    arrays(&mut changed)[array].1[index] = old;
                    (loss, f64::from(new))
                };
                let ((above, more), (below, less)) = (change(STEP), change(-STEP));
                let (expected, actual) = ((above - below) / (more - less), f64::from(gradient[index]));
                assert!(
                    (actual - expected).abs() < 1e-3 * f64::from(largest),
                    "{sizes:?} {name} {index}: {actual}, expected {expected}"
                );
            }
        }
    }
}

/// One test, because the CPU level is that of the process: the other tests accept the rounding of every level.
#[test]
fn bytes_do_not_depend_on_the_number_of_threads_nor_values_on_the_cpu_level() {
    let sizes = sizes(16, &[8, 16], 12, 10);
    let (parameters, images) = (parameters(&sizes), values(100 * sizes.side.pow(2) * 3, 6));
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("creating the thread pool");
        pool.install(|| {
            let mut network = network(&sizes, &parameters);
            let features = network.forward(&images);
            let gradients = network.backward(&images, &values(features.len(), 7));
            (features, network.statistics(), gradients)
        })
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_eq!(one, on(5));
    let (features, _, mut gradients) = one;
    for level in [CpuLevel::Avx2, CpuLevel::Baseline] {
        limit_cpu_level(level);
        let (lower, _, mut lower_gradients) = on(2);
        let double = |values: &[f32]| -> Vec<f64> { values.iter().map(|value| f64::from(*value)).collect() };
        assert_close("feature", &lower, &double(&features), 1e-5);
        for ((name, lower), (_, expected)) in arrays(&mut lower_gradients).into_iter().zip(arrays(&mut gradients)) {
            assert_close(&name, lower, &double(expected), 1e-3);
        }
    }
    limit_cpu_level(CpuLevel::Avx512);
}
