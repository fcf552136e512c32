//! [`ObjectiveConfig`]: what a plan is for, as a file says it.

use super::{ActionNorm, Change, Constraint, Control, Goal, LatentBox, Objective, ObjectiveCost, Regularised, Shape};
use super::{Slope, Trajectory};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Result};

/// Terms that are added up, and constraints.
///
/// Without a goal term, everything is added to the model's own cost. With one, the terms are the whole cost, of the rollout
/// of the model's latent dynamics; only then can latents be constrained.
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
    /// What is added up.
    pub terms: Vec<Term>,
    /// What must hold.
    pub constraints: Vec<Limit>,
}

/// A term of an objective.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "term", rename_all = "snake_case")]
pub enum Term {
    /// The distance to the goal.
    Goal(Goal),
    /// The effort.
    Control(Control),
    /// The restlessness.
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
    /// On the length of actions.
    ActionNorm(ActionNorm),
    /// On predicted latents.
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
    /// Whether it leaves a model as it is.
    pub fn is_empty(&self) -> bool {
        self.terms.is_empty() && self.constraints.is_empty()
    }

    /// A model that plans are made for this with.
    ///
    /// # Errors
    /// When there are terms or constraints on latents and the model shows none, constraints on latents without a goal term,
    /// or the model has constraints of its own.
    pub fn apply(&self, model: Box<dyn CostModel>) -> Result<Box<dyn CostModel>> {
        if self.is_empty() {
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
