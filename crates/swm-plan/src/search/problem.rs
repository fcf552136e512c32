//! Checks of a planning problem and of the values that a model returns, shared by all solvers.
//!
//! A solver starts with [`continuous`] or [`discrete`], which reject a problem it cannot solve, and gets its costs from
//! [`evaluate`], which rejects costs that are missing or not finite.

use crate::entry::{ActionKind, Need, SolverEntry};
use swm_core::{Candidates, Constrained, CostModel, DifferentiableCost, LatentDynamics};
use swm_core::{Error, PlanProblem, PlanSpace, Result, limits};

/// The bounds of one model step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds<'a> {
    /// The lower bounds, `[dim]`.
    pub low: &'a [f32],
    /// The upper bounds, `[dim]`.
    pub high: &'a [f32],
}

impl Bounds<'_> {
    /// Clips an action sequence, `[steps, dim]`, to the bounds.
    pub fn clip(&self, actions: &mut [f32]) {
        for step in actions.chunks_exact_mut(self.low.len()) {
            for ((action, &low), &high) in step.iter_mut().zip(self.low).zip(self.high) {
                // `clamp` would be slower: it checks its bounds in every call.
                let above = if *action < low { low } else { *action };
                *action = if above > high { high } else { above };
            }
        }
    }
}

/// Checks a problem with continuous actions; returns its bounds.
///
/// # Errors
/// When the solver does not fit the problem or the model, the horizon is 0 or too large, or the bounds or the initial
/// guess are invalid.
pub fn continuous<'a>(solver: &SolverEntry, cost: &mut dyn CostModel, problem: &PlanProblem<'a>) -> Result<Bounds<'a>> {
    check_fit(solver, cost, problem)?;
    let PlanSpace::Continuous { low, high } = problem.space else {
        return Err(misfit(
            solver.id,
            "the actions of the problem are not continuous",
            "correct `actions` in the solver's `ENTRY`",
        ));
    };
    if low.len() != high.len() {
        let given = format!("{} lower and {} upper bounds", low.len(), high.len());
        return Err(Error::mismatch("the action bounds of a plan", given, "equally many of each"));
    }
    let invalid = |(low, high): (&f32, &f32)| low.is_nan() || high.is_nan() || low > high;
    if let Some(j) = low.iter().zip(high).position(invalid) {
        return Err(Error::config(
            format!("bounds of action dimension {j}"),
            format!("{} ..= {}", low[j], high[j]),
            "the lower bound must not exceed the upper one",
        ));
    }
    check_size(solver, problem)?;
    check_init(problem)?;
    Ok(Bounds { low, high })
}

/// Checks a problem with discrete actions; returns the number of options of every choice of a model step.
///
/// An initial guess weighs the options of every choice: one-hot vectors, probabilities, or zeros for a choice
/// without preference.
///
/// # Errors
/// When the solver does not fit the problem or the model, the horizon is 0 or too large, or the choices or the initial
/// guess are invalid.
pub fn discrete<'a>(solver: &SolverEntry, cost: &mut dyn CostModel, problem: &PlanProblem<'a>) -> Result<&'a [usize]> {
    check_fit(solver, cost, problem)?;
    let PlanSpace::Discrete { choices } = problem.space else {
        return Err(misfit(
            solver.id,
            "the actions of the problem are not discrete",
            "correct `actions` in the solver's `ENTRY`",
        ));
    };
    if let Some(j) = choices.iter().position(|&options| options == 0) {
        return Err(Error::config(
            format!("choice {j} of a model step"),
            "it has no options",
            "offer at least 1 option",
        ));
    }
    check_size(solver, problem)?;
    check_init(problem)?;
    if let Some(weight) = problem.init.unwrap_or_default().iter().find(|&&weight| weight < 0.0) {
        return Err(Error::OutOfSpace {
            what: "the weight of an option in the initial guess of a plan".to_owned(),
            given: weight.to_string(),
            expected: "at least 0".to_owned(),
        });
    }
    Ok(choices)
}

/// Returns a model's cost with its gradient.
///
/// # Errors
/// When the model has none.
pub fn differentiable<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn DifferentiableCost> {
    cost.differentiable().ok_or_else(|| misfit(solver, &Need::Gradient.obstacle(), OTHER_SOLVER))
}

/// Returns the latent dynamics of a model.
///
/// # Errors
/// When the model has none.
pub fn latent<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn LatentDynamics> {
    cost.latent().ok_or_else(|| misfit(solver, &Need::Latent.obstacle(), OTHER_SOLVER))
}

/// Returns the constraints of a model.
///
/// # Errors
/// When the model has none.
pub fn constrained<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn Constrained> {
    cost.constrained().ok_or_else(|| misfit(solver, &Need::Constraints.obstacle(), OTHER_SOLVER))
}

/// Returns the capabilities of a model beyond a cost.
pub fn offers(cost: &mut dyn CostModel) -> Vec<Need> {
    let offered = [
        (Need::Gradient, cost.differentiable().is_some()),
        (Need::Latent, cost.latent().is_some()),
        (Need::Constraints, cost.constrained().is_some()),
    ];
    offered.into_iter().filter_map(|(need, offered)| offered.then_some(need)).collect()
}

/// Creates the error of a solver that does not fit a problem or a model.
pub fn misfit(solver: &str, obstacle: &str, fix: &str) -> Error {
    Error::config(format!("solver {solver}"), obstacle, fix)
}

/// The suggestion of errors that do not list suitable solvers; [`pairing`](crate::pairing) lists them.
const OTHER_SOLVER: &str = "choose another solver; `swm solvers` lists the requirements of each";

/// Checks that a solver can plan the actions of a problem with a model.
fn check_fit(solver: &SolverEntry, cost: &mut dyn CostModel, problem: &PlanProblem<'_>) -> Result<()> {
    match solver.obstacle(ActionKind::of_plan(problem.space), &offers(cost)) {
        Some(obstacle) => Err(misfit(solver.id, &obstacle, OTHER_SOLVER)),
        None => Ok(()),
    }
}

/// Computes the cost of every candidate.
///
/// # Shapes
/// `costs` is `[envs, samples]`.
///
/// # Errors
/// When the model fails, or leaves a cost unwritten or not finite.
pub fn evaluate(
    cost: &mut dyn CostModel,
    candidates: Candidates<'_>,
    iteration: usize,
    costs: &mut [f32],
) -> Result<()> {
    // A cost that the model does not write must not be mistaken for the cost of the previous iteration.
    costs.fill(UNWRITTEN);
    cost.cost(candidates, costs)?;
    check_costs(costs, candidates.samples, iteration)
}

/// Marks values that a model has to write: a NaN that no arithmetic produces.
pub const UNWRITTEN: f32 = f32::from_bits(0x7fc5_eeee);

/// Checks that every cost is finite.
///
/// # Shapes
/// `costs` is `[envs, samples]`.
///
/// # Errors
/// When a cost is not finite; the message names the candidate.
pub(super) fn check_costs(costs: &[f32], samples: usize, iteration: usize) -> Result<()> {
    let Some(i) = costs.iter().position(|cost| !cost.is_finite()) else {
        return Ok(());
    };
    let candidate =
        format!("candidate {} of planned environment {} in iteration {iteration}", i % samples, i / samples);
    if costs[i].to_bits() == UNWRITTEN.to_bits() {
        return Err(Error::mismatch(
            "the costs of a model",
            format!("none for {candidate}"),
            format!("a cost for each of the {} candidates, [{}, {samples}]", costs.len(), costs.len() / samples),
        ));
    }
    Err(Error::NotFinite {
        what: "the cost of a candidate".to_owned(),
        given: format!("{} for {candidate}", costs[i]),
        fix: "the model diverges on these actions or its weights are damaged; check the checkpoint".to_owned(),
    })
}

/// The number of values of one plan for each environment, or of `samples` candidates.
///
/// # Errors
/// When there are more values than [`limits::CANDIDATE_VALUES`]; `what` names them.
pub(crate) fn count_values(what: String, [envs, steps, dim]: [usize; 3], samples: Option<usize>) -> Result<usize> {
    let values = limits::product([envs, samples.unwrap_or(1), steps, dim]);
    if values <= limits::CANDIDATE_VALUES.max {
        return Ok(values);
    }
    let (times, fewer) = samples.map_or_else(Default::default, |n| (format!(" x {n} samples"), "samples, "));
    Err(Error::config(
        what,
        format!("{envs} environments{times} x {steps} steps x {dim} values do not fit into memory"),
        format!("plan with fewer {fewer}steps or parallel environments, or smaller action blocks"),
    ))
}

/// The sizes of the plans of a problem, `[envs, horizon, dim]`.
pub(super) fn sizes(problem: &PlanProblem<'_>) -> [usize; 3] {
    [problem.keys.len(), problem.horizon, problem.space.dim()]
}

/// Checks the sizes of a problem, before a solver allocates by them.
fn check_size(solver: &SolverEntry, problem: &PlanProblem<'_>) -> Result<()> {
    let (horizon, dim, most) = (problem.horizon, problem.space.dim(), limits::MODEL_STEPS.max);
    if !(1..=most).contains(&horizon) || dim == 0 {
        return Err(Error::config(
            "planning horizon",
            format!("{horizon} model steps of dimension {dim}"),
            format!("plan 1 to {most} model steps with actions of at least 1 dimension"),
        ));
    }
    count_values(format!("plans of {}", solver.id), sizes(problem), None).map(|_| ())
}

fn check_init(problem: &PlanProblem<'_>) -> Result<()> {
    let Some(init) = problem.init else {
        return Ok(());
    };
    let (envs, horizon, dim) = (problem.keys.len(), problem.horizon, problem.space.dim());
    let expected = envs * horizon * dim;
    if init.len() != expected {
        let expected_shape = format!("{expected} ({envs} environments x {horizon} x {dim})");
        return Err(Error::mismatch("the initial guess of a plan", format!("{} values", init.len()), expected_shape));
    }
    let Some(i) = init.iter().position(|v| !v.is_finite()) else {
        return Ok(());
    };
    Err(Error::NotFinite {
        what: format!("the initial guess of planned environment {}", i / (horizon * dim)),
        given: format!("{} at step {}", init[i], i / dim % horizon),
        fix: "start from finite actions".to_owned(),
    })
}
