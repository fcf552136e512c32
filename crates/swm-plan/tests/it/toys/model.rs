//! [`Model`]: a toy as a cost model.

use super::landscapes::Reach;
use super::{Landscape, Toy};
use swm_core::{Batch, Candidates, Constrained, CostModel, DifferentiableCost, LatentDynamics, Result};

/// A toy as a cost model.
pub struct Model {
    toy: &'static Toy,
    landscapes: Vec<Box<dyn Landscape>>,
    /// Whether the model offers a gradient and latent dynamics.
    gradient: bool,
    /// Replaces the cost of one candidate: environment, sample, and cost. Without a cost, the model writes none.
    wrong: Option<(usize, usize, Option<f32>)>,
}

impl Model {
    /// The model of a toy after it has observed these environments.
    pub fn new(toy: &'static Toy, envs: &[usize]) -> Self {
        let landscapes = envs.iter().map(|&env| (toy.landscape)(env)).collect();
        Self { toy, landscapes, gradient: true, wrong: None }
    }

    /// This model without gradient and latent dynamics.
    pub fn opaque(self) -> Self {
        Self { gradient: false, ..self }
    }

    /// This model with a wrong cost for one candidate; with `None`, the model does not write the cost.
    pub fn with_wrong_cost(self, env: usize, sample: usize, cost: Option<f32>) -> Self {
        Self { wrong: Some((env, sample, cost)), ..self }
    }

    fn landscape(&self, position: usize) -> &dyn Landscape {
        &*self.landscapes[position]
    }

    /// The candidates, each with the landscape of its environment.
    fn each<'a>(&'a self, candidates: Candidates<'a>) -> impl Iterator<Item = (&'a dyn Landscape, Vec<f64>)> {
        assert_eq!(candidates.envs, self.landscapes.len(), "the numbers of environments differ");
        assert_eq!(
            (candidates.horizon, candidates.dim),
            (self.toy.horizon, self.toy.space.dim()),
            "the shapes of candidates differ"
        );
        let plans = candidates.actions.chunks_exact(candidates.horizon * candidates.dim);
        plans.enumerate().map(move |(i, plan)| (self.landscape(i / candidates.samples), wide(plan)))
    }

    fn systems(&self) -> Vec<&Reach> {
        self.landscapes.iter().map(|landscape| landscape.system().expect("a latent toy")).collect()
    }
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value)).collect()
}

impl CostModel for Model {
    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.landscapes = envs.iter().map(|&env| (self.toy.landscape)(env)).collect();
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        assert_eq!(costs.len(), candidates.envs * candidates.samples, "the numbers of costs differ");
        for (i, (landscape, plan)) in self.each(candidates).enumerate() {
            let wrong = self.wrong.filter(|&(env, sample, _)| i == env * candidates.samples + sample);
            match wrong {
                None => costs[i] = landscape.cost(&plan) as f32,
                Some((_, _, Some(cost))) => costs[i] = cost,
                Some((_, _, None)) => {}
            }
        }
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        self.gradient.then_some(self)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        (self.gradient && self.toy.latent).then_some(self)
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        self.toy.constrained.then_some(self)
    }
}

impl DifferentiableCost for Model {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.cost(candidates, costs)?;
        let gradients = self.each(candidates).flat_map(|(landscape, plan)| landscape.gradient(&plan));
        gradient.iter_mut().zip(gradients).for_each(|(to, from)| *to = from as f32);
        Ok(())
    }
}

impl Constrained for Model {
    fn constraints(&self, _horizon: usize) -> usize {
        let plan = vec![0.0; self.toy.horizon * self.toy.space.dim()];
        self.landscapes.first().map_or(0, |landscape| landscape.constraints(&plan).len())
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let constraints = self.each(candidates).flat_map(|(landscape, plan)| landscape.constraints(&plan));
        values.iter_mut().zip(constraints).for_each(|(to, from)| *to = from as f32);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        let weights = weights.chunks_exact(Constrained::constraints(self, self.toy.horizon));
        let plans = self.each(candidates).zip(weights);
        let gradients =
            plans.flat_map(|((landscape, plan), weights)| landscape.constraint_gradient(&plan, &wide(weights)));
        gradient.iter_mut().zip(gradients).for_each(|(to, from)| *to += from as f32);
        Ok(())
    }
}

impl LatentDynamics for Model {
    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        for (i, system) in self.systems().into_iter().enumerate() {
            for j in 0..2 {
                start[i * 2 + j] = system.start[j] as f32;
                goal[i * 2 + j] = system.goal[j] as f32;
            }
        }
        Ok(())
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        next.iter_mut().zip(latents.iter().zip(actions)).for_each(|(next, (latent, action))| *next = latent + action);
        Ok(())
    }

    fn predict_vjp(
        &mut self,
        _: &[f32],
        _: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        latent_gradient.copy_from_slice(next_gradient);
        action_gradient.copy_from_slice(next_gradient);
        Ok(())
    }
}
