//! Planning: what a candidate action sequence costs, and who finds a cheap one.
//!
//! A [`CostModel`] scores candidates; a [`Solver`] asks it repeatedly and returns a [`Plan`]. Plain host arrays
//! cross this border, so solvers know no deep-learning framework. All environments that replan at a step
//! go in one call, yet the plan of each depends on its own cost and key only.

use crate::{Batch, Env, Key, Result};
use serde::Serialize;
use std::time::Instant;

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

    /// Reads the environment of `slot` itself, before [`CostModel::observe`] names that slot. Only a model with privileged
    /// information, such as a simulator, does.
    ///
    /// # Errors
    /// When the model does not support the environment.
    fn observe_env(&mut self, _slot: usize, _env: &dyn Env) -> Result<()> {
        Ok(())
    }

    /// This model with its gradient, if it has one.
    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        None
    }

    /// This model with its latent state, if it shows one.
    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        None
    }

    /// This model with its constraints, if it has any.
    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        None
    }
}

/// A cost with a gradient.
pub trait DifferentiableCost: CostModel {
    /// Costs `[envs, samples]` and the gradient of each with respect to its candidate, of the candidates' shape.
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

    /// One step for `n` pairs: `next[n, latent]` from `latents[n, latent]` and `actions[n, dim]`. Every observed
    /// environment has equally many pairs, one environment's after another's.
    ///
    /// # Errors
    /// When shapes do not fit the model.
    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()>;

    /// The vector-Jacobian product of [`LatentDynamics::predict`]: writes the gradients with respect to latents and actions.
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

/// Differentiable inequality constraints on candidates.
pub trait Constrained: CostModel {
    /// How many, for a candidate of `horizon` model steps: a limit on every step counts once a step.
    fn constraints(&self, horizon: usize) -> usize;

    /// Writes `[envs, samples, constraints]`; a constraint is satisfied when its value is at most 0.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()>;

    /// The vector-Jacobian product of [`Constrained::constrain`]: adds `Σ_c weights_c ∂value_c / ∂candidate` to
    /// `gradient`, of the candidates' shape; `weights` is `[envs, samples, constraints]`.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()>;
}

/// What one model step of a plan may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PlanSpace<'a> {
    /// Numbers within bounds, in the model's (normalised) action units; infinite bounds bound nothing.
    Continuous {
        /// The lower bound of each of the `dim` numbers.
        low: &'a [f32],
        /// The upper bound of each.
        high: &'a [f32],
    },
    /// Several choices, one after another in a model step, each as a one-hot vector.
    Discrete {
        /// Among how many each choice is made; they add up to `dim`.
        choices: &'a [usize],
    },
}

impl PlanSpace<'_> {
    /// Numbers of one model step.
    pub fn dim(&self) -> usize {
        match self {
            Self::Continuous { low, .. } => low.len(),
            Self::Discrete { choices } => choices.iter().sum(),
        }
    }
}

/// What a solver is asked.
#[derive(Clone, Copy, Debug)]
pub struct PlanProblem<'a> {
    /// Model steps to plan.
    pub horizon: usize,
    /// What a model step may be.
    pub space: PlanSpace<'a>,
    /// The key of each environment's plan, one an environment: `(seed, episode, replan)`.
    pub keys: &'a [Key],
    /// Where to start: `[envs, horizon, dim]`; `None` for zeros, or for every choice equally likely.
    pub init: Option<&'a [f32]>,
    /// When to stop searching and return the best plan so far: solvers look between iterations, after the first. A plan
    /// that was cut short depends on the machine's speed.
    pub deadline: Option<Instant>,
}

impl PlanProblem<'_> {
    /// Whether the search is to stop now.
    pub fn is_late(&self) -> bool {
        self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }
}

/// What a solver found.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    /// The action sequences, `[envs, horizon, dim]`; of discrete actions, one-hot vectors.
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
    /// The mean spread of the sampling distribution after the iteration (or of the candidates, where a solver has none).
    pub spread: Vec<f32>,
    /// The largest value of a constraint of the best candidate, where the model has constraints and the solver keeps them:
    /// at most 0, or the solver's tolerance, when all are satisfied.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub violation: Vec<f32>,
}

/// Finds cheap action sequences.
pub trait Solver: Send {
    /// Solves one problem for every environment `cost` observed.
    ///
    /// # Errors
    /// When the settings contradict each other or do not fit the action space or the model, or the model fails or returns
    /// costs that are not finite.
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan>;
}
