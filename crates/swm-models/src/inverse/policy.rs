//! [`InversePolicy`]: acting with an inverse-dynamics network.

use super::InverseCheckpoint;
use crate::lewm::pixels;
use crate::nn::parameters::IntoF32;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use std::time::Instant;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result};

/// Does what the network says leads from the picture to the goal's picture, a model step at a time.
pub struct InversePolicy {
    checkpoint: InverseCheckpoint,
    /// Bounds of an environment action.
    bounds: Vec<(f32, f32)>,
    slots: Vec<Slot>,
    latencies: Vec<f64>,
}

#[derive(Default)]
struct Slot {
    /// The latent of the goal, once it was seen.
    goal: Option<Vec<f32>>,
    /// The actions of the present model step, in environment units, and how many of their numbers are done.
    actions: Vec<f32>,
    done: usize,
    due: bool,
    failed: Option<Error>,
}

impl InversePolicy {
    /// A policy for `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the network was trained for other actions.
    pub fn new(checkpoint: InverseCheckpoint, spec: &EnvSpec, slots: usize) -> Result<Self> {
        checkpoint.world.facts.action.check(spec)?;
        #[allow(clippy::cast_possible_truncation)]
        let bounds = (0..spec.action_dim())
            .map(|i| {
                let (low, high) = spec.action_space.bounds(i);
                (low as f32, high as f32)
            })
            .collect();
        Ok(Self { checkpoint, bounds, slots: (0..slots).map(|_| Slot::default()).collect(), latencies: vec![] })
    }
}

/// The actions of a slot's next model step, in environment units.
fn decide(checkpoint: &InverseCheckpoint, slot: &mut Slot, infos: &Batch, row: usize) -> Result<Vec<f32>> {
    let device = Device::flex();
    let world = &checkpoint.world;
    let encode = |column: &str| {
        let patches = pixels::patches(&world.config.model, infos.row(row).get::<u8>(column)?, &device)?;
        Ok::<_, Error>(world.model.encode(patches).into_data().try_into_vec_as_f32())
    };
    let mut pair = encode("pixels")?;
    let goal = match &slot.goal {
        Some(goal) => goal.clone(),
        None => encode("goal")?,
    };
    pair.extend_from_slice(&goal);
    slot.goal = Some(goal);
    let width = pair.len();
    let said = checkpoint.model.forward(Tensor::from_data(TensorData::new(pair, [1, width]), &device));
    let model = said.into_data().try_into_vec_as_f32();
    let mut actions = vec![0.0; model.len()];
    let dim = world.facts.action.dim();
    for (to, from) in actions.chunks_exact_mut(dim).zip(model.chunks_exact(dim)) {
        world.facts.action.to_env(from, to);
    }
    Ok(actions)
}

impl Policy for InversePolicy {
    fn begin(&mut self, slot: usize, _: Key) {
        self.slots[slot] = Slot::default();
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index("action")?;
        for name in ["pixels", "goal"] {
            pixels::check(&self.checkpoint.world.config.model, infos.schema(), name)?;
        }
        for (slot, &active) in self.slots.iter_mut().zip(active) {
            slot.due = active && slot.done == slot.actions.len();
        }
        let begun = Instant::now();
        let (checkpoint, bounds) = (&self.checkpoint, &self.bounds);
        self.slots.par_iter_mut().enumerate().filter(|(_, slot)| slot.due).for_each(|(row, slot)| {
            match decide(checkpoint, slot, infos, row) {
                Ok(decided) => {
                    slot.actions = decided;
                    slot.done = 0;
                    for (value, &(low, high)) in slot.actions.iter_mut().zip(bounds.iter().cycle()) {
                        *value = value.clamp(low, high);
                    }
                }
                Err(error) => slot.failed = Some(error),
            }
        });
        if let Some(error) = self.slots.iter_mut().find_map(|slot| slot.failed.take()) {
            return Err(error);
        }
        let due = self.slots.iter().filter(|slot| slot.due).count();
        if due > 0 {
            #[allow(clippy::cast_precision_loss)]
            let share = begun.elapsed().as_secs_f64() / due as f64;
            self.latencies.extend(std::iter::repeat_n(share, due));
        }
        let dim = self.bounds.len();
        for (row, slot) in self.slots.iter_mut().enumerate().filter(|&(row, _)| active[row]) {
            actions.row_mut(row).set(column, &slot.actions[slot.done..][..dim]);
            slot.done += dim;
        }
        Ok(())
    }

    /// Seconds each decision took, encodings included: environments decided together share their time equally.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
