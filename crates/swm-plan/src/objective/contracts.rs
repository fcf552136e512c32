//! The contracts of objectives and constraints, and the trajectories they are computed on.

use swm_core::{Error, Result};

/// One candidate and its predicted latents.
#[derive(Clone, Copy, Debug)]
pub struct Trajectory<'a> {
    /// The latents, the present first, `[horizon + 1, latent]`; empty for a model without latents.
    pub latents: &'a [f32],
    /// The latent of the goal, `[latent]`; empty for a model without latents.
    pub goal: &'a [f32],
    /// The actions, `[horizon, dim]`.
    pub actions: &'a [f32],
    /// The action dimension of one model step.
    pub dim: usize,
}

/// The gradient of a cost with respect to a trajectory, to which terms add.
#[derive(Debug)]
pub struct Slope<'a> {
    /// The gradient with respect to the latents, `[horizon + 1, latent]`. The gradient with respect to the present
    /// latent is discarded.
    pub latents: &'a mut [f32],
    /// The gradient with respect to the actions, `[horizon, dim]`.
    pub actions: &'a mut [f32],
}

/// The sizes of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Model steps.
    pub horizon: usize,
    /// The dimension of a latent; 0 for a model without latents.
    pub latent: usize,
    /// The action dimension of one model step.
    pub dim: usize,
}

/// A differentiable cost of trajectories.
pub trait Objective: Send + Sync {
    /// Whether the cost uses latents.
    fn needs_latents(&self) -> bool;

    /// Checks the settings for trajectories of this shape.
    ///
    /// # Errors
    /// When the settings contradict each other or the shape.
    fn check(&self, shape: Shape) -> Result<()>;

    /// Returns the cost of a trajectory.
    fn cost(&self, trajectory: Trajectory<'_>) -> f32;

    /// Adds the gradient of the cost to `slope`.
    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>);
}

/// Differentiable inequalities; each is satisfied when its value is at most 0.
pub trait Constraint: Send + Sync {
    /// Whether the constraint uses latents.
    fn needs_latents(&self) -> bool;

    /// Checks the settings for trajectories of this shape.
    ///
    /// # Errors
    /// When the settings contradict each other or the shape.
    fn check(&self, shape: Shape) -> Result<()>;

    /// Returns the number of values for `horizon` model steps and the latent dimension `latent`.
    fn count(&self, horizon: usize, latent: usize) -> usize;

    /// Writes the values, `[count]`.
    fn values(&self, trajectory: Trajectory<'_>, values: &mut [f32]);

    /// Adds the gradient of the weighted sum of the values to `slope`; `weights` is `[count]`.
    fn add_gradient(&self, trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>);
}

impl<O: Objective + ?Sized> Objective for Box<O> {
    fn needs_latents(&self) -> bool {
        (**self).needs_latents()
    }

    fn check(&self, shape: Shape) -> Result<()> {
        (**self).check(shape)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        (**self).cost(trajectory)
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        (**self).add_gradient(trajectory, slope);
    }
}

/// The cost of a list of objectives is the sum of their costs.
impl<O: Objective> Objective for Vec<O> {
    fn needs_latents(&self) -> bool {
        self.iter().any(Objective::needs_latents)
    }

    fn check(&self, shape: Shape) -> Result<()> {
        self.iter().try_for_each(|term| term.check(shape))
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.iter().map(|term| term.cost(trajectory)).sum()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        self.iter().for_each(|term| term.add_gradient(trajectory, slope));
    }
}

/// Checks that the model has latents.
pub(super) fn check_latents(what: &str, shape: Shape) -> Result<()> {
    if shape.latent > 0 {
        return Ok(());
    }
    Err(Error::config(what, "it uses latents, and this model has none", "choose a term on actions, or another model"))
}

/// Checks that a model step is a whole number of actions.
pub(super) fn check_block(what: &str, block: usize, dim: usize) -> Result<()> {
    if block > 0 && dim.is_multiple_of(block) {
        return Ok(());
    }
    let given = format!("{block} actions in a model step of dimension {dim}");
    Err(Error::config(format!("{what} block"), given, "give the action block that plans are made with"))
}
