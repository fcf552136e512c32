//! [`Grasp`]: states and actions optimised together, every model step by itself.
//!
//! Psenka, Rabbat, Krishnapriyan, `LeCun` and Bar, *Parallel Stochastic Gradient-Based Planning for World Models* (2026),
//! as algorithm "GRASP Solver" of the stable-worldmodel paper. Besides the actions `a_0 … a_{H-1}`, the states between
//! start and goal are variables, `z_1 … z_{H-1}`, first on the straight line. All predictions `ẑ_{t+1} = P(sg(z_t), a_t)`
//! are made at once, and both kinds of variables descend
//!
//! `Σ_t ‖ẑ_{t+1} - z_{t+1}‖² + γ_k ‖ẑ_{t+1} - s_g‖²`
//!
//! where the gradient stops at `z_t` as an input of the predictor. Noise of the scale σ_k is added to the states, and every
//! few iterations the actions take some steps against the gradient of the rollout's cost (the synchronisation). So no
//! gradient passes through more than one prediction but there. States are `[envs, horizon + 1, latent]`, start and goal
//! among them; actions are `[envs, horizon, dim]`, one candidate an environment.
//!
//! The solver is not in the published package. What the paper leaves open is taken from the reference's later source
//! (`solver/grasp.py`): 200 iterations, Adam, the step size of states 0.1, a synchronisation of 10 steps of 0.01 every 50
//! iterations, and goal weight and noise that fall linearly from 2 and 0.1 to 0 between synchronisations. Only its step
//! size of actions, 0.001, is ten times larger here: with Adam it moves no number by more than 0.2 in 200 iterations, less
//! than plans in normalised units need.
//!
//! Deviations from the paper, on purpose:
//! - Actions are moved into the bounds of the problem after every step, which the paper's table of solvers promises and its
//!   algorithm leaves out.
//! - Steps are those of an [`Optimizer`] (plain gradient descent is one of them), which forgets its momentum at a
//!   synchronisation, as in the reference.
//! - Noise is keyed by (plan key, iteration); numbers that are not finite are errors.
//!
//! The one-step model is [`LatentDynamics::predict`](swm_core::LatentDynamics::predict). Of a model that looks at several
//! past states it sees one, and only the synchronisation sees the cost as the model computes it.
//!
//! As the gradient stops there, an action feels only what it does within one step. Where it takes two to move a number, as
//! from a force to a position, the lifted loss cannot see it, and only the synchronisation finds the plan. With plain
//! gradient steps one step size serves horizons at which gradient descent on the rollout needs another each time
//! (`tests/it/objective.rs`); with Adam on linear systems, gradient descent is as good or better.
//!
//! What a plan costs is known where it is rolled out. So the trace has an entry for every step of a synchronisation,
//! before it, and one for the plan.

use crate::optimizer::{Adam, Memory, Optimizer};
use crate::population::{Population, add_noise, check_settings};
use crate::problem::{Bounds, UNWRITTEN, continuous, latent};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Error, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "grasp";

/// The gradient relaxed stochastic planner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Grasp {
    /// Iterations, K.
    pub iterations: usize,
    /// How actions move.
    pub action_optimizer: Optimizer,
    /// How virtual states move.
    pub state_optimizer: Optimizer,
    /// How much every predicted state is drawn to the goal, γ.
    pub goal_weight: Fall,
    /// The standard deviation of the noise added to virtual states after every step, σ, in latent units.
    pub state_noise: Fall,
    /// Iterations from one synchronisation to the next, `K_sync`; 0 for none.
    pub sync_every: usize,
    /// Steps of a synchronisation.
    pub sync_iterations: usize,
    /// How actions move in a synchronisation.
    pub sync_optimizer: Optimizer,
}

/// A number that changes linearly between synchronisations, or from the first iteration to the last where there are none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fall {
    /// At the beginning.
    pub from: f32,
    /// At the end.
    pub to: f32,
}

impl Fall {
    /// The value at iteration `k` of `n`.
    #[allow(clippy::cast_precision_loss)]
    fn at(self, k: usize, n: usize) -> f32 {
        self.from + (self.to - self.from) * k as f32 / (n - 1).max(1) as f32
    }
}

impl Default for Grasp {
    fn default() -> Self {
        let adam = |step| Optimizer::Adam(Adam { step, ..Adam::default() });
        Self {
            iterations: 200,
            action_optimizer: adam(0.01),
            state_optimizer: adam(0.1),
            goal_weight: Fall { from: 2.0, to: 0.0 },
            state_noise: Fall { from: 0.1, to: 0.0 },
            sync_every: 50,
            sync_iterations: 10,
            sync_optimizer: adam(0.01),
        }
    }
}

impl Solver for Grasp {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }

        let mut plan = Population::around(&problem, 1, 0.0, ID);
        let mut lifted = Lifted::straight(cost, &problem)?;
        let mut action_memory = Memory::new(plan.actions.len());
        let mut state_memory = Memory::new(lifted.states.len());
        let mut trace = vec![PlanTrace::default(); problem.keys.len()];
        bounds.clip(&mut plan.actions);

        let phase = if self.sync_every == 0 { self.iterations } else { self.sync_every };
        for k in 0..self.iterations {
            let (gamma, sigma) = (self.goal_weight.at(k % phase, phase), self.state_noise.at(k % phase, phase));
            lifted.differentiate(cost, &mut plan, gamma, k)?;
            self.action_optimizer.step(&mut action_memory, &mut plan.actions, &plan.gradient);
            self.state_optimizer.step(&mut state_memory, &mut lifted.states, &lifted.gradient);
            lifted.perturb(&problem, sigma, k);
            bounds.clip(&mut plan.actions);
            if problem.is_late() {
                break;
            }
            if self.sync_every > 0 && k > 0 && (k + 1) % self.sync_every == 0 {
                self.synchronise(cost, &problem, &mut plan, bounds, &mut trace, k)?;
                action_memory.clear();
                state_memory.clear();
            }
        }
        plan.evaluate(cost, self.iterations)?;
        plan.record(&mut trace, &plan.cheapest());
        Ok(plan.plan(&plan.cheapest(), trace))
    }
}

impl Grasp {
    /// Some steps of the actions against the gradient of the rollout's cost.
    fn synchronise(
        &self,
        cost: &mut dyn CostModel,
        problem: &PlanProblem<'_>,
        plan: &mut Population,
        bounds: Bounds<'_>,
        trace: &mut [PlanTrace],
        iteration: usize,
    ) -> Result<()> {
        let mut memory = Memory::new(plan.actions.len());
        for _ in 0..self.sync_iterations {
            plan.differentiate(ID, cost, iteration)?;
            plan.record(trace, &plan.cheapest());
            self.sync_optimizer.step(&mut memory, &mut plan.actions, &plan.gradient);
            bounds.clip(&mut plan.actions);
            if problem.is_late() {
                break;
            }
        }
        Ok(())
    }
}

/// States on the way from start to goal, as variables.
///
/// # Shapes
/// `states` and `gradient` are `[envs, horizon + 1, latent]`; start and goal, the first and the last, do not move. `from`,
/// `next`, `pull` and `unused` are `[envs, horizon, latent]`.
struct Lifted {
    states: Vec<f32>,
    gradient: Vec<f32>,
    /// z_t, from which ẑ_{t+1} is predicted.
    from: Vec<f32>,
    /// ẑ_{t+1}.
    next: Vec<f32>,
    /// The gradient of the loss with respect to ẑ_{t+1}.
    pull: Vec<f32>,
    /// The gradient with respect to z_t as an input, where it stops.
    unused: Vec<f32>,
    horizon: usize,
    latent: usize,
}

impl Lifted {
    /// States on the straight line from start to goal.
    #[allow(clippy::cast_precision_loss)]
    fn straight(cost: &mut dyn CostModel, problem: &PlanProblem<'_>) -> Result<Self> {
        let (envs, horizon, model) = (problem.keys.len(), problem.horizon, latent(ID, cost)?);
        let latent = model.latent_dim();
        if latent == 0 {
            return Err(Error::mismatch("the latent state of a model", "0 numbers", "at least 1"));
        }
        let (mut start, mut goal) = (vec![UNWRITTEN; envs * latent], vec![UNWRITTEN; envs * latent]);
        model.encode(&mut start, &mut goal)?;
        check_finite("the latent state of start or goal", &[&start, &goal], latent, "at first")?;

        let mut states = Vec::with_capacity(envs * (horizon + 1) * latent);
        for (start, goal) in start.chunks_exact(latent).zip(goal.chunks_exact(latent)) {
            for t in 0..=horizon {
                let share = t as f32 / horizon as f32;
                states.extend(start.iter().zip(goal).map(|(start, goal)| (1.0 - share) * start + share * goal));
            }
        }
        let [from, next, pull, unused] = std::array::from_fn(|_| vec![0.0; envs * horizon * latent]);
        Ok(Self { gradient: vec![0.0; states.len()], states, from, next, pull, unused, horizon, latent })
    }

    /// The gradients of the loss with respect to actions and states.
    fn differentiate(&mut self, cost: &mut dyn CostModel, plan: &mut Population, gamma: f32, k: usize) -> Result<()> {
        let (way, steps) = ((self.horizon + 1) * self.latent, self.horizon * self.latent);
        for (from, states) in self.from.chunks_exact_mut(steps).zip(self.states.chunks_exact(way)) {
            from.copy_from_slice(&states[..steps]);
        }
        let model = latent(ID, cost)?;
        self.next.fill(UNWRITTEN);
        model.predict(&self.from, &plan.actions, &mut self.next)?;
        check_finite("a predicted latent state", &[&self.next], steps, &format!("in iteration {k}"))?;

        let envs = self.states.chunks_exact(way).zip(self.gradient.chunks_exact_mut(way));
        let predicted = self.next.chunks_exact(steps).zip(self.pull.chunks_exact_mut(steps));
        for ((states, gradient), (next, pull)) in envs.zip(predicted) {
            let goal = &states[steps..];
            // Prediction i is of the state one latent further on.
            for (i, &next) in next.iter().enumerate() {
                let miss = 2.0 * (next - states[i + self.latent]);
                pull[i] = miss + gamma * 2.0 * (next - goal[i % self.latent]);
                gradient[i + self.latent] = -miss;
            }
            gradient[steps..].fill(0.0);
        }
        plan.gradient.fill(UNWRITTEN);
        model.predict_vjp(&self.from, &plan.actions, &self.pull, &mut self.unused, &mut plan.gradient)?;
        plan.check_gradient(k)
    }

    /// Moves the states between start and goal at random.
    fn perturb(&mut self, problem: &PlanProblem<'_>, sigma: f32, k: usize) {
        if sigma > 0.0 {
            let steps = self.horizon * self.latent;
            for (states, key) in self.states.chunks_exact_mut(steps + self.latent).zip(problem.keys) {
                add_noise(&mut states[self.latent..steps], sigma, key.with(ID).with("state").at(k as u64));
            }
        }
    }
}

/// Checks that numbers are finite, of which every environment has `width`.
fn check_finite(what: &str, numbers: &[&[f32]], width: usize, when: &str) -> Result<()> {
    for numbers in numbers {
        if let Some(i) = numbers.iter().position(|v| !v.is_finite()) {
            return Err(Error::NotFinite {
                what: what.to_owned(),
                given: format!("{} for planned environment {} {when}", numbers[i], i / width),
                fix: "the model diverges on these actions or its weights are damaged; check the checkpoint".to_owned(),
            });
        }
    }
    Ok(())
}

impl Grasp {
    fn check(&self) -> Result<()> {
        let falls = [("goal_weight", self.goal_weight), ("state_noise", self.state_noise)];
        let spreads = falls.map(|(name, fall)| [(name, fall.from), (name, fall.to)]).concat();
        check_settings(ID, 1, self.iterations, &spreads)?;
        if self.sync_every > 0 && self.sync_iterations == 0 {
            return Err(Error::config(
                format!("{ID} synchronisation"),
                format!("{} steps every {} iterations", self.sync_iterations, self.sync_every),
                "ask for at least 1 step, or for no synchronisation with sync_every = 0",
            ));
        }
        for optimizer in [&self.action_optimizer, &self.state_optimizer, &self.sync_optimizer] {
            optimizer.check(ID)?;
        }
        Ok(())
    }
}
