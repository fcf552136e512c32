//! [`SOLVERS`]: every solver, what it plans and what it asks of a model.

use crate::{AugmentedLagrangian, CategoricalCem, Cem, GradientDescent, Grasp, ICem, Mppi, Pgd, PredictiveSampling};
use serde::Serialize;
use serde::de::DeserializeOwned;
use swm_core::registry::Named;
use swm_core::{Error, PlanSpace, Registry, Result, Solver, Space};

/// How a solver searches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// It compares the costs of samples.
    Sampling,
    /// It follows the gradient of the cost.
    Gradient,
}

/// The actions a solver plans.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Actions {
    /// Numbers within bounds.
    Continuous,
    /// Choices among a few.
    Discrete,
}

impl Actions {
    /// How actions of such a space are planned.
    pub fn of(space: &Space) -> Self {
        if matches!(space, Space::Box { .. }) { Self::Continuous } else { Self::Discrete }
    }

    /// What a plan of such a space is made of.
    pub fn of_plan(space: PlanSpace<'_>) -> Self {
        match space {
            PlanSpace::Continuous { .. } => Self::Continuous,
            PlanSpace::Discrete { .. } => Self::Discrete,
        }
    }
}

/// What a solver asks of a model beyond a cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Need {
    /// [`swm_core::DifferentiableCost`].
    Gradient,
    /// [`swm_core::LatentDynamics`].
    Latent,
    /// [`swm_core::Constrained`].
    Constraints,
}

/// A solver that can be made.
pub struct SolverEntry {
    /// Its id, such as `cem`.
    pub id: &'static str,
    /// How it searches, in a sentence.
    pub summary: &'static str,
    /// How it searches.
    pub family: Family,
    /// The actions it plans.
    pub actions: Actions,
    /// What it asks of a model beyond a cost.
    pub needs: &'static [Need],
    /// The publication it follows.
    pub paper: &'static str,
    /// Its settings and their defaults, as JSON.
    pub defaults: fn() -> serde_json::Value,
    /// Makes one from settings; what they do not name keeps its default.
    pub make: fn(&serde_json::Value) -> Result<Box<dyn Solver>>,
}

impl Named for SolverEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

/// Every solver.
pub static SOLVERS: Registry<SolverEntry> = Registry {
    kind: "solver",
    hint: "`swm solvers` lists them",
    rows: &[
        SolverEntry {
            id: "predictive_sampling",
            summary: "tries many guesses once and takes the cheapest",
            family: Family::Sampling,
            actions: Actions::Continuous,
            needs: &[],
            paper: "Howell et al., Predictive Sampling: Real-time Behaviour Synthesis with MuJoCo, 2022",
            defaults: defaults::<PredictiveSampling>,
            make: make::<PredictiveSampling>,
        },
        SolverEntry {
            id: "cem",
            summary: "refits a Gaussian to the cheapest samples",
            family: Family::Sampling,
            actions: Actions::Continuous,
            needs: &[],
            paper: "Rubinstein and Kroese, The Cross-Entropy Method, 2004",
            defaults: defaults::<Cem>,
            make: make::<Cem>,
        },
        SolverEntry {
            id: "icem",
            summary: "CEM with coloured noise, kept elites and momentum",
            family: Family::Sampling,
            actions: Actions::Continuous,
            needs: &[],
            paper: "Pinneri et al., Sample-efficient Cross-Entropy Method for Real-time Planning, 2020",
            defaults: defaults::<ICem>,
            make: make::<ICem>,
        },
        SolverEntry {
            id: "mppi",
            summary: "moves a mean by the weights that samples get from their costs",
            family: Family::Sampling,
            actions: Actions::Continuous,
            needs: &[],
            paper: "Williams et al., Aggressive Driving with Model Predictive Path Integral Control, 2016",
            defaults: defaults::<Mppi>,
            make: make::<Mppi>,
        },
        SolverEntry {
            id: "categorical_cem",
            summary: "refits the probability of every option to the cheapest samples",
            family: Family::Sampling,
            actions: Actions::Discrete,
            needs: &[],
            paper: "Rubinstein and Kroese, The Cross-Entropy Method, 2004",
            defaults: defaults::<CategoricalCem>,
            make: make::<CategoricalCem>,
        },
        SolverEntry {
            id: "gd",
            summary: "follows the gradient of the cost from several starts",
            family: Family::Gradient,
            actions: Actions::Continuous,
            needs: &[Need::Gradient],
            paper: "Maes et al., stable-worldmodel, 2026, algorithm \"Gradient Descent Solver\"",
            defaults: defaults::<GradientDescent>,
            make: make::<GradientDescent>,
        },
        SolverEntry {
            id: "pgd",
            summary: "follows the gradient on probabilities of the options, then takes the likeliest",
            family: Family::Gradient,
            actions: Actions::Discrete,
            needs: &[Need::Gradient],
            paper: "Henaff, Whitney and LeCun, Model-Based Planning with Discrete and Continuous Actions, 2017",
            defaults: defaults::<Pgd>,
            make: make::<Pgd>,
        },
        SolverEntry {
            id: "lagrangian",
            summary: "follows the gradient and prices violated constraints ever higher",
            family: Family::Gradient,
            actions: Actions::Continuous,
            needs: &[Need::Gradient, Need::Constraints],
            paper: "Maes et al., stable-worldmodel, 2026, algorithm \"Lagrangian Solver\"",
            defaults: defaults::<AugmentedLagrangian>,
            make: make::<AugmentedLagrangian>,
        },
        SolverEntry {
            id: "grasp",
            summary: "optimises states and actions together, every model step by itself",
            family: Family::Gradient,
            actions: Actions::Continuous,
            needs: &[Need::Gradient, Need::Latent],
            paper: "Psenka et al., Parallel Stochastic Gradient-Based Planning for World Models, 2026",
            defaults: defaults::<Grasp>,
            make: make::<Grasp>,
        },
    ],
};

/// The default settings of a solver.
fn defaults<S: Default + Serialize>() -> serde_json::Value {
    serde_json::to_value(S::default()).unwrap_or_default()
}

/// A solver with these settings.
fn make<S: Solver + DeserializeOwned + 'static>(settings: &serde_json::Value) -> Result<Box<dyn Solver>> {
    match S::deserialize(settings) {
        Ok(solver) => Ok(Box::new(solver)),
        Err(error) => Err(Error::config("solver settings", error.to_string(), "`swm solvers` lists what there is")),
    }
}
