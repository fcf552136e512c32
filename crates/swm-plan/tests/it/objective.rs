//! Objectives and constraints: their values, their gradients, and the plans they lead to.

use crate::lqr::{self, Lqr};
use crate::toys::{Landscape as _, Model, draw, toy};
use rand::Rng as _;
use swm_core::{
    Batch, Candidates, Constrained, CostModel, DifferentiableCost, Key, LatentDynamics, Plan, PlanProblem, PlanSpace,
    Result, Schema, Solver,
};
use swm_plan::objective::{
    ActionNorm, Change, Constraint, Control, CustomConstraint, Goal, LatentBox, Objective, ObjectiveConfig,
    ObjectiveCost, Pick, Regularised, Shape, Slope, Trajectory, When,
};
use swm_plan::search::{Adam, Optimizer, Sgd};
use swm_plan::solvers::{AugmentedLagrangian, GradientDescent, Grasp, LinearSchedule};

/// Latent dynamics `z' = f(M z + B a)`, where the matrices M and B are lists of rows. The cost is the squared distance
/// to the goal after the last step.
struct System {
    mix: Vec<Vec<f32>>,
    push: Vec<Vec<f32>>,
    /// Whether f is the hyperbolic tangent; otherwise it is the identity.
    nonlinear: bool,
    /// Start and goal of an environment.
    start_and_goal: fn(env: usize) -> (Vec<f32>, Vec<f32>),
    envs: Vec<usize>,
}

/// A nonlinear system with 3 latent dimensions and 2 actions of dimension 2 in a model step.
fn nonlinear() -> System {
    let mut rng = Key::new(1).rng();
    let mut row = |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-0.9f32..0.9)).collect() };
    let (mix, push) = ((0..3).map(|_| row(3)).collect(), (0..3).map(|_| row(4)).collect());
    let start_and_goal = |env| {
        let values: Vec<f32> = draw(env, 6, 0.8).iter().map(|&v| v as f32).collect();
        (values[..3].to_vec(), values[3..].to_vec())
    };
    System { mix, push, nonlinear: true, start_and_goal, envs: vec![] }
}

impl System {
    fn dim(&self) -> usize {
        self.push[0].len()
    }

    /// Returns the argument of f, `M z + B a`.
    fn before(&self, z: &[f32], a: &[f32]) -> Vec<f32> {
        let dot = |row: &[f32], v: &[f32]| row.iter().zip(v).map(|(w, v)| w * v).sum::<f32>();
        self.mix.iter().zip(&self.push).map(|(mix, push)| dot(mix, z) + dot(push, a)).collect()
    }
}

impl CostModel for System {
    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.envs = envs.to_vec();
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        for (i, plan) in candidates.actions.chunks_exact(candidates.horizon * candidates.dim).enumerate() {
            let (mut z, goal) = (self.start_and_goal)(self.envs[i / candidates.samples]);
            for a in plan.chunks_exact(candidates.dim) {
                let mut next = vec![0.0; z.len()];
                self.predict(&z, a, &mut next)?;
                z = next;
            }
            costs[i] = z.iter().zip(goal).map(|(z, goal)| (z - goal).powi(2)).sum();
        }
        Ok(())
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        Some(self)
    }
}

impl LatentDynamics for System {
    fn latent_dim(&self) -> usize {
        self.mix.len()
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        let (starts, goals): (Vec<_>, Vec<_>) = self.envs.iter().map(|&env| (self.start_and_goal)(env)).unzip();
        start.copy_from_slice(&starts.concat());
        goal.copy_from_slice(&goals.concat());
        Ok(())
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        let latent = self.latent_dim();
        let pairs = latents.chunks_exact(latent).zip(actions.chunks_exact(self.dim()));
        for ((z, a), next) in pairs.zip(next.chunks_exact_mut(latent)) {
            let before = self.before(z, a);
            next.iter_mut().zip(before).for_each(|(next, b)| *next = if self.nonlinear { b.tanh() } else { b });
        }
        Ok(())
    }

    fn predict_vjp(
        &mut self,
        latents: &[f32],
        actions: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        let (latent, dim) = (self.latent_dim(), self.dim());
        latent_gradient.fill(0.0);
        action_gradient.fill(0.0);
        for (i, (z, a)) in latents.chunks_exact(latent).zip(actions.chunks_exact(dim)).enumerate() {
            for (row, before) in self.before(z, a).into_iter().enumerate() {
                let slope = if self.nonlinear { 1.0 - before.tanh().powi(2) } else { 1.0 };
                let gradient = next_gradient[i * latent + row] * slope;
                (0..latent).for_each(|j| latent_gradient[i * latent + j] += gradient * self.mix[row][j]);
                (0..dim).for_each(|j| action_gradient[i * dim + j] += gradient * self.push[row][j]);
            }
        }
        Ok(())
    }
}

/// Calls `observe` with the indices of environments and a batch without columns.
fn observe(model: &mut dyn CostModel, envs: &[usize]) {
    model
        .observe(&Batch::zeros(&Schema::new([]).expect("creating the schema"), 0), envs)
        .expect("the model reads no columns");
}

const HORIZON: usize = 4;
const ENVS: [usize; 2] = [0, 1];
const SAMPLES: usize = 3;

fn candidates(actions: &[f32], horizon: usize) -> Candidates<'_> {
    let dim = actions.len() / (ENVS.len() * SAMPLES * horizon);
    Candidates { actions, envs: ENVS.len(), samples: SAMPLES, horizon, dim }
}

fn random(n: usize) -> Vec<f32> {
    draw(77, n, 1.0).iter().map(|&v| v as f32).collect()
}

/// An objective with every kind of term.
fn all_terms() -> Vec<Box<dyn Objective>> {
    let running =
        Goal { weight: 0.7, when: When::Running, discount: 0.8, latents: vec![Pick::One(2), Pick::Range([0, 1])] };
    vec![
        Box::new(Goal::default()),
        Box::new(running),
        Box::new(Goal { weight: 0.4, when: When::Closest, ..Goal::default() }),
        Box::new(Control { weight: 0.1 }),
        Box::new(Change { weight: 0.3, block: 2 }),
    ]
}

/// Every kind of constraint: 8 norms, 4 latents with two bounds, and a custom one on actions and latents.
fn limits() -> Vec<Box<dyn Constraint>> {
    let product = CustomConstraint {
        count: 1,
        needs_latents: true,
        values: |trajectory: Trajectory<'_>, values: &mut [f32]| {
            values[0] = trajectory.actions.chunks_exact(trajectory.dim).map(|a| a[0] * a[1]).sum::<f32>()
                + trajectory.latents[4].powi(2);
        },
        gradient: |trajectory: Trajectory<'_>, weights: &[f32], slope: &mut Slope<'_>| {
            for t in 0..trajectory.actions.len() / trajectory.dim {
                let at = t * trajectory.dim;
                slope.actions[at] += weights[0] * trajectory.actions[at + 1];
                slope.actions[at + 1] += weights[0] * trajectory.actions[at];
            }
            slope.latents[4] += 2.0 * weights[0] * trajectory.latents[4];
        },
    };
    let bounds = LatentBox { latents: vec![Pick::One(1)], low: Some(-0.2), high: Some(0.3) };
    vec![Box::new(ActionNorm { limit: 0.8, block: 2 }), Box::new(bounds), Box::new(product)]
}

/// Checks a gradient against central differences of a sum over all candidates.
#[track_caller]
fn assert_gradient(actions: &[f32], gradient: &[f32], mut sum: impl FnMut(&[f32]) -> f64) {
    const STEP: f32 = 4e-3;
    for j in 0..actions.len() {
        let mut moved = actions.to_vec();
        moved[j] = actions[j] + STEP;
        let above = sum(&moved);
        moved[j] = actions[j] - STEP;
        let slope = (above - sum(&moved)) / (2.0 * f64::from(STEP));
        assert!((slope - f64::from(gradient[j])).abs() < 1e-3, "value {j}: slope {slope}, gradient {}", gradient[j]);
    }
}

fn total(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum()
}

#[test]
fn gradients_through_time_equal_finite_differences() {
    let mut model =
        ObjectiveCost::new(Box::new(nonlinear()), Box::new(all_terms()), limits()).expect("creating the model");
    observe(&mut model, &ENVS);
    let actions = random(ENVS.len() * SAMPLES * HORIZON * 4);
    let (mut costs, mut again) = ([f32::NAN; 6], [f32::NAN; 6]);
    let mut gradient = vec![f32::NAN; actions.len()];
    model.cost(candidates(&actions, HORIZON), &mut costs).expect("the model computes costs");
    model
        .cost_and_gradient(candidates(&actions, HORIZON), &mut again, &mut gradient)
        .expect("the model computes gradients");
    assert_eq!(costs, again);
    assert_gradient(&actions, &gradient, |moved| {
        model.cost(candidates(moved, HORIZON), &mut costs).expect("the model computes costs");
        total(&costs)
    });

    let count = Constrained::constraints(&model, HORIZON);
    assert_eq!(count, 2 * HORIZON + 2 * HORIZON + 1);
    let weights = random(6 * count);
    let mut values = vec![0.0; 6 * count];
    // Gradients of constraints are added to the existing values.
    let mut gradient = vec![0.5; actions.len()];
    model.constrain_vjp(candidates(&actions, HORIZON), &weights, &mut gradient).expect("the model computes gradients");
    gradient.iter_mut().for_each(|g| *g -= 0.5);
    assert_gradient(&actions, &gradient, |moved| {
        model.constrain(candidates(moved, HORIZON), &mut values).expect("the model computes constraints");
        values.iter().zip(&weights).map(|(value, weight)| f64::from(value * weight)).sum()
    });
}

#[test]
fn values_of_terms_and_constraints_follow_their_formulas() {
    // Two steps of a latent of dimension 2.
    let trajectory = Trajectory {
        latents: &[9.0, 9.0, 2.0, 1.0, 4.0, 0.0],
        goal: &[1.0, 3.0],
        actions: &[3.0, 4.0, 0.0, 1.0, 0.0, 1.0, 2.0, 1.0],
        dim: 4,
    };
    assert_eq!(Goal::default().cost(trajectory), 9.0 + 9.0);
    let running = Goal { weight: 2.0, when: When::Running, discount: 0.5, latents: vec![] };
    assert_eq!(running.cost(trajectory), 2.0 * ((1.0 + 4.0) + 0.5 * (9.0 + 9.0)));
    assert_eq!(Goal { latents: vec![Pick::One(1)], ..running }.cost(trajectory), 2.0 * (4.0 + 0.5 * 9.0));
    let closest = Goal { weight: 3.0, when: When::Closest, ..Goal::default() };
    assert_eq!(closest.cost(trajectory), 3.0 * (1.0 + 4.0), "the first step is closer");
    assert_eq!(Goal { latents: vec![Pick::One(0)], ..closest }.cost(trajectory), 3.0);
    assert_eq!(Control { weight: 0.5 }.cost(trajectory), 0.5 * (25.0 + 1.0 + 1.0 + 5.0));
    // Model steps (3 4 0 1), (0 1 2 1); as two actions each, (3 4), (0 1), (0 1), (2 1).
    assert_eq!(Change { weight: 1.0, block: 1 }.cost(trajectory), 9.0 + 9.0 + 4.0 + 0.0);
    assert_eq!(Change { weight: 1.0, block: 2 }.cost(trajectory), (9.0 + 9.0) + 0.0 + 4.0);
    let values = |constraint: &dyn Constraint| {
        let mut values = vec![f32::NAN; constraint.count(2, 2)];
        constraint.values(trajectory, &mut values);
        values
    };
    assert_eq!(values(&ActionNorm { limit: 2.0, block: 2 }), [3.0, -1.0, -1.0, 5f32.sqrt() - 2.0]);
    assert_eq!(values(&LatentBox { high: Some(1.5), ..LatentBox::default() }), [0.5, -0.5, 2.5, -1.5]);
    let one = LatentBox { latents: vec![Pick::Range([0, 1])], low: Some(3.0), high: Some(5.0) };
    assert_eq!(values(&one), [1.0, -3.0, -1.0, -1.0]);
    let control_cost = Control::default().cost(Trajectory { latents: &[], goal: &[], ..trajectory });
    assert_eq!(control_cost, 32.0, "terms on actions need no latents");
}

#[test]
fn terminal_goal_equals_the_cost_of_the_model() {
    let actions = random(ENVS.len() * SAMPLES * HORIZON * 4);
    let (mut own, mut priced) = ([0.0; 6], [1.0; 6]);
    let mut model = nonlinear();
    observe(&mut model, &ENVS);
    model.cost(candidates(&actions, HORIZON), &mut own).expect("the model computes costs");
    let mut model =
        ObjectiveCost::new(Box::new(nonlinear()), Box::new(Goal::default()), vec![]).expect("creating the model");
    observe(&mut model, &ENVS);
    model.cost(candidates(&actions, HORIZON), &mut priced).expect("the model computes costs");
    assert_eq!(own, priced);
    assert!(model.constrained().is_none());
    // The same candidates are predicted again after a new observation.
    observe(&mut model, &[4, 5]);
    model.cost(candidates(&actions, HORIZON), &mut priced).expect("the model computes costs");
    assert!(own.iter().zip(priced).all(|(own, other)| *own != other));
}

#[test]
fn regularised_model_adds_costs_gradients_and_constraints() {
    let quadratic = toy("quadratic");
    let actions = random(ENVS.len() * SAMPLES * 6);
    let config = r#"{
        "terms": [{"term": "control", "weight": 0.25}, {"term": "change", "weight": 0.5}],
        "constraints": [{"constraint": "action_norm", "limit": 0.5}]
    }"#;
    let config: ObjectiveConfig = serde_json::from_str(config).expect("parsing the objective");
    let mut own = [0.0; 6];
    Model::new(quadratic, &ENVS).cost(candidates(&actions, 3), &mut own).expect("the model computes costs");

    let mut model = config.apply(Box::new(Model::new(quadratic, &ENVS))).expect("creating the model");
    let (mut costs, mut gradient) = ([0.0; 6], vec![0.0; actions.len()]);
    model.cost(candidates(&actions, 3), &mut costs).expect("the model computes costs");
    for ((cost, own), a) in costs.iter().zip(own).zip(actions.chunks_exact(6)) {
        let change: f32 = (2..6).map(|j| (a[j] - a[j - 2]).powi(2)).sum();
        let expected = own + 0.25 * a.iter().map(|a| a * a).sum::<f32>() + 0.5 * change;
        assert!((cost - expected).abs() < 1e-5, "{cost} {expected}");
    }
    let differentiable = model.differentiable().expect("the toy has a gradient");
    differentiable
        .cost_and_gradient(candidates(&actions, 3), &mut costs, &mut gradient)
        .expect("the model computes gradients");
    assert_gradient(&actions, &gradient, |moved| {
        model.cost(candidates(moved, 3), &mut costs).expect("the model computes costs");
        total(&costs)
    });
    let limits = model.constrained().expect("a constraint");
    let (weights, mut values) = (random(18), vec![0.0; 18]);
    gradient.fill(0.0);
    limits.constrain_vjp(candidates(&actions, 3), &weights, &mut gradient).expect("the model computes gradients");
    assert_gradient(&actions, &gradient, |moved| {
        limits.constrain(candidates(moved, 3), &mut values).expect("the model computes constraints");
        values.iter().zip(&weights).map(|(value, weight)| f64::from(value * weight)).sum()
    });

    let mut opaque = config.apply(Box::new(Model::new(quadratic, &ENVS).opaque())).expect("creating the model");
    assert!(opaque.differentiable().is_none() && opaque.latent().is_none() && opaque.constrained().is_some());
    let mut with_latents = config.apply(Box::new(Model::new(toy("reach"), &ENVS))).expect("creating the model");
    assert!(with_latents.latent().is_some());
}

fn solve(solver: &mut dyn Solver, model: &mut dyn CostModel, horizon: usize, dim: usize, envs: &[usize]) -> Plan {
    try_solve(solver, model, horizon, dim, envs).expect("the solver returns a plan")
}

fn try_solve(
    solver: &mut dyn Solver,
    model: &mut dyn CostModel,
    horizon: usize,
    dim: usize,
    envs: &[usize],
) -> Result<Plan> {
    let keys: Vec<Key> = envs.iter().map(|&env| Key::new(3).at(env as u64)).collect();
    let (low, high) = (vec![f32::NEG_INFINITY; dim], vec![f32::INFINITY; dim]);
    let space = PlanSpace::Continuous { low: &low, high: &high };
    let problem = PlanProblem { horizon, space, keys: &keys, init: None, deadline: None, observer: None };
    solver.solve(model, problem)
}

#[test]
fn plans_satisfy_an_action_norm_constraint() {
    // The goal is farther away than three actions of norm 0.1 reach, so the best plan is a straight line of maximal
    // actions.
    const LIMIT: f32 = 0.1;
    let limit: Vec<Box<dyn Constraint>> = vec![Box::new(ActionNorm { limit: LIMIT, block: 1 })];
    let envs = [0, 1, 2];
    let model = Box::new(Model::new(toy("reach"), &envs));
    let mut model = Regularised::new(model, Box::new(Vec::<Control>::new()), limit).expect("creating the model");
    let mut solver = AugmentedLagrangian {
        samples: 4,
        outer_iterations: 25,
        iterations: 200,
        optimizer: Optimizer::Sgd(Sgd { step: 0.02, momentum: 0.0 }),
        penalty_limit: 8.0,
        ..AugmentedLagrangian::default()
    };
    let plan = solve(&mut solver, &mut model, 3, 2, &envs);
    for (env, actions) in envs.into_iter().zip(plan.actions.chunks_exact(6)) {
        let goal = draw(env, 2, 1.0);
        let norm = goal.iter().map(|g| g * g).sum::<f64>().sqrt();
        assert!(norm > 0.35, "environment {env}: the goal is too near");
        for (j, action) in actions.iter().enumerate() {
            let best = f64::from(LIMIT) * goal[j % 2] / norm;
            assert!((f64::from(*action) - best).abs() < 2e-3, "environment {env}: {actions:?}, goal {goal:?}");
        }
        assert!(plan.trace[env].violation.last().is_some_and(|&violation| violation <= solver.tolerance));
    }
}

/// The cart of [`lqr`] with its cost as an objective. The cost of the initial state is omitted, because it is constant.
fn cart() -> ObjectiveCost {
    let narrow = |row: &[f64; 2]| row.map(|v| v as f32).to_vec();
    let start_and_goal = |env| (draw(env, 2, 1.5).iter().map(|&v| v as f32).collect(), vec![0.0; 2]);
    let (mix, push) = (lqr::A.iter().map(narrow).collect(), lqr::B.iter().map(|&b| vec![b as f32]).collect());
    let system = System { mix, push, nonlinear: false, start_and_goal, envs: vec![] };
    let mut terms: Vec<Box<dyn Objective>> = vec![Box::new(Control { weight: lqr::R as f32 })];
    for i in 0..2 {
        let (each, last) = (lqr::Q[i][i] as f32, lqr::LAST[i][i] as f32);
        let latents = vec![Pick::One(i)];
        terms.push(Box::new(Goal { weight: each, when: When::Running, latents: latents.clone(), ..Goal::default() }));
        terms.push(Box::new(Goal { weight: last - each, latents, ..Goal::default() }));
    }
    ObjectiveCost::new(Box::new(system), Box::new(terms), vec![]).expect("creating the model")
}

#[test]
fn gradient_solvers_find_the_plan_of_the_linear_quadratic_regulator() {
    let envs = [0, 1, 2];
    let gd = GradientDescent { samples: 4, iterations: 400, ..GradientDescent::default() };
    // The lifted loss of GRASP is not the regulator's cost, so only the synchronisation finds the plan.
    let sync_optimizer = Optimizer::Adam(Adam { step: 0.05, ..Adam::default() });
    let grasp = Grasp { iterations: 50, sync_iterations: 600, sync_optimizer, ..Grasp::default() };
    let solvers: [Box<dyn Solver>; 2] = [Box::new(gd), Box::new(grasp)];
    for (i, mut solver) in solvers.into_iter().enumerate() {
        let mut model = cart();
        observe(&mut model, &envs);
        let plan = solve(&mut *solver, &mut model, Lqr::HORIZON, 1, &envs);
        for (env, actions) in envs.into_iter().zip(plan.actions.chunks_exact(Lqr::HORIZON)) {
            for (action, best) in actions.iter().zip(Lqr::new(env).optimum()) {
                assert!((f64::from(*action) - best).abs() < 2e-3, "solver {i}, environment {env}: {actions:?}");
            }
        }
    }
}

/// An unstable linear system in the plane, which turns and grows by the factor `growth` in a step.
fn unstable(growth: f32) -> ObjectiveCost {
    let start_and_goal = |env| {
        let values: Vec<f32> = draw(env, 4, 1.0).iter().map(|&v| v as f32).collect();
        (values[..2].to_vec(), values[2..].to_vec())
    };
    let mix = vec![vec![growth, 0.2], vec![-0.2, growth]];
    let push = vec![vec![1.0, 0.0], vec![0.0, 1.0]];
    let system = System { mix, push, nonlinear: false, start_and_goal, envs: vec![] };
    ObjectiveCost::new(Box::new(system), Box::new(Goal::default()), vec![]).expect("creating the model")
}

#[test]
fn grasp_finds_the_optimum_with_one_step_size_for_several_horizons() {
    // The curvature of a rollout's cost grows with the horizon; the curvature of the lifted problem does not. The test
    // uses plain gradient steps, because Adam rescales every value and hides the difference.
    let plain = |step| Optimizer::Sgd(Sgd { step, momentum: 0.0 });
    let zero = LinearSchedule { from: 0.0, to: 0.0 };
    let mut grasp = Grasp {
        iterations: 100,
        action_optimizer: plain(0.2),
        state_optimizer: plain(0.2),
        goal_weight: zero,
        state_noise: zero,
        sync_every: 0,
        ..Grasp::default()
    };
    let envs = [0, 1, 2];
    let worst = |solver: &mut dyn Solver, growth: f32, horizon: usize| -> Result<f32> {
        let mut model = unstable(growth);
        observe(&mut model, &envs);
        let plan = try_solve(solver, &mut model, horizon, 2, &envs)?;
        Ok(plan.costs.into_iter().fold(0.0, f32::max))
    };
    for (growth, horizon) in [(1.1, 20), (1.1, 40), (1.3, 20)] {
        let cost = worst(&mut grasp, growth, horizon).expect("the solver returns a plan");
        assert!(cost < 1e-6, "growth {growth}, horizon {horizon}: {cost}");
    }
    let gd =
        |step| GradientDescent { samples: 1, iterations: 100, optimizer: plain(step), ..GradientDescent::default() };
    assert!(
        worst(&mut gd(1e-3), 1.1, 20).expect("the solver returns a plan") < 1e-6,
        "a suitable step size for horizon 20"
    );
    let message = worst(&mut gd(1e-3), 1.1, 40).expect_err("too large a step size for horizon 40").to_string();
    assert!(message.contains("not finite"), "{message}");
    assert!(
        worst(&mut gd(1e-5), 1.1, 40).expect("the solver returns a plan") < 1e-6,
        "a suitable step size for horizon 40"
    );
    assert!(
        worst(&mut gd(1e-5), 1.1, 20).expect("the solver returns a plan") > 1.0,
        "too small a step size for horizon 20"
    );
}

#[test]
fn errors_name_invalid_objectives_and_unsuitable_models() {
    let shape = Shape { horizon: 2, latent: 3, dim: 4 };
    let message = |objective: &dyn Objective| objective.check(shape).expect_err("the input is invalid").to_string();
    let goal = Goal::default;
    let past = message(&Goal { latents: vec![Pick::Range([2, 4])], ..goal() });
    assert_eq!(past, "goal term latents = 2..4 is outside its space: expected latent dimensions within 0..3");
    assert!(message(&Goal { latents: vec![Pick::One(1), Pick::Range([0, 2])], ..goal() }).contains("1 is named twice"));
    assert!(message(&Goal { discount: 0.9, ..goal() }).contains("0.9 of a term of one step"));
    assert!(message(&Goal { weight: f32::NAN, ..goal() }).contains("goal term weight: NaN"));
    assert!(message(&Control { weight: -1.0 }).contains("control term weight: -1"));
    assert!(message(&Change { weight: 1.0, block: 3 }).contains("3 actions in a model step of dimension 4"));
    let message = |constraint: &dyn Constraint| constraint.check(shape).expect_err("the input is invalid").to_string();
    assert!(message(&ActionNorm { limit: -1.0, block: 1 }).contains("action norm limit: -1"));
    assert!(message(&LatentBox::default()).contains("give a finite lower bound"));
    assert!(
        message(&LatentBox { low: Some(1.0), high: Some(0.0), ..LatentBox::default() })
            .contains("lower bound 1, upper bound 0")
    );
    let error = Goal::default().check(Shape { latent: 0, ..shape }).expect_err("a model without latents").to_string();
    assert!(error.contains("this model has none"), "{error}");

    let read = |json: &str| serde_json::from_str::<ObjectiveConfig>(json);
    assert!(read(r#"{"terms": [{"term": "goal", "wieght": 1}]}"#).expect_err("a typo").to_string().contains("wieght"));
    assert!(read(r#"{"terms": [{"term": "joy"}]}"#).expect_err("an unknown term").to_string().contains("joy"));
    let model = |name| Box::new(Model::new(toy(name), &ENVS));
    let reject = |json: &str, name| {
        read(json).expect("parsing the objective").apply(model(name)).err().expect("the input is invalid").to_string()
    };
    let message = reject(r#"{"terms": [{"term": "goal"}]}"#, "quadratic");
    assert!(message.contains("it uses latents, and this model has none"), "{message}");
    let message = reject(r#"{"constraints": [{"constraint": "latent_box", "low": 0}]}"#, "reach");
    assert!(message.contains("name a goal term too"), "{message}");
    let message = reject(r#"{"terms": [{"term": "control"}]}"#, "constrained");
    assert!(message.contains("the model has constraints of its own"), "{message}");
    assert!(ObjectiveConfig::default().is_empty());
    assert!(ObjectiveConfig::default().apply(model("constrained")).is_ok(), "an empty objective fits");

    let mut cost = ObjectiveCost::new(Box::new(nonlinear()), Box::new(goal()), vec![]).expect("creating the model");
    let actions = random(ENVS.len() * SAMPLES * HORIZON * 4);
    let message = cost.cost(candidates(&actions, HORIZON), &mut [0.0; 6]).expect_err("nothing is observed").to_string();
    assert!(message.contains("got 2, expected 0, the number of observed environments"), "{message}");
}
