//! [`Tdmpc2Cost`]: the planning cost of a TD-MPC2 for any solver, the negated sum of predicted rewards and the final
//! value. The cost reads no goal: the rewards of the training data define the task.

use super::config::Tdmpc2Config;
use super::model::Tdmpc2;
use super::planner::latent;
use super::rollouts::Rollouts;
use crate::Checkpoint;
use crate::checks;
use rayon::prelude::*;
use swm_core::{Batch, Candidates, CostModel, Result};

/// The planning cost of a TD-MPC2.
pub struct Tdmpc2Cost {
    rollouts: Rollouts,
    config: Tdmpc2Config,
    /// The latent of every observed environment, `[latent]` each.
    latents: Vec<Vec<f32>>,
}

impl Tdmpc2Cost {
    /// Creates the planning cost of a trained model.
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
        let sizes = [self.latents.len(), self.rollouts.model().action_dim()];
        checks::candidate_sizes("costs of a TD-MPC2", &candidates, costs, sizes)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let rollouts = &self.rollouts;
        let all = costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * horizon * dim)).zip(&self.latents);
        all.for_each(|((costs, actions), latent)| rollouts.cost(latent, actions, horizon, costs));
        Ok(())
    }
}
