//! Costs whose optimum is known in closed form or by trying everything, as models any solver can be asked to plan with.
//!
//! Each environment of a toy has its own optimum, drawn from its number, so that a plan which looked at a neighbour is
//! a wrong plan. Arithmetic is in double precision: what a test finds is the solver's error, not the toy's.

use crate::lqr::Lqr;
use rand::Rng as _;
use swm_core::{
    Batch, Candidates, Constrained, CostModel, DifferentiableCost, Key, LatentDynamics, Plan, PlanProblem, PlanSpace,
    Result, Solver,
};

/// A problem whose best plan is known.
pub struct Toy {
    pub name: &'static str,
    pub horizon: usize,
    pub space: PlanSpace<'static>,
    /// Whether it shows a latent state whose squared distance to the goal after the last step is the cost.
    pub latent: bool,
    /// Whether it has constraints.
    pub constrained: bool,
    /// What environment number `env` costs.
    pub landscape: fn(env: usize) -> Box<dyn Landscape>,
}

/// What the plan of one environment costs. Slices hold a whole plan, `[horizon, dim]`.
pub trait Landscape: Send {
    fn cost(&self, plan: &[f64]) -> f64;

    fn gradient(&self, plan: &[f64]) -> Vec<f64>;

    /// The best plan: the only one, or one of several where [`Landscape::is_unique`] says so.
    fn optimum(&self) -> Vec<f64>;

    fn is_unique(&self) -> bool {
        true
    }

    /// The values of the constraints; at most 0 where they hold.
    fn constraints(&self, _plan: &[f64]) -> Vec<f64> {
        vec![]
    }

    /// The gradient of the sum of the constraints, each times its weight.
    fn constraint_gradient(&self, plan: &[f64], _weights: &[f64]) -> Vec<f64> {
        vec![0.0; plan.len()]
    }

    /// The system behind the cost, if it shows one.
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
    // Targets lie in a box twice as wide as what is allowed: half of all numbers are best on a bound.
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
    // The goal is farther than the actions reach: the only best plan goes there at full speed.
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

/// The toy of a name.
pub fn toy(name: &str) -> &'static Toy {
    TOYS.iter().find(|toy| toy.name == name).expect("a toy of this name")
}

/// `n` numbers between -`scale` and `scale` that belong to an environment.
pub fn draw(env: usize, n: usize, scale: f64) -> Vec<f64> {
    let mut rng = Key::new(env as u64).with("toy").rng();
    (0..n).map(|_| rng.random_range(-scale..scale)).collect()
}

/// A bowl: `Σ (1 + j / 2) (a_j - target_j)²`, with every number of a plan between -bound and bound.
struct Bowl {
    target: Vec<f64>,
    bound: f64,
}

impl Bowl {
    /// The terms' weights and distances.
    fn terms<'a>(&'a self, plan: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        plan.iter().zip(&self.target).enumerate().map(|(j, (a, t))| (1.0 + j as f64 / 2.0, a - t))
    }
}

impl Landscape for Bowl {
    fn cost(&self, plan: &[f64]) -> f64 {
        self.terms(plan).map(|(weight, distance)| weight * distance.powi(2)).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        self.terms(plan).map(|(weight, distance)| 2.0 * weight * distance).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        self.target.iter().map(|t| t.clamp(-self.bound, self.bound)).collect()
    }
}

/// A double well in every number, `(a² - 1)² + tilt a`: 2ⁿ minima, the deepest where all signs are opposite to the tilts.
struct Wells {
    tilt: Vec<f64>,
}

impl Landscape for Wells {
    fn cost(&self, plan: &[f64]) -> f64 {
        plan.iter().zip(&self.tilt).map(|(a, tilt)| (a * a - 1.0).powi(2) + tilt * a).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        plan.iter().zip(&self.tilt).map(|(a, tilt)| 4.0 * a * (a * a - 1.0) + tilt).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        // Newton's method on the derivative, from the bottom of the untilted well.
        let bottom = |tilt: f64| {
            (0..20).fold(-tilt.signum(), |a, _| a - (4.0 * a * (a * a - 1.0) + tilt) / (12.0 * a * a - 4.0))
        };
        self.tilt.iter().map(|&tilt| bottom(tilt)).collect()
    }
}

/// The point of the unit ball that is nearest to a target outside: it lies on the sphere. A second constraint, that the
/// first number is at most 3, never binds.
struct Ball {
    target: Vec<f64>,
}

impl Landscape for Ball {
    fn cost(&self, plan: &[f64]) -> f64 {
        plan.iter().zip(&self.target).map(|(a, t)| (a - t).powi(2)).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        plan.iter().zip(&self.target).map(|(a, t)| 2.0 * (a - t)).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        let norm = self.target.iter().map(|t| t * t).sum::<f64>().sqrt();
        self.target.iter().map(|t| t / norm).collect()
    }

    fn constraints(&self, plan: &[f64]) -> Vec<f64> {
        vec![plan.iter().map(|a| a * a).sum::<f64>() - 1.0, plan[0] - 3.0]
    }

    fn constraint_gradient(&self, plan: &[f64], weights: &[f64]) -> Vec<f64> {
        let mut gradient: Vec<f64> = plan.iter().map(|a| 2.0 * weights[0] * a).collect();
        gradient[0] += weights[1];
        gradient
    }
}

/// Two choices a step, each with a price, and a price for every pair of neighbouring steps: what is best now depends
/// on what follows.
struct Chain {
    /// `[horizon, dim]`.
    price: Vec<f64>,
    /// `[horizon - 1, dim, dim]`.
    pair: Vec<f64>,
}

impl Chain {
    const CHOICES: &[usize] = &[3, 2];
    const DIM: usize = 5;

    fn new(env: usize) -> Self {
        let numbers = draw(env, 3 * Self::DIM + 2 * Self::DIM * Self::DIM, 1.0);
        let (price, pair) = numbers.split_at(3 * Self::DIM);
        Self { price: price.to_vec(), pair: pair.iter().map(|pair| 0.3 * pair).collect() }
    }

    fn pairs(&self) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        let dim = Self::DIM;
        self.pair.iter().enumerate().map(move |(i, &price)| {
            let (step, from, to) = (i / (dim * dim), i / dim % dim, i % dim);
            (step * dim + from, (step + 1) * dim + to, price)
        })
    }
}

impl Landscape for Chain {
    fn cost(&self, plan: &[f64]) -> f64 {
        let single: f64 = plan.iter().zip(&self.price).map(|(y, price)| y * price).sum();
        single + self.pairs().map(|(from, to, price)| plan[from] * plan[to] * price).sum::<f64>()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        let mut gradient = self.price.clone();
        for (from, to, price) in self.pairs() {
            gradient[from] += plan[to] * price;
            gradient[to] += plan[from] * price;
        }
        gradient
    }

    fn optimum(&self) -> Vec<f64> {
        // All 6³ sequences.
        let plans = (0..216usize).map(|mut code| {
            let mut plan = vec![0.0; 3 * Self::DIM];
            for step in plan.chunks_exact_mut(Self::DIM) {
                step[code % 3] = 1.0;
                step[3 + code / 3 % 2] = 1.0;
                code /= 6;
            }
            plan
        });
        plans.min_by(|a, b| self.cost(a).total_cmp(&self.cost(b))).expect("some plan")
    }
}

/// A point that moves by its action: `s' = s + a`, and the squared distance to a goal after the last step is the cost.
pub struct Reach {
    pub start: Vec<f64>,
    pub goal: Vec<f64>,
    bound: f64,
}

impl Reach {
    /// From the goal to where the plan ends.
    fn miss(&self, plan: &[f64]) -> Vec<f64> {
        let dim = self.goal.len();
        (0..dim).map(|j| self.start[j] + plan.iter().skip(j).step_by(dim).sum::<f64>() - self.goal[j]).collect()
    }
}

impl Landscape for Reach {
    fn cost(&self, plan: &[f64]) -> f64 {
        self.miss(plan).iter().map(|miss| miss * miss).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        let miss = self.miss(plan);
        (0..plan.len()).map(|j| 2.0 * miss[j % miss.len()]).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        let step = |j: usize| ((self.goal[j] - self.start[j]) / 3.0).clamp(-self.bound, self.bound);
        (0..6).map(|j| step(j % 2)).collect()
    }

    fn is_unique(&self) -> bool {
        // Within reach there are many ways to get there.
        self.cost(&self.optimum()) > 1e-12
    }

    fn system(&self) -> Option<&Reach> {
        Some(self)
    }
}

/// A toy as a model.
pub struct Model {
    toy: &'static Toy,
    landscapes: Vec<Box<dyn Landscape>>,
    /// Whether it shows its gradient; its latent state too, where it has one.
    gradient: bool,
    /// Answers this instead of the cost of one candidate, `(env, sample)`; `None` leaves the cost unwritten.
    wrong: Option<(usize, usize, Option<f32>)>,
}

impl Model {
    /// A toy that has observed these environments.
    pub fn new(toy: &'static Toy, envs: &[usize]) -> Self {
        let landscapes = envs.iter().map(|&env| (toy.landscape)(env)).collect();
        Self { toy, landscapes, gradient: true, wrong: None }
    }

    /// The same with nothing but a cost.
    pub fn opaque(self) -> Self {
        Self { gradient: false, ..self }
    }

    /// The same with a wrong cost for one candidate; `None` leaves it unwritten.
    pub fn with_wrong_cost(self, env: usize, sample: usize, cost: Option<f32>) -> Self {
        Self { wrong: Some((env, sample, cost)), ..self }
    }

    fn landscape(&self, position: usize) -> &dyn Landscape {
        &*self.landscapes[position]
    }

    /// Candidates with the landscape of their environments.
    fn each<'a>(&'a self, candidates: Candidates<'a>) -> impl Iterator<Item = (&'a dyn Landscape, Vec<f64>)> {
        assert_eq!(candidates.envs, self.landscapes.len(), "environments");
        assert_eq!((candidates.horizon, candidates.dim), (self.toy.horizon, self.toy.space.dim()), "shape");
        let plans = candidates.actions.chunks_exact(candidates.horizon * candidates.dim);
        plans.enumerate().map(move |(i, plan)| (self.landscape(i / candidates.samples), wide(plan)))
    }

    fn systems(&self) -> Vec<&Reach> {
        self.landscapes.iter().map(|landscape| landscape.system().expect("a latent toy")).collect()
    }
}

/// Solves a toy for these environments with a solver, each environment with its own key.
pub fn solve(solver: &mut dyn Solver, model: &mut dyn CostModel, toy: &Toy, envs: &[usize]) -> Result<Plan> {
    let keys: Vec<Key> = envs.iter().map(|&env| Key::new(5).with("plan").at(env as u64)).collect();
    let problem = PlanProblem { horizon: toy.horizon, space: toy.space, keys: &keys, init: None, deadline: None };
    solver.solve(model, problem)
}

fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().map(|&number| f64::from(number)).collect()
}

impl CostModel for Model {
    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.landscapes = envs.iter().map(|&env| (self.toy.landscape)(env)).collect();
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        assert_eq!(costs.len(), candidates.envs * candidates.samples, "costs");
        for (i, (landscape, plan)) in self.each(candidates).enumerate() {
            let wrong = self.wrong.filter(|&(env, sample, _)| i == env * candidates.samples + sample);
            match wrong {
                None => costs[i] = landscape.cost(&plan) as f32,
                Some((_, _, Some(cost))) => costs[i] = cost,
                Some((_, _, None)) => {}
            }
        }
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        self.gradient.then_some(self)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        (self.gradient && self.toy.latent).then_some(self)
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        self.toy.constrained.then_some(self)
    }
}

impl DifferentiableCost for Model {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.cost(candidates, costs)?;
        let gradients = self.each(candidates).flat_map(|(landscape, plan)| landscape.gradient(&plan));
        gradient.iter_mut().zip(gradients).for_each(|(to, from)| *to = from as f32);
        Ok(())
    }
}

impl Constrained for Model {
    fn constraints(&self, _horizon: usize) -> usize {
        let plan = vec![0.0; self.toy.horizon * self.toy.space.dim()];
        self.landscapes.first().map_or(0, |landscape| landscape.constraints(&plan).len())
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let constraints = self.each(candidates).flat_map(|(landscape, plan)| landscape.constraints(&plan));
        values.iter_mut().zip(constraints).for_each(|(to, from)| *to = from as f32);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        let weights = weights.chunks_exact(Constrained::constraints(self, self.toy.horizon));
        let plans = self.each(candidates).zip(weights);
        let gradients =
            plans.flat_map(|((landscape, plan), weights)| landscape.constraint_gradient(&plan, &wide(weights)));
        gradient.iter_mut().zip(gradients).for_each(|(to, from)| *to += from as f32);
        Ok(())
    }
}

impl LatentDynamics for Model {
    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        for (i, system) in self.systems().into_iter().enumerate() {
            for j in 0..2 {
                start[i * 2 + j] = system.start[j] as f32;
                goal[i * 2 + j] = system.goal[j] as f32;
            }
        }
        Ok(())
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        next.iter_mut().zip(latents.iter().zip(actions)).for_each(|(next, (latent, action))| *next = latent + action);
        Ok(())
    }

    fn predict_vjp(
        &mut self,
        _: &[f32],
        _: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        latent_gradient.copy_from_slice(next_gradient);
        action_gradient.copy_from_slice(next_gradient);
        Ok(())
    }
}

#[test]
fn no_other_plan_is_better_than_the_optimum_and_gradients_are_slopes() {
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
                        let chosen = (0..options).max_by(|&i, &j| choice[i].total_cmp(&choice[j])).expect("options");
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
