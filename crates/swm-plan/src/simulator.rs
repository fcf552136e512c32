//! [`SimulatorCost`]: the true simulator as the model, so that any solver can be run with perfect dynamics.
//!
//! It is an upper bound, and a test of solvers without a model's errors: what fails here is the search, its settings or
//! the cost. The model looks at the world itself ([`CostModel::observe_env`]), so only a [`crate::MpcPolicy`] that is shown the
//! worlds can use it.
//!
//! Every candidate is played from a snapshot of the world in a simulator of the model's own, with the actions that the
//! policy would execute. Simulators are made when a thread first needs one and kept. A cost depends on the snapshot and
//! the candidate alone.

use crate::ActionScale;
use crate::codec::{ActionCodec, Decoded};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::{Mutex, PoisonError};
use swm_core::{Batch, Candidates, CostModel, Env, Error, Result, Snapshot};

/// What a candidate is judged by; distances are [`Env::goal_distance`], in the environment's unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Score {
    /// The distance to the goal at the end.
    #[default]
    Terminal,
    /// The sum of the distances after every environment step.
    Running,
    /// Reaching the goal on the way counts, and the earlier the better: minus the share of the steps that are left then,
    /// which is never above 0. A candidate that does not reach it costs its distance at the end.
    Reach,
}

/// The simulator as a model.
pub struct SimulatorCost {
    make: Box<dyn Fn() -> Result<Box<dyn Env>> + Send + Sync>,
    id: String,
    codec: ActionCodec,
    score: Score,
    /// The worlds that were shown since they were last observed, by slot.
    shown: Vec<Option<Snapshot>>,
    /// The worlds to plan from.
    present: Vec<Snapshot>,
    /// Simulators that no thread uses now.
    idle: Mutex<Vec<Simulator>>,
}

/// A world to try actions in.
struct Simulator {
    env: Box<dyn Env>,
    action: Decoded,
}

/// Candidates that one thread plays after another.
const GROUP: usize = 8;

impl SimulatorCost {
    /// A model of the worlds that `make` makes, such as [`swm_core::EnvChoice::env`]. Scale and block are those of the
    /// policy: a simulator has no units of its own, so [`ActionScale::unscaled`] will do.
    ///
    /// # Errors
    /// When the scale does not fit the environment, or a model step has no action, and what `make` returns.
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
        Ok(Self { make: Box::new(make), id, codec, score, shown: vec![], present: vec![], idle })
    }

    /// A simulator nobody uses; one that fails is not put back, because it may be in any state.
    fn borrow(&self) -> Result<Simulator> {
        let idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop();
        idle.map_or_else(|| Ok(Simulator { env: (self.make)()?, action: Decoded::default() }), Ok)
    }

    fn put_back(&self, simulator: Simulator) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(simulator);
    }

    /// Plays a candidate.
    #[allow(clippy::cast_precision_loss)]
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
                Score::Reach if env.is_success() => {
                    let steps = actions.len() / width;
                    return Ok((step as f64 + 1.0 - steps as f64) / steps as f64);
                }
                Score::Reach => {}
            }
        }
        Ok(if self.score == Score::Running { sum } else { env.goal_distance() })
    }
}

impl CostModel for SimulatorCost {
    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        if env.spec().id != self.id {
            return Err(Error::mismatch("showing a world to a simulator", &env.spec().id, &self.id));
        }
        if slot >= self.shown.len() {
            self.shown.resize(slot + 1, None);
        }
        self.shown[slot] = Some(env.snapshot());
        Ok(())
    }

    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.present.clear();
        for &slot in envs {
            // Taken, not copied: a world that is not shown again must not be planned from where it was.
            let Some(world) = self.shown.get_mut(slot).and_then(Option::take) else {
                return Err(Error::config(
                    format!("planning in slot {slot} with a simulator"),
                    "the world was not shown",
                    "call Policy::observe_envs with the worlds before Policy::act",
                ));
            };
            self.present.push(world);
        }
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        if envs != self.present.len() || dim != self.codec.space().dim() {
            return Err(Error::mismatch(
                "scoring candidates in a simulator",
                format!("{envs} environments, {dim} numbers a model step"),
                format!("{} and {}", self.present.len(), self.codec.space().dim()),
            ));
        }
        let (this, len) = (&*self, horizon * dim);
        let groups = actions.par_chunks(GROUP * len).zip(costs.par_chunks_mut(GROUP)).enumerate();
        groups.try_for_each(|(group, (actions, costs))| {
            let mut simulator = this.borrow()?;
            for (i, (actions, cost)) in actions.chunks_exact(len).zip(costs).enumerate() {
                let start = &this.present[(group * GROUP + i) / samples];
                #[allow(clippy::cast_possible_truncation)]
                let judged = this.play(&mut simulator, start, actions)? as f32;
                *cost = judged;
            }
            this.put_back(simulator);
            Ok(())
        })
    }
}
