//! [`MpcPolicy`]: model-predictive control. Plan some steps ahead, execute the first of them, plan again.
//!
//! Slots whose executed part has run out replan together, in one [`Solver::solve`] call; the others keep
//! executing. A plan is keyed by (episode, replan), so an episode is played the same way in whichever slot and
//! beside whichever other episodes it runs.
//!
//! # What is planned
//! Points of a box in model units ([`ActionScale`]), clamped to the box when they are executed; integers as choices, one
//! one-hot vector an integer. The `action_block` actions of a model step lie one after another.
//!
//! # What a model sees
//! [`CostModel::observe_env`] gets the worlds that are about to be planned for, [`CostModel::observe`] the infos. With `history`
//! above 1 the infos have these columns too, oldest step first and the latest at the end:
//!
//! | column | shape | |
//! | --- | --- | --- |
//! | `history.length` | one `int32` | how many of the past model steps are real; what precedes them is zero |
//! | `history.action` | `[history - 1, action_block * action]` `float32` | executed actions, as they are planned |
//! | `history.pixels` | `[history - 1, H, W, 3]` `uint8` | the picture each model step began with, where there are pictures |

use crate::ActionScale;
use crate::codec::{ActionCodec, Decoded};
use crate::guard::{Guard, caught};
use crate::history::History;
use crate::trace::{PlanRecord, TraceLog};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};
use swm_core::{Action, Batch, ColumnSpec, CostModel, EnvPool, EnvSpec, Error, Key, Plan, PlanProblem};
use swm_core::{Policy, Result, Solver};

/// How far to plan and how much of a plan to execute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MpcConfig {
    /// Model steps to plan, H.
    pub horizon: usize,
    /// Model steps to execute before planning again; the whole horizon is open loop.
    pub receding_horizon: usize,
    /// Environment steps in one model step (the frameskip the model was trained with): their actions lie
    /// one after another in a model step's action.
    pub action_block: usize,
    /// Whether a plan starts from what the last one left unexecuted, moved forward and filled with zeros (the mean
    /// action, in model units; no preference, among choices).
    pub warm_start: bool,
    /// Model steps the model may look at, the present one included.
    pub history: usize,
    /// Seconds after which solvers stop searching and return the best plan so far, counted from when the present is
    /// observed, for all environments that are planned together. The first iteration is always finished. With a budget,
    /// results depend on the machine's speed and on what else it does; without, they never do.
    pub latency_budget: Option<f64>,
}

impl Default for MpcConfig {
    /// The setting of the paper's planning experiments: 5 model steps of 5 environment steps, open loop.
    fn default() -> Self {
        Self { horizon: 5, receding_horizon: 5, action_block: 5, warm_start: true, history: 1, latency_budget: None }
    }
}

impl MpcConfig {
    /// Checks that the settings fit each other.
    ///
    /// # Errors
    /// When a number is 0, more would be executed than planned, or the latency budget is no time.
    pub fn check(&self) -> Result<()> {
        let numbers = [
            ("horizon", self.horizon),
            ("receding horizon", self.receding_horizon),
            ("action block", self.action_block),
            ("history", self.history),
        ];
        if let Some((what, _)) = numbers.into_iter().find(|&(_, n)| n == 0) {
            return Err(Error::config(format!("MPC {what}"), "0", "choose at least 1"));
        }
        if self.receding_horizon > self.horizon {
            return Err(Error::config(
                "MPC receding horizon",
                format!("{} model steps to execute, {} planned", self.receding_horizon, self.horizon),
                "execute at most what is planned",
            ));
        }
        if let Some(seconds) = self.latency_budget.filter(|seconds| !(seconds.is_finite() && *seconds > 0.0)) {
            return Err(Error::config(
                "MPC latency budget",
                format!("{seconds} seconds"),
                "choose more than 0 seconds, or none for no limit",
            ));
        }
        Ok(())
    }

    /// When a search that begins now has to stop. A budget too long for the clock is none.
    fn deadline(&self, now: Instant) -> Option<Instant> {
        let budget = Duration::try_from_secs_f64(self.latency_budget?).ok()?;
        now.checked_add(budget)
    }
}

/// A policy that plans.
pub struct MpcPolicy {
    solver: Box<dyn Solver>,
    cost: Box<dyn CostModel>,
    config: MpcConfig,
    codec: ActionCodec,
    /// What the world's actions look like.
    column: ColumnSpec,
    slots: Vec<Slot>,
    history: Option<History>,
    latencies: Vec<f64>,
    log: Option<TraceLog>,
    scratch: Scratch,
}

/// The plan one slot is executing.
#[derive(Clone)]
struct Slot {
    key: Key,
    /// Plans made in this episode.
    plans: u64,
    /// The part of the plan to execute, `[receding horizon, dim]`, and how many of its numbers are done.
    plan: Vec<f32>,
    done: usize,
    /// Where the next plan starts, `[horizon, dim]`.
    warm: Vec<f32>,
}

impl Slot {
    fn is_due(&self) -> bool {
        self.done == self.plan.len()
    }
}

/// Buffers that keep their memory between calls.
#[derive(Default)]
struct Scratch {
    replan: Vec<usize>,
    keys: Vec<Key>,
    init: Vec<f32>,
    decoded: Decoded,
    /// An executed action, as it would be planned.
    executed: Vec<f32>,
}

impl MpcPolicy {
    /// A planning policy for `slots` environments of `spec`. `scale` is the model's ([`ActionScale::unscaled`] for one that
    /// sees the environment's own actions).
    ///
    /// # Errors
    /// When the settings contradict each other, or the environment's actions cannot be planned or do not fit `scale`.
    pub fn new(
        solver: Box<dyn Solver>,
        cost: Box<dyn CostModel>,
        config: MpcConfig,
        scale: ActionScale,
        spec: &EnvSpec,
        slots: usize,
    ) -> Result<Self> {
        config.check()?;
        let codec = ActionCodec::new(spec, scale, config.action_block)?;
        let (dim, width) = (codec.space().dim(), codec.width());
        let slot = Slot {
            key: Key::new(0),
            plans: 0,
            plan: Vec::with_capacity(config.receding_horizon * dim),
            done: 0,
            warm: vec![0.0; config.horizon * dim],
        };
        let history = (config.history > 1).then(|| History::new(config.history - 1, config.action_block, width, slots));
        Ok(Self {
            solver,
            cost,
            config,
            codec,
            column: spec.action_column(),
            slots: vec![slot; slots],
            history,
            latencies: vec![],
            log: None,
            scratch: Scratch { executed: vec![0.0; width], ..Scratch::default() },
        })
    }

    /// Notes every plan in `log`.
    #[must_use]
    pub fn traced(mut self, log: TraceLog) -> Self {
        self.log = Some(log);
        self
    }

    /// Plans for all slots in `scratch.replan`, in one call.
    fn replan(&mut self, infos: &Batch) -> Result<()> {
        let begun = Instant::now();
        let deadline = self.config.deadline(begun);
        let Scratch { replan, keys, init, .. } = &mut self.scratch;
        let mut model = Guard::new(&mut *self.cost);
        let infos = match &mut self.history {
            Some(history) => history.infos(infos, replan)?,
            None => infos,
        };
        model.observe(infos, replan)?;
        keys.clear();
        init.clear();
        for &slot in replan.iter() {
            let slot = &self.slots[slot];
            keys.push(slot.key.with("plan").at(slot.plans));
            init.extend_from_slice(&slot.warm);
        }
        let (horizon, space) = (self.config.horizon, self.codec.space());
        let problem = PlanProblem { horizon, space, keys, init: Some(init), deadline };
        let plan = caught("the solver", "planning", || self.solver.solve(&mut model, problem))?;
        check_plan(&plan, replan.len(), horizon, space.dim())?;

        let together = replan.len();
        #[allow(clippy::cast_precision_loss)]
        let [seconds, model_seconds] = [begun.elapsed().as_secs_f64(), model.seconds].map(|s| s / together as f64);
        let mut searches = plan.trace.into_iter();
        for (i, (&index, actions)) in replan.iter().zip(plan.actions.chunks_exact(horizon * space.dim())).enumerate() {
            let slot = &mut self.slots[index];
            let (execute, rest) = actions.split_at(self.config.receding_horizon * space.dim());
            slot.done = 0;
            slot.plan.clear();
            slot.plan.extend_from_slice(execute);
            if self.config.warm_start {
                slot.warm[..rest.len()].copy_from_slice(rest);
                slot.warm[rest.len()..].fill(0.0);
            }
            if let Some(log) = &self.log {
                log.note(PlanRecord {
                    episode: slot.key.seed() >> 1,
                    slot: index,
                    replan: slot.plans,
                    together,
                    seconds,
                    model_seconds,
                    cost: plan.costs[i],
                    search: searches.next().unwrap_or_default(),
                });
            }
            slot.plans += 1;
            self.latencies.push(seconds);
        }
        Ok(())
    }

    fn check_slots(&self, given: &[usize]) -> Result<()> {
        if given.iter().all(|&given| given == self.slots.len()) {
            return Ok(());
        }
        let expected = format!("{} of each, the slots this policy was made for", self.slots.len());
        Err(Error::mismatch("planning", format!("worlds, flags or actions: {given:?}"), expected))
    }
}

/// Checks what a solver returned for `envs` environments.
fn check_plan(plan: &Plan, envs: usize, horizon: usize, dim: usize) -> Result<()> {
    let wrong = |given, expected| Err(Error::mismatch("the plan a solver returned", given, expected));
    if plan.actions.len() != envs * horizon * dim {
        let expected = format!("{} ({envs} environments x {horizon} x {dim})", envs * horizon * dim);
        return wrong(format!("{} numbers", plan.actions.len()), expected);
    }
    if plan.costs.len() != envs {
        return wrong(format!("{} costs", plan.costs.len()), format!("{envs}, one an environment"));
    }
    if !plan.trace.is_empty() && plan.trace.len() != envs {
        return wrong(format!("{} traces", plan.trace.len()), format!("{envs}, one an environment, or none"));
    }
    let len = horizon * dim;
    let bad_action = plan.actions.iter().position(|v| !v.is_finite());
    let bad_action = bad_action.map(|i| (i / len, format!("{} at step {}", plan.actions[i], i % len / dim)));
    let bad_cost = plan.costs.iter().position(|v| !v.is_finite());
    let Some((env, given)) = bad_action.or_else(|| bad_cost.map(|i| (i, format!("a cost of {}", plan.costs[i]))))
    else {
        return Ok(());
    };
    Err(Error::NotFinite {
        what: format!("the plan a solver returned for planned environment {env}"),
        given,
        fix: "its settings let the search diverge, or the solver has a mistake".to_owned(),
    })
}

impl Policy for MpcPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        let state = &mut self.slots[slot];
        (state.key, state.plans, state.done) = (key, 0, 0);
        state.plan.clear();
        state.warm.fill(0.0);
        if let Some(history) = &mut self.history {
            history.begin(slot);
        }
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> Result<()> {
        self.check_slots(&[envs.len(), active.len()])?;
        let mut model = Guard::new(&mut *self.cost);
        let mut due = (0..active.len()).filter(|&slot| active[slot] && self.slots[slot].is_due());
        due.try_for_each(|slot| model.observe_env(slot, envs.env(slot)))
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.check_slots(&[infos.rows(), active.len(), actions.rows()])?;
        let column = actions.schema().index("action")?;
        let given = &actions.schema().columns()[column];
        if *given != self.column {
            return Err(Error::mismatch("planning actions", format!("{given:?}"), format!("{:?}", self.column)));
        }
        self.scratch.replan.clear();
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            if let Some(history) = &mut self.history {
                history.see(slot, infos)?;
            }
            if self.slots[slot].is_due() {
                self.scratch.replan.push(slot);
            }
        }
        if !self.scratch.replan.is_empty() {
            self.replan(infos)?;
        }
        let width = self.codec.width();
        let Scratch { decoded, executed, .. } = &mut self.scratch;
        for (index, slot) in self.slots.iter_mut().enumerate().filter(|&(index, _)| active[index]) {
            let action = self.codec.decode(&slot.plan[slot.done..][..width], decoded);
            let mut row = actions.row_mut(index);
            match action {
                Action::Continuous(numbers) => row.set(column, numbers),
                Action::Discrete(integers) => row.set(column, integers),
            }
            if let Some(history) = &mut self.history {
                self.codec.encode(action, executed);
                history.acted(index, executed);
            }
            slot.done += width;
        }
        Ok(())
    }

    /// Seconds each plan took, encoding the present included: environments planned in one call share its time
    /// equally.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
