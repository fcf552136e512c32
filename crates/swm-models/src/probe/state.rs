//! Reading columns of numbers from latents.

use super::fit::{FitConfig, fit, rows};
use super::ridge::{Ridge, moments};
use super::scale::Scale;
use super::{ImageEncoder, samples};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Init, Mlp};
use crate::train::{StepOutput, at_least};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};
use swm_data::{Part, Reader};

/// What to read, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateConfig {
    /// Decides which frames are drawn, initial weights and batches.
    pub seed: u64,
    /// The columns to read.
    pub columns: Vec<String>,
    /// Frames to fit on, at most; from episodes that models are trained on.
    pub frames: usize,
    /// Frames to judge on, at most; from episodes held out for validation.
    pub held_out: usize,
    /// λ of the linear read-out.
    pub ridge: f64,
    /// Hidden features of the network.
    pub hidden: usize,
    /// How the network is fitted.
    pub fit: FitConfig,
}

impl StateConfig {
    /// The settings that are used unless something else is said.
    pub fn new(columns: Vec<String>) -> Self {
        let fit = FitConfig { steps: 1500, batch_size: 128, lr: 2e-3 };
        Self { seed: 0, columns, frames: 6000, held_out: 2000, ridge: 1e-4, hidden: 128, fit }
    }
}

/// How well one number is read on episodes that nothing was fitted on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The column.
    pub column: String,
    /// The place of the number in a row of it.
    pub index: usize,
    /// The number's standard deviation, in its units.
    pub spread: f64,
    /// The share of its variance that is read: 1 is all, 0 what its mean says, less is worse than that. None for a number
    /// that never changes.
    pub r2: Option<f64>,
    /// The root of the mean squared error, in its units.
    pub rmse: f64,
    /// The mean absolute error, in its units.
    pub mae: f64,
}

/// What two read-outs found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StateReport {
    /// Numbers in a latent.
    pub latent: usize,
    /// Frames fitted on.
    pub frames: usize,
    /// Frames judged on.
    pub held_out: usize,
    /// The linear read-out, number by number.
    pub linear: Vec<Score>,
    /// The network with two hidden layers.
    pub network: Vec<Score>,
}

/// Fits a linear and a nonlinear read-out of columns from an encoder's latents, and judges both on held-out episodes.
///
/// # Errors
/// When a column is missing or holds pictures, the pictures have another size than the encoder sees, no episode is held
/// out, or a setting makes no sense.
pub fn read_state(encoder: &dyn ImageEncoder, reader: &dyn Reader, config: &StateConfig) -> Result<StateReport> {
    at_least(&[
        ("columns", config.columns.len(), 1),
        ("frames", config.frames, 2),
        ("held_out", config.held_out, 2),
        ("hidden", config.hidden, 1),
        ("fit.steps", config.fit.steps, 1),
        ("fit.batch_size", config.fit.batch_size, 1),
    ])?;
    let mut names = vec![];
    for name in &config.columns {
        let column = reader.schema().column(name)?;
        if column.is_image() {
            let fix = "name columns of numbers; pictures are drawn again by the picture probe";
            return Err(Error::config(name, "holds pictures", fix));
        }
        names.extend((0..column.len()).map(|index| (name.clone(), index)));
    }
    let key = Key::new(config.seed).with("probe");
    let draw = |part, count| samples::draw(encoder, reader, part, &config.columns, false, (count, key.with("frames")));
    let train = draw(Part::Train, config.frames)?;
    let held_out = draw(Part::Validation, config.held_out)?;

    let ridge = Ridge::fit(&train.latents, &train.targets, train.count, config.ridge)?;
    let network = Network::fit(&train, config, key)?;
    let judge = |said: &[f32]| scores(&names, said, &held_out.targets);
    Ok(StateReport {
        latent: encoder.latent_dim(),
        frames: train.count,
        held_out: held_out.count,
        linear: judge(&ridge.predict(&held_out.latents)),
        network: judge(&network.predict(&held_out.latents)),
    })
}

/// The nonlinear read-out.
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
        let step = |model: &Mlp, places: &[usize]| {
            let trained = model.clone().train();
            let error = trained.forward(rows(&x, inputs, places).autodiff()) - rows(&y, outputs, places).autodiff();
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
        let parts: Vec<Vec<f32>> = x
            .par_chunks(256 * width)
            .map(|x| {
                let x = TensorData::new(x.to_vec(), [x.len() / width, width]);
                self.model.forward(Tensor::from_data(x, &Device::flex())).into_data().into_f32_vec()
            })
            .collect();
        let mut said = parts.concat();
        self.targets.undo(&mut said);
        said
    }
}

#[allow(clippy::cast_precision_loss)]
fn scores(names: &[(String, usize)], said: &[f32], truth: &[f32]) -> Vec<Score> {
    let (width, count) = (names.len(), (truth.len() / names.len()) as f64);
    let (_, spread) = moments(truth, truth.len() / width);
    let score = |(place, (column, index)): (usize, &(String, usize))| {
        let errors = || said.iter().zip(truth).skip(place).step_by(width).map(|(a, b)| f64::from(a - b));
        let square = errors().map(|e| e * e).sum::<f64>() / count;
        let (column, index, spread) = (column.clone(), *index, spread[place]);
        let r2 = (spread > 1e-9).then(|| 1.0 - square / spread.powi(2));
        Score { column, index, spread, r2, rmse: square.sqrt(), mae: errors().map(f64::abs).sum::<f64>() / count }
    };
    names.iter().enumerate().map(score).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_are_in_units_and_a_constant_has_no_r2() {
        let names = vec![("x".to_owned(), 0), ("x".to_owned(), 1)];
        let (said, truth) = ([1.0, 5.0, 2.0, 5.0, 6.0, 5.0], [0.0, 5.0, 3.0, 5.0, 6.0, 5.0]);
        let scores = scores(&names, &said, &truth);
        assert!((scores[0].mae - 2.0 / 3.0).abs() < 1e-9 && (scores[0].rmse - (2.0f64 / 3.0).sqrt()).abs() < 1e-9);
        // The variance of 0, 3, 6 is 6.
        assert!((scores[0].r2.expect("it changes") - (1.0 - 2.0 / 3.0 / 6.0)).abs() < 1e-9);
        assert!(scores[1].r2.is_none() && scores[1].mae == 0.0);
    }
}
