//! Prediction errors of models whose errors are known in closed form.

use crate::evaluating::recorded;
use crate::memory::{Memory, MemoryReader};
use swm_core::results::Prediction;
use swm_core::{Batch, DType, Error, Result, Schema};
use swm_data::{Reader as _, StepRange};
use swm_eval::Starts;
use swm_eval::prediction::{Predictor, predict, predict_recorded};

/// A model with latents `(x, 7)` and the dynamics of the line, whose error grows by `drift` in every model step.
pub struct Drifting {
    pub drift: f32,
}

impl Predictor for Drifting {
    fn frameskip(&self) -> usize {
        2
    }

    fn columns(&self) -> Vec<String> {
        vec!["state".to_owned()]
    }

    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        for (latent, &x) in latents.chunks_exact_mut(2).zip(rows.get::<f64>("state")?) {
            latent.copy_from_slice(&[x as f32, 7.0]);
        }
        Ok(())
    }

    fn rollout(&mut self, start: &[f32], actions: &[f32], horizon: usize, latents: &mut [f32]) -> Result<()> {
        for (i, trajectory) in latents.chunks_exact_mut(2 * horizon).enumerate() {
            let mut x = start[2 * i];
            for (k, latent) in trajectory.chunks_exact_mut(2).enumerate() {
                for push in &actions[2 * (i * horizon + k)..][..2] {
                    x = (x + push.clamp(-1.0, 1.0)).clamp(-5.0, 5.0);
                }
                latent.copy_from_slice(&[x + self.drift * (k + 1) as f32, 7.0]);
            }
        }
        Ok(())
    }
}

/// The recorded positions after each model step from every pick, and their variance.
fn recorded_positions(reader: &MemoryReader, picks: &[[usize; 2]], horizon: usize) -> (Vec<f64>, f64) {
    let ranges: Vec<StepRange> = picks
        .iter()
        .flat_map(|&[episode, start]| (1..=horizon).map(move |k| StepRange::new(episode, start + 2 * k, 1)))
        .collect();
    let rows = reader.read(&["state"], &ranges).expect("the dataset is readable");
    let x = rows.get::<f64>("state").expect("the dataset has states").to_vec();
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / x.len() as f64;
    (x, variance)
}

#[test]
fn prediction_errors_equal_the_closed_form() {
    let reader = recorded(40);
    let picks = Starts::choose(&reader, 50, 6, 2).expect("the dataset has enough starts");
    let (_, variance) = recorded_positions(&reader, &picks, 3);
    let found = predict(&mut Drifting { drift: 0.5 }, &reader, &picks, 3, |i| Some(i % 3 == 0))
        .expect("the prediction succeeds");
    // One of two latent dimensions has the error 0.5 k; the other is constant.
    assert!((found.variance - variance / 2.0).abs() < 1e-5 * variance, "{} {variance}", found.variance);
    for (trajectory, pick) in found.trajectories.iter().zip(&picks) {
        assert_eq!(trajectory.start, *pick);
        for (k, error) in trajectory.errors.iter().enumerate() {
            let known = (0.5 * (k + 1) as f64).powi(2) / variance;
            assert!((error - known).abs() < 1e-5 * known, "step {k}: {error}, expected {known}");
        }
    }
    let sizes: Vec<(Option<bool>, usize)> = found.groups.iter().map(|g| (g.success, g.trajectory.n)).collect();
    assert_eq!(sizes, [(None, 50), (Some(true), 17), (Some(false), 33)]);
    let exact = predict(&mut Drifting { drift: 0.0 }, &reader, &picks, 3, |_| None).expect("the prediction succeeds");
    assert!(exact.groups[0].trajectory.p95 < 1e-12, "{:?}", exact.groups[0]);
    assert_eq!(exact.groups.len(), 1, "trajectories without an outcome have no groups by success");
}

/// The dataset with its actions as float64.
fn with_float64_actions(reader: &MemoryReader) -> MemoryReader {
    let memory = Memory::default();
    for (episode, length) in reader.episodes().iter().map(|episode| episode.length).enumerate() {
        let rows = reader.read(&["state", "action"], &[StepRange::new(episode, 0, length)]).expect("reading rows");
        let mut columns = rows.schema().columns().to_vec();
        columns[1].dtype = DType::Float64;
        let mut double = Batch::zeros(&Schema::new(columns).expect("creating the schema"), length);
        for step in 0..length {
            double.row_mut(step).set(0, rows.row(step).at::<f64>(0));
            double.row_mut(step).set(1, &rows.row(step).to_f64("action").expect("reading the action"));
        }
        memory.episodes.lock().expect("no thread has panicked").push(double);
    }
    memory.reader()
}

#[test]
fn float64_actions_predict_as_their_float32_values() {
    let reader = recorded(20);
    let picks = Starts::choose(&reader, 9, 6, 2).expect("the dataset has enough starts");
    let [single, double] = [&reader, &with_float64_actions(&reader)].map(|reader| {
        predict(&mut Drifting { drift: 0.5 }, reader, &picks, 3, |_| None).expect("the prediction succeeds")
    });
    assert_eq!(single, double);
}

/// A model with a constant prediction.
struct Constant(f32);

impl Predictor for Constant {
    fn frameskip(&self) -> usize {
        2
    }

    fn columns(&self) -> Vec<String> {
        Drifting { drift: 0.0 }.columns()
    }

    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        Drifting { drift: 0.0 }.encode(rows, latents)
    }

    fn rollout(&mut self, _: &[f32], _: &[f32], _: usize, latents: &mut [f32]) -> Result<()> {
        latents.chunks_exact_mut(2).for_each(|latent| latent.copy_from_slice(&[self.0, 7.0]));
        Ok(())
    }
}

#[test]
fn predicting_the_mean_latent_has_the_error_one() {
    let reader = recorded(40);
    let picks = Starts::choose(&reader, 33, 4, 0).expect("the dataset has enough starts");
    let (x, _) = recorded_positions(&reader, &picks, 2);
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    let found = predict(&mut Constant(mean as f32), &reader, &picks, 2, |_| None).expect("the prediction succeeds");
    assert!((found.groups[0].trajectory.mean - 1.0).abs() < 1e-6, "{:?}", found.groups[0]);
}

#[test]
fn trajectories_are_grouped_by_recorded_success() {
    let reader = recorded(60);
    let episodes: Vec<usize> = (10..60).collect();
    let predict = || -> Prediction {
        predict_recorded(&mut Drifting { drift: 0.1 }, &reader, &episodes, 40, 2, 9).expect("the prediction succeeds")
    };
    let found = predict();
    assert_eq!(found, predict(), "the seed determines the trajectories");
    let succeeded = |episode: usize| {
        let length = reader.episodes()[episode].length;
        let rows = reader.read(&["success"], &[StepRange::new(episode, 0, length)]).expect("the dataset is readable");
        rows.bytes(0).contains(&1)
    };
    for trajectory in &found.trajectories {
        assert!(trajectory.start[0] >= 10, "the trajectory is in one of the chosen episodes");
        assert_eq!(trajectory.success, Some(succeeded(trajectory.start[0])));
    }
    assert_eq!(found.groups.len(), 3, "groups of all, successful and failed trajectories");
}

#[test]
fn errors_name_the_invalid_trajectory() {
    let reader = recorded(10);
    let rejected = |drift: f32, picks: &[[usize; 2]], horizon| -> Error {
        predict(&mut Drifting { drift }, &reader, picks, horizon, |_| None).expect_err("the request is rejected")
    };
    let [none, far] = [rejected(0.0, &[], 2), rejected(0.0, &[[3, 4]], 50)].map(|error| error.to_string());
    assert!(none.contains("0 trajectories of 2 model steps"), "{none}");
    assert!(far.contains("50 model steps of 2 from step 4 of episode 3") && far.contains("more than 104"), "{far}");
    let picks = Starts::choose(&reader, 5, 4, 0).expect("the dataset has enough starts");
    let error = rejected(f32::NAN, &picks, 2).to_string();
    assert!(error.contains(&format!("model step 1 from step {} of episode {}", picks[0][1], picks[0][0])), "{error}");
    let error = rejected(0.0, &picks[..1], 1).to_string();
    assert!(error.contains("collapsed"), "a single observation has no variance: {error}");
}
