//! Planning problems whose optimum is known in closed form or by exhaustive search, as models for any solver.
//!
//! Each environment of a toy has its own optimum, keyed by its index, so that using another environment's data gives a
//! wrong plan. Arithmetic is in double precision, so errors are due to the solver.

mod landscapes;
mod model;

pub use model::Model;

use crate::lqr::Lqr;
use landscapes::{Ball, Bowl, Chain, Reach, Wells};
use rand::Rng as _;
use swm_core::{CostModel, Key, Plan, PlanProblem, PlanSpace, Result, Solver};

/// A planning problem with a known optimum.
pub struct Toy {
    pub name: &'static str,
    pub horizon: usize,
    pub space: PlanSpace<'static>,
    /// Whether the toy has latent dynamics; the cost is then the squared distance of the last latent to the goal.
    pub latent: bool,
    /// Whether the toy has constraints.
    pub constrained: bool,
    /// The cost function of an environment.
    pub landscape: fn(env: usize) -> Box<dyn Landscape>,
}

/// The cost function of one environment. Slices hold a whole plan, `[horizon, dim]`.
pub trait Landscape: Send {
    fn cost(&self, plan: &[f64]) -> f64;

    fn gradient(&self, plan: &[f64]) -> Vec<f64>;

    /// The best plan; one of several if [`Landscape::is_unique`] is false.
    fn optimum(&self) -> Vec<f64>;

    fn is_unique(&self) -> bool {
        true
    }

    /// The values of the constraints; a constraint holds if its value is at most 0.
    fn constraints(&self, _plan: &[f64]) -> Vec<f64> {
        vec![]
    }

    /// The gradient of the weighted sum of the constraints.
    fn constraint_gradient(&self, plan: &[f64], _weights: &[f64]) -> Vec<f64> {
        vec![0.0; plan.len()]
    }

    /// The latent dynamics behind the cost, if there are any.
    fn system(&self) -> Option<&Reach> {
        None
    }
}

/// Every toy.
pub const TOYS: &[Toy] = &[
    Toy {
        name: "quadratic",
        horizon: 3,
        space: PlanSpace::Continuous { low: &[f32::NEG_INFINITY; 2], high: &[f32::INFINITY; 2] },
        latent: false,
        constrained: false,
        landscape: |env| Box::new(Bowl { target: draw(env, 6, 1.0), bound: f64::INFINITY }),
    },
    // Targets lie in a box twice as wide as the bounds: for half of the values, the optimum is on a bound.
    Toy {
        name: "bounded",
        horizon: 3,
        space: PlanSpace::Continuous { low: &[-1.0; 2], high: &[1.0; 2] },
        latent: false,
        constrained: false,
        landscape: |env| Box::new(Bowl { target: draw(env, 6, 2.0), bound: 1.0 }),
    },
    Toy {
        name: "multi-modal",
        horizon: 2,
        space: PlanSpace::Continuous { low: &[-2.0; 2], high: &[2.0; 2] },
        latent: false,
        constrained: false,
        landscape: |env| Box::new(Wells { tilt: draw(env, 4, 1.0).iter().map(|tilt| 0.4 * tilt.signum()).collect() }),
    },
    Toy {
        name: "constrained",
        horizon: 2,
        space: PlanSpace::Continuous { low: &[-2.0; 2], high: &[2.0; 2] },
        latent: false,
        constrained: true,
        landscape: |env| Box::new(Ball { target: draw(env, 4, 1.0).iter().map(|t| t + t.signum()).collect() }),
    },
    Toy {
        name: "discrete",
        horizon: 3,
        space: PlanSpace::Discrete { choices: Chain::CHOICES },
        latent: false,
        constrained: false,
        landscape: |env| Box::new(Chain::new(env)),
    },
    Toy {
        name: "lqr",
        horizon: Lqr::HORIZON,
        space: PlanSpace::Continuous { low: &[f32::NEG_INFINITY; 1], high: &[f32::INFINITY; 1] },
        latent: false,
        constrained: false,
        landscape: |env| Box::new(Lqr::new(env)),
    },
    Toy {
        name: "reach",
        horizon: 3,
        space: PlanSpace::Continuous { low: &[-2.0; 2], high: &[2.0; 2] },
        latent: true,
        constrained: false,
        landscape: |env| Box::new(Reach { start: vec![0.0; 2], goal: draw(env, 2, 1.0), bound: 2.0 }),
    },
    // The goal is out of reach, so the only optimum is the largest action towards it.
    Toy {
        name: "reach-bounded",
        horizon: 3,
        space: PlanSpace::Continuous { low: &[-0.5; 2], high: &[0.5; 2] },
        latent: true,
        constrained: false,
        landscape: |env| {
            let goal = draw(env, 2, 1.0).iter().map(|goal| 2.5 * goal.signum() + goal / 4.0).collect();
            Box::new(Reach { start: vec![0.0; 2], goal, bound: 0.5 })
        },
    },
];

/// Finds a toy by name.
pub fn toy(name: &str) -> &'static Toy {
    TOYS.iter().find(|toy| toy.name == name).expect("a toy of this name")
}

/// `n` random values between -`scale` and `scale`, keyed by the environment.
pub fn draw(env: usize, n: usize, scale: f64) -> Vec<f64> {
    let mut rng = Key::new(env as u64).with("toy").rng();
    (0..n).map(|_| rng.random_range(-scale..scale)).collect()
}

/// Solves a toy for several environments, each with its own key.
pub fn solve(solver: &mut dyn Solver, model: &mut dyn CostModel, toy: &Toy, envs: &[usize]) -> Result<Plan> {
    let keys: Vec<Key> = envs.iter().map(|&env| Key::new(5).with("plan").at(env as u64)).collect();
    let problem =
        PlanProblem { horizon: toy.horizon, space: toy.space, keys: &keys, init: None, deadline: None, observer: None };
    solver.solve(model, problem)
}

#[test]
fn optima_are_optimal_and_gradients_equal_finite_differences() {
    for (toy, env) in TOYS.iter().flat_map(|toy| (0..3).map(move |env| (toy, env))) {
        let landscape = (toy.landscape)(env);
        let best = landscape.optimum();
        let feasible = |plan: &[f64]| landscape.constraints(plan).iter().all(|&value| value <= 1e-9);
        assert!(feasible(&best), "{}", toy.name);
        for other in 0..200 {
            let mut plan = draw(1000 + other, best.len(), 2.0);
            match toy.space {
                PlanSpace::Continuous { low, high } => {
                    for (j, a) in plan.iter_mut().enumerate() {
                        let j = j % low.len();
                        *a = a.clamp(f64::from(low[j]), f64::from(high[j]));
                    }
                }
                PlanSpace::Discrete { choices } => {
                    let mut rest = &mut plan[..];
                    for &options in choices.iter().cycle() {
                        let Some((choice, tail)) = rest.split_at_mut_checked(options) else { break };
                        let chosen = (0..options)
                            .max_by(|&i, &j| choice[i].total_cmp(&choice[j]))
                            .expect("a choice has options");
                        (0..options).for_each(|i| choice[i] = f64::from(u8::from(i == chosen)));
                        rest = tail;
                    }
                }
            }
            if feasible(&plan) && plan != best {
                assert!(landscape.cost(&plan) > landscape.cost(&best), "{} {env}: {plan:?}", toy.name);
            }
            let weights = [0.7, -1.3];
            let sum =
                |plan: &[f64]| -> f64 { landscape.constraints(plan).iter().zip(weights).map(|(v, w)| v * w).sum() };
            for j in 0..plan.len() {
                let slope = |f: &dyn Fn(&[f64]) -> f64| {
                    let mut moved = plan.clone();
                    moved[j] += 1e-6;
                    let above = f(&moved);
                    moved[j] -= 2e-6;
                    (above - f(&moved)) / 2e-6
                };
                let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-4, "{} {env}: {a} {b}", toy.name);
                near(slope(&|plan| landscape.cost(plan)), landscape.gradient(&plan)[j]);
                near(slope(&sum), landscape.constraint_gradient(&plan, &weights)[j]);
            }
        }
    }
}
