//! [`VirtualStates`]: the states between start and goal as variables of [`Grasp`](super::Grasp).

use super::ID;
use crate::search::{Descent, UNWRITTEN, add_noise, latent};
use swm_core::{CostModel, Error, PlanProblem, Result};

/// States on the way from start to goal, and their gradient.
///
/// # Shapes
/// `values` and `gradient` are `[envs, horizon + 1, latent]`; the first and the last state, start and goal, do not
/// move. The private buffers are `[envs, horizon, latent]`.
pub struct VirtualStates {
    pub values: Vec<f32>,
    pub gradient: Vec<f32>,
    /// z_t, from which ẑ_{t+1} is predicted.
    from: Vec<f32>,
    /// ẑ_{t+1}.
    next: Vec<f32>,
    /// The gradient of the loss with respect to ẑ_{t+1}.
    next_gradient: Vec<f32>,
    /// The gradient with respect to z_t as an input, which is discarded.
    unused: Vec<f32>,
    horizon: usize,
    latent: usize,
}

impl VirtualStates {
    /// States on the straight line from start to goal.
    ///
    /// # Errors
    /// When the model has no latent state, or encodes values that are not finite.
    pub fn straight(cost: &mut dyn CostModel, problem: &PlanProblem<'_>) -> Result<Self> {
        let (envs, horizon, model) = (problem.keys.len(), problem.horizon, latent(ID, cost)?);
        let latent = model.latent_dim();
        if latent == 0 {
            return Err(Error::mismatch("the latent dimension of a model", "0", "at least 1"));
        }
        let (mut start, mut goal) = (vec![UNWRITTEN; envs * latent], vec![UNWRITTEN; envs * latent]);
        model.encode(&mut start, &mut goal)?;
        check_finite("the latent state of start or goal", &[&start, &goal], latent, "at the start")?;

        let mut values = Vec::with_capacity(envs * (horizon + 1) * latent);
        for (start, goal) in start.chunks_exact(latent).zip(goal.chunks_exact(latent)) {
            for t in 0..=horizon {
                let fraction = t as f32 / horizon as f32;
                values.extend(start.iter().zip(goal).map(|(start, goal)| (1.0 - fraction) * start + fraction * goal));
            }
        }
        let [from, next, next_gradient, unused] = std::array::from_fn(|_| vec![0.0; envs * horizon * latent]);
        Ok(Self { gradient: vec![0.0; values.len()], values, from, next, next_gradient, unused, horizon, latent })
    }

    /// Computes the gradients of the loss with respect to the states and to the actions of `descent`.
    ///
    /// # Errors
    /// When the model fails or returns values that are not finite.
    pub fn differentiate(
        &mut self,
        cost: &mut dyn CostModel,
        descent: &mut Descent<'_>,
        gamma: f32,
        k: usize,
    ) -> Result<()> {
        let (all, steps) = ((self.horizon + 1) * self.latent, self.horizon * self.latent);
        for (from, states) in self.from.chunks_exact_mut(steps).zip(self.values.chunks_exact(all)) {
            from.copy_from_slice(&states[..steps]);
        }
        let model = latent(ID, cost)?;
        let actions = &descent.population.actions;
        self.next.fill(UNWRITTEN);
        model.predict(&self.from, actions, &mut self.next)?;
        check_finite("a predicted latent state", &[&self.next], steps, &format!("in iteration {k}"))?;

        let envs = self.values.chunks_exact(all).zip(self.gradient.chunks_exact_mut(all));
        let predicted = self.next.chunks_exact(steps).zip(self.next_gradient.chunks_exact_mut(steps));
        for ((states, gradient), (next, next_gradient)) in envs.zip(predicted) {
            let goal = &states[steps..];
            // The prediction at `i` is compared with the state of the next step, at `i + latent`.
            for (i, &next) in next.iter().enumerate() {
                let error = 2.0 * (next - states[i + self.latent]);
                next_gradient[i] = error + gamma * 2.0 * (next - goal[i % self.latent]);
                gradient[i + self.latent] = -error;
            }
            gradient[steps..].fill(0.0);
        }
        descent.gradient.fill(UNWRITTEN);
        model.predict_vjp(&self.from, actions, &self.next_gradient, &mut self.unused, &mut descent.gradient)?;
        descent.check_gradient()
    }

    /// The loss of every environment at the last [`VirtualStates::differentiate`], `[envs]`.
    pub fn losses(&self, gamma: f32) -> Vec<f32> {
        let (all, steps) = ((self.horizon + 1) * self.latent, self.horizon * self.latent);
        let envs = self.from.chunks_exact(steps).zip(self.next.chunks_exact(steps)).zip(self.values.chunks_exact(all));
        let loss = |((from, next), states): ((&[f32], &[f32]), &[f32])| {
            let goal = &states[steps..];
            let square = |a: f32, b: f32| f64::from(a - b).powi(2);
            // `from` holds the states of the gradient; the goal follows them.
            let after = from[self.latent..].iter().chain(goal);
            let terms = next.iter().zip(after).enumerate();
            terms
                .map(|(i, (&next, &z))| square(next, z) + f64::from(gamma) * square(next, goal[i % self.latent]))
                .sum::<f64>() as f32
        };
        envs.map(loss).collect()
    }

    /// Adds noise with the standard deviation `sigma` to the states between start and goal.
    pub fn perturb(&mut self, problem: &PlanProblem<'_>, sigma: f32, k: usize) {
        if sigma > 0.0 {
            let steps = self.horizon * self.latent;
            for (states, key) in self.values.chunks_exact_mut(steps + self.latent).zip(problem.keys) {
                add_noise(&mut states[self.latent..steps], sigma, key.with(ID).with("state").at(k as u64));
            }
        }
    }
}

/// Checks that arrays with `width` values for each environment are finite.
fn check_finite(what: &str, arrays: &[&[f32]], width: usize, when: &str) -> Result<()> {
    for values in arrays {
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            return Err(Error::NotFinite {
                what: what.to_owned(),
                given: format!("{} for planned environment {} {when}", values[i], i / width),
                fix: "the model diverges on these actions or its weights are damaged; check the checkpoint".to_owned(),
            });
        }
    }
    Ok(())
}
