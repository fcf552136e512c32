//! Regression of numeric columns on latents.

use super::fit::{FitConfig, fit, rows};
use super::ridge::{Ridge, mean_and_std};
use super::scale::Scale;
use super::{ImageEncoder, samples};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Init, Mlp};
use crate::train::{StepOutput, check_sizes, limits};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};
use swm_data::{Part, Reader};

/// The settings of a state probe: the columns to predict and the settings of both regressions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateConfig {
    /// The seed of sampled frames, initial weights and batches.
    pub seed: u64,
    /// The columns to predict.
    pub columns: Vec<String>,
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
    /// Returns the default settings for `columns`.
    pub fn new(columns: Vec<String>) -> Self {
        let fit = FitConfig { steps: 1500, batch_size: 128, lr: 2e-3 };
        Self { seed: 0, columns, frames: 6000, held_out: 2000, ridge: 1e-4, hidden: 128, fit }
    }
}

/// The prediction errors of one element of a column on held-out episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The column.
    pub column: String,
    /// The index of the element in a row of the column.
    pub index: usize,
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
}

/// Fits a linear and a nonlinear regression of columns on an encoder's latents, and scores both on held-out episodes.
///
/// # Errors
/// When a column is missing or holds images, the images have another size than the encoder's, no episode is held out,
/// or a setting is out of range.
pub fn read_state(encoder: &dyn ImageEncoder, reader: &dyn Reader, config: &StateConfig) -> Result<StateReport> {
    check_sizes(&[
        ("columns", config.columns.len(), 1, limits::FEATURES),
        ("frames", config.frames, 2, limits::BATCH),
        ("held_out", config.held_out, 2, limits::BATCH),
        ("hidden", config.hidden, 1, limits::FEATURES),
        ("fit.steps", config.fit.steps, 1, limits::STEPS),
        ("fit.batch_size", config.fit.batch_size, 1, limits::BATCH),
    ])?;
    let mut names = vec![];
    for name in &config.columns {
        let column = reader.schema().column(name)?;
        if column.is_image() {
            let fix = "name numeric columns; the image probe reconstructs images";
            return Err(Error::config(name, "holds images", fix));
        }
        names.extend((0..column.len()).map(|index| (name.clone(), index)));
    }
    let key = Key::new(config.seed).with("probe");
    let sample =
        |part, count| samples::sample(encoder, reader, part, &config.columns, false, (count, key.with("frames")));
    let train = sample(Part::Train, config.frames)?;
    let held_out = sample(Part::Validation, config.held_out)?;

    let ridge = Ridge::fit(&train.latents, &train.targets, train.count, config.ridge)?;
    let network = Network::fit(&train, config, key)?;
    let score = |predictions: &[f32]| scores(&names, predictions, &held_out.targets);
    Ok(StateReport {
        latent: encoder.latent_dim(),
        frames: train.count,
        held_out: held_out.count,
        linear: score(&ridge.predict(&held_out.latents)),
        network: score(&network.predict(&held_out.latents)),
    })
}

/// The nonlinear regression.
struct Network {
    model: Mlp,
    latents: Scale,
    targets: Scale,
}

impl Network {
    fn fit(train: &samples::Samples, config: &StateConfig, key: Key) -> Result<Self> {
        let (latents, targets) = (Scale::of(&train.latents, train.count), Scale::of(&train.targets, train.count));
        let (x, y) = (latents.apply(&train.latents), targets.apply(&train.targets));
        let (inputs, outputs) = (latents.width(), targets.width());
        let model = Mlp::new(&Init::new(key.with("init"), &Device::flex()), inputs, config.hidden, outputs);
        let step = |model: &Mlp, indices: &[usize]| {
            let trained = model.clone().train();
            let error = trained.forward(rows(&x, inputs, indices).autodiff()) - rows(&y, outputs, indices).autodiff();
            let loss = error.square().mean();
            let metrics = vec![("loss", f64::from(loss.clone().inner().into_scalar::<f32>()))];
            let gradients = parameters::gradients(&trained, &loss.backward());
            Ok(StepOutput { metrics, gradients, ..StepOutput::default() })
        };
        let (model, _) = fit(model, config.fit, train.count, key.with("batches"), step)?;
        Ok(Self { model, latents, targets })
    }

    fn predict(&self, latents: &[f32]) -> Vec<f32> {
        let width = self.latents.width();
        let x = self.latents.apply(latents);
        let chunks: Vec<Vec<f32>> = x
            .par_chunks(256 * width)
            .map(|x| {
                let x = TensorData::new(x.to_vec(), [x.len() / width, width]);
                self.model.forward(Tensor::from_data(x, &Device::flex())).into_data().into_f32_vec()
            })
            .collect();
        let mut predictions = chunks.concat();
        self.targets.undo(&mut predictions);
        predictions
    }
}

/// Scores predictions of the elements `names`, given as column and index.
///
/// # Shapes
/// `predictions` and `targets` are `[rows, names.len()]`.
fn scores(names: &[(String, usize)], predictions: &[f32], targets: &[f32]) -> Vec<Score> {
    let (width, count) = (names.len(), (targets.len() / names.len()) as f64);
    let (_, spread) = mean_and_std(targets, targets.len() / width);
    let score = |(i, (column, index)): (usize, &(String, usize))| {
        let errors = || predictions.iter().zip(targets).skip(i).step_by(width).map(|(a, b)| f64::from(a - b));
        let square = errors().map(|e| e * e).sum::<f64>() / count;
        let (column, index, spread) = (column.clone(), *index, spread[i]);
        let r2 = (spread > 1e-9).then(|| 1.0 - square / spread.powi(2));
        Score { column, index, spread, r2, rmse: square.sqrt(), mae: errors().map(f64::abs).sum::<f64>() / count }
    };
    names.iter().enumerate().map(score).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_are_in_column_units_and_constants_have_no_r2() {
        let names = vec![("x".to_owned(), 0), ("x".to_owned(), 1)];
        let (predictions, targets) = ([1.0, 5.0, 2.0, 5.0, 6.0, 5.0], [0.0, 5.0, 3.0, 5.0, 6.0, 5.0]);
        let scores = scores(&names, &predictions, &targets);
        assert!((scores[0].mae - 2.0 / 3.0).abs() < 1e-9 && (scores[0].rmse - (2.0f64 / 3.0).sqrt()).abs() < 1e-9);
        // The variance of 0, 3, 6 is 6.
        assert!((scores[0].r2.expect("a coefficient of determination") - (1.0 - 2.0 / 3.0 / 6.0)).abs() < 1e-9);
        assert!(scores[1].r2.is_none() && scores[1].mae == 0.0);
    }
}
