//! The gradient solvers, compared with torch and the reference implementation (`../golden/gradient_solvers.json`).

use crate::toys::{Model, toy};
use serde::Deserialize;
use std::time::Instant;
use swm_core::Solver;
use swm_core::{
    Batch, Candidates, Constrained, CostModel, DifferentiableCost, Key, Plan, PlanProblem, PlanSpace, Result,
};
use swm_plan::search::{Adam, Memory, Optimizer, RmsProp, Sgd};
use swm_plan::{AugmentedLagrangian, GradientDescent, Pgd, SOLVERS};

/// The content of the file that `export_gradient_solvers.py` writes.
#[derive(Deserialize)]
struct Golden {
    optimizers: Paths,
    gd: Descent,
    pgd: Projected,
    lagrangian: Augmented,
}

#[derive(Deserialize)]
struct Paths {
    sgd: Vec<[f32; 4]>,
    adam: Vec<[f32; 4]>,
    rmsprop: Vec<[f32; 4]>,
}

#[derive(Deserialize)]
struct Descent {
    actions: Vec<f32>,
    costs: Vec<f32>,
}

#[derive(Deserialize)]
struct Projected {
    choices: Vec<usize>,
    costs: Vec<f32>,
}

#[derive(Deserialize)]
struct Augmented {
    actions: Vec<f32>,
    losses: Vec<f32>,
}

fn golden() -> Golden {
    serde_json::from_str(include_str!("../golden/gradient_solvers.json")).expect("gradient_solvers.json is valid")
}

#[track_caller]
fn assert_near(given: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(given.len(), expected.len(), "the numbers of values differ");
    let near = given.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance);
    assert!(near, "{given:?}\n{expected:?}");
}

/// Half the scaled squared distance to a target, the cost of `Bowl` and `Choice` in `export_gradient_solvers.py`.
struct Bowl {
    scale: &'static [f32],
    target: &'static [f32],
    /// Replaces one value of the gradient: its index and the new value.
    wrong: Option<(usize, f32)>,
    /// Whether the sum of the values of a step is constrained to at most a half.
    limited: bool,
}

const BOWL: Bowl = Bowl {
    scale: &[1.0, 0.4, 0.2, 0.7, 0.5, 0.1],
    target: &[1.0, -2.0, 0.5, 3.0, -1.5, 0.25],
    wrong: None,
    limited: false,
};

const CHOICE: Bowl = Bowl { scale: &[0.6, 0.2, 0.3, 0.1, 0.5, 0.4], target: &[0.9, 0.4, -0.2, 0.2, 0.3, 1.1], ..BOWL };

impl CostModel for Bowl {
    fn observe(&mut self, _: &Batch, _: &[usize]) -> Result<()> {
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let terms = |plan: &[f32]| -> f32 {
            plan.iter().zip(self.target).zip(self.scale).map(|((a, t), s)| 0.5 * s * (a - t).powi(2)).sum()
        };
        let plans = candidates.actions.chunks_exact(self.target.len());
        costs.iter_mut().zip(plans).for_each(|(cost, plan)| *cost = terms(plan));
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        self.limited.then_some(self)
    }
}

impl Constrained for Bowl {
    fn constraints(&self, horizon: usize) -> usize {
        horizon
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let steps = candidates.actions.chunks_exact(candidates.dim);
        values.iter_mut().zip(steps).for_each(|(value, step)| *value = step.iter().sum::<f32>() - 0.5);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        gradient.iter_mut().enumerate().for_each(|(i, g)| *g += weights[i / candidates.dim]);
        Ok(())
    }
}

impl DifferentiableCost for Bowl {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        let len = self.target.len();
        for (i, g) in gradient.iter_mut().enumerate() {
            *g = self.scale[i % len] * (candidates.actions[i] - self.target[i % len]);
        }
        if let Some((at, wrong)) = self.wrong {
            gradient[at] = wrong;
        }
        self.cost(candidates, costs)
    }
}

const FREE: PlanSpace<'static> = PlanSpace::Continuous { low: &[f32::NEG_INFINITY; 2], high: &[f32::INFINITY; 2] };

fn solve(solver: &mut dyn Solver, model: &mut dyn CostModel, keys: &[Key]) -> Result<Plan> {
    solver.solve(model, PlanProblem { horizon: 3, space: FREE, keys, init: None, deadline: None, observer: None })
}

#[test]
fn optimizers_equal_torch() {
    let golden = golden().optimizers;
    let table = [
        (Optimizer::Sgd(Sgd { step: 0.1, momentum: 0.9 }), golden.sgd),
        (Optimizer::Adam(Adam { step: 0.1, ..Adam::default() }), golden.adam),
        (Optimizer::RmsProp(RmsProp { step: 0.01, ..RmsProp::default() }), golden.rmsprop),
    ];
    for (optimizer, path) in table {
        let (mut x, mut memory) = ([1.0, -2.0, 0.5, 3.0], Memory::new(4));
        assert_eq!(path.len(), 5);
        for expected in path {
            let gradient: Vec<f32> = x.iter().zip([1.0, 4.0, 0.3, 0.05]).map(|(x, scale)| scale * x).collect();
            optimizer.step(&mut memory, &mut x, &gradient);
            assert_near(&x, &expected, 1e-6);
        }
    }
}

#[test]
fn gradient_descent_equals_the_reference() {
    let golden = golden().gd;
    let optimizer = Optimizer::Sgd(Sgd { step: 0.5, momentum: 0.9 });
    let mut gd =
        GradientDescent { samples: 1, iterations: 4, optimizer, clip: Some(1.0), ..GradientDescent::default() };
    let plan = solve(&mut gd, &mut { BOWL }, &[Key::new(0)]).expect("the solver returns a plan");
    assert_near(&plan.actions, &golden.actions, 1e-5);
    assert_near(&plan.trace[0].best[..4], &golden.costs, 1e-5);
    assert_eq!(plan.trace[0].best[4..], plan.costs, "the last entry of the trace is the cost of the plan");
}

#[test]
fn projected_gradient_descent_equals_the_reference() {
    let golden = golden().pgd;
    let mut pgd = Pgd { samples: 1, iterations: 4, ..Pgd::default() };
    let start = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0];
    let space = PlanSpace::Discrete { choices: &[3] };
    let problem =
        PlanProblem { horizon: 2, space, keys: &[Key::new(0)], init: Some(&start), deadline: None, observer: None };
    let plan = pgd.solve(&mut { CHOICE }, problem).expect("the solver returns a plan");
    assert_near(&plan.trace[0].best[..4], &golden.costs, 1e-6);
    let chosen: Vec<f32> =
        golden.choices.iter().flat_map(|&c| (0..3).map(move |i| f32::from(u8::from(i == c)))).collect();
    assert_eq!(plan.actions, chosen);
    let mut cost = [0.0];
    { CHOICE }
        .cost(Candidates { actions: &chosen, envs: 1, samples: 1, horizon: 2, dim: 3 }, &mut cost)
        .expect("the model computes a cost");
    assert_eq!(plan.costs, cost, "the plan's cost is the cost of the chosen options, not of their probabilities");
}

#[test]
fn augmented_lagrangian_equals_the_reference() {
    let golden = golden().lagrangian;
    let mut solver = AugmentedLagrangian {
        samples: 1,
        iterations: 3,
        outer_iterations: 3,
        penalty_limit: 3.0,
        ..AugmentedLagrangian::default()
    };
    let plan =
        solve(&mut solver, &mut Bowl { limited: true, ..BOWL }, &[Key::new(0)]).expect("the solver returns a plan");
    // Nine steps of Adam, which agree only if the multipliers and penalties agree.
    assert_near(&plan.actions, &golden.actions, 1e-5);
    let trace = &plan.trace[0];
    assert_eq!(trace.best.len(), 10);
    // The first steps violate no constraint, so their loss is their cost.
    assert!(trace.violation[0] < 0.0 && trace.violation[1] < 0.0);
    assert_near(&trace.best[..2], &golden.losses[..2], 1e-5);
}

#[test]
fn trace_records_the_violation_of_the_plan() {
    // No action within these bounds adds up to at most a half.
    let space = PlanSpace::Continuous { low: &[0.3, 0.4], high: &[9.0, 9.0] };
    let problem = PlanProblem { horizon: 3, space, keys: &[Key::new(0)], init: None, deadline: None, observer: None };
    let mut solver = AugmentedLagrangian { samples: 8, ..AugmentedLagrangian::default() };
    let plan = solver.solve(&mut Bowl { limited: true, ..BOWL }, problem).expect("the solver returns a plan");
    let violation = plan.trace[0].violation.last().expect("the trace has violations");
    assert!((violation - 0.2).abs() < 1e-2, "the smallest possible violation, not {violation}");
    // A feasible candidate is preferred to a cheaper infeasible one.
    let plan =
        solve(&mut solver, &mut Bowl { limited: true, ..BOWL }, &[Key::new(0)]).expect("the solver returns a plan");
    let steps = plan.actions.chunks_exact(2).map(|step| step.iter().sum::<f32>() - 0.5);
    let violation = steps.fold(f32::NEG_INFINITY, f32::max);
    assert_eq!(plan.trace[0].violation.last(), Some(&violation));
    assert!(violation <= solver.tolerance);
}

/// For each gradient solver: a toy, and settings of a short search with all kinds of noise.
const NOISY: &[(&str, &str, &str)] = &[
    ("gd", "quadratic", r#"{"samples": 5, "iterations": 4, "action_noise": 0.1, "clip": 1.0}"#),
    ("pgd", "discrete", r#"{"samples": 5, "iterations": 4, "action_noise": 0.1}"#),
    ("lagrangian", "constrained", r#"{"samples": 5, "iterations": 2, "outer_iterations": 2, "action_noise": 0.1}"#),
    ("grasp", "reach", r#"{"iterations": 6, "sync_every": 3, "sync_iterations": 2}"#),
];

#[test]
fn noisy_plans_do_not_depend_on_batches_or_threads() {
    for &(solver, name, settings) in NOISY {
        let toy = toy(name);
        let settings = serde_json::from_str(settings).expect("parsing the settings");
        let mut solver =
            (SOLVERS.get(solver).expect("a registered solver").make)(&settings).expect("creating the solver");
        let mut run = |threads: usize, size: usize| -> Vec<u32> {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("creating the thread pool");
            let all: Vec<usize> = (0..50).collect();
            let mut plan = |envs: &[usize]| {
                let plan = pool.install(|| crate::toys::solve(&mut *solver, &mut Model::new(toy, envs), toy, envs));
                let plan = plan.expect("the solver returns a plan");
                plan.actions.into_iter().chain(plan.costs).map(f32::to_bits).collect::<Vec<_>>()
            };
            // Actions and costs, environment by environment.
            let mut rows = vec![vec![]; 50];
            for envs in all.chunks(size) {
                let bits = plan(envs);
                let len = bits.len() / envs.len();
                for (i, &env) in envs.iter().enumerate() {
                    rows[env].extend(&bits[i * (len - 1)..(i + 1) * (len - 1)]);
                    rows[env].push(bits[envs.len() * (len - 1) + i]);
                }
            }
            rows.concat()
        };
        let alone = run(1, 1);
        for (threads, size) in [(2, 1), (1, 7), (2, 7), (1, 50), (2, 50)] {
            assert!(run(threads, size) == alone, "{name}: {size} environments on {threads} threads");
        }
    }
}

#[test]
fn noisy_searches_have_the_pinned_costs() {
    // Published results depend on these values: changing them is a breaking change. The values are rounded, because
    // `exp` and `ln` may differ in the last bit between platforms.
    for (&(solver, name, settings), expected) in NOISY.iter().zip(PINNED) {
        let toy = toy(name);
        let settings = serde_json::from_str(settings).expect("parsing the settings");
        let mut solver =
            (SOLVERS.get(solver).expect("a registered solver").make)(&settings).expect("creating the solver");
        let plan =
            crate::toys::solve(&mut *solver, &mut Model::new(toy, &[0]), toy, &[0]).expect("the solver returns a plan");
        let rounded: Vec<f32> = plan.trace[0].mean.iter().map(|cost| (cost * 1e3).round() / 1e3).collect();
        assert_eq!(rounded, *expected, "{name}");
    }
}

/// The mean cost of the candidates at every entry of the trace.
const PINNED: &[&[f32]] = &[
    &[9.009, 7.106, 5.52, 4.943, 4.004],
    &[-1.873, -3.722, -3.95, -3.993, -4.033],
    &[7.874, 7.119, 6.369, 6.35, 6.532],
    &[0.194, 0.159, 0.062, 0.044, 0.029],
];

#[test]
fn errors_locate_gradients_that_are_not_finite() {
    for wrong in [f32::NAN, f32::INFINITY] {
        // Value 3 of candidate 1 of environment 1, of two environments with two candidates each.
        let mut bowl = Bowl { wrong: Some((3 * 6 + 3, wrong)), ..BOWL };
        let mut gd = GradientDescent { samples: 2, ..GradientDescent::default() };
        let message =
            solve(&mut gd, &mut bowl, &[Key::new(0), Key::new(1)]).expect_err("the input is invalid").to_string();
        let location = format!("{wrong} at step 1 for candidate 1 of planned environment 1 in iteration 0");
        assert!(message.contains(&location), "{message}");
    }
}

#[test]
fn gradient_descent_requires_a_gradient() {
    let quadratic = toy("quadratic");
    let mut model = Model::new(quadratic, &[0]).opaque();
    let mut gd = GradientDescent::default();
    let message =
        crate::toys::solve(&mut gd, &mut model, quadratic, &[0]).expect_err("a model without gradient").to_string();
    assert!(message.starts_with("solver gd: it needs the gradient of the cost"), "{message}");
    assert!(message.contains("choose another solver"), "{message}");
}

#[test]
fn deadline_ends_the_search() {
    for &(id, name, _) in NOISY {
        let (toy, keys) = (toy(name), [Key::new(0)]);
        let problem = |deadline| PlanProblem {
            horizon: toy.horizon,
            space: toy.space,
            keys: &keys,
            init: None,
            deadline,
            observer: None,
        };
        let mut solver =
            (SOLVERS.get(id).expect("a registered solver").make)(&serde_json::json!({})).expect("creating the solver");
        let stopped =
            solver.solve(&mut Model::new(toy, &[0]), problem(Some(Instant::now()))).expect("the solver returns a plan");
        let complete = solver.solve(&mut Model::new(toy, &[0]), problem(None)).expect("the solver returns a plan");
        // The trace has entries for the start and one step. For GRASP, whose steps are not rolled out, it has only the
        // plan.
        assert_eq!(stopped.trace[0].best.len(), if id == "grasp" { 1 } else { 2 }, "{id}");
        assert_eq!(stopped.trace[0].best.last(), Some(&stopped.costs[0]), "{id}");
        assert!(stopped.costs[0].is_finite() && stopped.actions.len() == complete.actions.len(), "{id}");
        assert!(
            stopped.trace[0].best.len() < complete.trace[0].best.len(),
            "{id}: the search without a deadline is longer"
        );
    }
}

#[test]
fn errors_name_invalid_settings() {
    let message =
        |gd: GradientDescent| solve(&mut gd.clone(), &mut { BOWL }, &[]).expect_err("the input is invalid").to_string();
    let default = GradientDescent::default;
    assert!(message(GradientDescent { samples: 0, ..default() }).contains("gd samples: 0; choose 1 to"));
    assert!(message(GradientDescent { iterations: 0, ..default() }).contains("gd iterations"));
    assert!(message(GradientDescent { sigma: f32::NAN, ..default() }).contains("gd sigma: NaN"));
    assert!(message(GradientDescent { action_noise: -1.0, ..default() }).contains("gd action_noise: -1"));
    assert!(message(GradientDescent { clip: Some(0.0), ..default() }).contains("gd clip: 0"));

    // Invalid settings of PGD, the augmented Lagrangian method and GRASP.
    let message = |id: &str, settings: serde_json::Value| {
        let mut solver = match (SOLVERS.get(id).expect("a registered solver").make)(&settings) {
            Ok(solver) => solver,
            Err(error) => return error.to_string(),
        };
        solve(&mut *solver, &mut { BOWL }, &[]).expect_err("the input is invalid").to_string()
    };
    let table = [
        ("pgd", r#"{"step": 0}"#, "pgd optimizer, step: 0"),
        ("pgd", r#"{"momentum": 0.5}"#, "unknown field `momentum`"),
        ("lagrangian", r#"{"outer_iterations": 0}"#, "lagrangian outer_iterations: 0"),
        ("lagrangian", r#"{"outer_iterations": 100001}"#, "lagrangian outer_iterations: 100001; choose 1 to 100000"),
        ("grasp", r#"{"sync_iterations": 100001}"#, "grasp sync_iterations: 100001; choose 1 to 100000"),
        ("lagrangian", r#"{"penalty": -1}"#, "lagrangian penalty: -1"),
        (
            "lagrangian",
            r#"{"penalty": 2, "penalty_limit": 1}"#,
            "lagrangian penalty_limit: 1, below the first penalty 2",
        ),
        ("lagrangian", r#"{"penalty_growth": 0.5}"#, "lagrangian penalty_growth: 0.5"),
        ("lagrangian", r#"{"tolerance": -0.1}"#, "lagrangian tolerance: -0.1"),
        ("grasp", r#"{"sync_iterations": 0}"#, "grasp synchronisation: 0 steps every 50 iterations"),
        ("grasp", r#"{"goal_weight": {"from": -1, "to": 0}}"#, "grasp goal_weight: -1"),
        ("grasp", r#"{"state_optimizer": {"kind": "sgd", "momentum": 2}}"#, "grasp optimizer, momentum: 2"),
    ];
    for (id, settings, expected) in table {
        let message = message(id, serde_json::from_str(settings).expect("parsing the settings"));
        assert!(message.contains(expected), "{message}");
    }
}
