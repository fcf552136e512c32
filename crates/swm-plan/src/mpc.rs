//! [`MpcPolicy`]: model-predictive control. Plan some steps ahead, execute the first of them, plan again.
//!
//! Slots whose executed part has run out replan together, in one [`Solver::solve`] call; the others keep
//! executing. A plan is keyed by (episode, replan), so an episode is played the same way in whichever slot and
//! beside whichever other episodes it runs.
//!
//! # What a model sees
//! [`CostModel::observe`] gets the world's infos. With `history` above 1 it gets these columns too, oldest
//! step first and the latest at the end:
//!
//! | column | shape | |
//! | --- | --- | --- |
//! | `history.length` | one `int32` | how many of the past model steps are real; what precedes them is zero |
//! | `history.action` | `[history - 1, action_block * action]` `float32` | executed actions, in model units |
//! | `history.pixels` | `[history - 1, H, W, 3]` `uint8` | the picture each model step began with, where there are pictures |

use crate::ActionScale;
use crate::history::History;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use swm_core::{Batch, CostModel, EnvSpec, Error, Key, PlanProblem, PlanSpace, Policy, Result, Solver};

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
    /// Whether a plan starts from what the last one left unexecuted, moved forward and filled with zeros
    /// (the mean action, in model units).
    pub warm_start: bool,
    /// Model steps the model may look at, the present one included.
    pub history: usize,
}

impl Default for MpcConfig {
    /// The setting of the paper's planning experiments: 5 model steps of 5 environment steps, open loop.
    fn default() -> Self {
        Self { horizon: 5, receding_horizon: 5, action_block: 5, warm_start: true, history: 1 }
    }
}

impl MpcConfig {
    /// Checks that the settings fit each other.
    ///
    /// # Errors
    /// When a number is 0 or more would be executed than planned.
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
        Ok(())
    }
}

/// A policy that plans.
pub struct MpcPolicy {
    solver: Box<dyn Solver>,
    cost: Box<dyn CostModel>,
    config: MpcConfig,
    scale: ActionScale,
    /// Bounds of a model step, in model units.
    low: Vec<f32>,
    high: Vec<f32>,
    /// Bounds of an environment action, in its own units.
    bounds: Vec<(f32, f32)>,
    slots: Vec<Slot>,
    history: Option<History>,
    latencies: Vec<f64>,
    scratch: Scratch,
}

/// The plan one slot is executing.
#[derive(Clone)]
struct Slot {
    key: Key,
    /// Plans made in this episode.
    plans: u64,
    /// Actions to execute, in environment units, and how many of their numbers are done.
    actions: Vec<f32>,
    done: usize,
    /// Where the next plan starts, `[horizon, block * action]` in model units.
    warm: Vec<f32>,
}

/// Buffers that keep their memory between calls.
#[derive(Default)]
struct Scratch {
    replan: Vec<usize>,
    keys: Vec<Key>,
    init: Vec<f32>,
    action: Vec<f32>,
}

impl MpcPolicy {
    /// A planning policy for `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the settings contradict each other, or the environment's actions are not continuous or do not
    /// fit `scale`.
    pub fn new(
        solver: Box<dyn Solver>,
        cost: Box<dyn CostModel>,
        config: MpcConfig,
        scale: ActionScale,
        spec: &EnvSpec,
        slots: usize,
    ) -> Result<Self> {
        config.check()?;
        scale.check(spec)?;
        let (low, high) = scale.bounds(&spec.action_space, config.action_block);
        #[allow(clippy::cast_possible_truncation)]
        let bounds = (0..scale.dim())
            .map(|i| {
                let (low, high) = spec.action_space.bounds(i);
                (low as f32, high as f32)
            })
            .collect();
        let slot = Slot {
            key: Key::new(0),
            plans: 0,
            actions: Vec::with_capacity(config.receding_horizon * low.len()),
            done: 0,
            warm: vec![0.0; config.horizon * low.len()],
        };
        let history =
            (config.history > 1).then(|| History::new(config.history - 1, config.action_block, scale.dim(), slots));
        Ok(Self {
            solver,
            cost,
            low,
            high,
            bounds,
            slots: vec![slot; slots],
            history,
            latencies: vec![],
            scratch: Scratch { action: vec![0.0; scale.dim()], ..Scratch::default() },
            config,
            scale,
        })
    }

    /// Plans for all slots in `scratch.replan`, in one call.
    #[allow(clippy::cast_precision_loss)]
    fn replan(&mut self, infos: &Batch) -> Result<()> {
        let Scratch { replan, keys, init, .. } = &mut self.scratch;
        let begun = Instant::now();
        let infos = match &mut self.history {
            Some(history) => history.infos(infos, replan)?,
            None => infos,
        };
        self.cost.observe(infos, replan)?;
        keys.clear();
        init.clear();
        for &slot in replan.iter() {
            let slot = &mut self.slots[slot];
            keys.push(slot.key.with("plan").at(slot.plans));
            init.extend_from_slice(&slot.warm);
            slot.plans += 1;
        }
        let (horizon, dim) = (self.config.horizon, self.low.len());
        let space = PlanSpace::Continuous { low: &self.low, high: &self.high };
        let problem = PlanProblem { horizon, space, keys, init: Some(init), deadline: None };
        let plan = self.solver.solve(&mut *self.cost, problem)?;
        if plan.actions.len() != init.len() {
            return Err(Error::mismatch(
                "the plan a solver returned",
                format!("{} numbers", plan.actions.len()),
                format!("{} ({} environments x {horizon} x {dim})", init.len(), replan.len()),
            ));
        }

        let action_dim = self.scale.dim();
        for (&slot, plan) in replan.iter().zip(plan.actions.chunks_exact(horizon * dim)) {
            let slot = &mut self.slots[slot];
            let (execute, rest) = plan.split_at(self.config.receding_horizon * dim);
            slot.done = 0;
            slot.actions.resize(execute.len(), 0.0);
            for (env, model) in slot.actions.chunks_exact_mut(action_dim).zip(execute.chunks_exact(action_dim)) {
                self.scale.to_env(model, env);
                for (value, &(low, high)) in env.iter_mut().zip(&self.bounds) {
                    *value = value.clamp(low, high);
                }
            }
            if self.config.warm_start {
                slot.warm[..rest.len()].copy_from_slice(rest);
                slot.warm[rest.len()..].fill(0.0);
            }
        }
        let share = begun.elapsed().as_secs_f64() / replan.len() as f64;
        self.latencies.extend(std::iter::repeat_n(share, replan.len()));
        Ok(())
    }
}

impl Policy for MpcPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        let state = &mut self.slots[slot];
        (state.key, state.plans, state.done) = (key, 0, 0);
        state.actions.clear();
        state.warm.fill(0.0);
        if let Some(history) = &mut self.history {
            history.begin(slot);
        }
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let slots = self.slots.len();
        if [infos.rows(), active.len(), actions.rows()] != [slots; 3] {
            return Err(Error::mismatch(
                "planning",
                format!("{} infos, {} flags, {} actions", infos.rows(), active.len(), actions.rows()),
                format!("{slots} of each, the slots this policy was made for"),
            ));
        }
        let column = actions.schema().index("action")?;
        self.scratch.replan.clear();
        for slot in (0..slots).filter(|&slot| active[slot]) {
            if let Some(history) = &mut self.history {
                history.see(slot, infos)?;
            }
            if self.slots[slot].done == self.slots[slot].actions.len() {
                self.scratch.replan.push(slot);
            }
        }
        if !self.scratch.replan.is_empty() {
            self.replan(infos)?;
        }
        let dim = self.scale.dim();
        for (index, slot) in self.slots.iter_mut().enumerate().filter(|&(index, _)| active[index]) {
            let action = &slot.actions[slot.done..][..dim];
            actions.row_mut(index).set(column, action);
            if let Some(history) = &mut self.history {
                self.scale.to_model(action, &mut self.scratch.action);
                history.acted(index, &self.scratch.action);
            }
            slot.done += dim;
        }
        Ok(())
    }

    /// Seconds each plan took, encoding the present included: environments planned in one call share its time
    /// equally.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};
    use swm_core::{Candidates, ColumnSpec, DType, Plan, Schema, Space, VariationSpace};

    /// One call of the solver: the keys and the first guess.
    type Call = (Vec<Key>, Vec<f32>);

    /// Plans `100 * (call + 1) + place of the number`, and notes what it was asked.
    struct Counting {
        calls: Arc<Mutex<Vec<Call>>>,
    }

    impl Solver for Counting {
        fn solve(&mut self, _: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
            let mut calls = self.calls.lock().expect("one thread");
            calls.push((problem.keys.to_vec(), problem.init.expect("a first guess").to_vec()));
            let base = 100.0 * calls.len() as f32;
            let len = problem.horizon * problem.space.dim();
            let actions = (0..problem.keys.len() * len).map(|i| base + (i % len) as f32).collect();
            Ok(Plan { actions, ..Plan::default() })
        }
    }

    /// Notes which slots it was shown, and the past beside them.
    #[derive(Default)]
    struct Watching {
        seen: Arc<Mutex<Vec<Vec<usize>>>>,
        past: Arc<Mutex<Vec<Past>>>,
    }

    #[derive(Debug, PartialEq)]
    struct Past {
        length: i32,
        pixels: Vec<u8>,
        actions: Vec<f32>,
    }

    impl CostModel for Watching {
        fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
            self.seen.lock().expect("one thread").push(envs.to_vec());
            if infos.schema().find("history.length").is_some() {
                let row = infos.row(envs[0]);
                self.past.lock().expect("one thread").push(Past {
                    length: row.get::<i32>("history.length")?[0],
                    pixels: row.get::<u8>("history.pixels")?.to_vec(),
                    actions: row.get::<f32>("history.action")?.to_vec(),
                });
            }
            Ok(())
        }

        fn cost(&mut self, _: Candidates<'_>, _: &mut [f32]) -> Result<()> {
            Ok(())
        }
    }

    fn spec(high: f64) -> EnvSpec {
        EnvSpec {
            id: "test/Line-v0",
            action_space: Space::uniform_box([1], DType::Float32, -high, high),
            columns: vec![],
            variation_space: VariationSpace::new(vec![], &[]),
            max_episode_steps: 100,
        }
    }

    struct Rig {
        policy: MpcPolicy,
        calls: Arc<Mutex<Vec<Call>>>,
        seen: Arc<Mutex<Vec<Vec<usize>>>>,
        past: Arc<Mutex<Vec<Past>>>,
        infos: Batch,
        actions: Batch,
    }

    impl Rig {
        fn new(config: MpcConfig, high: f64, slots: usize) -> Self {
            let calls = Arc::default();
            let cost = Watching::default();
            let (seen, past) = (Arc::clone(&cost.seen), Arc::clone(&cost.past));
            let scale = ActionScale { mean: vec![1.0], std: vec![2.0] };
            let solver = Box::new(Counting { calls: Arc::clone(&calls) });
            let policy = MpcPolicy::new(solver, Box::new(cost), config, scale, &spec(high), slots).expect("a policy");
            let infos = Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("schema");
            let actions = Schema::new([spec(high).action_column()]).expect("schema");
            Self {
                policy,
                calls,
                seen,
                past,
                infos: Batch::zeros(&infos, slots),
                actions: Batch::zeros(&actions, slots),
            }
        }

        fn act(&mut self, active: &[bool]) -> Vec<f32> {
            self.policy.act(&self.infos, active, &mut self.actions).expect("actions");
            self.actions.get::<f32>("action").expect("actions").to_vec()
        }

        fn seen(&self) -> Vec<Vec<usize>> {
            self.seen.lock().expect("one thread").clone()
        }
    }

    #[test]
    fn what_is_due_replans_in_one_call_and_starts_from_the_rest() {
        let config = MpcConfig { horizon: 3, receding_horizon: 2, action_block: 2, warm_start: true, history: 1 };
        let mut rig = Rig::new(config, 1e6, 3);
        for slot in 0..3 {
            rig.policy.begin(slot, Key::new(slot as u64));
        }
        // Two model steps of two environment steps are executed: the plan's first four numbers, times 2 plus 1.
        for number in 0..4 {
            assert_eq!(rig.act(&[true, true, false])[..2], [201.0 + 2.0 * number as f32; 2]);
        }
        assert_eq!(rig.seen(), [[0, 1]]);
        // A new episode in slot 1; slot 2 joins. All are due: one call.
        rig.policy.begin(1, Key::new(7));
        rig.act(&[true, true, true]);
        assert_eq!(rig.seen(), [vec![0, 1], vec![0, 1, 2]]);
        let calls = rig.calls.lock().expect("one thread");
        let (keys, init) = &calls[1];
        let key = |seed, plan| Key::new(seed).with("plan").at(plan);
        assert_eq!(keys[..], [key(0, 1), key(7, 0), key(2, 0)]);
        assert_eq!(init[..6], [104.0, 105.0, 0.0, 0.0, 0.0, 0.0], "what was left, moved forward");
        assert_eq!(init[6..], [0.0; 12], "new episodes start from zeros");
        assert_eq!(rig.policy.take_latencies().len(), 5);
        assert!(rig.policy.take_latencies().is_empty());
    }

    #[test]
    fn cold_starts_begin_at_zero_and_open_loop_executes_everything() {
        let config = MpcConfig { horizon: 2, receding_horizon: 2, action_block: 1, warm_start: true, history: 1 };
        let mut open = Rig::new(config.clone(), 1e6, 1);
        (0..3).for_each(|_| drop(open.act(&[true])));
        assert_eq!(
            open.calls.lock().expect("one thread").iter().map(|c| c.1.clone()).collect::<Vec<_>>(),
            [[0.0; 2]; 2]
        );
        let mut cold = Rig::new(MpcConfig { receding_horizon: 1, warm_start: false, ..config }, 1e6, 1);
        (0..2).for_each(|_| drop(cold.act(&[true])));
        assert_eq!(cold.calls.lock().expect("one thread")[1].1, [0.0; 2]);
    }

    #[test]
    fn executed_actions_are_in_the_action_space() {
        let config = MpcConfig { horizon: 1, receding_horizon: 1, action_block: 1, ..MpcConfig::default() };
        assert_eq!(Rig::new(config, 5.0, 1).act(&[true]), [5.0]);
    }

    #[test]
    fn the_past_is_shown_to_models_that_want_it() {
        let config = MpcConfig { horizon: 1, receding_horizon: 1, action_block: 2, warm_start: false, history: 3 };
        let mut rig = Rig::new(config, 1e6, 2);
        rig.policy.begin(1, Key::new(0));
        for step in 0..7u8 {
            rig.infos.get_mut::<u8>("pixels").expect("pixels").fill(10 + step);
            rig.act(&[false, true]);
        }
        let past = rig.past.lock().expect("one thread");
        let pixel = |values: [u8; 2]| values.iter().flat_map(|&v| [v; 3]).collect::<Vec<_>>();
        let at = |length, pixels, actions: [f32; 4]| Past { length, pixels: pixel(pixels), actions: actions.to_vec() };
        assert_eq!(past[0], at(0, [0, 0], [0.0; 4]));
        assert_eq!(past[1], at(1, [0, 10], [0.0, 0.0, 100.0, 101.0]));
        assert_eq!(past[2], at(2, [10, 12], [100.0, 101.0, 200.0, 201.0]));
        assert_eq!(past[3], at(2, [12, 14], [200.0, 201.0, 300.0, 301.0]));
        drop(past);
        rig.policy.begin(1, Key::new(1));
        rig.act(&[false, true]);
        assert_eq!(rig.past.lock().expect("one thread")[4], at(0, [0, 0], [0.0; 4]));
    }

    #[test]
    fn wrong_settings_say_so() {
        let make = |config: MpcConfig, scale: ActionScale, spec: &EnvSpec| {
            let solver = Box::new(Counting { calls: Arc::default() });
            let made = MpcPolicy::new(solver, Box::new(Watching::default()), config, scale, spec, 1);
            made.err().expect("wrong").to_string()
        };
        let scale = ActionScale::identity(1);
        let far = MpcConfig { receding_horizon: 6, ..MpcConfig::default() };
        assert!(make(far, scale.clone(), &spec(1.0)).contains("6 model steps to execute, 5 planned"));
        let none = MpcConfig { horizon: 0, ..MpcConfig::default() };
        assert!(make(none, scale.clone(), &spec(1.0)).contains("MPC horizon"));
        assert!(make(MpcConfig::default(), ActionScale::identity(2), &spec(1.0)).contains("2 means"));
        let flat = ActionScale { mean: vec![0.0], std: vec![0.0] };
        assert!(make(MpcConfig::default(), flat, &spec(1.0)).contains("above 0"));
        let discrete = EnvSpec { action_space: Space::Discrete { n: 3, start: 0 }, ..spec(1.0) };
        assert!(make(MpcConfig::default(), scale, &discrete).contains("continuous actions"));
    }
}
