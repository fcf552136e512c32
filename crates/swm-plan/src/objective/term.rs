//! The terms an objective is made of: [`Goal`], [`Control`], [`Change`].

use super::{
    Objective, Pick, Shape, Slope, Trajectory, check_block, check_latents, check_picks, check_positive, picked,
};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// When a term is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum When {
    /// After the last step.
    Terminal,
    /// After every step, the last included.
    Running,
}

/// The squared distance of latents to those of the goal: `w Σ_t γ^(t-1) Σ_i (z_t,i - g_i)²`, over the last latent or over
/// all that are predicted. With the defaults, the cost of the reference's models, which add up squared errors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Goal {
    /// The weight, w.
    pub weight: f32,
    /// Which latents are compared.
    pub when: When,
    /// How much less a later latent weighs, γ, if it is running.
    pub discount: f32,
    /// Which numbers of a latent; all where none is named.
    pub latents: Vec<Pick>,
}

impl Default for Goal {
    fn default() -> Self {
        Self { weight: 1.0, when: When::Terminal, discount: 1.0, latents: vec![] }
    }
}

impl Goal {
    /// The latents that are due, each with its place and its weight.
    fn due(&self, trajectory: Trajectory<'_>) -> impl Iterator<Item = (usize, f32)> {
        let latent = trajectory.goal.len();
        let last = trajectory.latents.len() / latent - 1;
        let first = if self.when == When::Terminal { last } else { 1 };
        let (mut weight, discount) = (self.weight, self.discount);
        (first..=last).map(move |t| {
            let due = (t * latent, weight);
            weight *= discount;
            due
        })
    }
}

impl Objective for Goal {
    fn needs_latents(&self) -> bool {
        true
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_latents("goal term", shape)?;
        check_picks("goal term", &self.latents, shape.latent)?;
        check_positive("goal term", "weight", self.weight)?;
        check_positive("goal term", "discount", self.discount)?;
        #[allow(clippy::float_cmp)]
        if self.when == When::Terminal && self.discount != 1.0 {
            let given = format!("{} of a terminal term", self.discount);
            return Err(Error::config("goal term, discount", given, "make it running, or leave the discount at 1"));
        }
        Ok(())
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        let Trajectory { latents, goal, .. } = trajectory;
        let distance =
            |at: usize| -> f32 { picked(&self.latents, goal.len()).map(|i| (latents[at + i] - goal[i]).powi(2)).sum() };
        self.due(trajectory).map(|(at, weight)| weight * distance(at)).sum()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        let Trajectory { latents, goal, .. } = trajectory;
        for (at, weight) in self.due(trajectory) {
            for i in picked(&self.latents, goal.len()) {
                slope.latents[at + i] += 2.0 * weight * (latents[at + i] - goal[i]);
            }
        }
    }
}

/// The effort of a plan: `w Σ_t ‖a_t‖²`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Control {
    /// The weight, w.
    pub weight: f32,
}

impl Default for Control {
    fn default() -> Self {
        Self { weight: 1.0 }
    }
}

impl Objective for Control {
    fn needs_latents(&self) -> bool {
        false
    }

    fn check(&self, _: Shape) -> Result<()> {
        check_positive("control term", "weight", self.weight)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.weight * trajectory.actions.iter().map(|a| a * a).sum::<f32>()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        slope.actions.iter_mut().zip(trajectory.actions).for_each(|(g, a)| *g += 2.0 * self.weight * a);
    }
}

/// How restless a plan is: `w Σ_t ‖a_t - a_{t-1}‖²` from its second action on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Change {
    /// The weight, w.
    pub weight: f32,
    /// Actions of the environment in a model step, each compared with the one before.
    pub block: usize,
}

impl Default for Change {
    fn default() -> Self {
        Self { weight: 1.0, block: 1 }
    }
}

impl Objective for Change {
    fn needs_latents(&self) -> bool {
        false
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_positive("change term", "weight", self.weight)?;
        check_block("change term", self.block, shape.dim)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        let Trajectory { actions, dim, .. } = trajectory;
        let later = &actions[dim / self.block..];
        self.weight * later.iter().zip(actions).map(|(later, earlier)| (later - earlier).powi(2)).sum::<f32>()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        let Trajectory { actions, dim, .. } = trajectory;
        let width = dim / self.block;
        for i in width..actions.len() {
            let pull = 2.0 * self.weight * (actions[i] - actions[i - width]);
            slope.actions[i] += pull;
            slope.actions[i - width] -= pull;
        }
    }
}
