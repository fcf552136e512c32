//! [`Tdmpc2Policy`]: a policy that plans by model-predictive path integral control in latent space (Hansen et al. 2024,
//! section 3.2 and appendix H).
//!
//! Every iteration evaluates `proposals` rollouts of the policy and samples of a Gaussian. The `elites` with the lowest
//! cost get the weights `exp(-temperature (cost - lowest cost))` in the next mean and standard deviation. A search
//! begins at the previous plan's mean, shifted by one step. The policy takes the first action of an elite drawn by
//! weight; with exploration, the policy adds noise with the last standard deviation. (The mean is not executed, because
//! the mean of two equally good actions can be a bad action.)

use super::config::Tdmpc2Config;
use super::model::Tdmpc2;
use super::rollouts::Rollouts;
use super::train::observe_row;
use crate::Checkpoint;
use crate::nn::normal;
use crate::nn::parameters::IntoF32 as _;
use crate::online::{AgentPolicy, PlannerConfig, SharedModel};
use crate::train::{DatasetInfo, TrainConfig};
use rand::Rng as _;
use rayon::prelude::*;
use std::time::Instant;
use swm_core::columns::{ACTION, STEP_IDX};
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result};
use swm_plan::ActionScale;

/// The result of a search.
pub struct SearchResult {
    /// The weighted mean of the elites, `[horizon, action_dim]`.
    pub mean: Vec<f32>,
    /// The weighted standard deviation of the elites, `[horizon, action_dim]`.
    pub std: Vec<f32>,
    /// The elites in order of cost, `[elites, horizon, action_dim]`.
    pub elites: Vec<f32>,
    /// The weights of the elites, which sum to 1: `[elites]`.
    pub weights: Vec<f32>,
}

impl PlannerConfig {
    /// Searches for a plan from a latent. `key` determines the samples.
    ///
    /// # Shapes
    /// `latent` is `[latent]`, `mean`, the initial mean, is `[horizon, action_dim]`.
    pub fn search(&self, rollouts: &Rollouts, latent: &[f32], mean: &[f32], key: Key) -> SearchResult {
        let len = mean.len();
        let mut candidates = vec![0.0; self.samples * len];
        let (proposals, sampled) = candidates.split_at_mut(self.proposals * len);
        if self.proposals > 0 {
            rollouts.propose(latent, &[], self.horizon, key.with("proposals"), proposals);
        }
        let mut result =
            SearchResult { mean: mean.to_vec(), std: vec![self.max_std; len], elites: vec![], weights: vec![] };
        let sampled = sampled.len();
        let mut costs = vec![0.0; self.samples];
        let mut order: Vec<usize> = vec![];
        for iteration in 0..self.iterations {
            let drawn = normal(&[key.at(iteration as u64)], sampled);
            for (i, (to, noise)) in candidates[self.proposals * len..].iter_mut().zip(drawn).enumerate() {
                *to = (result.mean[i % len] + result.std[i % len] * noise).clamp(-1.0, 1.0);
            }
            rollouts.cost(latent, &candidates, self.horizon, &mut costs);
            order.clear();
            order.extend(0..self.samples);
            order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(a.cmp(&b)));
            order.truncate(self.elites);
            result.elites.clear();
            order.iter().for_each(|&i| result.elites.extend_from_slice(&candidates[i * len..][..len]));
            self.update_distribution(order.iter().map(|&i| costs[i] - costs[order[0]]), &mut result);
        }
        result
    }

    /// Computes the weights of the elites from the costs above the lowest cost, then the weighted mean and standard
    /// deviation of the elites.
    fn update_distribution(&self, excess_costs: impl Iterator<Item = f32>, result: &mut SearchResult) {
        let SearchResult { mean, std, elites, weights } = result;
        weights.clear();
        weights.extend(excess_costs.map(|cost| (-self.temperature * cost).exp()));
        let sum: f32 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
        let len = mean.len();
        mean.fill(0.0);
        for (elite, weight) in elites.chunks_exact(len).zip(&*weights) {
            mean.iter_mut().zip(elite).for_each(|(mean, value)| *mean += weight * value);
        }
        std.fill(0.0);
        for (elite, weight) in elites.chunks_exact(len).zip(&*weights) {
            std.iter_mut()
                .zip(elite)
                .zip(&*mean)
                .for_each(|((std, value), mean)| *std += weight * (value - mean).powi(2));
        }
        std.iter_mut().for_each(|std| *std = std.sqrt().clamp(self.min_std, self.max_std));
    }
}

/// A policy that plans at every step with a TD-MPC2.
pub struct Tdmpc2Policy {
    planner: PlannerConfig,
    model: Tdmpc2Config,
    discount: f64,
    uncertainty: f64,
    scale: ActionScale,
    shared_model: SharedModel<Tdmpc2>,
    explore: bool,
    slots: Vec<Slot>,
    latencies: Vec<f64>,
}

/// The plan of one environment.
struct Slot {
    key: Key,
    /// The initial mean of the next search, `[horizon, action_dim]`.
    mean: Vec<f32>,
    action: Vec<f32>,
    failed: Option<Error>,
}

impl Tdmpc2Policy {
    /// Creates a policy for `slots` environments of `spec` with the current weights of a shared model.
    ///
    /// # Errors
    /// When the model was trained for another action space, or a setting is invalid.
    pub fn new(
        planner: &PlannerConfig,
        config: &TrainConfig<Tdmpc2>,
        dataset_info: &DatasetInfo,
        shared_model: SharedModel<Tdmpc2>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Self> {
        planner.check()?;
        dataset_info.action.check(spec)?;
        let dim = spec.action_dim();
        let slot =
            || Slot { key: Key::new(0), mean: vec![0.0; planner.horizon * dim], action: vec![0.0; dim], failed: None };
        Ok(Self {
            planner: planner.clone(),
            model: config.model.clone(),
            discount: config.loss.discount,
            uncertainty: config.loss.uncertainty,
            scale: dataset_info.action.clone(),
            shared_model,
            explore,
            slots: (0..slots).map(|_| slot()).collect(),
            latencies: vec![],
        })
    }

    /// Creates the policy of a checkpoint.
    ///
    /// # Errors
    /// As [`Tdmpc2Policy::new`].
    pub fn of(checkpoint: &Checkpoint<Tdmpc2>, planner: &PlannerConfig, spec: &EnvSpec, slots: usize) -> Result<Self> {
        let shared_model = SharedModel::new(checkpoint.model.clone());
        Self::new(planner, &checkpoint.config, &checkpoint.dataset_info, shared_model, spec, slots, false)
    }
}

impl Slot {
    /// Plans and stores the first action in model units.
    fn plan(&mut self, planner: &PlannerConfig, rollouts: &Rollouts, latent: &[f32], key: Key, explore: bool) {
        let result = planner.search(rollouts, latent, &self.mean, key);
        let dim = self.action.len();
        let mut draw: f32 = key.with("elite").rng().random();
        let chosen = result.weights.iter().position(|weight| {
            draw -= weight;
            draw < 0.0
        });
        let elite = chosen.unwrap_or(0) * self.mean.len();
        self.action.copy_from_slice(&result.elites[elite..][..dim]);
        if explore {
            let noise = normal(&[key.with("exploration")], dim);
            for ((action, noise), std) in self.action.iter_mut().zip(noise).zip(&result.std) {
                *action = (*action + noise * std).clamp(-1.0, 1.0);
            }
        }
        let len = self.mean.len();
        self.mean[..len - dim].copy_from_slice(&result.mean[dim..]);
        self.mean[len - dim..].fill(0.0);
    }
}

impl Policy for Tdmpc2Policy {
    fn begin(&mut self, slot: usize, key: Key) {
        let slot = &mut self.slots[slot];
        slot.key = key.with("tdmpc2");
        slot.mean.fill(0.0);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(ACTION)?;
        let started = Instant::now();
        // The key depends on the step of the episode, so that a policy that starts in mid-episode draws the same
        // samples.
        let steps = infos.get::<i32>(STEP_IDX)?;
        let rollouts = Rollouts::new(&self.shared_model.get(), self.discount, self.uncertainty);
        let (planner, model, explore) = (&self.planner, &self.model, self.explore);
        self.slots.par_iter_mut().enumerate().filter(|(slot, _)| active[*slot]).for_each(|(row, slot)| {
            match latent(model, rollouts.model(), infos, row) {
                Ok(latent) => {
                    let key = slot.key.at(steps[row].unsigned_abs().into());
                    slot.plan(planner, &rollouts, &latent, key, explore);
                }
                Err(error) => slot.failed = Some(error),
            }
        });
        if let Some(error) = self.slots.iter_mut().find_map(|slot| slot.failed.take()) {
            return Err(error);
        }
        let mut action = vec![0.0; self.scale.dim()];
        let count = active.iter().filter(|&&active| active).count();
        for (row, slot) in self.slots.iter().enumerate().filter(|&(row, _)| active[row]) {
            self.scale.to_env(&slot.action, &mut action);
            actions.row_mut(row).set(column, &action);
        }
        let seconds = started.elapsed().as_secs_f64() / count.max(1) as f64;
        self.latencies.extend(std::iter::repeat_n(seconds, count));
        Ok(())
    }

    /// Returns the seconds of each plan: the time of a call is divided equally among the environments.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}

impl AgentPolicy for Tdmpc2Policy {
    /// The initial means of the next searches, a slot each.
    fn memory(&self) -> Vec<Vec<f32>> {
        self.slots.iter().map(|slot| slot.mean.clone()).collect()
    }

    fn recall(&mut self, memory: &[Vec<f32>]) -> Result<()> {
        if memory.is_empty() {
            return Ok(());
        }
        let lengths = |means: &mut dyn Iterator<Item = usize>| means.collect::<Vec<_>>();
        let given = lengths(&mut memory.iter().map(Vec::len));
        let expected = lengths(&mut self.slots.iter().map(|slot| slot.mean.len()));
        if given != expected {
            let given = format!("plans of {given:?} values");
            return Err(Error::mismatch("continuing a training run", given, format!("{expected:?}")));
        }
        self.slots.iter_mut().zip(memory).for_each(|(slot, mean)| slot.mean.clone_from(mean));
        Ok(())
    }
}

/// Returns the latent of the observation in a row of the infos, `[latent]`.
///
/// # Errors
/// When the infos lack a column that the model observes.
pub fn latent(config: &Tdmpc2Config, model: &Tdmpc2, infos: &Batch, row: usize) -> Result<Vec<f32>> {
    let observation = observe_row(config, model, infos.row(row))?;
    Ok(model.encode(observation).into_data().into_f32_vec())
}
