//! Common behaviour of the sampling solvers: initial guess, deadline, traces, bounds, and errors.

use crate::solvers::TRIALS;
use crate::toys::{Model, Toy, solve, toy};
use serde_json::{Value, json};
use std::time::Instant;
use swm_core::{Key, Plan, PlanProblem, PlanSpace, Solver};
use swm_plan::{ActionKind, Family, SOLVERS, SolverEntry};

fn sampling_solvers() -> impl Iterator<Item = (&'static SolverEntry, &'static Toy)> {
    let toy_for = |row: &SolverEntry| toy(if row.actions == ActionKind::Discrete { "discrete" } else { "quadratic" });
    SOLVERS.rows.iter().filter(|row| row.family == Family::Sampling).map(move |row| (row, toy_for(row)))
}

fn make(id: &str, settings: &Value) -> Box<dyn Solver> {
    (SOLVERS.get(id).expect("a registered solver").make)(settings).expect("creating the solver")
}

fn plan(id: &str, toy: &'static Toy, init: Option<&[f32]>, deadline: Option<Instant>) -> Plan {
    let problem =
        PlanProblem { horizon: toy.horizon, space: toy.space, keys: &[Key::new(1)], init, deadline, observer: None };
    make(id, &json!({})).solve(&mut Model::new(toy, &[0]), problem).expect("the solver returns a plan")
}

#[test]
fn initial_guess_is_the_first_candidate() {
    for (row, toy) in sampling_solvers() {
        let landscape = (toy.landscape)(0);
        let optimum = landscape.optimum();
        let init: Vec<f32> = optimum.iter().map(|&v| v as f32).collect();
        let found = plan(row.id, toy, Some(&init), None);
        assert!((f64::from(found.trace[0].best[0]) - landscape.cost(&optimum)).abs() < 1e-6, "{}", row.id);
        if row.id == "predictive_sampling" {
            assert_eq!(found.actions, init);
        }
    }
}

#[test]
fn deadline_ends_the_search() {
    for (row, toy) in sampling_solvers() {
        let (stopped, complete) = (plan(row.id, toy, None, Some(Instant::now())), plan(row.id, toy, None, None));
        assert_eq!(stopped.trace[0].best.len(), 1, "{}", row.id);
        assert_eq!(stopped.trace[0].best[0], complete.trace[0].best[0], "{}", row.id);
        assert_eq!(stopped.costs, stopped.trace[0].best, "{}", row.id);
        assert_eq!(complete.trace[0].best.len(), if row.id == "predictive_sampling" { 1 } else { 30 }, "{}", row.id);
    }
}

#[test]
fn trace_best_cost_is_at_most_the_mean_cost_and_spread_shrinks() {
    for (row, toy) in sampling_solvers() {
        let trace = &plan(row.id, toy, None, None).trace[0];
        let n = trace.best.len();
        assert!(trace.mean.len() == n && trace.spread.len() == n && trace.violation.is_empty(), "{}", row.id);
        assert!(trace.best.iter().zip(&trace.mean).all(|(best, mean)| best <= mean), "{}", row.id);
        assert!(trace.spread.iter().all(|&spread| spread >= 0.0), "{}", row.id);
        let fixed = matches!(row.id, "mppi" | "predictive_sampling");
        assert!(fixed || trace.spread[n - 1] < trace.spread[0] / 10.0, "{}: {:?}", row.id, trace.spread);
    }
}

#[test]
fn candidates_stay_within_bounds() {
    /// Records the largest absolute action.
    struct LargestAction(f32);
    impl swm_core::CostModel for LargestAction {
        fn observe(&mut self, _: &swm_core::Batch, _: &[usize]) -> swm_core::Result<()> {
            Ok(())
        }
        fn cost(&mut self, candidates: swm_core::Candidates<'_>, costs: &mut [f32]) -> swm_core::Result<()> {
            self.0 = candidates.actions.iter().fold(self.0, |largest, a| largest.max(a.abs()));
            costs.fill(1.0);
            Ok(())
        }
    }
    for (row, _) in sampling_solvers().filter(|(row, _)| row.actions == ActionKind::Continuous) {
        let mut model = LargestAction(0.0);
        let space = PlanSpace::Continuous { low: &[-0.3, -0.5], high: &[0.25, 0.5] };
        let problem = PlanProblem {
            horizon: 3,
            space,
            keys: &[Key::new(0)],
            init: Some(&[9.0; 6]),
            deadline: None,
            observer: None,
        };
        let plan = make(row.id, &json!({})).solve(&mut model, problem).expect("the solver returns a plan");
        assert_eq!(model.0, 0.5, "{}", row.id);
        // The plan must be within the bounds even though all costs are equal.
        for step in plan.actions.chunks_exact(2) {
            assert!((-0.3..=0.25).contains(&step[0]) && (-0.5..=0.5).contains(&step[1]), "{}: {step:?}", row.id);
        }
    }
}

#[test]
fn no_environments_give_no_plans() {
    for (row, toy) in sampling_solvers() {
        let plan = solve(&mut *make(row.id, &json!({})), &mut Model::new(toy, &[]), toy, &[])
            .expect("planning for no environments");
        assert!(plan.actions.is_empty() && plan.costs.is_empty() && plan.trace.is_empty());
    }
}

#[test]
fn noise_of_an_action_block_is_that_of_its_actions_as_steps() {
    static STEPS: Toy = Toy {
        name: "the quadratic toy, a step for each number",
        horizon: 6,
        space: PlanSpace::Continuous { low: &[f32::NEG_INFINITY; 1], high: &[f32::INFINITY; 1] },
        latent: false,
        constrained: false,
        landscape: |env| (toy("quadratic").landscape)(env),
    };
    let plan = |toy: &'static Toy, settings| {
        solve(&mut *make("icem", &settings), &mut Model::new(toy, &[0, 1]), toy, &[0, 1]).expect("planning").actions
    };
    let blocks = plan(toy("quadratic"), json!({ "iterations": 3, "block": 2 }));
    assert_eq!(blocks, plan(&STEPS, json!({ "iterations": 3 })));
    assert_ne!(blocks, plan(toy("quadratic"), json!({ "iterations": 3 })));
}

#[test]
fn errors_name_invalid_settings() {
    let wrong = [
        ("predictive_sampling", json!({"samples": 0}), "predictive_sampling samples: 0"),
        ("predictive_sampling", json!({"sigma": 0}), "predictive_sampling sigma: 0"),
        ("cem", json!({"iterations": 0}), "cem iterations: 0; choose 1 to 100000"),
        ("cem", json!({"iterations": 1u64 << 60}), "cem iterations: 1152921504606846976; choose 1 to 100000"),
        ("mppi", json!({"iterations": 100_001}), "mppi iterations: 100001; choose 1 to 100000"),
        ("cem", json!({"samples": 64, "elites": 65}), "cem elites: 65 of 64 samples"),
        ("cem", json!({"elites": 1}), "at least 2 (a standard deviation needs two)"),
        ("cem", json!({"sigma": -1}), "cem sigma: -1; choose a finite number above 0"),
        ("icem", json!({"elites": 0}), "icem elites: 0 of 300 samples"),
        ("icem", json!({"momentum": 1.5}), "icem momentum: 1.5; choose a number of at least 0 and below 1"),
        ("icem", json!({"momentum": -0.1}), "icem momentum"),
        ("icem", json!({"beta": -1}), "icem beta"),
        ("icem", json!({"beta": 1000}), "icem beta: 1000; choose a number of 0 to 10"),
        ("icem", json!({"block": 0}), "icem block: 0; choose at least 1"),
        ("icem", json!({"block": 5}), "icem block: 5 for 2 dimensions of a model step; give the action block"),
        ("icem", json!({"keep": 31}), "icem keep: 31; choose at most 30"),
        ("icem", json!({"samples": 5, "elites": 5, "keep": 5}), "choose at most 4"),
        ("mppi", json!({"temperature": 0}), "mppi temperature: 0; choose a finite number above 0"),
        ("mppi", json!({"elites": 0}), "mppi elites: 0 of 300 samples; choose at least 1"),
        ("mppi", json!({"elites": 301}), "mppi elites: 301 of 300 samples"),
        ("categorical_cem", json!({"smoothing": -0.5}), "categorical_cem smoothing: -0.5"),
        ("categorical_cem", json!({"momentum": 1}), "categorical_cem momentum: 1"),
        ("categorical_cem", json!({"elites": 0}), "categorical_cem elites"),
    ];
    for (id, settings, expected) in wrong {
        let toy = sampling_solvers().find(|(row, _)| row.id == id).expect("a sampling solver").1;
        let error = match (SOLVERS.get(id).expect("a registered solver").make)(&settings) {
            Err(error) => error,
            Ok(mut solver) => solve(&mut *solver, &mut Model::new(toy, &[0]), toy, &[0]).expect_err(expected),
        };
        assert!(error.is_usage() && error.to_string().contains(expected), "{error}");
    }
    for (row, _) in sampling_solvers() {
        let error = (row.make)(&json!({"sampels": 3})).err().expect("an unknown setting must be an error").to_string();
        assert!(error.contains("sampels"), "{error}");
    }
}

#[test]
fn errors_name_invalid_problems() {
    let quadratic = toy("quadratic");
    let message = |id: &str, horizon, space, init: Option<&[f32]>| {
        let keys = [Key::new(0), Key::new(1)];
        let problem = PlanProblem { horizon, space, keys: &keys, init, deadline: None, observer: None };
        make(id, &json!({}))
            .solve(&mut Model::new(quadratic, &[0, 1]), problem)
            .expect_err("the input is invalid")
            .to_string()
    };
    let space = quadratic.space;
    assert!(message("cem", 0, space, None).contains("planning horizon: 0 model steps"));
    let given = message("cem", 3, space, Some(&[0.0; 5]));
    assert!(given.contains("5 values") && given.contains("12 (2 environments x 3 x 2)"), "{given}");
    let infinite = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, f32::INFINITY, 0.0, 0.0, 0.0];
    let given = message("cem", 3, space, Some(&infinite));
    assert!(given.contains("planned environment 1") && given.contains("inf at step 1"), "{given}");
    let crossed = PlanSpace::Continuous { low: &[0.0, 1.0], high: &[1.0, 0.5] };
    assert!(message("cem", 3, crossed, None).contains("bounds of action dimension 1: 1 ..= 0.5"));
    let uneven = PlanSpace::Continuous { low: &[0.0], high: &[1.0, 0.5] };
    assert!(message("cem", 3, uneven, None).contains("1 lower and 2 upper"));
    let none = PlanSpace::Discrete { choices: &[2, 0] };
    assert!(message("categorical_cem", 3, none, None).contains("choice 1 of a model step: it has no options"));
    let choices = PlanSpace::Discrete { choices: &[2] };
    let negative = [1.0, -1.0, 0.0, 0.0];
    assert!(message("categorical_cem", 1, choices, Some(&negative)).contains("at least 0"));
    let many = PlanSpace::Discrete { choices: &[usize::MAX, 2] };
    let error = message("categorical_cem", 3, many, None);
    assert!(error.contains("values do not fit into memory") && !error.contains("samples"), "{error}");
}

#[test]
fn plans_that_do_not_fit_into_memory_are_refused_before_it_is_asked_for() {
    for trial in TRIALS {
        let toy = toy(trial.near[0].0);
        for horizon in [10_001, 1 << 36, 1 << 60, usize::MAX] {
            let space = toy.space;
            let problem =
                PlanProblem { horizon, space, keys: &[Key::new(0)], init: None, deadline: None, observer: None };
            let error = make(trial.solver, &json!({})).solve(&mut Model::new(toy, &[0]), problem);
            let error = error.expect_err("too long").to_string();
            assert!(error.contains(&format!("{horizon} model steps")) && error.contains("1 to 10000"), "{error}");
        }
    }
}
