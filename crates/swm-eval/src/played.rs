//! Prediction errors along the trajectories that a policy plays: its own observations and actions, instead of recorded ones.
//!
//! [`PlayedRecording`] keeps the observation at every model step of the first steps of each episode, and the actions between
//! them. The model then predicts from the first observation with these actions.

use crate::prediction::squared_error;
use std::collections::BTreeMap;
use swm_core::columns::{ACTION, GOAL, PIXELS};
use swm_core::results::{Played, PlayedTrajectory, Run};
use swm_core::{Batch, ColumnSpec, DType, EnvPool, Error, Predictor, Result, Schema};

/// The first model steps of all episodes.
pub(crate) struct PlayedRecording {
    frameskip: usize,
    /// The number of model steps to keep.
    horizon: usize,
    /// The columns that the model encodes.
    schema: Schema,
    /// Their indices in the infos of the pool, and those of the same columns of the goal; `None` without one of these.
    columns: Vec<usize>,
    of_goal: Option<Vec<usize>>,
    episodes: BTreeMap<usize, Episode>,
}

/// The first model steps of an episode.
struct Episode {
    /// The observations at model steps: at most one more than the horizon.
    observations: Batch,
    goal: Option<Batch>,
    /// The distance to the goal at the start, in the environment's unit.
    displacement: f64,
    /// The actions of all steps, at most horizon times frameskip.
    actions: Vec<f32>,
    /// The number of steps that were played.
    steps: usize,
}

impl PlayedRecording {
    /// Prepares a recording for a model that predicts `horizon` steps; `infos` is the schema of the pool's infos.
    ///
    /// # Errors
    /// When the infos lack a column that the model encodes.
    pub fn new(predictor: &dyn Predictor, horizon: usize, infos: &Schema) -> Result<Self> {
        let names = predictor.columns();
        let columns = names.iter().map(|name| infos.index(name)).collect::<Result<Vec<_>>>()?;
        let specs: Vec<ColumnSpec> = columns.iter().map(|index| infos.columns()[*index].clone()).collect();
        let of_goal =
            |name: &String| infos.find(&if name == PIXELS { GOAL.to_owned() } else { format!("goal_{name}") });
        let of_goal: Option<Vec<usize>> = names.iter().map(of_goal).collect();
        let same = |goal: &Vec<usize>| {
            goal.iter().zip(&specs).all(|(index, spec)| infos.columns()[*index].row_bytes() == spec.row_bytes())
        };
        Ok(Self {
            frameskip: predictor.frameskip(),
            horizon,
            of_goal: of_goal.filter(same),
            schema: Schema::new(specs)?,
            columns,
            episodes: BTreeMap::new(),
        })
    }

    /// Keeps the first observation of an episode, and its goal.
    pub fn start(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let row = |columns: &[usize]| {
            let mut batch = Batch::zeros(&self.schema, 1);
            copy(&mut batch, 0, columns, slot, pool);
            batch
        };
        let (observations, goal) = (row(&self.columns), self.of_goal.as_deref().map(row));
        let displacement = pool.env(slot).goal_distance();
        self.episodes.insert(episode, Episode { observations, goal, displacement, actions: vec![], steps: 0 });
    }

    /// Keeps an action, before its step.
    pub fn act(&mut self, episode: usize, slot: usize, actions: &Batch) {
        let longest = self.horizon * self.frameskip;
        let Some(found) = self.episodes.get_mut(&episode).filter(|found| found.steps < longest) else { return };
        let Some(column) = actions.schema().find(ACTION) else { return };
        let row = actions.row(slot);
        match actions.schema().columns()[column].dtype {
            DType::Float32 => found.actions.extend(row.at::<f32>(column)),
            // Choices are small integers, which float32 represents exactly.
            _ => found.actions.extend(row.at::<i64>(column).iter().map(|&choice| choice as f32)),
        }
    }

    /// Keeps the observation after a step, if a model step ends there.
    pub fn step(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let longest = self.horizon * self.frameskip;
        let Some(found) = self.episodes.get_mut(&episode).filter(|found| found.steps < longest) else { return };
        found.steps += 1;
        if found.steps.is_multiple_of(self.frameskip) {
            let row = found.observations.rows();
            found.observations.resize(row + 1);
            copy(&mut found.observations, row, &self.columns, slot, pool);
        }
    }

    /// Predicts every episode of the run that was recorded, and compares.
    ///
    /// # Errors
    /// When the model fails, or a prediction is not finite.
    pub fn predict(self, predictor: &mut dyn Predictor, run: &Run) -> Result<Played> {
        let dim = predictor.latent_dim();
        let mut trajectories = vec![];
        for (index, episode) in &self.episodes {
            let horizon = episode.observations.rows() - 1;
            let Some(result) = run.episodes.get(*index).filter(|_| horizon > 0) else { continue };
            let mut latents = vec![0.0; (horizon + 1) * dim];
            predictor.encode(&episode.observations, &mut latents)?;
            let (first, reached) = latents.split_at(dim);
            let action_dim = episode.actions.len() / episode.steps.max(1);
            let actions = &episode.actions[..horizon * self.frameskip * action_dim];
            let mut predicted = vec![0.0; horizon * dim];
            predictor.rollout(first, actions, horizon, &mut predicted)?;
            let pairs = || predicted.chunks_exact(dim).zip(reached.chunks_exact(dim));
            let errors: Vec<f64> = pairs().map(|(a, b)| squared_error(a, b)).collect();
            let optimism = match (&episode.goal, pairs().next_back()) {
                (Some(goal), Some((predicted, reached))) => {
                    let mut latent = vec![0.0; dim];
                    predictor.encode(goal, &mut latent)?;
                    Some(squared_error(reached, &latent) - squared_error(predicted, &latent))
                }
                _ => None,
            };
            if !errors.iter().chain(&optimism).all(|value| value.is_finite()) {
                return Err(Error::NotFinite {
                    what: "a predicted latent".to_owned(),
                    given: format!("episode {index} of the evaluation"),
                    fix: "train longer or with a smaller learning rate, or predict fewer steps".to_owned(),
                });
            }
            let start = result.start.unwrap_or([*index, 0]);
            let displacement = Some(episode.displacement).filter(|displacement| displacement.is_finite());
            trajectories.push(PlayedTrajectory { start, success: result.success, errors, optimism, displacement });
        }
        Ok(Played { trajectories })
    }
}

/// Copies columns of a slot to a row.
fn copy(batch: &mut Batch, row: usize, columns: &[usize], slot: usize, pool: &EnvPool) {
    let (from, mut to) = (pool.infos().row(slot), batch.row_mut(row));
    for (column, index) in columns.iter().enumerate() {
        to.bytes(column).copy_from_slice(from.bytes(*index));
    }
}
