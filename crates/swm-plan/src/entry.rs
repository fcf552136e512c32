//! [`SolverEntry`]: the row of a solver in the registry, which states what the solver plans and what it requires of a
//! model.
//!
//! Every solver's file defines its row as `pub const ENTRY`; [`SOLVERS`](crate::SOLVERS) lists them.

use serde::Serialize;
use serde::de::DeserializeOwned;
use swm_core::registry::Named;
use swm_core::{Error, PlanSpace, Result, Solver, Space};

/// A solver in the registry.
pub struct SolverEntry {
    /// The id, such as `cem`.
    pub id: &'static str,
    /// One sentence on the search method.
    pub summary: &'static str,
    /// How the solver searches.
    pub family: Family,
    /// The kind of actions that the solver plans.
    pub actions: ActionKind,
    /// The capabilities that the solver requires of a model in addition to a cost.
    pub needs: &'static [Need],
    /// The publication of the algorithm.
    pub paper: &'static str,
    /// Returns the default settings, as JSON.
    pub defaults: fn() -> serde_json::Value,
    /// Creates a solver from settings; omitted settings have their default values.
    pub make: fn(&serde_json::Value) -> Result<Box<dyn Solver>>,
}

/// How a solver searches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// Compares the costs of samples.
    Sampling,
    /// Follows the gradient of the cost.
    Gradient,
}

/// The kind of actions a solver plans.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// Real values within bounds.
    Continuous,
    /// Choices among finitely many options.
    Discrete,
}

/// A capability of a model beyond a cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Need {
    /// The gradient of the cost: [`swm_core::DifferentiableCost`].
    Gradient,
    /// Latent dynamics: [`swm_core::LatentDynamics`].
    Latent,
    /// Constraints: [`swm_core::Constrained`].
    Constraints,
}

impl Named for SolverEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

impl SolverEntry {
    /// Returns the reason why this solver cannot plan actions of this kind with a model that has the capabilities
    /// `offers`; `None` if it can.
    pub fn obstacle(&self, actions: ActionKind, offers: &[Need]) -> Option<String> {
        if self.actions != actions {
            return Some(match actions {
                ActionKind::Continuous => "it plans discrete actions, but the given actions are continuous".to_owned(),
                ActionKind::Discrete => "it plans continuous actions, but the given actions are discrete".to_owned(),
            });
        }
        if let Some(need) = self.needs.iter().find(|need| !offers.contains(need)) {
            return Some(need.obstacle());
        }
        let ignores_constraints = offers.contains(&Need::Constraints) && !self.needs.contains(&Need::Constraints);
        ignores_constraints.then(|| "it would ignore the constraints of the model".to_owned())
    }
}

impl ActionKind {
    /// Returns the kind of the actions in an environment's action space.
    pub fn of(space: &Space) -> Self {
        if matches!(space, Space::Box { .. }) { Self::Continuous } else { Self::Discrete }
    }

    /// Returns the kind of the actions in a plan space.
    pub fn of_plan(space: PlanSpace<'_>) -> Self {
        match space {
            PlanSpace::Continuous { .. } => Self::Continuous,
            PlanSpace::Discrete { .. } => Self::Discrete,
        }
    }
}

impl Need {
    /// Returns the reason why a solver that needs this capability cannot use a model without it.
    pub fn obstacle(self) -> String {
        let needed = match self {
            Self::Gradient => "the gradient of the cost",
            Self::Latent => "the model's latent state",
            Self::Constraints => "constraints",
        };
        format!("it needs {needed}, which this model does not offer")
    }
}

/// Returns the default settings of a solver as JSON, for [`SolverEntry::defaults`].
pub fn defaults<S: Default + Serialize>() -> serde_json::Value {
    serde_json::to_value(S::default()).unwrap_or_default()
}

/// Creates a solver from JSON settings, for [`SolverEntry::make`].
///
/// # Errors
/// When a setting is unknown, has the wrong type, or is invalid ([`Solver::check`]).
pub fn make<S: Solver + DeserializeOwned + 'static>(settings: &serde_json::Value) -> Result<Box<dyn Solver>> {
    let solver = S::deserialize(settings)
        .map_err(|error| Error::config("solver settings", error.to_string(), "`swm solvers` lists the settings"))?;
    solver.check()?;
    Ok(Box::new(solver))
}
