//! [`Policy`]: reads the infos of all environments of a pool at once and fills one action row for each.
//!
//! A policy's randomness is keyed by the episode that a slot plays, not by the slot, so an episode has the same actions
//! in every slot.

use crate::batch::{Batch, DType, RowMut, RowRef};
use crate::parallelism::Parallelism;
use crate::run::Interrupt;
use crate::{EnvPool, EnvSpec, Error, Key, Result, Rng, columns};
use std::time::Duration;

/// The shortest work of experts that may be shared: the policy enters the pool of threads for it, which takes longer than
/// what [`ExpertPolicy`] measures itself.
const HAND_OVER: Duration = Duration::from_micros(50);

/// Chooses the actions of the environments of a pool.
pub trait Policy: Send {
    /// Starts an episode in `slot`; `key` is the key of the episode.
    fn begin(&mut self, slot: usize, key: Key);

    /// Fills the `action` rows of the active slots.
    ///
    /// # Errors
    /// When the infos lack a column that the policy reads, or its model fails.
    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()>;

    /// Reads the environments directly, before [`Policy::act`]. Only policies with privileged information, such as
    /// policies that plan in a simulator, override this method.
    ///
    /// # Errors
    /// When the policy does not support an environment.
    fn observe_envs(&mut self, _envs: &EnvPool, _active: &[bool]) -> Result<()> {
        Ok(())
    }

    /// As [`Policy::act`], for policies that may act for long, such as planners: checks `interrupt` from time to time.
    ///
    /// # Errors
    /// As [`Policy::act`], and the error of `interrupt`.
    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        _interrupt: &dyn Interrupt,
    ) -> Result<()> {
        self.act(infos, active, actions)
    }

    /// Whether [`Policy::act`] uses several threads. If not, `act` runs on the calling thread.
    fn uses_threads(&self) -> bool {
        true
    }

    /// The duration of each plan since the last call, in seconds, for policies that plan.
    fn take_latencies(&mut self) -> Vec<f64> {
        vec![]
    }
}

/// Samples actions uniformly from the action space.
pub struct RandomPolicy {
    spec: EnvSpec,
    rngs: Vec<Rng>,
}

impl RandomPolicy {
    /// A random policy for `slots` environments.
    pub fn new(spec: &EnvSpec, slots: usize) -> Self {
        Self { spec: spec.clone(), rngs: vec![Key::new(0).rng(); slots] }
    }
}

impl Policy for RandomPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        self.rngs[slot] = key.with("random policy").rng();
    }

    fn act(&mut self, _infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(columns::ACTION)?;
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let action = self.spec.action_space.sample(&mut self.rngs[slot]);
            write_action(&mut actions.row_mut(slot), column, &action);
        }
        Ok(())
    }

    fn uses_threads(&self) -> bool {
        false
    }
}

/// A scripted policy of one environment: reads the infos row of the environment and writes the action.
pub trait Expert: Send {
    /// Starts an episode.
    fn begin(&mut self, key: Key);

    /// Writes the action for an infos row, `[dim]`.
    ///
    /// # Errors
    /// When the row lacks a column that the expert reads.
    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()>;
}

/// A policy of one [`Expert`] per slot.
pub struct ExpertPolicy {
    slots: Vec<ExpertSlot>,
    parallelism: Parallelism,
}

/// The expert of one slot, its last action, `[dim]`, and its error.
struct ExpertSlot {
    expert: Box<dyn Expert>,
    action: Vec<f64>,
    failed: Option<Error>,
}

impl ExpertPolicy {
    /// A policy of these experts, one per slot.
    pub fn new(spec: &EnvSpec, experts: Vec<Box<dyn Expert>>) -> Self {
        let slot_expert = |expert| ExpertSlot { expert, action: vec![0.0; spec.action_dim()], failed: None };
        Self { slots: experts.into_iter().map(slot_expert).collect(), parallelism: Parallelism::above(HAND_OVER) }
    }
}

impl Policy for ExpertPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        self.slots[slot].expert.begin(key.with("expert"));
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(columns::ACTION)?;
        let work = |slot: usize, mut row: RowMut<'_>, slot_expert: &mut ExpertSlot| {
            if active[slot] {
                slot_expert.failed = slot_expert.expert.act(infos.row(slot), &mut slot_expert.action).err();
                write_action(&mut row, column, &slot_expert.action);
            }
        };
        let serial = !self.uses_threads();
        let clock = self.parallelism.clock(self.slots.len());
        if serial {
            actions.zip_mut(&mut self.slots, work);
        } else {
            actions.par_zip_mut(&mut self.slots, work);
        }
        if let Some(clock) = clock {
            self.parallelism.record(serial, self.slots.len(), clock.elapsed());
        }
        self.slots.iter_mut().find_map(|slot_expert| slot_expert.failed.take()).map_or(Ok(()), Err)
    }

    fn uses_threads(&self) -> bool {
        !self.parallelism.is_serial(self.slots.len())
    }
}

/// Writes an action, `[dim]`, in the type of its column.
pub fn write_action(row: &mut RowMut<'_>, column: usize, action: &[f64]) {
    match row.schema().columns()[column].dtype {
        DType::Float32 => {
            for (to, &from) in row.at::<f32>(column).iter_mut().zip(action) {
                *to = from as f32;
            }
        }
        _ => {
            for (to, &from) in row.at::<i64>(column).iter_mut().zip(action) {
                *to = from as i64;
            }
        }
    }
}
