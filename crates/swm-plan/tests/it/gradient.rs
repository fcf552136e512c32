//! The solvers that follow gradients, beside what torch and the reference compute (`../golden/gradient_solvers.json`).

use crate::toys::{Model, toy};
use serde::Deserialize;
use std::time::Instant;
use swm_core::Solver;
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, Key, Plan, PlanProblem, PlanSpace, Result};
use swm_plan::GradientDescent;
use swm_plan::optimizer::{Adam, Memory, Optimizer, RmsProp, Sgd};

/// What `export_gradient_solvers.py` recorded.
#[derive(Deserialize)]
struct Golden {
    optimizers: Paths,
    gd: Descent,
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

fn golden() -> Golden {
    serde_json::from_str(include_str!("../golden/gradient_solvers.json")).expect("the recorded file")
}

#[track_caller]
fn assert_near(given: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(given.len(), expected.len(), "numbers");
    let near = given.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance);
    assert!(near, "{given:?}\n{expected:?}");
}

/// Half the scaled squared distance to a target, as `Bowl` and `Choice` of the exporter.
struct Bowl {
    scale: &'static [f32],
    target: &'static [f32],
    /// Writes this instead of one number of the gradient.
    wrong: Option<(usize, f32)>,
}

const BOWL: Bowl =
    Bowl { scale: &[1.0, 0.4, 0.2, 0.7, 0.5, 0.1], target: &[1.0, -2.0, 0.5, 3.0, -1.5, 0.25], wrong: None };

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
    solver.solve(model, PlanProblem { horizon: 3, space: FREE, keys, init: None, deadline: None })
}

#[test]
fn optimizers_take_the_steps_of_torch() {
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
fn gradient_descent_takes_the_steps_of_the_reference() {
    let golden = golden().gd;
    let optimizer = Optimizer::Sgd(Sgd { step: 0.5, momentum: 0.9 });
    let mut gd =
        GradientDescent { samples: 1, iterations: 4, optimizer, clip: Some(1.0), ..GradientDescent::default() };
    let plan = solve(&mut gd, &mut { BOWL }, &[Key::new(0)]).expect("a plan");
    assert_near(&plan.actions, &golden.actions, 1e-5);
    assert_near(&plan.trace[0].best[..4], &golden.costs, 1e-5);
    assert_eq!(plan.trace[0].best[4..], plan.costs, "the last entry is of the plan");
}

#[test]
fn gradients_that_are_not_finite_say_where() {
    for wrong in [f32::NAN, f32::INFINITY] {
        // Number 3 of candidate 1 of environment 1, of two with two candidates each.
        let mut bowl = Bowl { wrong: Some((3 * 6 + 3, wrong)), ..BOWL };
        let mut gd = GradientDescent { samples: 2, ..GradientDescent::default() };
        let message = solve(&mut gd, &mut bowl, &[Key::new(0), Key::new(1)]).expect_err("wrong").to_string();
        let place = format!("{wrong} at step 1 for candidate 1 of planned environment 1 in iteration 0");
        assert!(message.contains(&place), "{message}");
    }
}

#[test]
fn a_model_without_a_gradient_is_refused_and_others_are_named() {
    let quadratic = toy("quadratic");
    let mut model = Model::new(quadratic, &[0]).opaque();
    let mut gd = GradientDescent::default();
    let message = crate::toys::solve(&mut gd, &mut model, quadratic, &[0]).expect_err("no gradient").to_string();
    assert!(message.starts_with("solver gd: it needs the gradient of the cost"), "{message}");
    assert!(message.contains("choose cem"), "{message}");
}

#[test]
fn a_late_search_returns_what_it_has() {
    let mut gd = GradientDescent::default();
    let deadline = Some(Instant::now());
    let problem = PlanProblem { horizon: 3, space: FREE, keys: &[Key::new(0)], init: None, deadline };
    let plan = gd.solve(&mut { BOWL }, problem).expect("a plan");
    assert_eq!(plan.trace[0].best.len(), 2, "the start and one step");
    assert!(plan.costs[0] < plan.trace[0].best[0]);
}

#[test]
fn settings_that_make_no_sense_say_so() {
    let message = |gd: GradientDescent| solve(&mut gd.clone(), &mut { BOWL }, &[]).expect_err("wrong").to_string();
    let default = GradientDescent::default;
    assert!(message(GradientDescent { samples: 0, ..default() }).contains("gd samples: 0; ask for at least 1"));
    assert!(message(GradientDescent { iterations: 0, ..default() }).contains("gd iterations"));
    assert!(message(GradientDescent { sigma: f32::NAN, ..default() }).contains("gd sigma: NaN"));
    assert!(message(GradientDescent { action_noise: -1.0, ..default() }).contains("gd action_noise: -1"));
    assert!(message(GradientDescent { clip: Some(0.0), ..default() }).contains("gd clip: 0"));
}
