//! Regression of numeric columns on latents, and on a baseline such as the position of the agent.

use super::fit::{FitConfig, fit, rows};
use super::ridge::{Ridge, mean_and_std};
use super::scale::Scale;
use super::targets::{AnglePart, Target, Targets};
use super::{ImageEncoder, samples};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Init, Mlp};
use crate::train::{StepOutput, check_sizes, limits};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use swm_core::precision::NOISE;
use swm_core::run::Control;
use swm_core::{Key, Result};
use swm_data::{Part, Reader};

/// The settings of a state probe: the columns to predict and the settings of both regressions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateConfig {
    /// The seed of sampled frames, initial weights and batches.
    pub seed: u64,
    /// The columns to predict.
    pub columns: Vec<String>,
    /// The elements of columns that are angles in radians: the column and the index of the element. The sine and the
    /// cosine of an angle are predicted instead of the angle.
    pub angles: Vec<(String, usize)>,
    /// The columns of the baseline, such as the position of the agent; without columns there is no baseline.
    pub baseline: Vec<String>,
    /// The largest number of frames to fit on, from the training episodes.
    pub frames: usize,
    /// The largest number of frames to score on, from the validation episodes.
    pub held_out: usize,
    /// λ of the ridge regression.
    pub ridge: f64,
    /// The number of hidden features of the network.
    pub hidden: usize,
    /// The training of the network.
    pub fit: FitConfig,
}

impl StateConfig {
    /// Returns the default settings for `columns`, without angles and without a baseline.
    pub fn new(columns: Vec<String>) -> Self {
        let fit = FitConfig { steps: 1500, batch_size: 128, lr: 2e-3 };
        Self {
            seed: 0,
            columns,
            angles: vec![],
            baseline: vec![],
            frames: 6000,
            held_out: 2000,
            ridge: 1e-4,
            hidden: 128,
            fit,
        }
    }
}

/// The prediction errors of one element of a column, or of the sine or cosine of an angle, on held-out episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The column.
    pub column: String,
    /// The index of the element in a row of the column.
    pub index: usize,
    /// The function of an angle that was predicted; `None` for the element itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part: Option<AnglePart>,
    /// The standard deviation of the element, in the units of the column.
    pub spread: f64,
    /// The coefficient of determination: 1 for perfect predictions, 0 for predictions of the mean. `None` for a
    /// constant element.
    pub r2: Option<f64>,
    /// The root mean squared error, in the units of the column.
    pub rmse: f64,
    /// The mean absolute error, in the units of the column.
    pub mae: f64,
}

/// The scores of both regressions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StateReport {
    /// The dimension of a latent.
    pub latent: usize,
    /// Frames that were fitted on.
    pub frames: usize,
    /// Frames that were scored on.
    pub held_out: usize,
    /// The scores of the ridge regression, element by element.
    pub linear: Vec<Score>,
    /// The scores of the network with two hidden layers, element by element.
    pub network: Vec<Score>,
    /// What the columns of the baseline predict without an image.
    pub baseline: Option<Baseline>,
}

/// What the columns of the baseline predict. A latent that contains only the baseline predicts the columns as well as the
/// baseline does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// The columns of the baseline.
    pub columns: Vec<String>,
    /// The scores of a network from the baseline to the columns, element by element.
    pub network: Vec<Score>,
    /// The share of the variance of the latents that a network from the baseline to the latents explains on held-out
    /// episodes. `None` for constant latents.
    pub latent_variance: Option<f64>,
}

impl StateConfig {
    /// Checks that all sizes are in range. A batch has at least `smallest_batch` frames.
    pub(super) fn check(&self, smallest_batch: usize) -> Result<()> {
        check_sizes(&[
            ("columns", self.columns.len(), 1, limits::FEATURES),
            ("frames", self.frames, 2, limits::BATCH),
            ("held_out", self.held_out, 2, limits::BATCH),
            ("hidden", self.hidden, 1, limits::FEATURES),
            ("fit.steps", self.fit.steps, 1, limits::STEPS),
            ("fit.batch_size", self.fit.batch_size, smallest_batch, limits::BATCH),
        ])
    }
}

/// Fits a linear and a nonlinear regression of columns on an encoder's latents, and scores both on held-out episodes.
///
/// # Errors
/// When a column is missing or holds images, the images have another size than the encoder's, no episode is held out,
/// a setting is out of range, or the run is stopped ([`Error::Interrupted`](swm_core::Error::Interrupted)).
pub fn read_state(
    encoder: &dyn ImageEncoder,
    reader: &dyn Reader,
    config: &StateConfig,
    control: &mut Control<'_>,
) -> Result<StateReport> {
    config.check(1)?;
    let targets = Targets::new(reader, &config.columns, &config.angles)?;
    let baseline = Targets::new(reader, &config.baseline, &config.angles)?;
    let columns = [&config.columns[..], &config.baseline].concat();
    let key = Key::new(config.seed).with("probe");
    let tables = |part, count| -> Result<Tables> {
        let samples = samples::sample(encoder, reader, part, &columns, false, (count, key.with("frames")))?;
        Ok(Tables::new(samples, &targets, &baseline))
    };
    let train = tables(Part::Train, config.frames)?;
    let held_out = tables(Part::Validation, config.held_out)?;

    let score = |predictions: &[f32]| scores(&targets.list, predictions, &held_out.targets);
    let network =
        |x: &[f32], y: &[f32], key, control: &mut Control<'_>| Network::fit((x, y, train.count), config, key, control);
    let baseline = if config.baseline.is_empty() {
        None
    } else {
        let to_targets = network(&train.baseline, &train.targets, key.with("baseline"), control)?;
        let to_latents = network(&train.baseline, &train.latents, key.with("latents of the baseline"), control)?;
        let predicted = to_latents.predict(&held_out.baseline);
        Some(Baseline {
            columns: config.baseline.clone(),
            network: score(&to_targets.predict(&held_out.baseline)),
            latent_variance: explained_variance(&predicted, &held_out.latents, held_out.count),
        })
    };
    let ridge = Ridge::fit(&train.latents, &train.targets, train.count, config.ridge, control)?;
    Ok(StateReport {
        latent: encoder.latent_dim(),
        frames: train.count,
        held_out: held_out.count,
        linear: score(&ridge.predict(&held_out.latents)),
        network: score(&network(&train.latents, &train.targets, key, control)?.predict(&held_out.latents)),
        baseline,
    })
}

/// The values of one split of a dataset, a row for each frame.
struct Tables {
    count: usize,
    latents: Vec<f32>,
    targets: Vec<f32>,
    baseline: Vec<f32>,
}

impl Tables {
    /// Splits samples of the columns of the targets and the baseline.
    fn new(samples: samples::Samples, targets: &Targets, baseline: &Targets) -> Self {
        let width = targets.width + baseline.width;
        let columns = &samples.targets;
        Self {
            count: samples.count,
            targets: targets.of(columns, width, 0),
            baseline: baseline.of(columns, width, targets.width),
            latents: samples.latents,
        }
    }
}

/// The nonlinear regression.
pub(super) struct Network {
    model: Mlp,
    from: Scale,
    to: Scale,
}

impl Network {
    /// Fits the regression of `y` on `x`.
    ///
    /// # Shapes
    /// `x` is `[count, inputs]`, `y` is `[count, outputs]`.
    pub fn fit(
        (x, y, count): (&[f32], &[f32], usize),
        config: &StateConfig,
        key: Key,
        control: &mut Control<'_>,
    ) -> Result<Self> {
        let (from, to) = (Scale::of(x, count), Scale::of(y, count));
        let (x, y) = (from.apply(x), to.apply(y));
        let (inputs, outputs) = (from.width(), to.width());
        let model = Mlp::new(&Init::new(key.with("init"), &Device::flex()), inputs, config.hidden, outputs);
        let step = |model: &Mlp, indices: &[usize]| {
            let trained = model.clone().train();
            let error = trained.forward(rows(&x, inputs, indices).autodiff()) - rows(&y, outputs, indices).autodiff();
            let loss = error.square().mean();
            let metrics = vec![("loss", f64::from(loss.clone().inner().into_scalar::<f32>()))];
            let gradients = parameters::gradients(&trained, &loss.backward());
            Ok(StepOutput { metrics, gradients, ..StepOutput::default() })
        };
        let (model, _) = fit(model, config.fit, count, key.with("batches"), step, |_, _| (), control)?;
        Ok(Self { model, from, to })
    }

    pub fn predict(&self, x: &[f32]) -> Vec<f32> {
        let width = self.from.width();
        let x = self.from.apply(x);
        let chunks: Vec<Vec<f32>> = x
            .par_chunks(256 * width)
            .map(|x| {
                let x = TensorData::new(x.to_vec(), [x.len() / width, width]);
                self.model.forward(Tensor::from_data(x, &Device::flex())).into_data().into_f32_vec()
            })
            .collect();
        let mut predictions = chunks.concat();
        self.to.undo(&mut predictions);
        predictions
    }
}

/// The standard deviation, beside the largest one of a column, up to which an element is constant but for rounding.
const ROUNDING: f64 = 1e-12;

/// Whether each target varies by more than noise, by the standard deviations of all targets.
pub(super) fn varying(targets: &[Target], spread: &[f64]) -> Vec<bool> {
    let mut largest: BTreeMap<&str, f64> = BTreeMap::new();
    for (target, spread) in targets.iter().zip(spread) {
        let most = largest.entry(&target.column).or_default();
        *most = most.max(*spread);
    }
    let noise = |target: &Target| NOISE.max(ROUNDING * largest[target.column.as_str()]);
    targets.iter().zip(spread).map(|(target, spread)| *spread > noise(target)).collect()
}

/// Scores predictions of targets.
///
/// # Shapes
/// `predictions` and `values` are `[rows, targets.len()]`.
pub(super) fn scores(targets: &[Target], predictions: &[f32], values: &[f32]) -> Vec<Score> {
    let (width, count) = (targets.len(), (values.len() / targets.len()) as f64);
    let (_, spread) = mean_and_std(values, values.len() / width);
    let varies = varying(targets, &spread);
    let score = |(i, Target { column, index, part }): (usize, &Target)| {
        let errors = || predictions.iter().zip(values).skip(i).step_by(width).map(|(a, b)| f64::from(a - b));
        let square = errors().map(|e| e * e).sum::<f64>() / count;
        let (column, index, part, spread) = (column.clone(), *index, *part, spread[i]);
        let r2 = varies[i].then(|| 1.0 - square / spread.powi(2));
        let (rmse, mae) = (square.sqrt(), errors().map(f64::abs).sum::<f64>() / count);
        Score { column, index, part, spread, r2, rmse, mae }
    };
    targets.iter().enumerate().map(score).collect()
}

/// Returns the share of the variance of `rows` values, summed over their dimensions, that predictions explain; `None` for
/// constant values.
///
/// # Shapes
/// `predictions` and `values` are `[rows, dim]`.
fn explained_variance(predictions: &[f32], values: &[f32], rows: usize) -> Option<f64> {
    let (_, std) = mean_and_std(values, rows);
    let variance = std.iter().map(|std| std * std).sum::<f64>() * rows as f64;
    let error: f64 = predictions.iter().zip(values).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    (variance > 0.0).then(|| 1.0 - error / variance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_are_in_column_units_and_constants_have_no_r2() {
        let names = [0, 1].map(|index| Target { column: "x".to_owned(), index, part: None });
        let (predictions, targets) = ([1.0, 5.0, 2.0, 5.0, 6.0, 5.0], [0.0, 5.0, 3.0, 5.0, 6.0, 5.0]);
        let scores = scores(&names, &predictions, &targets);
        assert!((scores[0].mae - 2.0 / 3.0).abs() < 1e-9 && (scores[0].rmse - (2.0f64 / 3.0).sqrt()).abs() < 1e-9);
        // The variance of 0, 3, 6 is 6.
        assert!((scores[0].r2.expect("a coefficient of determination") - (1.0 - 2.0 / 3.0 / 6.0)).abs() < 1e-9);
        assert!(scores[1].r2.is_none() && scores[1].mae == 0.0);
    }

    #[test]
    fn values_of_any_unit_are_scored_alike() {
        let names = [Target { column: "x".to_owned(), index: 0, part: None }];
        let score = |unit: f32| {
            let [predictions, targets] = [[1.0, 2.0, 6.0], [0.0, 3.0, 6.0]].map(|values| values.map(|v: f32| v * unit));
            scores(&names, &predictions, &targets)[0].r2.expect("the values vary")
        };
        assert!((score(1.0) - score(1e-12)).abs() < 1e-5);
        // A third has no exact mean in binary.
        assert!(scores(&names, &[1.0; 3], &[1.0 / 3.0; 3])[0].r2.is_none());
        // Rounding errors beside a position.
        let names = [0, 1].map(|index| Target { column: "x".to_owned(), index, part: None });
        let values = [0.0, 1e-17, 3.0, -2e-17, 6.0, 1e-17];
        let known = |values: &[f32]| -> Vec<bool> {
            scores(&names, &vec![0.0; values.len()], values).iter().map(|score| score.r2.is_some()).collect()
        };
        assert_eq!(known(&values), [true, false]);
        // A large constant hides no element.
        assert_eq!(known(&[0.0, 1e30, 3.0, 1e30]), [true, false]);
    }

    #[test]
    fn explained_variance_is_summed_over_dimensions() {
        // Variances of 1 and 4; the predictions are exact for the first dimension and the mean for the second.
        let values = [0.0, 0.0, 2.0, 4.0];
        let explained = explained_variance(&[0.0, 2.0, 2.0, 2.0], &values, 2).expect("the values vary");
        assert!((explained - 0.2).abs() < 1e-9, "{explained}");
        assert!(explained_variance(&[1.0; 4], &[1.0; 4], 2).is_none());
    }
}
