//! How well a model predicts recorded trajectories: from the latent of a first observation and the actions that were
//! recorded, open loop, step by step beside the latents of what was observed.
//!
//! Prediction errors and success are looked at together, because one does not follow from the other: the
//! trajectories of an evaluation are grouped by whether its policy solved them, those of a split of a dataset by whether
//! their recorded episode succeeded.

use crate::Starts;
use swm_core::results::{Prediction, Run, Trajectory};
use swm_core::{Batch, DType, Error, Result};
use swm_data::{Reader, StepRange};

pub use swm_core::Predictor;

/// Trajectories that are read and predicted at once.
const AT_ONCE: usize = 16;

/// Predicts the trajectories that begin at these picks, `[episode, step]`, `horizon` model steps far. `success` tells
/// what came of each pick, where that is known.
///
/// # Errors
/// When there is no pick, a trajectory reaches beyond its episode, the dataset lacks a column the model encodes, a
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
        return Err(Error::config("prediction errors", given, "ask for at least one of each"));
    }
    let frames = horizon + 1;
    let mut spread = Spread::new(predictor.latent_dim());
    let mut trajectories = Vec::with_capacity(picks.len());
    let (mut latents, mut predicted, mut starts) = (vec![], vec![], vec![]);
    for first in (0..picks.len()).step_by(AT_ONCE) {
        let part = first..picks.len().min(first + AT_ONCE);
        let (rows, actions) = read(predictor, reader, &picks[part.clone()], horizon)?;
        let dim = predictor.latent_dim();
        latents.resize(part.len() * frames * dim, 0.0);
        predictor.encode(&rows, &mut latents)?;
        starts.clear();
        starts.extend(latents.chunks_exact(frames * dim).flat_map(|frames| &frames[..dim]));
        predicted.resize(part.len() * horizon * dim, 0.0);
        predictor.rollout(&starts, &actions, horizon, &mut predicted)?;
        let both = latents.chunks_exact(frames * dim).zip(predicted.chunks_exact(horizon * dim));
        for (i, (seen, predicted)) in part.zip(both) {
            let steps = seen[dim..].chunks_exact(dim).zip(predicted.chunks_exact(dim));
            let errors: Vec<f64> = steps
                .map(|(seen, predicted)| {
                    spread.note(seen);
                    squared_error(predicted, seen)
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
            "all observations have the same latent: the model has collapsed, or nothing moves in these trajectories",
            "look at another model, or at other trajectories",
        ));
    }
    trajectories.iter_mut().flat_map(|trajectory| &mut trajectory.errors).for_each(|error| *error /= variance);
    Ok(Prediction::new(predictor.frameskip(), variance, trajectories))
}

/// Predicts trajectories of some episodes of a dataset, such as those of a held-out [`swm_data::Split`]: `n` of them,
/// drawn as [`Starts::choose_among`] draws. An episode succeeded when its column `success` says so in any of its rows;
/// without that column it is not known.
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
    let known = reader.schema().find("success").is_some();
    let outcome = |&[episode, _]: &[usize; 2]| -> Result<Option<bool>> {
        let length = reader.episodes()[episode].length;
        let rows = known.then(|| reader.read(&["success"], &[StepRange::new(episode, 0, length)])).transpose()?;
        Ok(rows.map(|rows| rows.bytes(0).iter().any(|&flag| flag != 0)))
    };
    let outcomes: Vec<Option<bool>> = picks.iter().map(outcome).collect::<Result<_>>()?;
    predict(predictor, reader, &picks, horizon, |i| outcomes[i])
}

/// Predicts the trajectories that a run's starts were taken from, and tells them apart by what came of them there. What
/// strict counting left out has no outcome.
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
            "the starts were drawn by the environment, so nothing was recorded there",
            "take starts from a dataset",
        ));
    };
    predict(predictor, reader, &picks, horizon, |i| {
        let episode = &run.episodes[i];
        (episode.steps > 0).then_some(episode.success)
    })
}

/// The observations at every model step of some trajectories, `[trajectories, horizon + 1]` rows, and the actions
/// between them, `[trajectories, horizon, frameskip * action]`.
fn read(
    predictor: &dyn Predictor,
    reader: &dyn Reader,
    picks: &[[usize; 2]],
    horizon: usize,
) -> Result<(Batch, Vec<f32>)> {
    let (frameskip, columns) = (predictor.frameskip(), predictor.columns());
    let span = horizon * frameskip;
    let (mut frames, mut between) = (vec![], vec![]);
    for &[episode, start] in picks {
        let length = reader.episodes().get(episode).map_or(0, |episode| episode.length);
        if start + span >= length {
            return Err(Error::mismatch(
                format!("predicting {horizon} model steps of {frameskip} from step {start} of episode {episode}"),
                format!("{length} rows"),
                format!("more than {}: predict fewer steps, or from earlier starts", start + span),
            ));
        }
        frames.extend((0..=span).step_by(frameskip).map(|at| StepRange::new(episode, start + at, 1)));
        between.push(StepRange::new(episode, start, span));
    }
    let names: Vec<&str> = columns.iter().map(String::as_str).collect();
    let rows = reader.read(&names, &frames)?;
    let actions = reader.read(&["action"], &between)?;
    #[allow(clippy::cast_precision_loss)]
    let actions = match actions.schema().columns()[0].dtype {
        DType::Float32 => actions.get::<f32>("action")?.to_vec(),
        // Choices are small integers, which float32 holds.
        _ => actions.get::<i64>("action")?.iter().map(|&choice| choice as f32).collect(),
    };
    Ok((rows, actions))
}

/// The mean squared error of a prediction.
#[allow(clippy::cast_precision_loss)]
fn squared_error(predicted: &[f32], seen: &[f32]) -> f64 {
    let squares = predicted.iter().zip(seen).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
    squares.sum::<f64>() / seen.len() as f64
}

/// The variance of latents, number by number, by Welford's update.
struct Spread {
    count: f64,
    mean: Vec<f64>,
    squares: Vec<f64>,
}

impl Spread {
    fn new(dim: usize) -> Self {
        Self { count: 0.0, mean: vec![0.0; dim], squares: vec![0.0; dim] }
    }

    fn note(&mut self, latent: &[f32]) {
        self.count += 1.0;
        for ((mean, squares), &value) in self.mean.iter_mut().zip(&mut self.squares).zip(latent) {
            let delta = f64::from(value) - *mean;
            *mean += delta / self.count;
            *squares += delta * (f64::from(value) - *mean);
        }
    }

    /// The mean over a latent's numbers of their variances.
    #[allow(clippy::cast_precision_loss)]
    fn variance(&self) -> f64 {
        self.squares.iter().sum::<f64>() / self.count / self.mean.len() as f64
    }
}
