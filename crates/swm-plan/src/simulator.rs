//! [`SimulatorCost`]: the true simulator as a cost model, so that any solver can be run with perfect dynamics.
//!
//! Planning with the simulator gives an upper bound on performance and tests solvers without model errors: a failure is
//! due to the search, its settings or the cost. The model reads the environments ([`CostModel::observe_env`]), so
//! [`MpcPolicy`](crate::MpcPolicy) must receive them through `observe_envs`.
//!
//! Every candidate is played from a snapshot of the environment in a private simulator, with the actions that the
//! policy would execute. A thread reuses an idle simulator, or creates one if none is idle. A cost depends only on the
//! snapshot and the candidate.

use crate::mpc::{ActionCodec, ActionScale, Decoded};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::{Mutex, PoisonError};
use swm_core::{Batch, Candidates, CostModel, Env, Error, Result, Snapshot};

/// The cost of a candidate; distances are [`Env::goal_distance`], in the environment's unit, unless the score says otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Score {
    /// The distance to the goal at the end.
    #[default]
    Terminal,
    /// The sum of the distances after every environment step.
    Running,
    /// For a candidate that succeeds, minus the fraction of its steps after the first success (from -1 to 0); for any
    /// other candidate, the distance to the goal at the end.
    Reach,
    /// As [`Score::Reach`], with [`Env::success_distance`] as the distance.
    Success,
}

/// The simulator as a model.
pub struct SimulatorCost {
    make: Box<dyn Fn() -> Result<Box<dyn Env>> + Send + Sync>,
    id: String,
    codec: ActionCodec,
    score: Score,
    /// Snapshots of the environments passed to `observe_env`, by slot; `observe` removes them.
    received: Vec<Option<Snapshot>>,
    /// Snapshots of the environments to plan from.
    present: Vec<Snapshot>,
    /// Simulators that no thread is using.
    idle: Mutex<Vec<Simulator>>,
}

/// A private environment in which candidates are played.
struct Simulator {
    env: Box<dyn Env>,
    action: Decoded,
}

/// The number of candidates that one task plays.
const GROUP: usize = 8;

impl SimulatorCost {
    /// Creates a model of the environments that `make` creates, such as [`swm_core::EnvChoice::env`]. `scale` and
    /// `action_block` must be the policy's; [`ActionScale::unscaled`] is a valid scale for every environment.
    ///
    /// # Errors
    /// When the scale does not fit the environment, a model step has no action, or `make` fails.
    pub fn new(
        make: impl Fn() -> Result<Box<dyn Env>> + Send + Sync + 'static,
        scale: ActionScale,
        action_block: usize,
        score: Score,
    ) -> Result<Self> {
        if action_block == 0 {
            return Err(Error::config("a simulator's action block", "0", "choose at least 1"));
        }
        let first = Simulator { env: make()?, action: Decoded::default() };
        let spec = first.env.spec();
        let (id, codec) = (spec.id.clone(), ActionCodec::new(spec, scale, action_block)?);
        let idle = Mutex::new(vec![first]);
        Ok(Self { make: Box::new(make), id, codec, score, received: vec![], present: vec![], idle })
    }

    /// Takes an idle simulator or creates one. A simulator that fails is not returned, because its state is unknown.
    fn take(&self) -> Result<Simulator> {
        let idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop();
        idle.map_or_else(|| Ok(Simulator { env: (self.make)()?, action: Decoded::default() }), Ok)
    }

    fn give_back(&self, simulator: Simulator) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(simulator);
    }

    /// Plays a candidate, `[horizon, dim]`; returns its cost.
    fn play(&self, simulator: &mut Simulator, start: &Snapshot, actions: &[f32]) -> Result<f64> {
        let Simulator { env, action } = simulator;
        env.restore(start)?;
        let width = self.codec.width();
        let mut sum = 0.0;
        for (step, planned) in actions.chunks_exact(width).enumerate() {
            env.step(self.codec.decode(planned, action))?;
            match self.score {
                Score::Terminal => {}
                Score::Running => sum += env.goal_distance(),
                Score::Reach | Score::Success if env.is_success() => {
                    let steps = actions.len() / width;
                    return Ok((step as f64 + 1.0 - steps as f64) / steps as f64);
                }
                Score::Reach | Score::Success => {}
            }
        }
        Ok(match self.score {
            Score::Terminal | Score::Reach => env.goal_distance(),
            Score::Running => sum,
            Score::Success => env.success_distance(),
        })
    }
}

impl CostModel for SimulatorCost {
    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        if env.spec().id != self.id {
            return Err(Error::mismatch("the environment of a simulator", &env.spec().id, &self.id));
        }
        if slot >= self.received.len() {
            self.received.resize(slot + 1, None);
        }
        self.received[slot] = Some(env.snapshot());
        Ok(())
    }

    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.present.clear();
        for &slot in envs {
            // The snapshot is removed, so that a later call cannot plan from an outdated snapshot.
            let Some(snapshot) = self.received.get_mut(slot).and_then(Option::take) else {
                return Err(Error::config(
                    format!("planning in slot {slot} with a simulator"),
                    "the environment was not passed to the policy",
                    "call Policy::observe_envs before Policy::act",
                ));
            };
            self.present.push(snapshot);
        }
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        if envs != self.present.len() || dim != self.codec.space().dim() {
            return Err(Error::mismatch(
                "scoring candidates in a simulator",
                format!("{envs} environments, {dim} values per model step"),
                format!("{} and {}", self.present.len(), self.codec.space().dim()),
            ));
        }
        let (this, len) = (&*self, horizon * dim);
        let groups = actions.par_chunks(GROUP * len).zip(costs.par_chunks_mut(GROUP)).enumerate();
        groups.try_for_each(|(group, (actions, costs))| {
            let mut simulator = this.take()?;
            for (i, (actions, cost)) in actions.chunks_exact(len).zip(costs).enumerate() {
                let start = &this.present[(group * GROUP + i) / samples];
                *cost = this.play(&mut simulator, start, actions)? as f32;
            }
            this.give_back(simulator);
            Ok(())
        })
    }
}
