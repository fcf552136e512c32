//! [`MpcPolicy`]: a policy that plans with a solver and a model.
//!
//! Slots that have executed the first `receding_horizon` steps of their plans replan together, in one [`Solver::solve`]
//! call; other slots continue their plans. A plan is keyed by (episode, replan), so the plans of an episode do not
//! depend on its slot or on other episodes.
//!
//! # Actions
//! Points of a box are planned in model units ([`ActionScale`]) and clipped to the box when they are executed. Integers
//! are planned as choices, with a one-hot vector for each integer. The `action_block` actions of a model step are
//! concatenated.
//!
//! # Inputs of the model
//! [`CostModel::observe_env`] receives the environments that are about to be planned for, [`CostModel::observe`] their
//! info columns. With `history` above 1, these columns are added, oldest step first:
//!
//! | column | shape | |
//! | --- | --- | --- |
//! | `history.length` | one `int32` | the number of past model steps that are filled; earlier steps are zero |
//! | `history.action` | `[history - 1, action_block * action_dim]` `float32` | executed actions, in plan values |
//! | `history.pixels` | `[history - 1, H, W, 3]` `uint8` | the frame at the beginning of each model step, if frames are rendered |

use super::action_codec::{ActionCodec, Decoded};
use super::action_scale::ActionScale;
use super::config::MpcConfig;
use super::guarded_model::{GuardedModel, catch_panic};
use super::history::History;
use super::observer::{BetweenIterations, PlanObserver};
use super::trace_log::{PlanRecord, TraceLog};
use crate::search::count_values;
use std::time::Instant;
use swm_core::run::Interrupt;
use swm_core::{Action, Batch, ColumnSpec, CostModel, EnvPool, EnvSpec, Error, Key, Plan, PlanProblem};
use swm_core::{Policy, Result, SearchObserver, Solver};

/// A policy that plans with a solver and a model.
pub struct MpcPolicy {
    solver: Box<dyn Solver>,
    cost: Box<dyn CostModel>,
    config: MpcConfig,
    codec: ActionCodec,
    /// The action column of the environments.
    column: ColumnSpec,
    slots: Vec<Slot>,
    history: Option<History>,
    latencies: Vec<f64>,
    log: Option<TraceLog>,
    observer: Option<Box<dyn PlanObserver>>,
    scratch: Scratch,
}

/// The plan one slot is executing.
#[derive(Clone)]
struct Slot {
    key: Key,
    /// The number of plans made in this episode.
    plans: u64,
    /// The part of the plan to execute, `[receding horizon, dim]`.
    plan: Vec<f32>,
    /// The number of values of `plan` that have been executed.
    done: usize,
    /// The initial guess of the next plan, `[horizon, dim]`.
    warm: Vec<f32>,
}

impl Slot {
    /// Whether a new plan is required before the next action.
    fn is_due(&self) -> bool {
        self.done == self.plan.len()
    }
}

/// Buffers that are reused between calls.
#[derive(Default)]
struct Scratch {
    replan: Vec<usize>,
    keys: Vec<Key>,
    init: Vec<f32>,
    decoded: Decoded,
    /// An executed action, in plan values.
    executed: Vec<f32>,
}

impl MpcPolicy {
    /// Creates a policy for `slots` environments of `spec`. `scale` is the model's scale ([`ActionScale::unscaled`]
    /// for a model that uses the environment's own units).
    ///
    /// # Errors
    /// When the settings contradict each other, or the environment's actions cannot be planned or do not fit `scale` or the
    /// solver's settings.
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
        solver.check_space(codec.space())?;
        let (dim, width) = (codec.space().dim(), codec.width());
        let steps = config.horizon.max(config.history);
        count_values("MPC plans".to_owned(), [slots, steps, dim], None)?;
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
            observer: None,
            scratch: Scratch { executed: vec![0.0; width], ..Scratch::default() },
        })
    }

    /// Records every plan in `log`.
    #[must_use]
    pub fn traced(mut self, log: TraceLog) -> Self {
        self.log = Some(log);
        self
    }

    /// Shows every search to `observer`.
    #[must_use]
    pub fn observed(mut self, observer: Box<dyn PlanObserver>) -> Self {
        self.observer = Some(observer);
        self
    }

    /// Plans for all slots in `scratch.replan` in one call.
    fn replan(&mut self, infos: &Batch, interrupt: Option<&dyn Interrupt>) -> Result<()> {
        let begun = Instant::now();
        let deadline = self.config.deadline(begun);
        let Scratch { replan, keys, init, .. } = &mut self.scratch;
        let mut model = GuardedModel::new(&mut *self.cost);
        let infos = match &mut self.history {
            Some(history) => history.extend(infos, replan)?,
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
        let between =
            BetweenIterations { interrupt, observer: self.observer.as_deref().map(|it| it as &dyn SearchObserver) };
        let observer = between.observer();
        let problem = PlanProblem { horizon, space, keys, init: Some(init), deadline, observer };
        if let Some(observer) = &self.observer {
            observer.begin(replan)?;
        }
        let plan = catch_panic("the solver", "planning", || self.solver.solve(&mut model, problem))?;
        if let Some(observer) = &self.observer {
            observer.end()?;
        }
        check_plan(&plan, replan.len(), horizon, space.dim())?;

        let together = replan.len();
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
                log.push(PlanRecord {
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
        let expected = format!("{} of each, the number of slots of this policy", self.slots.len());
        Err(Error::mismatch("planning", format!("{given:?} environments, flags or actions"), expected))
    }
}

/// Checks the plan that a solver returned for `envs` environments.
fn check_plan(plan: &Plan, envs: usize, horizon: usize, dim: usize) -> Result<()> {
    let wrong = |given, expected| Err(Error::mismatch("the plan a solver returned", given, expected));
    if plan.actions.len() != envs * horizon * dim {
        let expected = format!("{} ({envs} environments x {horizon} x {dim})", envs * horizon * dim);
        return wrong(format!("{} values", plan.actions.len()), expected);
    }
    if plan.costs.len() != envs {
        return wrong(format!("{} costs", plan.costs.len()), format!("{envs}, one for each environment"));
    }
    if !plan.trace.is_empty() && plan.trace.len() != envs {
        return wrong(format!("{} traces", plan.trace.len()), format!("{envs}, one for each environment, or none"));
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
        fix: "the search diverged, or the solver has a bug; check the settings of the solver".to_owned(),
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
        let mut model = GuardedModel::new(&mut *self.cost);
        let mut due = (0..active.len()).filter(|&slot| active[slot] && self.slots[slot].is_due());
        due.try_for_each(|slot| model.observe_env(slot, envs.env(slot)))
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.act_with(infos, active, actions, None)
    }

    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: &dyn Interrupt,
    ) -> Result<()> {
        self.act_with(infos, active, actions, Some(interrupt))
    }

    /// Returns the seconds that each plan took, including the encoding of the present observation. The time of a call
    /// is divided equally among its environments.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}

impl MpcPolicy {
    /// As [`Policy::act_until`].
    fn act_with(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: Option<&dyn Interrupt>,
    ) -> Result<()> {
        self.check_slots(&[infos.rows(), active.len(), actions.rows()])?;
        let column = actions.schema().index("action")?;
        let given = &actions.schema().columns()[column];
        if *given != self.column {
            return Err(Error::mismatch("planning actions", format!("{given:?}"), format!("{:?}", self.column)));
        }
        self.scratch.replan.clear();
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            if let Some(history) = &mut self.history {
                history.observe(slot, infos)?;
            }
            if self.slots[slot].is_due() {
                self.scratch.replan.push(slot);
            }
        }
        if !self.scratch.replan.is_empty() {
            self.replan(infos, interrupt)?;
        }
        let width = self.codec.width();
        let Scratch { decoded, executed, .. } = &mut self.scratch;
        for (index, slot) in self.slots.iter_mut().enumerate().filter(|&(index, _)| active[index]) {
            let action = self.codec.decode(&slot.plan[slot.done..][..width], decoded);
            let mut row = actions.row_mut(index);
            match action {
                Action::Continuous(values) => row.set(column, values),
                Action::Discrete(integers) => row.set(column, integers),
            }
            if let Some(history) = &mut self.history {
                self.codec.encode(action, executed);
                history.push_action(index, executed);
            }
            slot.done += width;
        }
        Ok(())
    }
}
