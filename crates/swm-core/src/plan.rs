//! Planning: what a candidate action sequence costs, and who finds a cheap one.
//!
//! A [`CostModel`] scores candidates; a [`Solver`] asks it repeatedly and returns a [`Plan`]. Plain host arrays
//! cross this border, so solvers know no deep-learning framework. All environments that replan at a step
//! go in one call, yet the plan of each depends on its own cost and key only.

use crate::{Batch, Key, Result};
use serde::Serialize;

/// Candidate action sequences of several environments.
///
/// # Shapes
/// `actions` is `[envs, samples, horizon, dim]`, row-major.
#[derive(Clone, Copy, Debug)]
pub struct Candidates<'a> {
    /// The numbers.
    pub actions: &'a [f32],
    /// Environments that replan.
    pub envs: usize,
    /// Candidates for each.
    pub samples: usize,
    /// Model steps of a candidate.
    pub horizon: usize,
    /// Numbers of one model step: action dimension times action block.
    pub dim: usize,
}

/// Scores candidate action sequences from the present of each environment.
pub trait CostModel: Send {
    /// Takes note of the present and the goal: rows `envs` of `infos`. What a plan needs only once (encoding
    /// the start and the goal) happens here.
    ///
    /// # Errors
    /// When `infos` lacks a column the model reads.
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()>;

    /// Writes the cost of every candidate, `[envs, samples]`, environments in the order of the last
    /// [`CostModel::observe`].
    ///
    /// # Errors
    /// When the candidates do not fit the model.
    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()>;
}

/// A cost with a gradient.
pub trait DifferentiableCost: CostModel {
    /// Costs `[envs, samples]` and their gradient with respect to the candidates, of the candidates' shape.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()>;
}

/// A model with a latent state, for solvers that optimise states and actions together.
pub trait LatentDynamics: CostModel {
    /// Numbers in one latent state.
    fn latent_dim(&self) -> usize;

    /// The latent state of every observed environment and of its goal, `[envs, latent]` each.
    ///
    /// # Errors
    /// When nothing was observed.
    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()>;

    /// One step for `n` pairs: `next[n, latent]` from `latents[n, latent]` and `actions[n, dim]`.
    ///
    /// # Errors
    /// When shapes do not fit the model.
    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()>;

    /// The vector-Jacobian product of [`LatentDynamics::predict`]: gradients with respect to latents and actions.
    ///
    /// # Errors
    /// As [`LatentDynamics::predict`].
    fn predict_vjp(
        &mut self,
        latents: &[f32],
        actions: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()>;
}

/// Inequality constraints on candidates.
pub trait Constrained: CostModel {
    /// How many.
    fn constraints(&self) -> usize;

    /// Writes `[envs, samples, constraints]`; a constraint is satisfied when its value is at most 0.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()>;
}

/// What a solver is asked.
#[derive(Clone, Copy, Debug)]
pub struct PlanProblem<'a> {
    /// Model steps to plan.
    pub horizon: usize,
    /// Numbers of one model step.
    pub dim: usize,
    /// Lower bound of each of the `dim` numbers, in the model's (normalised) action units.
    pub low: &'a [f32],
    /// Upper bound of each.
    pub high: &'a [f32],
    /// The key of each environment's plan, one an environment: `(seed, episode, replan)`.
    pub keys: &'a [Key],
    /// Where to start: `[envs, horizon, dim]`, or `None` for zeros.
    pub init: Option<&'a [f32]>,
}

/// What a solver found.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    /// The action sequences, `[envs, horizon, dim]`.
    pub actions: Vec<f32>,
    /// The cost of each, `[envs]`: what the model said of the best candidate of the last iteration.
    pub costs: Vec<f32>,
    /// How the search went, `[envs][iterations]`.
    pub trace: Vec<PlanTrace>,
}

/// How the search of one environment's plan went, one number an iteration.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PlanTrace {
    /// The lowest cost of the iteration.
    pub best: Vec<f32>,
    /// The mean cost of the elites (or of all candidates, where a solver has none).
    pub mean: Vec<f32>,
    /// The mean spread of the sampling distribution after the iteration.
    pub spread: Vec<f32>,
}

/// Finds cheap action sequences.
pub trait Solver: Send {
    /// Solves one problem for every environment `cost` observed.
    ///
    /// # Errors
    /// When the settings contradict each other, or the model fails or returns costs that are not finite.
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan>;
}
