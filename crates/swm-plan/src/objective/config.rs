//! [`ObjectiveConfig`]: an objective and constraints as described in a configuration file.

use super::constraint::{ActionNorm, LatentBox};
use super::contracts::{Constraint, Objective, Shape, Slope, Trajectory};
use super::cost::ObjectiveCost;
use super::regularised::Regularised;
use super::term::{Change, Control, Goal, When};
use crate::search::Settings;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Result};

/// The terms and constraints of a plan.
///
/// Without a goal term, the terms are added to the model's own cost. With a goal term, the terms are the whole cost,
/// computed on a rollout of the model's latent dynamics. Constraints on latents require a goal term.
///
/// ```
/// use swm_plan::objective::ObjectiveConfig;
/// let described = r#"{
///     "terms": [{"term": "goal", "when": "running", "discount": 0.9}, {"term": "control", "weight": 0.01}],
///     "constraints": [{"constraint": "action_norm", "limit": 2.0}]
/// }"#;
/// let config: ObjectiveConfig = serde_json::from_str(described)?;
/// assert_eq!(config.terms.len(), 2);
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObjectiveConfig {
    /// The terms; their costs are added.
    pub terms: Vec<Term>,
    /// The constraints.
    pub constraints: Vec<Limit>,
}

/// A term of an objective.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "term", rename_all = "snake_case")]
pub enum Term {
    /// The squared distance to the goal.
    Goal(Goal),
    /// The squared norm of the actions.
    Control(Control),
    /// The squared differences of neighbouring actions.
    Change(Change),
}

impl Term {
    fn objective(&self) -> &dyn Objective {
        match self {
            Self::Goal(term) => term,
            Self::Control(term) => term,
            Self::Change(term) => term,
        }
    }
}

impl Objective for Term {
    fn needs_latents(&self) -> bool {
        self.objective().needs_latents()
    }

    fn check(&self, shape: Shape) -> Result<()> {
        self.objective().check(shape)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.objective().cost(trajectory)
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        self.objective().add_gradient(trajectory, slope);
    }
}

/// A constraint of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "constraint", rename_all = "snake_case")]
pub enum Limit {
    /// A limit on the norm of actions.
    ActionNorm(ActionNorm),
    /// Bounds on predicted latents.
    LatentBox(LatentBox),
}

impl Limit {
    fn constraint(&self) -> Box<dyn Constraint> {
        match self.clone() {
            Self::ActionNorm(limit) => Box::new(limit),
            Self::LatentBox(limit) => Box::new(limit),
        }
    }
}

impl ObjectiveConfig {
    /// Whether there are no terms and no constraints.
    pub fn is_empty(&self) -> bool {
        self.terms.is_empty() && self.constraints.is_empty()
    }

    /// Whether the objective is the closest distance to the goal alone, which models may compute faster themselves.
    fn is_closest_goal(&self) -> bool {
        let closest = Goal { when: When::Closest, ..Goal::default() };
        self.constraints.is_empty() && self.terms == [Term::Goal(closest)]
    }

    /// Checks the numbers of all terms and constraints, as far as they can be checked without a model.
    ///
    /// # Errors
    /// When a number is invalid; the error names it.
    pub fn check(&self) -> Result<()> {
        for term in &self.terms {
            match term {
                Term::Goal(goal) => goal.check_numbers()?,
                Term::Control(Control { weight }) => Settings("control term").not_negative("weight", *weight)?,
                Term::Change(Change { weight, .. }) => Settings("change term").not_negative("weight", *weight)?,
            }
        }
        for limit in &self.constraints {
            match limit {
                Limit::ActionNorm(norm) => Settings("action norm").not_negative("limit", norm.limit)?,
                Limit::LatentBox(bounds) => bounds.check_bounds()?,
            }
        }
        Ok(())
    }

    /// Applies the terms and constraints to a model.
    ///
    /// # Errors
    /// When a term or constraint uses latents and the model has none, a constraint uses latents without a goal term, or
    /// the model has constraints of its own.
    pub fn apply(&self, mut model: Box<dyn CostModel>) -> Result<Box<dyn CostModel>> {
        if self.is_empty() || (self.is_closest_goal() && model.compare_closest()) {
            return Ok(model);
        }
        let constraints = self.constraints.iter().map(Limit::constraint).collect();
        let terms = Box::new(self.terms.clone());
        Ok(if terms.needs_latents() {
            Box::new(ObjectiveCost::new(model, terms, constraints)?)
        } else {
            Box::new(Regularised::new(model, terms, constraints)?)
        })
    }
}
