//! [`Trajectories`]: the costs, constraints and gradients of a whole population.

use super::contracts::{Constraint, Objective, Shape, Slope, Trajectory};
use swm_core::{Candidates, Error, Result};

/// Candidates and their predicted latents.
///
/// # Shapes
/// `latents` is `[envs, samples, horizon + 1, latent]`, `goals` is `[envs, latent]`.
#[derive(Clone, Copy)]
pub(super) struct Trajectories<'a> {
    pub candidates: Candidates<'a>,
    pub latents: &'a [f32],
    pub goals: &'a [f32],
    /// The latent dimension.
    pub latent: usize,
}

impl<'a> Trajectories<'a> {
    /// The number of latent values and of action values of one candidate.
    fn sizes(&self) -> (usize, usize) {
        let Candidates { horizon, dim, .. } = self.candidates;
        ((horizon + 1) * self.latent, horizon * dim)
    }

    /// Iterates over the candidates.
    fn iter(self) -> impl Iterator<Item = Trajectory<'a>> {
        let (all, len) = self.sizes();
        (0..self.candidates.envs * self.candidates.samples).map(move |i| Trajectory {
            latents: &self.latents[i * all..][..all],
            goal: &self.goals[i / self.candidates.samples * self.latent..][..self.latent],
            actions: &self.candidates.actions[i * len..][..len],
            dim: self.candidates.dim,
        })
    }

    /// Adds the cost of every candidate to `costs`, `[envs, samples]`.
    pub fn add_costs(self, objective: &dyn Objective, costs: &mut [f32]) {
        self.iter().zip(costs).for_each(|(trajectory, cost)| *cost += objective.cost(trajectory));
    }

    /// Adds the gradients of the costs to `latents`, `[envs, samples, horizon + 1, latent]`, and `actions`,
    /// `[envs, samples, horizon, dim]`.
    pub fn add_gradients(self, objective: &dyn Objective, latents: &mut [f32], actions: &mut [f32]) {
        let (all, len) = self.sizes();
        for (i, trajectory) in self.iter().enumerate() {
            let (latents, actions) = (&mut latents[i * all..][..all], &mut actions[i * len..][..len]);
            objective.add_gradient(trajectory, &mut Slope { latents, actions });
        }
    }

    /// The number of constraint values of all candidates.
    pub fn count(self, constraints: &[Box<dyn Constraint>]) -> usize {
        let each: usize =
            constraints.iter().map(|constraint| constraint.count(self.candidates.horizon, self.latent)).sum();
        self.candidates.envs * self.candidates.samples * each
    }

    /// Writes the values of all constraints, `[envs, samples, constraints]`.
    pub fn constrain(self, constraints: &[Box<dyn Constraint>], values: &mut [f32]) {
        let mut rest = values;
        for trajectory in self.iter() {
            for constraint in constraints {
                let (values, tail) = rest.split_at_mut(constraint.count(self.candidates.horizon, self.latent));
                constraint.values(trajectory, values);
                rest = tail;
            }
        }
    }

    /// Adds the gradients of the constraints, each multiplied by its weight, `[envs, samples, constraints]`.
    pub fn add_constraint_gradients(
        self,
        constraints: &[Box<dyn Constraint>],
        weights: &[f32],
        latents: &mut [f32],
        actions: &mut [f32],
    ) {
        let (all, len) = self.sizes();
        let mut rest = weights;
        for (i, trajectory) in self.iter().enumerate() {
            let (latents, actions) = (&mut latents[i * all..][..all], &mut actions[i * len..][..len]);
            let slope = &mut Slope { latents, actions };
            for constraint in constraints {
                let (weights, tail) = rest.split_at(constraint.count(self.candidates.horizon, self.latent));
                constraint.add_gradient(trajectory, weights, slope);
                rest = tail;
            }
        }
    }
}

/// Checks an objective and constraints for trajectories of this shape.
pub(super) fn check_all(shape: Shape, objective: &dyn Objective, constraints: &[Box<dyn Constraint>]) -> Result<()> {
    objective.check(shape)?;
    constraints.iter().try_for_each(|constraint| constraint.check(shape))
}

/// Checks the length of an array.
pub(super) fn check_len(what: &str, given: usize, expected: usize) -> Result<()> {
    if given == expected {
        return Ok(());
    }
    Err(Error::mismatch(what, format!("{given} values"), format!("{expected}")))
}
