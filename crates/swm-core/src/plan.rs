//! Planning: a [`CostModel`] scores candidate action sequences, a [`Solver`] minimises the cost and returns a [`Plan`].
//!
//! Model and solver exchange plain host slices, so solvers depend on no deep-learning framework. All environments that
//! replan at a step share one call. The plan of an environment depends on its own cost and key only.

use crate::{Batch, Env, Key, Result};
use serde::Serialize;
use std::fmt;
use std::ops::ControlFlow;
use std::time::Instant;

/// Candidate action sequences of several environments.
///
/// # Shapes
/// `actions` is `[envs, samples, horizon, dim]`, row-major.
#[derive(Clone, Copy, Debug)]
pub struct Candidates<'a> {
    /// The action sequences.
    pub actions: &'a [f32],
    /// The number of environments that replan.
    pub envs: usize,
    /// Candidates of each environment.
    pub samples: usize,
    /// Model steps of a candidate.
    pub horizon: usize,
    /// The dimension of one model step: action dimension times action block.
    pub dim: usize,
}

/// A model that scores candidate action sequences from the present observation of each environment.
pub trait CostModel: Send {
    /// Reads the present observation and the goal of each environment: rows `envs` of `infos`. Work that a plan needs
    /// only once, such as encoding the observation and the goal, belongs in this method.
    ///
    /// # Errors
    /// When `infos` lacks a column that the model reads.
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()>;

    /// Writes the cost of every candidate. Environments have the order of the last [`CostModel::observe`].
    ///
    /// # Shapes
    /// `costs` is `[envs, samples]`.
    ///
    /// # Errors
    /// When the candidates do not fit the model.
    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()>;

    /// Reads the environment of `slot` directly, before a call of [`CostModel::observe`] with that slot. Only models
    /// with privileged information, such as simulators, override this method.
    ///
    /// # Errors
    /// When the model does not support the environment.
    fn observe_env(&mut self, _slot: usize, _env: &dyn Env) -> Result<()> {
        Ok(())
    }

    /// Lets later calls share work between environments where that is faster. The last bits of an environment's costs may then depend on
    /// the other environments. Models without such work ignore it.
    fn plan_together(&mut self) {}

    /// Makes the cost of a candidate the squared distance to the goal's latent of the closest predicted latent, not of the last one, and
    /// returns whether the model can. Models that cannot are unchanged.
    fn compare_closest(&mut self) -> bool {
        false
    }

    /// Returns the gradient interface of this model, if it is differentiable.
    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        None
    }

    /// Returns the latent dynamics of this model, if it exposes them.
    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        None
    }

    /// Returns the constraints of this model, if it has any.
    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        None
    }
}

/// A cost with a gradient.
pub trait DifferentiableCost: CostModel {
    /// Writes the cost of every candidate and the gradient of each cost with respect to its candidate.
    ///
    /// # Shapes
    /// `costs` is `[envs, samples]`, `gradient` is `[envs, samples, horizon, dim]`.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()>;
}

/// A model with a latent state, for solvers that optimise states and actions together.
pub trait LatentDynamics: CostModel {
    /// The dimension of a latent state.
    fn latent_dim(&self) -> usize;

    /// Writes the latent state of every observed environment and of its goal.
    ///
    /// # Shapes
    /// `start` and `goal` are `[envs, latent]`.
    ///
    /// # Errors
    /// Before the first [`CostModel::observe`].
    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()>;

    /// Predicts one model step for `n` pairs of latent state and action. The pairs are grouped by observed
    /// environment, with the same number of pairs for each environment.
    ///
    /// # Shapes
    /// `latents` and `next` are `[n, latent]`, `actions` is `[n, dim]`.
    ///
    /// # Errors
    /// When the shapes do not fit the model.
    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()>;

    /// The vector-Jacobian product of [`LatentDynamics::predict`]: writes the gradients with respect to latents and
    /// actions.
    ///
    /// # Shapes
    /// `next_gradient` and `latent_gradient` are `[n, latent]`, `action_gradient` is `[n, dim]`.
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
    /// The number of constraints of a candidate of `horizon` model steps; a limit on every step counts once per step.
    fn constraints(&self, horizon: usize) -> usize;

    /// Writes the value of every constraint; a constraint is satisfied when its value is at most 0.
    ///
    /// # Shapes
    /// `values` is `[envs, samples, constraints]`.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()>;

    /// The vector-Jacobian product of [`Constrained::constrain`]: adds `Σ_c weights_c ∂value_c / ∂candidate` to
    /// `gradient`.
    ///
    /// # Shapes
    /// `weights` is `[envs, samples, constraints]`, `gradient` is `[envs, samples, horizon, dim]`.
    ///
    /// # Errors
    /// As [`CostModel::cost`].
    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()>;
}

/// The action space of one model step of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PlanSpace<'a> {
    /// A point within bounds, in the model's (normalised) action units; bounds may be infinite.
    Continuous {
        /// The lower bounds, `[dim]`.
        low: &'a [f32],
        /// The upper bounds, `[dim]`.
        high: &'a [f32],
    },
    /// Several choices, concatenated in a model step, each as a one-hot vector.
    Discrete {
        /// The number of options of each choice; the sum is `dim`.
        choices: &'a [usize],
    },
}

impl PlanSpace<'_> {
    /// The dimension of one model step.
    pub fn dim(&self) -> usize {
        match self {
            Self::Continuous { low, .. } => low.len(),
            Self::Discrete { choices } => choices.iter().copied().fold(0, usize::saturating_add),
        }
    }
}

/// A planning problem: the inputs of a solver except the cost model.
#[derive(Clone, Copy, Debug)]
pub struct PlanProblem<'a> {
    /// The number of model steps to plan.
    pub horizon: usize,
    /// The action space of a model step.
    pub space: PlanSpace<'a>,
    /// The key of each environment's plan, `[envs]`: `(seed, episode, replan)`.
    pub keys: &'a [Key],
    /// The initial action sequences, `[envs, horizon, dim]`; `None` for zeros (continuous) or uniform choices
    /// (discrete).
    pub init: Option<&'a [f32]>,
    /// The time at which the solver stops and returns the best plan found. Solvers check the deadline after every
    /// iteration. The plan of a search that stopped early depends on the machine's speed.
    pub deadline: Option<Instant>,
    /// Reads every iteration and may stop the search. Without one, an iteration costs what it costs anyway; with one,
    /// plans are the same, unless it stops the search.
    pub observer: Option<&'a dyn SearchObserver>,
}

impl PlanProblem<'_> {
    /// Whether the deadline has passed.
    pub fn is_late(&self) -> bool {
        self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }

    /// Shows an iteration to the observer, if there is one, and returns whether it wants the search to go on.
    ///
    /// # Errors
    /// The error of the observer, which ends the search without a plan.
    pub fn observed<'i>(&self, iteration: impl FnOnce() -> Iteration<'i>) -> Result<bool> {
        self.observer.map_or(Ok(true), |observer| Ok(observer.iteration(&iteration())?.is_continue()))
    }
}

/// One iteration of a search, as a [`SearchObserver`] reads it.
#[derive(Clone, Debug)]
pub struct Iteration<'a> {
    /// The index of the iteration.
    pub index: usize,
    /// The candidates of all environments.
    pub candidates: Candidates<'a>,
    /// The cost of every candidate, `[envs, samples]`.
    pub costs: &'a [f32],
    /// The indices of the elites of every environment, cheapest first, `[envs, elites]`; empty if the solver has none.
    pub elites: Vec<usize>,
    /// The gradient of each cost with respect to its candidate, `[envs, samples, horizon, dim]`, from solvers that
    /// compute it.
    pub gradient: Option<&'a [f32]>,
}

/// Reads the iterations of a search, between one and the next.
///
/// All environments that are planned for together share one search, so they share its iterations.
pub trait SearchObserver: Sync {
    /// Reads an iteration. `Break` ends the search after it: the plan is the one of the iterations so far.
    ///
    /// # Errors
    /// An error ends the search without a plan; an interrupted run returns [`crate::Error::Interrupted`].
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>>;
}

impl fmt::Debug for dyn SearchObserver + '_ {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SearchObserver")
    }
}

/// The plans of a solver.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    /// The action sequences, `[envs, horizon, dim]`; discrete actions are one-hot vectors.
    pub actions: Vec<f32>,
    /// The cost of each plan, `[envs]`: the model's cost of the best candidate of the last iteration.
    pub costs: Vec<f32>,
    /// The trace of each search, one per environment.
    pub trace: Vec<PlanTrace>,
}

/// The trace of one environment's search: one value per iteration, unless said otherwise.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PlanTrace {
    /// The lowest cost of the iteration.
    pub best: Vec<f32>,
    /// The mean cost of the elites, or of all candidates if the solver has no elites.
    pub mean: Vec<f32>,
    /// The mean spread of the sampling distribution after the iteration, or of the candidates if the solver has no
    /// distribution.
    pub spread: Vec<f32>,
    /// The largest constraint value of the best candidate, if the model has constraints and the solver enforces them.
    /// The value is at most 0, or at most the solver's tolerance, when all constraints are satisfied.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub violation: Vec<f32>,
    /// The multipliers of the constraints after the search, `[constraints]`, if the solver has multipliers.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub multipliers: Vec<f32>,
}

/// A search for action sequences of low cost.
pub trait Solver: Send {
    /// Solves one problem for every environment that `cost` observed.
    ///
    /// # Errors
    /// When the solver's settings are invalid or do not fit the action space or the model, or the model fails or
    /// returns costs that are not finite.
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan>;

    /// Checks the settings, so that invalid ones are found before any problem is solved.
    ///
    /// # Errors
    /// When a setting is out of bounds or contradicts another.
    fn check(&self) -> Result<()> {
        Ok(())
    }

    /// Checks that the settings fit the actions of a model step, before any problem is solved.
    ///
    /// # Errors
    /// When a setting does not fit the actions.
    fn check_space(&self, _space: PlanSpace<'_>) -> Result<()> {
        Ok(())
    }
}
