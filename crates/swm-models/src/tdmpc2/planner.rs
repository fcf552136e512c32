//! Planning as published (section 3.2 and appendix H): model-predictive path integral control in latents, whose population the
//! policy takes part in, and whose candidates end in a value.
//!
//! Every iteration scores `proposals` rollouts of the policy beside samples of a Gaussian around the mean; the `elites` with
//! the lowest cost weigh `exp(-temperature (cost - least))` in the next mean and spread. The mean of the plan before, moved
//! forward, is where a search begins. What is done is the first action of an elite drawn by weight, exploring with noise of
//! the last spread. (Not the mean's: where left and right are as good, it would do neither.)

use super::config::Tdmpc2Config;
use super::model::Tdmpc2;
use super::rollouts::Rollouts;
use super::train::glance;
use crate::Checkpoint;
use crate::nn::normal;
use crate::nn::parameters::IntoF32 as _;
use crate::online::SharedModel;
use crate::train::config::at_least;
use crate::train::{DatasetInfo, TrainConfig};
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result};
use swm_plan::ActionScale;

/// The settings of a search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannerConfig {
    /// Steps ahead.
    pub horizon: usize,
    /// Candidates of an iteration.
    pub samples: usize,
    /// Iterations.
    pub iterations: usize,
    /// Candidates that weigh.
    pub elites: usize,
    /// Candidates that are rollouts of the policy.
    pub proposals: usize,
    /// The least spread of the samples, of actions between -1 and 1.
    pub min_std: f32,
    /// The largest, where a search begins.
    pub max_std: f32,
    /// How much a unit of cost counts.
    pub temperature: f32,
}

impl PlannerConfig {
    /// Checks that the settings make sense.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        at_least(&[
            ("online.planner.horizon", self.horizon, 1),
            ("online.planner.samples", self.samples, 1),
            ("online.planner.iterations", self.iterations, 1),
            ("online.planner.elites", self.elites, 1),
        ])?;
        for (what, part) in [("elites", self.elites), ("proposals", self.proposals)] {
            if part > self.samples {
                let given = format!("{part} of {} candidates", self.samples);
                return Err(Error::config(format!("online.planner.{what}"), given, "choose at most all of them"));
            }
        }
        if !(self.min_std > 0.0 && self.min_std <= self.max_std && self.max_std.is_finite()) {
            let given = format!("from {} to {}", self.min_std, self.max_std);
            return Err(Error::config("online.planner.min_std", given, "choose 0 < min_std <= max_std"));
        }
        if !(self.temperature.is_finite() && self.temperature > 0.0) {
            let fix = "choose a number above 0";
            return Err(Error::config("online.planner.temperature", self.temperature.to_string(), fix));
        }
        Ok(())
    }
}

/// What a search found.
pub struct Found {
    /// The mean of the elites, `[horizon, actions]`.
    pub mean: Vec<f32>,
    /// Their spread.
    pub std: Vec<f32>,
    /// The elites, cheapest first, `[elites, horizon, actions]`.
    pub elites: Vec<f32>,
    /// What each weighs; they add up to 1.
    pub weights: Vec<f32>,
}

impl PlannerConfig {
    /// Searches from a latent; `mean`, `[horizon, actions]`, is where it begins. Decided by `key`.
    pub fn search(&self, rollouts: &Rollouts, latent: &[f32], mean: &[f32], key: Key) -> Found {
        let len = mean.len();
        let mut candidates = vec![0.0; self.samples * len];
        let (proposals, sampled) = candidates.split_at_mut(self.proposals * len);
        if self.proposals > 0 {
            rollouts.propose(latent, &[], self.horizon, key.with("proposals"), proposals);
        }
        let mut found = Found { mean: mean.to_vec(), std: vec![self.max_std; len], elites: vec![], weights: vec![] };
        let numbers = sampled.len();
        let mut costs = vec![0.0; self.samples];
        let mut order: Vec<usize> = vec![];
        for iteration in 0..self.iterations {
            let drawn = normal(&[key.at(iteration as u64)], numbers);
            for (i, (to, noise)) in candidates[self.proposals * len..].iter_mut().zip(drawn).enumerate() {
                *to = (found.mean[i % len] + found.std[i % len] * noise).clamp(-1.0, 1.0);
            }
            rollouts.cost(latent, &candidates, self.horizon, &mut costs);
            order.clear();
            order.extend(0..self.samples);
            order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(a.cmp(&b)));
            order.truncate(self.elites);
            found.elites.clear();
            order.iter().for_each(|&i| found.elites.extend_from_slice(&candidates[i * len..][..len]));
            self.weigh(order.iter().map(|&i| costs[i] - costs[order[0]]), &mut found);
        }
        found
    }

    /// Weights of the elites by how much dearer than the cheapest they are; their mean and spread.
    fn weigh(&self, dearer: impl Iterator<Item = f32>, found: &mut Found) {
        let Found { mean, std, elites, weights } = found;
        weights.clear();
        weights.extend(dearer.map(|cost| (-self.temperature * cost).exp()));
        let sum: f32 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
        let len = mean.len();
        mean.fill(0.0);
        for (elite, weight) in elites.chunks_exact(len).zip(&*weights) {
            mean.iter_mut().zip(elite).for_each(|(mean, number)| *mean += weight * number);
        }
        std.fill(0.0);
        for (elite, weight) in elites.chunks_exact(len).zip(&*weights) {
            std.iter_mut()
                .zip(elite)
                .zip(&*mean)
                .for_each(|((std, number), mean)| *std += weight * (number - mean).powi(2));
        }
        std.iter_mut().for_each(|std| *std = std.sqrt().clamp(self.min_std, self.max_std));
    }
}

/// Plans at every step with a TD-MPC2.
pub struct Tdmpc2Policy {
    planner: PlannerConfig,
    model: Tdmpc2Config,
    discount: f64,
    uncertainty: f64,
    scale: ActionScale,
    live: SharedModel<Tdmpc2>,
    explore: bool,
    slots: Vec<Slot>,
    latencies: Vec<f64>,
}

/// The plan of one world.
struct Slot {
    key: Key,
    /// Where the next search begins, `[horizon, actions]`.
    mean: Vec<f32>,
    action: Vec<f32>,
    failed: Option<Error>,
}

impl Tdmpc2Policy {
    /// A policy for `slots` worlds of `spec`, with the weights that `live` holds at the moment.
    ///
    /// # Errors
    /// When the model was trained for other actions, or the settings make no sense.
    pub fn new(
        planner: &PlannerConfig,
        config: &TrainConfig<Tdmpc2>,
        dataset_info: &DatasetInfo,
        live: SharedModel<Tdmpc2>,
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
            live,
            explore,
            slots: (0..slots).map(|_| slot()).collect(),
            latencies: vec![],
        })
    }

    /// The policy of a checkpoint.
    ///
    /// # Errors
    /// As [`Tdmpc2Policy::new`].
    pub fn of(checkpoint: &Checkpoint<Tdmpc2>, planner: &PlannerConfig, spec: &EnvSpec, slots: usize) -> Result<Self> {
        let live = SharedModel::new(checkpoint.model.clone());
        Self::new(planner, &checkpoint.config, &checkpoint.dataset_info, live, spec, slots, false)
    }
}

impl Slot {
    /// Plans, and says the first action in model units.
    fn plan(&mut self, planner: &PlannerConfig, rollouts: &Rollouts, latent: &[f32], key: Key, explore: bool) {
        let found = planner.search(rollouts, latent, &self.mean, key);
        let dim = self.action.len();
        let mut draw: f32 = key.with("elite").rng().random();
        let chosen = found.weights.iter().position(|weight| {
            draw -= weight;
            draw < 0.0
        });
        let elite = chosen.unwrap_or(0) * self.mean.len();
        self.action.copy_from_slice(&found.elites[elite..][..dim]);
        if explore {
            let noise = normal(&[key.with("exploration")], dim);
            for ((action, noise), std) in self.action.iter_mut().zip(noise).zip(&found.std) {
                *action = (*action + noise * std).clamp(-1.0, 1.0);
            }
        }
        let len = self.mean.len();
        self.mean[..len - dim].copy_from_slice(&found.mean[dim..]);
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
        let column = actions.schema().index("action")?;
        let begun = Instant::now();
        // Of the episode, not of this policy: who comes in later draws the same.
        let steps = infos.get::<i32>("step_idx")?;
        let rollouts = Rollouts::new(&self.live.get(), self.discount, self.uncertainty);
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
        #[allow(clippy::cast_precision_loss)]
        let share = begun.elapsed().as_secs_f64() / count.max(1) as f64;
        self.latencies.extend(std::iter::repeat_n(share, count));
        Ok(())
    }

    /// Seconds each plan took: worlds planned for together share their time equally.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}

/// The latent of what a row of the infos shows.
pub(super) fn latent(config: &Tdmpc2Config, model: &Tdmpc2, infos: &Batch, row: usize) -> Result<Vec<f32>> {
    let observation = glance(config, model, infos.row(row))?;
    Ok(model.encode(observation).into_data().into_f32_vec())
}
