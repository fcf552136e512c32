//! What a solver is asked and what a model answers, checked in one place for every solver.
//!
//! A solver opens with [`continuous`] or [`discrete`], which refuse a problem it cannot solve and name the solvers that
//! can, and takes its costs from [`score`], which refuses costs that are missing or not finite.

use crate::registry::{Actions, Need, SOLVERS, SolverEntry};
use swm_core::{Candidates, Constrained, CostModel, DifferentiableCost, LatentDynamics};
use swm_core::{Error, PlanProblem, PlanSpace, Result};

/// The bounds of one model step, `dim` numbers each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds<'a> {
    /// The lower bound of each number.
    pub low: &'a [f32],
    /// The upper bound of each number.
    pub high: &'a [f32],
}

impl Bounds<'_> {
    /// Moves every number of an action sequence, `[steps, dim]`, into its bounds.
    pub fn clip(&self, actions: &mut [f32]) {
        for step in actions.chunks_exact_mut(self.low.len()) {
            for ((action, &low), &high) in step.iter_mut().zip(self.low).zip(self.high) {
                // Not `clamp`, whose check of the bounds would cost more than the rest.
                let above = if *action < low { low } else { *action };
                *action = if above > high { high } else { above };
            }
        }
    }
}

/// The bounds of a problem with continuous actions. `solver` is the id of the one that is asked.
///
/// # Errors
/// When the solver cannot solve such a problem with such a model (the error names those that can), the horizon is 0, or
/// bounds or first guess are wrong.
pub fn continuous<'a>(solver: &str, cost: &mut dyn CostModel, problem: &PlanProblem<'a>) -> Result<Bounds<'a>> {
    pairing(solver, cost, Actions::of_plan(problem.space))?;
    let PlanSpace::Continuous { low, high } = problem.space else {
        return Err(misfit(solver, "these actions are not continuous", "register it for the actions it plans"));
    };
    if low.len() != high.len() {
        let given = format!("{} lower and {} upper", low.len(), high.len());
        return Err(Error::mismatch("the action bounds of a plan", given, "as many of each"));
    }
    let wrong = |(low, high): (&f32, &f32)| low.is_nan() || high.is_nan() || low > high;
    if let Some(j) = low.iter().zip(high).position(wrong) {
        return Err(Error::config(
            format!("bounds of action number {j}"),
            format!("{} ..= {}", low[j], high[j]),
            "the lower bound must not exceed the upper one",
        ));
    }
    check_size(problem)?;
    check_init(problem)?;
    Ok(Bounds { low, high })
}

/// Among how many each choice of a model step is made. `solver` is the id of the one that is asked. A first guess
/// weighs the options of every choice: one-hot vectors, probabilities, or zeros where there is no preference.
///
/// # Errors
/// When the solver cannot solve such a problem with such a model (the error names those that can), the horizon is 0, or
/// choices or first guess are wrong.
pub fn discrete<'a>(solver: &str, cost: &mut dyn CostModel, problem: &PlanProblem<'a>) -> Result<&'a [usize]> {
    pairing(solver, cost, Actions::of_plan(problem.space))?;
    let PlanSpace::Discrete { choices } = problem.space else {
        return Err(misfit(solver, "these actions are not discrete", "register it for the actions it plans"));
    };
    if let Some(j) = choices.iter().position(|&options| options == 0) {
        return Err(Error::config(
            format!("choice {j} of a model step"),
            "there is nothing to choose from",
            "offer at least 1 option",
        ));
    }
    check_size(problem)?;
    check_init(problem)?;
    if let Some(weight) = problem.init.unwrap_or_default().iter().find(|&&weight| weight < 0.0) {
        return Err(Error::OutOfSpace {
            what: "an option in the first guess of a plan".to_owned(),
            given: weight.to_string(),
            expected: "weights of the options, none below 0".to_owned(),
        });
    }
    Ok(choices)
}

/// The gradient of a model's cost, for the solver of this id.
///
/// # Errors
/// When the model has none.
pub fn differentiable<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn DifferentiableCost> {
    cost.differentiable().ok_or_else(|| misfit(solver, &Need::Gradient.obstacle(), "choose another solver"))
}

/// A model's latent state, for the solver of this id.
///
/// # Errors
/// When the model shows none.
pub fn latent<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn LatentDynamics> {
    cost.latent().ok_or_else(|| misfit(solver, &Need::Latent.obstacle(), "choose another solver"))
}

/// A model's constraints, for the solver of this id.
///
/// # Errors
/// When the model has none.
pub fn constrained<'m>(solver: &str, cost: &'m mut dyn CostModel) -> Result<&'m mut dyn Constrained> {
    cost.constrained().ok_or_else(|| misfit(solver, &Need::Constraints.obstacle(), "choose another solver"))
}

/// Asks the model for the cost of every candidate, `[envs, samples]`.
///
/// # Errors
/// When the model fails, or leaves a cost unwritten or not finite.
pub fn score(cost: &mut dyn CostModel, candidates: Candidates<'_>, iteration: usize, costs: &mut [f32]) -> Result<()> {
    // A model that forgets to write a cost must not be served the last iteration's.
    costs.fill(UNWRITTEN);
    cost.cost(candidates, costs)?;
    check_costs(costs, candidates.samples, iteration)
}

/// What stands where the model has to write a cost: a NaN that no arithmetic makes.
pub const UNWRITTEN: f32 = f32::from_bits(0x7fc5_eeee);

/// Checks that every cost of `[envs, samples]` is finite.
///
/// # Errors
/// When one is not; says which.
pub fn check_costs(costs: &[f32], samples: usize, iteration: usize) -> Result<()> {
    let Some(i) = costs.iter().position(|cost| !cost.is_finite()) else {
        return Ok(());
    };
    let place = format!("candidate {} of planned environment {} in iteration {iteration}", i % samples, i / samples);
    if costs[i].to_bits() == UNWRITTEN.to_bits() {
        return Err(Error::mismatch(
            "the costs of a model",
            format!("none for {place}"),
            format!("a cost for each of the {} candidates, [{}, {samples}]", costs.len(), costs.len() / samples),
        ));
    }
    Err(Error::NotFinite {
        what: "the cost of a candidate".to_owned(),
        given: format!("{} for {place}", costs[i]),
        fix: "the model diverges on these actions or its weights are damaged; check the checkpoint".to_owned(),
    })
}

/// Checks that the solver of this id can plan such actions with such a model.
///
/// # Errors
/// When it cannot; names the solvers that can.
pub fn pairing(solver: &str, cost: &mut dyn CostModel, actions: Actions) -> Result<()> {
    let offers = offers(cost);
    let Some(obstacle) = obstacle(SOLVERS.get(solver)?, actions, &offers) else {
        return Ok(());
    };
    let able: Vec<&str> =
        SOLVERS.rows.iter().filter(|row| self::obstacle(row, actions, &offers).is_none()).map(|row| row.id).collect();
    let fix = match (&able[..], offers.contains(&Need::Constraints)) {
        ([], true) => {
            "add the constraints to the cost as a penalty, and any solver for these actions will do".to_owned()
        }
        ([], false) => "no solver fits these actions and this model".to_owned(),
        (able, true) => format!("choose {}, or add the constraints to the cost as a penalty", able.join(" or ")),
        (able, false) => format!("choose {}", able.join(" or ")),
    };
    Err(misfit(solver, &obstacle, &fix))
}

/// What a model offers beyond a cost.
fn offers(cost: &mut dyn CostModel) -> Vec<Need> {
    let offered = [
        (Need::Gradient, cost.differentiable().is_some()),
        (Need::Latent, cost.latent().is_some()),
        (Need::Constraints, cost.constrained().is_some()),
    ];
    offered.into_iter().filter_map(|(need, offered)| offered.then_some(need)).collect()
}

/// What keeps the solver of a row from planning such actions with a model that offers this.
fn obstacle(row: &SolverEntry, actions: Actions, offers: &[Need]) -> Option<String> {
    if row.actions != actions {
        return Some(match actions {
            Actions::Continuous => "it plans discrete actions; these are continuous".to_owned(),
            Actions::Discrete => "it plans continuous actions; these are discrete".to_owned(),
        });
    }
    if let Some(need) = row.needs.iter().find(|need| !offers.contains(need)) {
        return Some(need.obstacle());
    }
    let heedless = offers.contains(&Need::Constraints) && !row.needs.contains(&Need::Constraints);
    heedless.then(|| "it would ignore the constraints of the model".to_owned())
}

impl Need {
    fn obstacle(self) -> String {
        let needed = match self {
            Self::Gradient => "the gradient of the cost",
            Self::Latent => "the model's latent state",
            Self::Constraints => "constraints",
        };
        format!("it needs {needed}, which this model does not offer")
    }
}

fn misfit(solver: &str, obstacle: &str, fix: &str) -> Error {
    Error::config(format!("solver {solver}"), obstacle, fix)
}

fn check_size(problem: &PlanProblem<'_>) -> Result<()> {
    let (horizon, dim) = (problem.horizon, problem.space.dim());
    if horizon > 0 && dim > 0 {
        return Ok(());
    }
    Err(Error::config(
        "planning horizon",
        format!("{horizon} model steps of {dim} numbers"),
        "plan at least 1 step of at least 1 number",
    ))
}

fn check_init(problem: &PlanProblem<'_>) -> Result<()> {
    let Some(init) = problem.init else {
        return Ok(());
    };
    let (envs, horizon, dim) = (problem.keys.len(), problem.horizon, problem.space.dim());
    let expected = envs * horizon * dim;
    if init.len() != expected {
        let wanted = format!("{expected} ({envs} environments x {horizon} x {dim})");
        return Err(Error::mismatch("the first guess of a plan", format!("{} numbers", init.len()), wanted));
    }
    let Some(i) = init.iter().position(|v| !v.is_finite()) else {
        return Ok(());
    };
    Err(Error::NotFinite {
        what: format!("the first guess of planned environment {}", i / (horizon * dim)),
        given: format!("{} at step {}", init[i], i / dim % horizon),
        fix: "start from finite actions".to_owned(),
    })
}
