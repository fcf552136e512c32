//! The terms of an objective: [`Goal`], [`Control`], [`Change`].

use super::contracts::{Objective, Shape, Slope, Trajectory, check_block, check_latents};
use super::pick::{Pick, check_picks, picked};
use crate::search::Settings;
use serde::{Deserialize, Serialize};
use swm_core::Result;

/// The steps at which a term is evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum When {
    /// After the last step.
    Terminal,
    /// After every step, the last included.
    Running,
    /// After the step whose latent is closest to the goal's. A plan may then reach the goal before its end, so a long
    /// horizon delays nothing.
    Closest,
}

/// The squared distance of latents to the goal's latent: `w Σ_t γ^(t-1) Σ_i (z_t,i - g_i)²`, over the last latent, the
/// closest one or all predicted ones. The defaults give the cost of the reference implementation's models.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Goal {
    /// The weight, w.
    pub weight: f32,
    /// The steps after which latents are compared.
    pub when: When,
    /// The discount factor of later latents, γ, for a running term.
    pub discount: f32,
    /// The compared latent dimensions; empty for all.
    pub latents: Vec<Pick>,
}

impl Default for Goal {
    fn default() -> Self {
        Self { weight: 1.0, when: When::Terminal, discount: 1.0, latents: vec![] }
    }
}

impl Goal {
    /// The compared latents: the index of the first value and the weight of each.
    fn compared(&self, trajectory: Trajectory<'_>) -> impl Iterator<Item = (usize, f32)> {
        let latent = trajectory.goal.len();
        let last = trajectory.latents.len() / latent - 1;
        let steps = match self.when {
            When::Terminal => last..=last,
            When::Running => 1..=last,
            When::Closest => {
                let distance = |t: &usize| self.distance(trajectory, t * latent);
                let closest = (1..=last).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(last);
                closest..=closest
            }
        };
        let (mut weight, discount) = (self.weight, self.discount);
        steps.map(move |t| {
            let compared = (t * latent, weight);
            weight *= discount;
            compared
        })
    }

    /// The squared distance of the latent that begins at the index `at`.
    fn distance(&self, trajectory: Trajectory<'_>, at: usize) -> f32 {
        let Trajectory { latents, goal, .. } = trajectory;
        picked(&self.latents, goal.len()).map(|i| (latents[at + i] - goal[i]).powi(2)).sum()
    }

    /// Checks weight and discount, without a model.
    ///
    /// # Errors
    /// When a number is invalid; the error names it.
    pub(super) fn check_numbers(&self) -> Result<()> {
        let settings = Settings("goal term");
        settings.not_negative("weight", self.weight)?;
        settings.not_negative("discount", self.discount)?;
        #[allow(clippy::float_cmp, reason = "1 is the default, which no arithmetic has changed")]
        let undiscounted = self.discount == 1.0;
        settings.check(
            self.when == When::Running || undiscounted,
            "discount",
            format!("{} of a term of one step", self.discount),
            "make it running, or leave the discount at 1",
        )
    }
}

impl Objective for Goal {
    fn needs_latents(&self) -> bool {
        true
    }

    fn check(&self, shape: Shape) -> Result<()> {
        check_latents("goal term", shape)?;
        check_picks("goal term", &self.latents, shape.latent)?;
        self.check_numbers()
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.compared(trajectory).map(|(at, weight)| weight * self.distance(trajectory, at)).sum()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        let Trajectory { latents, goal, .. } = trajectory;
        for (at, weight) in self.compared(trajectory) {
            for i in picked(&self.latents, goal.len()) {
                slope.latents[at + i] += 2.0 * weight * (latents[at + i] - goal[i]);
            }
        }
    }
}

/// The squared norm of the actions: `w Σ_t ‖a_t‖²`.
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
        Settings("control term").not_negative("weight", self.weight)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.weight * trajectory.actions.iter().map(|a| a * a).sum::<f32>()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        slope.actions.iter_mut().zip(trajectory.actions).for_each(|(g, a)| *g += 2.0 * self.weight * a);
    }
}

/// The squared differences of neighbouring actions: `w Σ_t ‖a_t - a_{t-1}‖²`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Change {
    /// The weight, w.
    pub weight: f32,
    /// Environment actions in a model step; each action is compared with the preceding one.
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
        Settings("change term").not_negative("weight", self.weight)?;
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
            let derivative = 2.0 * self.weight * (actions[i] - actions[i - width]);
            slope.actions[i] += derivative;
            slope.actions[i - width] -= derivative;
        }
    }
}
