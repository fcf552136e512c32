//! [`History`]: past frames and actions of every slot, for models that condition on more than one frame.
//!
//! A model step is `action_block` environment steps, so the history holds the frame at the beginning of each past model
//! step and the block of actions executed in it.

use swm_core::columns::PIXELS;
use swm_core::{Batch, ColumnSpec, DType, Result, Schema};

/// The past model steps of every slot.
pub(crate) struct History {
    /// Model steps stored before the present one.
    past: usize,
    /// Environment actions in a model step.
    action_block: usize,
    /// Plan values of one environment action.
    action_dim: usize,
    slots: Vec<Slot>,
    /// The observed columns extended by the history; allocated when their schema is first known.
    infos: Option<Infos>,
}

struct Infos {
    batch: Batch,
    /// The index of the column of frames; `None` if the observations have no frames.
    pixels: Option<usize>,
    /// The number of observed columns. The history's columns follow them.
    observed: usize,
}

#[derive(Clone, Default)]
struct Slot {
    /// Environment steps in this episode.
    steps: usize,
    /// Past model steps that are filled, at most `past`.
    length: usize,
    /// The frame at the beginning of the present model step.
    present: Vec<u8>,
    /// Past frames, oldest first.
    frames: Vec<u8>,
    /// The last `past * action_block` executed actions in model units, oldest first.
    actions: Vec<f32>,
}

impl History {
    /// Creates the history of `slots` environments, with past actions of zero.
    pub fn new(past: usize, action_block: usize, action_dim: usize, slots: usize) -> Self {
        let empty = Slot { actions: vec![0.0; past * action_block * action_dim], ..Slot::default() };
        Self { past, action_block, action_dim, slots: vec![empty; slots], infos: None }
    }

    /// Clears a slot's history when a new episode begins.
    pub fn begin(&mut self, slot: usize) {
        let slot = &mut self.slots[slot];
        (slot.steps, slot.length) = (0, 0);
        slot.frames.fill(0);
        slot.actions.fill(0.0);
    }

    /// Stores the observation of a slot, before it acts.
    pub fn observe(&mut self, slot: usize, observed: &Batch) -> Result<()> {
        let infos = match &mut self.infos {
            Some(infos) => infos,
            none => none.insert(Infos::new(observed.schema(), self.past, self.action_block * self.action_dim)?),
        };
        let slot_index = slot;
        let slot = &mut self.slots[slot];
        if !slot.steps.is_multiple_of(self.action_block) {
            return Ok(());
        }
        if slot.steps > 0 {
            slot.length = (slot.length + 1).min(self.past);
            let frame = slot.present.len();
            shift_in(&mut slot.frames, &slot.present, frame);
        }
        if let Some(pixels) = infos.pixels {
            let n = observed.schema().columns()[pixels].row_bytes();
            slot.present.clear();
            slot.present.extend_from_slice(&observed.bytes(pixels)[slot_index * n..][..n]);
            slot.frames.resize(self.past * n, 0);
        }
        Ok(())
    }

    /// Stores the action a slot executes, in model units.
    pub fn push_action(&mut self, slot: usize, action: &[f32]) {
        let slot = &mut self.slots[slot];
        shift_in(&mut slot.actions, action, self.action_dim);
        slot.steps += 1;
    }

    /// Returns the observed columns and the history's columns. Only the rows of `slots` are up to date.
    pub fn extend(&mut self, observed: &Batch, slots: &[usize]) -> Result<&Batch> {
        let infos = match &mut self.infos {
            Some(infos) => infos,
            none => none.insert(Infos::new(observed.schema(), self.past, self.action_block * self.action_dim)?),
        };
        infos.batch.resize(observed.rows());
        for &slot in slots {
            for (column, spec) in observed.schema().columns().iter().enumerate() {
                let n = spec.row_bytes();
                infos.batch.bytes_mut(column)[slot * n..][..n]
                    .copy_from_slice(&observed.bytes(column)[slot * n..][..n]);
            }
            let mut row = infos.batch.row_mut(slot);
            let past = &self.slots[slot];
            row.set(infos.observed, &[past.length as i32]);
            row.set(infos.observed + 1, &past.actions);
            if infos.pixels.is_some() {
                row.set(infos.observed + 2, &past.frames);
            }
        }
        Ok(&infos.batch)
    }
}

impl Infos {
    fn new(observed: &Schema, past: usize, action: usize) -> Result<Self> {
        let mut columns = observed.columns().to_vec();
        columns.push(ColumnSpec::new("history.length", DType::Int32, []));
        columns.push(ColumnSpec::new("history.action", DType::Float32, [past, action]));
        let pixels = observed.find(PIXELS);
        if let Some(pixels) = pixels {
            let shape: Vec<usize> =
                [past].into_iter().chain(observed.columns()[pixels].shape.iter().copied()).collect();
            columns.push(ColumnSpec::new("history.pixels", DType::U8, shape));
        }
        Ok(Self { batch: Batch::zeros(&Schema::new(columns)?, 0), pixels, observed: observed.columns().len() })
    }
}

/// Drops the first `n` items and appends the `n` items of `added`.
fn shift_in<T: Copy>(items: &mut [T], added: &[T], n: usize) {
    if items.len() >= n && n > 0 {
        items.copy_within(n.., 0);
        let end = items.len() - n;
        items[end..].copy_from_slice(added);
    }
}
