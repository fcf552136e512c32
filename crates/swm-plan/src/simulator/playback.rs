//! [`Playback`]: plays candidates in private environments, from snapshots of the environments to plan for.

use crate::mpc::{ActionCodec, ActionScale, Decoded};
use std::sync::{Mutex, PoisonError};
use swm_core::{Candidates, Env, Error, Result, Snapshot, Transition};

/// Makes a private environment.
type Make = Box<dyn Fn() -> Result<Box<dyn Env>> + Send + Sync>;

/// Private environments, and snapshots of those to plan for. A thread reuses an idle environment, or creates one if none is
/// idle.
pub(super) struct Playback {
    make: Make,
    id: String,
    codec: ActionCodec,
    /// Snapshots of the environments passed to `observe_env`, by slot; `observe` removes them.
    received: Vec<Option<Snapshot>>,
    /// Snapshots of the environments to plan from.
    present: Vec<Snapshot>,
    /// Simulators that no thread is using.
    idle: Mutex<Vec<Simulator>>,
}

/// A private environment in which candidates are played.
pub(super) struct Simulator {
    pub env: Box<dyn Env>,
    action: Decoded,
}

impl Playback {
    /// Plays candidates of a policy with this scale and action block.
    ///
    /// # Errors
    /// When the scale does not fit the environment, a model step has no action, or `make` fails.
    pub fn new(make: Make, scale: ActionScale, action_block: usize) -> Result<Self> {
        if action_block == 0 {
            return Err(Error::config("a simulator's action block", "0", "choose at least 1"));
        }
        let first = Simulator { env: make()?, action: Decoded::default() };
        let spec = first.env.spec();
        let (id, codec) = (spec.id.clone(), ActionCodec::new(spec, scale, action_block)?);
        Ok(Self { make, id, codec, received: vec![], present: vec![], idle: Mutex::new(vec![first]) })
    }

    /// The number of plan values that encode one environment action.
    pub fn width(&self) -> usize {
        self.codec.width()
    }

    /// The snapshot of a planned environment.
    pub fn start(&self, env: usize) -> &Snapshot {
        &self.present[env]
    }

    /// Runs `work` with a simulator, which is in any state. One whose work fails is not used again.
    pub fn with<T>(&self, work: impl FnOnce(&mut Simulator) -> Result<T>) -> Result<T> {
        let idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut simulator = match idle {
            Some(simulator) => simulator,
            None => Simulator { env: (self.make)()?, action: Decoded::default() },
        };
        let result = work(&mut simulator)?;
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(simulator);
        Ok(result)
    }

    /// Steps a simulator with one action, `[width]` plan values.
    pub fn step(&self, simulator: &mut Simulator, planned: &[f32]) -> Result<Transition> {
        simulator.env.step(self.codec.decode(planned, &mut simulator.action))
    }

    /// Keeps a snapshot of the environment of a slot, as [`swm_core::CostModel::observe_env`].
    pub fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        if env.spec().id != self.id {
            return Err(Error::mismatch("the environment of a simulator", &env.spec().id, &self.id));
        }
        if slot >= self.received.len() {
            self.received.resize(slot + 1, None);
        }
        self.received[slot] = Some(env.snapshot());
        Ok(())
    }

    /// Chooses the slots to plan for, as [`swm_core::CostModel::observe`].
    pub fn observe(&mut self, envs: &[usize]) -> Result<()> {
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

    /// Checks that candidates fit the observed environments.
    pub fn check(&self, candidates: &Candidates<'_>) -> Result<()> {
        let Candidates { envs, dim, .. } = *candidates;
        if envs == self.present.len() && dim == self.codec.space().dim() {
            return Ok(());
        }
        Err(Error::mismatch(
            "scoring candidates in a simulator",
            format!("{envs} environments, {dim} values per model step"),
            format!("{} and {}", self.present.len(), self.codec.space().dim()),
        ))
    }
}
