//! [`Tdmpc2Cost`]: a TD-MPC2 as a cost model, for any solver: rewards and the value behind them, negated.
//!
//! There is no goal: the task is in the rewards it was trained with.

use super::config::Tdmpc2Config;
use super::model::Tdmpc2;
use super::planner::latent;
use super::rollouts::Rollouts;
use crate::Checkpoint;
use rayon::prelude::*;
use swm_core::{Batch, Candidates, CostModel, Error, Result};

/// The planning cost of a TD-MPC2.
pub struct Tdmpc2Cost {
    rollouts: Rollouts,
    config: Tdmpc2Config,
    /// The latent of every observed environment.
    latents: Vec<Vec<f32>>,
}

impl Tdmpc2Cost {
    /// The cost of a trained model.
    pub fn new(checkpoint: &Checkpoint<Tdmpc2>) -> Self {
        let loss = &checkpoint.config.loss;
        Self {
            rollouts: Rollouts::new(&checkpoint.model, loss.discount, loss.uncertainty),
            config: checkpoint.config.model.clone(),
            latents: vec![],
        }
    }
}

impl CostModel for Tdmpc2Cost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        let model = self.rollouts.model();
        let latents: Result<_> = envs.par_iter().map(|&env| latent(&self.config, model, infos, env)).collect();
        self.latents = latents?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        let width = self.rollouts.model().actions();
        if envs != self.latents.len() || dim != width || costs.len() != envs * samples {
            let words = |envs, dim, costs| format!("{envs} environments, {dim} numbers a model step, {costs} costs");
            return Err(Error::mismatch(
                "costs of a TD-MPC2",
                words(envs, dim, costs.len()),
                words(self.latents.len(), width, envs * samples),
            ));
        }
        let rollouts = &self.rollouts;
        let all = costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * horizon * dim)).zip(&self.latents);
        all.for_each(|((costs, actions), latent)| rollouts.cost(latent, actions, horizon, costs));
        Ok(())
    }
}
