//! [`Grasp`]: optimises states and actions together, every model step independently.
//!
//! Psenka, Rabbat, Krishnapriyan, `LeCun` and Bar, *Parallel Stochastic Gradient-Based Planning for World Models*
//! (2026), as algorithm "GRASP Solver" of the stable-worldmodel paper. In addition to the actions `a_0 … a_{H-1}`, the
//! states between start and goal are variables, `z_1 … z_{H-1}`, initially on a straight line. All predictions
//! `ẑ_{t+1} = P(sg(z_t), a_t)` are computed at once, and both kinds of variables descend
//!
//! `Σ_t ‖ẑ_{t+1} - z_{t+1}‖² + γ_k ‖ẑ_{t+1} - s_g‖²`
//!
//! where the gradient stops at `z_t` as an input of the predictor. Noise with the standard deviation σ_k is added to
//! the states. Every few iterations, the synchronisation moves the actions some steps against the gradient of the
//! rollout's cost; no other gradient passes through more than one prediction. States are `[envs, horizon + 1, latent]`,
//! start and goal included; actions are `[envs, horizon, dim]`, one candidate for each environment.
//!
//! The published Python package does not contain this solver. Values that the paper does not give are those of a later
//! reference version (`solver/grasp.py`): 200 iterations, Adam, the step size 0.1 for states, a synchronisation of 10
//! steps of 0.01 every 50 iterations, and goal weight and noise that fall linearly from 2 and 0.1 to 0 between
//! synchronisations. Only the step size of actions is ten times larger here: with the reference's 0.001, Adam moves no
//! value by more than 0.2 in 200 iterations, which is less than plans in normalised units need.
//!
//! Intended differences from the paper:
//! - Actions are clipped to the bounds of the problem after every step. The paper's table of solvers states this, but
//!   its algorithm omits it.
//! - Steps are those of an [`Optimizer`] (plain gradient descent is one), whose memory is cleared at a synchronisation,
//!   as in the reference.
//! - Noise is keyed by (plan key, iteration); values that are not finite are errors.
//!
//! The one-step model is [`LatentDynamics::predict`](swm_core::LatentDynamics::predict). If the model conditions on
//! several past states, `predict` receives only one of them; only the synchronisation uses the model's own cost.
//!
//! Because the gradient stops at `z_t`, an action only receives a gradient for its effect within one step. Where an
//! effect takes two steps, as from a force to a position, the lifted loss has no gradient, and only the synchronisation
//! finds the plan. With plain gradient steps, one step size works for all tested horizons, while gradient descent on
//! the rollout requires a different step size for each horizon (`tests/it/objective.rs`); with Adam on linear systems,
//! gradient descent is as good or better.
//!
//! The cost of a plan is only known after a rollout. So the trace has an entry before every step of a synchronisation,
//! and one for the plan. Observers get the loss above as the cost of an iteration, and the cost in a synchronisation.

mod virtual_states;

use crate::entry::{ActionKind, Family, Need, SolverEntry, defaults, make};
use crate::search::{Adam, Descent, Memory, Optimizer, Settings, Step, continuous};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};
use virtual_states::VirtualStates;

const ID: &str = "grasp";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "optimises states and actions together, every model step independently",
    family: Family::Gradient,
    actions: ActionKind::Continuous,
    needs: &[Need::Gradient, Need::Latent],
    paper: "Psenka et al., Parallel Stochastic Gradient-Based Planning for World Models, 2026",
    defaults: defaults::<Grasp>,
    make: make::<Grasp>,
};

/// Settings of the gradient relaxed stochastic planner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Grasp {
    /// Iterations, K.
    pub iterations: usize,
    /// The optimizer of the actions.
    pub action_optimizer: Optimizer,
    /// The optimizer of the virtual states.
    pub state_optimizer: Optimizer,
    /// The weight of the distance of every predicted state to the goal, γ.
    pub goal_weight: LinearSchedule,
    /// The standard deviation of the noise added to the virtual states after every step, σ, in latent units.
    pub state_noise: LinearSchedule,
    /// Iterations from one synchronisation to the next, `K_sync`; 0 for none.
    pub sync_every: usize,
    /// Steps of a synchronisation.
    pub sync_iterations: usize,
    /// The optimizer of the actions in a synchronisation.
    pub sync_optimizer: Optimizer,
}

/// A value that changes linearly between synchronisations, or over all iterations if there are no synchronisations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinearSchedule {
    /// The first value.
    pub from: f32,
    /// The last value.
    pub to: f32,
}

impl LinearSchedule {
    /// The value at iteration `k` of `n`.
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
            goal_weight: LinearSchedule { from: 2.0, to: 0.0 },
            state_noise: LinearSchedule { from: 0.1, to: 0.0 },
            sync_every: 50,
            sync_iterations: 10,
            sync_optimizer: adam(0.01),
        }
    }
}

impl Solver for Grasp {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(&ENTRY, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }
        let mut descent = Descent::new(ID, &problem, 1, 0.0, move |actions| bounds.clip(actions))?;
        let mut states = VirtualStates::straight(cost, &problem)?;
        let mut state_memory = Memory::new(states.values.len());
        let action_step = Step { optimizer: &self.action_optimizer, action_noise: 0.0 };
        let sync_step = Step { optimizer: &self.sync_optimizer, action_noise: 0.0 };

        let phase = if self.sync_every == 0 { self.iterations } else { self.sync_every };
        for k in 0..self.iterations {
            let (gamma, sigma) = (self.goal_weight.at(k % phase, phase), self.state_noise.at(k % phase, phase));
            states.differentiate(cost, &mut descent, gamma, k)?;
            let goes_on = problem.observer.is_none() || descent.observed(&states.losses(gamma))?;
            descent.step(action_step);
            self.state_optimizer.step(&mut state_memory, &mut states.values, &states.gradient);
            states.perturb(&problem, sigma, k);
            if !goes_on || problem.is_late() {
                break;
            }
            if self.sync_every > 0 && k > 0 && (k + 1) % self.sync_every == 0 {
                descent.forget();
                let goes_on = descent.run(cost, self.sync_iterations, sync_step, |descent, _| {
                    descent.record();
                    Ok(())
                })?;
                if !goes_on {
                    break;
                }
                descent.forget();
                state_memory.clear();
            }
        }
        descent.finish(cost)
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.iterations("iterations", self.iterations)?;
        for (name, schedule) in [("goal_weight", self.goal_weight), ("state_noise", self.state_noise)] {
            settings.not_negative(name, schedule.from)?;
            settings.not_negative(name, schedule.to)?;
        }
        settings.check(
            self.sync_every == 0 || self.sync_iterations > 0,
            "synchronisation",
            format!("{} steps every {} iterations", self.sync_iterations, self.sync_every),
            "choose at least 1 step, or no synchronisation with sync_every = 0",
        )?;
        if self.sync_every > 0 {
            settings.iterations("sync_iterations", self.sync_iterations)?;
        }
        [&self.action_optimizer, &self.state_optimizer, &self.sync_optimizer].iter().try_for_each(|it| it.check(ID))
    }
}
