//! [`Rollout`]: the predicted latents of candidates, and back-propagation through the predictions.

use crate::search::UNWRITTEN;
use swm_core::{Candidates, LatentDynamics, Result};

/// The predicted latents of the last candidates, cached because their costs, constraints and gradients all use them.
#[derive(Default)]
pub(super) struct Rollout {
    /// The actions of the candidates.
    actions: Vec<f32>,
    /// The shape of the actions, `[envs, samples, horizon, dim]`.
    shape: [usize; 4],
    /// The present and the predicted latents, `[envs, samples, horizon + 1, latent]`.
    pub latents: Vec<f32>,
    /// The latents of all candidates before the current step.
    before: Vec<f32>,
    /// The actions of all candidates in the current step.
    action: Vec<f32>,
    /// The latents of all candidates after the current step.
    after: Vec<f32>,
    /// The gradient with respect to `before`.
    before_gradient: Vec<f32>,
    /// The gradient with respect to `action`.
    action_gradient: Vec<f32>,
}

impl Rollout {
    /// Discards the cached latents.
    pub fn clear(&mut self) {
        self.shape = [0; 4];
    }

    /// Predicts the latents of all candidates, step by step, unless the latents of these candidates are cached.
    ///
    /// # Shapes
    /// `start` is `[envs, latent]`.
    pub fn run(
        &mut self,
        model: &mut dyn LatentDynamics,
        start: &[f32],
        latent: usize,
        candidates: Candidates<'_>,
    ) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        let shape = [envs, samples, horizon, dim];
        if self.shape == shape && self.actions == actions {
            return Ok(());
        }
        self.clear();
        let all = (horizon + 1) * latent;
        self.latents.clear();
        self.latents.resize(envs * samples * all, 0.0);
        for (row, latents) in self.latents.chunks_exact_mut(all).enumerate() {
            latents[..latent].copy_from_slice(&start[row / samples * latent..][..latent]);
        }
        self.after.resize(envs * samples * latent, 0.0);
        for t in 0..horizon {
            gather(&self.latents, all, t * latent, latent, &mut self.before);
            gather(actions, horizon * dim, t * dim, dim, &mut self.action);
            self.after.fill(UNWRITTEN);
            model.predict(&self.before, &self.action, &mut self.after)?;
            for (latents, next) in self.latents.chunks_exact_mut(all).zip(self.after.chunks_exact(latent)) {
                latents[(t + 1) * latent..][..latent].copy_from_slice(next);
            }
        }
        self.actions.clear();
        self.actions.extend_from_slice(actions);
        self.shape = shape;
        Ok(())
    }

    /// Propagates gradients from the latents back to the actions, from the last step to the first.
    ///
    /// # Shapes
    /// `slopes` has the shape of the latents, `gradient` has the shape of the actions.
    pub fn back(
        &mut self,
        model: &mut dyn LatentDynamics,
        latent: usize,
        candidates: Candidates<'_>,
        slopes: &mut [f32],
        gradient: &mut [f32],
    ) -> Result<()> {
        let Candidates { actions, horizon, dim, .. } = candidates;
        let (all, len) = ((horizon + 1) * latent, horizon * dim);
        for t in (0..horizon).rev() {
            gather(slopes, all, (t + 1) * latent, latent, &mut self.after);
            // No cost depends on these latents, for example because only actions have costs or constraints.
            if self.after.iter().all(|&slope| slope == 0.0) {
                continue;
            }
            gather(&self.latents, all, t * latent, latent, &mut self.before);
            gather(actions, len, t * dim, dim, &mut self.action);
            self.before_gradient.resize(self.before.len(), 0.0);
            self.action_gradient.resize(self.action.len(), 0.0);
            self.before_gradient.fill(UNWRITTEN);
            self.action_gradient.fill(UNWRITTEN);
            model.predict_vjp(
                &self.before,
                &self.action,
                &self.after,
                &mut self.before_gradient,
                &mut self.action_gradient,
            )?;
            add(slopes, all, t * latent, latent, &self.before_gradient);
            add(gradient, len, t * dim, dim, &self.action_gradient);
        }
        Ok(())
    }
}

/// Copies `width` values of every row, from index `at` on.
fn gather(rows: &[f32], row: usize, at: usize, width: usize, to: &mut Vec<f32>) {
    to.clear();
    rows.chunks_exact(row).for_each(|values| to.extend_from_slice(&values[at..at + width]));
}

/// Adds `terms` to `width` values of every row, from index `at` on.
fn add(rows: &mut [f32], row: usize, at: usize, width: usize, terms: &[f32]) {
    for (values, terms) in rows.chunks_exact_mut(row).zip(terms.chunks_exact(width)) {
        values[at..at + width].iter_mut().zip(terms).for_each(|(value, term)| *value += term);
    }
}
