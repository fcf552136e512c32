//! Inequality constraints on trajectories: [`ActionNorm`], [`LatentBox`], and custom ones.

use super::contracts::{Constraint, Shape, Slope, Trajectory, check_block, check_latents};
use super::pick::{Pick, check_picks, picked};
use crate::search::Settings;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// Limits the norm of every action: `‖a_t‖ - limit ≤ 0`. At a zero action, the gradient is taken to be zero.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionNorm {
    /// The largest norm of an action.
    pub limit: f32,
    /// Environment actions in a model step; the limit holds for each of them.
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
        Settings("action norm").not_negative("limit", self.limit)?;
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

/// Bounds predicted latents: `low - z_t,i ≤ 0` and `z_t,i - high ≤ 0` after every step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LatentBox {
    /// The bounded latent dimensions; empty for all.
    pub latents: Vec<Pick>,
    /// The lower bound, if there is one.
    pub low: Option<f32>,
    /// The upper bound, if there is one.
    pub high: Option<f32>,
}

impl LatentBox {
    /// The bounds that exist, each with the sign of the constraint's derivative.
    fn sides(&self) -> impl Iterator<Item = (f32, f32)> + Clone {
        self.low.map(|low| (-1.0, low)).into_iter().chain(self.high.map(|high| (1.0, high)))
    }

    /// Every bounded value of the predicted latents: its index, the sign of the derivative, and the bound.
    fn bounded(&self, latent: usize, latents: usize) -> impl Iterator<Item = (usize, f32, f32)> {
        let steps = (latent..latents).step_by(latent.max(1));
        let indices = steps.flat_map(move |start| picked(&self.latents, latent).map(move |i| start + i));
        indices.flat_map(|index| self.sides().map(move |(sign, bound)| (index, sign, bound)))
    }
}

impl LatentBox {
    /// Checks the bounds, without a model.
    ///
    /// # Errors
    /// When there is no bound, a bound is not finite, or the lower bound is above the upper one.
    pub(super) fn check_bounds(&self) -> Result<()> {
        let (low, high) = (self.low.unwrap_or(f32::NEG_INFINITY), self.high.unwrap_or(f32::INFINITY));
        let bounds = self.low.is_none_or(f32::is_finite) && self.high.is_none_or(f32::is_finite) && low <= high;
        if bounds && (self.low.is_some() || self.high.is_some()) {
            return Ok(());
        }
        let shown = |bound: Option<f32>| bound.map_or("none".to_owned(), |bound| bound.to_string());
        let given = format!("lower bound {}, upper bound {}", shown(self.low), shown(self.high));
        Err(Error::config("latent box", given, "give a finite lower bound, a finite upper bound not below it, or both"))
    }
}

impl Constraint for LatentBox {
    fn needs_latents(&self) -> bool {
        true
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_latents("latent box", shape)?;
        check_picks("latent box", &self.latents, shape.latent)?;
        self.check_bounds()
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

/// A constraint made of two functions: `values` writes `count` values, and `gradient` adds the gradient of their
/// weighted sum.
pub struct CustomConstraint<V, G> {
    /// The number of values, independent of the horizon.
    pub count: usize,
    /// Whether the functions use latents.
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
