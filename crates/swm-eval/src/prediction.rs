//! Prediction errors of a model on recorded trajectories.
//!
//! The model predicts latents open loop from the latent of the first observation and the recorded actions. Each
//! predicted latent is compared with the latent of the recorded observation. Trajectories are grouped by success,
//! because a low prediction error does not imply success. Success is the outcome of the evaluated policy for the starts
//! of an evaluation, and the outcome of the recorded episode for the episodes of a dataset.

use crate::starts::Starts;
use swm_core::columns::{ACTION, SUCCESS};
use swm_core::results::{Prediction, Run, Trajectory};
use swm_core::{Batch, Error, Result};
use swm_data::{Reader, StepRange};

pub use swm_core::Predictor;

/// The number of trajectories that are read and predicted at once.
const CHUNK: usize = 16;

/// Predicts `horizon` model steps from each pick `[episode, step]`. `success` returns the outcome of the pick with
/// an index, or `None` if the outcome is unknown.
///
/// # Errors
/// When there are no picks, a trajectory reaches beyond its episode, the dataset lacks a column the model encodes, a
/// prediction is not finite, or all observations have the same latent.
pub fn predict(
    predictor: &mut dyn Predictor,
    reader: &dyn Reader,
    picks: &[[usize; 2]],
    horizon: usize,
    success: impl Fn(usize) -> Option<bool>,
) -> Result<Prediction> {
    if picks.is_empty() || horizon == 0 {
        let given = format!("{} trajectories of {horizon} model steps", picks.len());
        return Err(Error::config("prediction errors", given, "request at least 1 trajectory and 1 model step"));
    }
    let frames = horizon + 1;
    let mut spread = Spread::new(predictor.latent_dim());
    let mut trajectories = Vec::with_capacity(picks.len());
    let (mut latents, mut predicted, mut starts) = (vec![], vec![], vec![]);
    for first in (0..picks.len()).step_by(CHUNK) {
        let chunk = first..picks.len().min(first + CHUNK);
        let (rows, actions) = read(predictor, reader, &picks[chunk.clone()], horizon)?;
        let dim = predictor.latent_dim();
        latents.resize(chunk.len() * frames * dim, 0.0);
        predictor.encode(&rows, &mut latents)?;
        starts.clear();
        starts.extend(latents.chunks_exact(frames * dim).flat_map(|frames| &frames[..dim]));
        predicted.resize(chunk.len() * horizon * dim, 0.0);
        predictor.rollout(&starts, &actions, horizon, &mut predicted)?;
        let pairs = latents.chunks_exact(frames * dim).zip(predicted.chunks_exact(horizon * dim));
        for (i, (recorded, predicted)) in chunk.zip(pairs) {
            let steps = recorded[dim..].chunks_exact(dim).zip(predicted.chunks_exact(dim));
            let errors: Vec<f64> = steps
                .map(|(recorded, predicted)| {
                    spread.add(recorded);
                    squared_error(predicted, recorded)
                })
                .collect();
            if let Some(step) = errors.iter().position(|error| !error.is_finite()) {
                return Err(Error::NotFinite {
                    what: "a predicted latent".to_owned(),
                    given: format!("model step {} from step {} of episode {}", step + 1, picks[i][1], picks[i][0]),
                    fix: "train longer or with a smaller learning rate, or predict fewer steps".to_owned(),
                });
            }
            trajectories.push(Trajectory { start: picks[i], success: success(i), errors });
        }
    }
    let variance = spread.variance();
    if variance <= 0.0 {
        return Err(Error::config(
            "prediction errors",
            "all observations have the same latent: the model has collapsed, or these trajectories are constant",
            "use another model, or other trajectories",
        ));
    }
    trajectories.iter_mut().flat_map(|trajectory| &mut trajectory.errors).for_each(|error| *error /= variance);
    Ok(Prediction::new(predictor.frameskip(), variance, trajectories))
}

/// Predicts `n` trajectories of some episodes of a dataset, such as the episodes of a held-out [`swm_data::Split`],
/// chosen by [`Starts::choose_among`]. An episode succeeded if its column `success` is set in any row; without that
/// column the outcome is unknown.
///
/// # Errors
/// As [`predict`], and when the episodes have fewer than `n` trajectories.
pub fn predict_recorded(
    predictor: &mut dyn Predictor,
    reader: &dyn Reader,
    episodes: &[usize],
    n: usize,
    horizon: usize,
    seed: u64,
) -> Result<Prediction> {
    let picks = Starts::choose_among(reader, episodes, n, horizon * predictor.frameskip(), seed)?;
    let known = reader.schema().find(SUCCESS).is_some();
    let outcome = |&[episode, _]: &[usize; 2]| -> Result<Option<bool>> {
        let length = reader.episodes()[episode].length;
        let rows = known.then(|| reader.read(&[SUCCESS], &[StepRange::new(episode, 0, length)])).transpose()?;
        Ok(rows.map(|rows| rows.bytes(0).iter().any(|&flag| flag != 0)))
    };
    let outcomes: Vec<Option<bool>> = picks.iter().map(outcome).collect::<Result<_>>()?;
    predict(predictor, reader, &picks, horizon, |i| outcomes[i])
}

/// Predicts the recorded trajectories that a run's starts were taken from, grouped by the outcome of the run. Episodes
/// that strict counting did not play have no outcome.
///
/// # Errors
/// As [`predict`], and when the run's starts were not taken from a dataset.
pub fn predict_run(
    predictor: &mut dyn Predictor,
    reader: &dyn Reader,
    run: &Run,
    horizon: usize,
) -> Result<Prediction> {
    let picks: Option<Vec<[usize; 2]>> = run.episodes.iter().map(|episode| episode.start).collect();
    let Some(picks) = picks else {
        return Err(Error::config(
            "prediction errors",
            "the environment drew the starts, so there are no recorded trajectories",
            "take starts from a dataset",
        ));
    };
    predict(predictor, reader, &picks, horizon, |i| {
        let episode = &run.episodes[i];
        (episode.steps > 0).then_some(episode.success)
    })
}

/// Checks that a dataset has all rows of the predicted trajectories.
///
/// # Errors
/// When there is no step to predict, or an episode is too short.
pub fn check(predictor: &dyn Predictor, reader: &dyn Reader, picks: &[[usize; 2]], horizon: usize) -> Result<()> {
    let frameskip = predictor.frameskip();
    if horizon == 0 {
        return Err(Error::config("model steps to predict", "0", "predict at least 1"));
    }
    for &[episode, start] in picks {
        let length = reader.episodes().get(episode).map_or(0, |episode| episode.length);
        let last = start.saturating_add(horizon.saturating_mul(frameskip));
        if last >= length {
            return Err(Error::mismatch(
                format!("predicting {horizon} model steps of {frameskip} from step {start} of episode {episode}"),
                format!("{length} rows"),
                format!("more than {last}; predict fewer steps, or choose earlier starts"),
            ));
        }
    }
    Ok(())
}

/// Reads the observations at every model step of some trajectories, `[trajectories, horizon + 1]` rows, and the actions
/// between them, `[trajectories, horizon, frameskip * action_dim]`.
fn read(
    predictor: &dyn Predictor,
    reader: &dyn Reader,
    picks: &[[usize; 2]],
    horizon: usize,
) -> Result<(Batch, Vec<f32>)> {
    let (frameskip, columns) = (predictor.frameskip(), predictor.columns());
    let span = horizon * frameskip;
    let (mut frames, mut between) = (vec![], vec![]);
    check(predictor, reader, picks, horizon)?;
    for &[episode, start] in picks {
        frames.extend((0..=span).step_by(frameskip).map(|at| StepRange::new(episode, start + at, 1)));
        between.push(StepRange::new(episode, start, span));
    }
    let names: Vec<&str> = columns.iter().map(String::as_str).collect();
    let rows = reader.read(&names, &frames)?;
    Ok((rows, reader.read(&[ACTION], &between)?.to_f32(ACTION)?))
}

/// The mean squared error of a predicted latent, both `[latent]`.
pub(crate) fn squared_error(predicted: &[f32], recorded: &[f32]) -> f64 {
    let squares = predicted.iter().zip(recorded).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
    squares.sum::<f64>() / recorded.len() as f64
}

/// The variance of every latent dimension, by Welford's algorithm.
struct Spread {
    count: f64,
    mean: Vec<f64>,
    squares: Vec<f64>,
}

impl Spread {
    fn new(dim: usize) -> Self {
        Self { count: 0.0, mean: vec![0.0; dim], squares: vec![0.0; dim] }
    }

    fn add(&mut self, latent: &[f32]) {
        self.count += 1.0;
        for ((mean, squares), &value) in self.mean.iter_mut().zip(&mut self.squares).zip(latent) {
            let delta = f64::from(value) - *mean;
            *mean += delta / self.count;
            *squares += delta * (f64::from(value) - *mean);
        }
    }

    /// The mean of the variances over the latent dimensions.
    fn variance(&self) -> f64 {
        self.squares.iter().sum::<f64>() / self.count / self.mean.len() as f64
    }
}
