//! Inequalities on trajectories: [`ActionNorm`], [`LatentBox`], and what users write themselves.

use super::{Pick, Shape, Slope, Trajectory, check_block, check_latents, check_picks, check_positive, picked};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// Differentiable inequalities; each is satisfied when its value is at most 0.
pub trait Constraint: Send + Sync {
    /// Whether it looks at latents.
    fn needs_latents(&self) -> bool;

    /// Checks the settings, for trajectories of this shape.
    ///
    /// # Errors
    /// When they contradict each other or the shape.
    fn check(&self, shape: Shape) -> Result<()>;

    /// How many values, for so many model steps and numbers of a latent.
    fn count(&self, horizon: usize, latent: usize) -> usize;

    /// Writes the values.
    fn values(&self, trajectory: Trajectory<'_>, values: &mut [f32]);

    /// Adds the gradient of the sum of the values, each times its weight.
    fn add_gradient(&self, trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>);
}

/// No action is longer than a limit: `‖a_t‖ - limit ≤ 0`, for every action. Where an action is zero, its slope is taken to
/// be zero too.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionNorm {
    /// The greatest norm of an action.
    pub limit: f32,
    /// Actions of the environment in a model step, each with a norm of its own.
    #[serde(default = "one")]
    pub block: usize,
}

fn one() -> usize {
    1
}

fn norm(action: &[f32]) -> f32 {
    action.iter().map(|a| a * a).sum::<f32>().sqrt()
}

impl Constraint for ActionNorm {
    fn needs_latents(&self) -> bool {
        false
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_positive("action norm", "limit", self.limit)?;
        check_block("action norm", self.block, shape.dim)
    }

    fn count(&self, horizon: usize, _: usize) -> usize {
        horizon * self.block
    }

    fn values(&self, trajectory: Trajectory<'_>, values: &mut [f32]) {
        let actions = trajectory.actions.chunks_exact(trajectory.dim / self.block);
        values.iter_mut().zip(actions).for_each(|(value, action)| *value = norm(action) - self.limit);
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>) {
        let width = trajectory.dim / self.block;
        let actions = trajectory.actions.chunks_exact(width).zip(slope.actions.chunks_exact_mut(width));
        for ((action, slope), weight) in actions.zip(weights) {
            let norm = norm(action);
            if norm > 0.0 {
                slope.iter_mut().zip(action).for_each(|(g, a)| *g += weight * a / norm);
            }
        }
    }
}

/// Predicted latents stay between two bounds: `low - z_t,i ≤ 0` and `z_t,i - high ≤ 0` after every step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LatentBox {
    /// Which numbers of a latent; all where none is named.
    pub latents: Vec<Pick>,
    /// The lower bound, if there is one.
    pub low: Option<f32>,
    /// The upper bound, if there is one.
    pub high: Option<f32>,
}

impl LatentBox {
    /// The sides: how a value rises with a latent, and from what bound.
    fn sides(&self) -> impl Iterator<Item = (f32, f32)> + Clone {
        self.low.map(|low| (-1.0, low)).into_iter().chain(self.high.map(|high| (1.0, high)))
    }

    /// Every predicted number that is bounded, with its place among the latents.
    fn bounded(&self, latent: usize, latents: usize) -> impl Iterator<Item = (usize, f32, f32)> {
        let places = (latent..latents).step_by(latent.max(1));
        let numbers = places.flat_map(move |at| picked(&self.latents, latent).map(move |i| at + i));
        numbers.flat_map(|place| self.sides().map(move |(sign, bound)| (place, sign, bound)))
    }
}

impl Constraint for LatentBox {
    fn needs_latents(&self) -> bool {
        true
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_latents("latent box", shape)?;
        check_picks("latent box", &self.latents, shape.latent)?;
        let (low, high) = (self.low.unwrap_or(f32::NEG_INFINITY), self.high.unwrap_or(f32::INFINITY));
        let bounds = self.low.is_none_or(f32::is_finite) && self.high.is_none_or(f32::is_finite) && low <= high;
        if bounds && (self.low.is_some() || self.high.is_some()) {
            return Ok(());
        }
        let given = format!("{:?} to {:?}", self.low, self.high);
        Err(Error::config("latent box", given, "give a finite lower bound, a finite upper bound not below it, or both"))
    }

    fn count(&self, horizon: usize, latent: usize) -> usize {
        horizon * picked(&self.latents, latent).count() * self.sides().count()
    }

    fn values(&self, trajectory: Trajectory<'_>, values: &mut [f32]) {
        let Trajectory { latents, goal, .. } = trajectory;
        let bounded = self.bounded(goal.len(), latents.len());
        values.iter_mut().zip(bounded).for_each(|(value, (i, sign, bound))| *value = sign * (latents[i] - bound));
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>) {
        let bounded = self.bounded(trajectory.goal.len(), trajectory.latents.len());
        weights.iter().zip(bounded).for_each(|(weight, (i, sign, _))| slope.latents[i] += sign * weight);
    }
}

/// A constraint of functions: `values` writes as many numbers as `count` says, and `gradient` adds the gradient of their
/// weighted sum.
pub struct CustomConstraint<V, G> {
    /// How many values, whatever the horizon.
    pub count: usize,
    /// Whether the functions look at latents.
    pub needs_latents: bool,
    /// See [`Constraint::values`].
    pub values: V,
    /// See [`Constraint::add_gradient`].
    pub gradient: G,
}

impl<V, G> Constraint for CustomConstraint<V, G>
where
    V: Fn(Trajectory<'_>, &mut [f32]) + Send + Sync,
    G: Fn(Trajectory<'_>, &[f32], &mut Slope<'_>) + Send + Sync,
{
    fn needs_latents(&self) -> bool {
        self.needs_latents
    }

    fn check(&self, shape: Shape) -> Result<()> {
        if self.needs_latents { check_latents("custom constraint", shape) } else { Ok(()) }
    }

    fn count(&self, _: usize, _: usize) -> usize {
        self.count
    }

    fn values(&self, trajectory: Trajectory<'_>, values: &mut [f32]) {
        (self.values)(trajectory, values);
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>) {
        (self.gradient)(trajectory, weights, slope);
    }
}
