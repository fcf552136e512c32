//! Every solver on every toy: the solver finds the optimum to the accuracy of its trial, or rejects the toy.

use crate::toys::{Model, TOYS, Toy, solve, toy};
use swm_core::PlanSpace;
use swm_core::registry::Named;
use swm_plan::{ActionKind, Need, Penalised, SOLVERS, SolverEntry, pairing};

/// The settings with which a solver is tested, and the required accuracy.
pub struct Trial {
    pub solver: &'static str,
    /// The settings, as JSON.
    pub settings: &'static str,
    /// The settings of the short search that golden files record.
    pub short: &'static str,
    /// For each toy that the solver can solve: the allowed excess of the cost over the lowest one, and the allowed
    /// distance of any value of the plan from the best plan.
    pub near: &'static [(&'static str, f64, f64)],
}

pub const TRIALS: &[Trial] = &[
    // One population of samples finds the optimum only approximately.
    Trial {
        solver: "predictive_sampling",
        settings: r#"{"samples": 200000, "sigma": 0.7}"#,
        short: r#"{"samples": 40}"#,
        near: &[
            ("quadratic", 0.4, 0.4),
            ("bounded", 0.4, 0.4),
            ("multi-modal", 0.2, 0.2),
            ("constrained", 0.1, 0.1),
            ("lqr", 0.4, 0.4),
            ("reach", 1e-3, 0.0),
            ("reach-bounded", 1e-6, 1e-3),
        ],
    },
    Trial {
        solver: "cem",
        settings: r#"{"samples": 600, "elites": 100, "iterations": 60, "sigma": 2}"#,
        short: r#"{"samples": 40, "elites": 8, "iterations": 4}"#,
        near: &[
            ("quadratic", 1e-6, 1e-3),
            ("bounded", 1e-6, 1e-3),
            ("multi-modal", 1e-6, 1e-3),
            ("constrained", 1e-2, 2e-2),
            ("lqr", 1e-6, 1e-3),
            ("reach", 1e-6, 0.0),
            ("reach-bounded", 1e-6, 1e-3),
        ],
    },
    Trial {
        solver: "icem",
        settings: r#"{"samples": 600, "elites": 100, "iterations": 60, "sigma": 2, "beta": 0.5}"#,
        short: r#"{"samples": 40, "elites": 8, "iterations": 4}"#,
        near: &[
            ("quadratic", 1e-6, 1e-3),
            ("bounded", 1e-6, 1e-3),
            ("multi-modal", 1e-6, 1e-3),
            ("constrained", 1e-2, 2e-2),
            ("lqr", 1e-6, 1e-3),
            ("reach", 1e-6, 0.0),
            ("reach-bounded", 1e-6, 1e-3),
        ],
    },
    Trial {
        solver: "mppi",
        settings: r#"{"samples": 2000, "elites": 20, "sigma": 0.1, "temperature": 0.01, "iterations": 100}"#,
        short: r#"{"samples": 40, "elites": 8, "iterations": 4}"#,
        near: &[
            ("quadratic", 1e-2, 5e-2),
            ("bounded", 1e-2, 5e-2),
            ("multi-modal", 1e-2, 5e-2),
            ("constrained", 1e-2, 5e-2),
            ("lqr", 1e-2, 5e-2),
            ("reach", 1e-2, 5e-2),
            ("reach-bounded", 1e-2, 5e-2),
        ],
    },
    Trial {
        solver: "categorical_cem",
        settings: "{}",
        short: r#"{"samples": 20, "elites": 4, "iterations": 4, "smoothing": 0.1, "momentum": 0.2}"#,
        near: &[("discrete", 1e-6, 0.0)],
    },
    Trial {
        solver: "gd",
        settings: r#"{"iterations": 300}"#,
        short: r#"{"samples": 4, "iterations": 4}"#,
        near: &[
            ("quadratic", 1e-6, 1e-3),
            ("bounded", 1e-6, 1e-3),
            ("multi-modal", 1e-6, 1e-3),
            ("lqr", 1e-6, 1e-3),
            ("reach", 1e-6, 0.0),
            ("reach-bounded", 1e-6, 1e-3),
        ],
    },
    Trial {
        solver: "pgd",
        settings: r#"{"step": 0.3}"#,
        short: r#"{"samples": 4, "iterations": 4, "action_noise": 0.1}"#,
        near: &[("discrete", 1e-6, 0.0)],
    },
    Trial {
        solver: "lagrangian",
        settings: r#"{"outer_iterations": 10, "optimizer": {"kind": "sgd", "step": 0.01}, "penalty_limit": 16, "tolerance": 5e-4}"#,
        short: r#"{"samples": 4, "outer_iterations": 2, "iterations": 3}"#,
        near: &[("constrained", 2e-3, 1e-3)],
    },
    Trial {
        solver: "grasp",
        settings: r#"{"sync_iterations": 40}"#,
        short: r#"{"iterations": 4}"#,
        near: &[("reach", 1e-4, 0.0), ("reach-bounded", 1e-4, 1e-3)],
    },
];

/// Pairs of solver and toy that are not tested, with the reason.
const SKIPPED: &[(&str, &str, &str)] = &[];

/// The environments that every toy is solved for in one call.
const ENVS: [usize; 3] = [0, 1, 2];

/// The weight of the penalty, which exceeds the multipliers of the constrained toy (below 2).
const PENALTY: f32 = 4.0;

pub fn trial(solver: &str) -> &'static Trial {
    let trial = TRIALS.iter().find(|trial| trial.solver == solver);
    trial.unwrap_or_else(|| panic!("TRIALS has no entry for {solver}"))
}

/// Whether a solver can plan for a toy if the toy's constraints are ignored.
fn fits(row: &SolverEntry, toy: &Toy) -> bool {
    let actions = match toy.space {
        PlanSpace::Continuous { .. } => ActionKind::Continuous,
        PlanSpace::Discrete { .. } => ActionKind::Discrete,
    };
    let offered = |need: &Need| match need {
        Need::Gradient => true,
        Need::Latent => toy.latent,
        Need::Constraints => toy.constrained,
    };
    row.actions == actions && row.needs.iter().all(offered)
}

/// Whether a solver can plan for a toy and satisfies its constraints.
pub fn solves(row: &SolverEntry, toy: &Toy) -> bool {
    fits(row, toy) && (!toy.constrained || row.needs.contains(&Need::Constraints))
}

#[test]
fn solvers_find_the_optima_of_toys() {
    for row in SOLVERS.rows {
        let trial = trial(row.id);
        let settings = serde_json::from_str(trial.settings).expect("parsing the settings");
        for toy in TOYS {
            // A sampling solver receives constraints as a penalty.
            let penalised = toy.constrained && fits(row, toy) && row.needs.is_empty();
            let skipped = SKIPPED.iter().any(|&(solver, name, _)| (solver, name) == (row.id, toy.name));
            let near = trial.near.iter().find(|near| near.0 == toy.name);
            let tried = (solves(row, toy) || penalised) && !skipped;
            assert_eq!(near.is_some(), tried, "the trial of {} on {}", row.id, toy.name);
            let Some(&(_, excess, distance)) = near else { continue };

            let mut solver = (row.make)(&settings).expect("creating the solver");
            let mut model = Model::new(toy, &ENVS);
            let plan = if penalised {
                let mut model = Penalised::new(Box::new(model), PENALTY).expect("the toy has constraints");
                solve(&mut *solver, &mut model, toy, &ENVS)
            } else {
                solve(&mut *solver, &mut model, toy, &ENVS)
            };
            let plan = plan.unwrap_or_else(|error| panic!("{} on {}: {error}", row.id, toy.name));
            let len = toy.horizon * toy.space.dim();
            assert_eq!(plan.actions.len(), ENVS.len() * len);
            for (env, actions) in ENVS.into_iter().zip(plan.actions.chunks_exact(len)) {
                let landscape = (toy.landscape)(env);
                let actions: Vec<f64> = actions.iter().map(|&a| f64::from(a)).collect();
                let best = landscape.optimum();
                let gap = landscape.cost(&actions) - landscape.cost(&best);
                let distance_to_best = actions.iter().zip(&best).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                let subject = format!("{} on {}, environment {env}", row.id, toy.name);
                assert!(gap.abs() <= excess, "{subject}: costs {gap:e} more than the optimum");
                assert!(
                    distance_to_best <= distance || !landscape.is_unique(),
                    "{subject}: {actions:?}, best {best:?}"
                );
                let violation = landscape.constraints(&actions).into_iter().fold(0.0, f64::max);
                assert!(violation <= 1e-3, "{subject}: violates a constraint by {violation:e}");
            }
        }
    }
}

#[test]
fn pairing_errors_name_the_solvers_that_fit() {
    let message = |row: &SolverEntry, toy: &Toy, model: &mut Model| {
        let mut solver = (row.make)(&serde_json::json!({})).expect("creating the solver");
        let rejected = solve(&mut *solver, model, toy, &ENVS).expect_err(row.id).to_string();
        let message = pairing(row.id, model, ActionKind::of_plan(toy.space)).expect_err(row.id).to_string();
        let obstacle = |message: &str| message.split("; ").next().map(str::to_owned);
        assert_eq!(obstacle(&rejected), obstacle(&message), "the solver and `pairing` agree");
        message
    };
    let named = |message: &str, id: &str| message.split(|c: char| !(c.is_alphanumeric() || c == '_')).any(|w| w == id);
    for (row, toy) in SOLVERS.rows.iter().flat_map(|row| TOYS.iter().map(move |toy| (row, toy))) {
        if solves(row, toy) {
            continue;
        }
        let message = message(row, toy, &mut Model::new(toy, &ENVS));
        for other in SOLVERS.rows.iter().filter(|other| other.id() != row.id()) {
            assert_eq!(named(&message, other.id), solves(other, toy), "{} on {}: {message}", other.id, toy.name);
        }
    }
    // Without a gradient, only sampling solvers fit.
    for row in SOLVERS.rows.iter().filter(|row| row.needs.contains(&Need::Gradient)) {
        let toy = toy(if row.actions == ActionKind::Discrete { "discrete" } else { "quadratic" });
        let message = message(row, toy, &mut Model::new(toy, &ENVS).opaque());
        for other in SOLVERS.rows.iter().filter(|other| other.id() != row.id()) {
            let fits_actions = other.actions == row.actions && other.needs.is_empty();
            assert_eq!(named(&message, other.id), fits_actions, "{message}");
        }
    }
}

#[test]
fn trials_and_skipped_trials_name_existing_solvers_and_toys() {
    for &(solver, name, why) in SKIPPED {
        assert!(SOLVERS.get(solver).is_ok() && TOYS.iter().any(|toy| toy.name == name) && why.len() > 10, "{solver}");
    }
    for trial in TRIALS {
        assert!(SOLVERS.get(trial.solver).is_ok(), "{}", trial.solver);
        assert!(trial.near.iter().all(|near| TOYS.iter().any(|toy| toy.name == near.0)), "{}", trial.solver);
    }
}

#[test]
fn errors_name_costs_that_are_missing_or_not_finite() {
    for row in SOLVERS.rows {
        let toy = TOYS.iter().find(|toy| solves(row, toy)).expect("a toy for this solver");
        let message = |cost| {
            let mut solver = (row.make)(&serde_json::json!({})).expect("creating the solver");
            let model = Model::new(toy, &ENVS).with_wrong_cost(1, 0, cost);
            solve(&mut *solver, &mut { model }, toy, &ENVS).expect_err(row.id).to_string()
        };
        for cost in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let message = message(Some(cost));
            assert!(message.contains("not finite") && message.contains("environment 1"), "{}: {message}", row.id);
        }
        let message = message(None);
        assert!(message.contains("none for candidate 0 of planned environment 1"), "{}: {message}", row.id);
    }
}
