//! [`SimulatorCost`]: the true simulator as a cost model, so that any solver can be run with perfect dynamics.
//!
//! Planning with the simulator gives an upper bound on performance and tests solvers without model errors: a failure is
//! due to the search, its settings or the cost. The model reads the environments ([`CostModel::observe_env`]), so
//! [`MpcPolicy`](crate::MpcPolicy) must receive them through `observe_envs`.
//!
//! [`SimulatedLatents`] has the true dynamics as well, but the cost of a world model: the distance of latents.
//!
//! Every candidate is played from a snapshot of the environment in a private simulator, with the actions that the
//! policy would execute (`Playback`). A cost depends only on the snapshot and the candidate.

mod latents;
mod playback;

pub use latents::SimulatedLatents;

use crate::mpc::ActionScale;
use playback::{Playback, Simulator};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{Batch, Candidates, CostModel, Env, Result, Snapshot};

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
    /// Minus the sum of the rewards, up to the end of the episode.
    Reward,
}

impl Score {
    /// The names of all scores, in their order.
    pub const NAMES: [&str; 5] = ["terminal", "running", "reach", "success", "reward"];
}

/// The simulator as a model.
pub struct SimulatorCost {
    playback: Playback,
    score: Score,
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
        Ok(Self { playback: Playback::new(Box::new(make), scale, action_block)?, score })
    }

    /// Plays a candidate, `[horizon, dim]`; returns its cost.
    fn play(&self, simulator: &mut Simulator, start: &Snapshot, actions: &[f32]) -> Result<f64> {
        simulator.env.restore(start)?;
        let width = self.playback.width();
        let mut sum = 0.0;
        for (step, planned) in actions.chunks_exact(width).enumerate() {
            let outcome = self.playback.step(simulator, planned)?;
            let env = &*simulator.env;
            match self.score {
                Score::Terminal => {}
                Score::Reward => {
                    sum -= outcome.reward;
                    if outcome.terminated || outcome.truncated {
                        return Ok(sum);
                    }
                }
                Score::Running => sum += env.goal_distance(),
                Score::Reach | Score::Success if env.is_success() => {
                    let steps = actions.len() / width;
                    return Ok((step as f64 + 1.0 - steps as f64) / steps as f64);
                }
                Score::Reach | Score::Success => {}
            }
        }
        Ok(match self.score {
            Score::Terminal | Score::Reach => simulator.env.goal_distance(),
            Score::Running | Score::Reward => sum,
            Score::Success => simulator.env.success_distance(),
        })
    }
}

impl CostModel for SimulatorCost {
    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.playback.observe_env(slot, env)
    }

    fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
        self.playback.observe(envs)
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.playback.check(&candidates)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let (this, len) = (&*self, horizon * dim);
        let groups = actions.par_chunks(GROUP * len).zip(costs.par_chunks_mut(GROUP)).enumerate();
        groups.try_for_each(|(group, (actions, costs))| {
            this.playback.with(|simulator| {
                for (i, (actions, cost)) in actions.chunks_exact(len).zip(costs).enumerate() {
                    let start = this.playback.start((group * GROUP + i) / samples);
                    *cost = this.play(simulator, start, actions)? as f32;
                }
                Ok(())
            })
        })
    }
}
