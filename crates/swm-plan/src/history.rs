//! What happened before the present of an episode, for models that condition on more than one frame.
//!
//! A model step is `action_block` environment steps, so the past is seen at model steps only: the picture at the
//! beginning of each and the block of actions executed in it.

use swm_core::{Batch, ColumnSpec, DType, Result, Schema};

/// The last model steps of every slot.
pub(crate) struct History {
    /// Model steps kept before the present one.
    past: usize,
    /// Environment actions in a model step, and numbers in one of them.
    action_block: usize,
    action_dim: usize,
    slots: Vec<Slot>,
    /// The world's infos and the past beside them; made when the infos' schema is first seen.
    infos: Option<Infos>,
}

struct Infos {
    batch: Batch,
    /// The picture's column in the world's infos, if they have one.
    pixels: Option<usize>,
    /// How many columns come from the world; the past's follow.
    world: usize,
}

#[derive(Clone, Default)]
struct Slot {
    /// Environment steps acted in this episode.
    steps: usize,
    /// Model steps of the past that are filled, at most `past`.
    length: usize,
    /// The picture at the beginning of the present model step.
    present: Vec<u8>,
    /// Pictures of the past, oldest first, the latest at the end.
    frames: Vec<u8>,
    /// Actions of the past in model units, oldest first; the last block is the one being executed.
    actions: Vec<f32>,
}

impl History {
    pub fn new(past: usize, action_block: usize, action_dim: usize, slots: usize) -> Self {
        let empty = Slot { actions: vec![0.0; past * action_block * action_dim], ..Slot::default() };
        Self { past, action_block, action_dim, slots: vec![empty; slots], infos: None }
    }

    /// Forgets a slot's past: a new episode begins.
    pub fn begin(&mut self, slot: usize) {
        let slot = &mut self.slots[slot];
        (slot.steps, slot.length) = (0, 0);
        slot.frames.fill(0);
        slot.actions.fill(0.0);
    }

    /// Notes what a slot sees, before it acts.
    pub fn see(&mut self, slot: usize, world: &Batch) -> Result<()> {
        let infos = match &mut self.infos {
            Some(infos) => infos,
            none => none.insert(Infos::new(world.schema(), self.past, self.action_block * self.action_dim)?),
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
            let n = world.schema().columns()[pixels].row_bytes();
            slot.present.clear();
            slot.present.extend_from_slice(&world.bytes(pixels)[slot_index * n..][..n]);
            slot.frames.resize(self.past * n, 0);
        }
        Ok(())
    }

    /// Notes the action a slot executes, in model units.
    pub fn acted(&mut self, slot: usize, action: &[f32]) {
        let slot = &mut self.slots[slot];
        shift_in(&mut slot.actions, action, self.action_dim);
        slot.steps += 1;
    }

    /// The world's infos with the past beside them, for these slots (other rows are stale).
    pub fn infos(&mut self, world: &Batch, slots: &[usize]) -> Result<&Batch> {
        let infos = match &mut self.infos {
            Some(infos) => infos,
            none => none.insert(Infos::new(world.schema(), self.past, self.action_block * self.action_dim)?),
        };
        infos.batch.resize(world.rows());
        for &slot in slots {
            for (column, spec) in world.schema().columns().iter().enumerate() {
                let n = spec.row_bytes();
                infos.batch.bytes_mut(column)[slot * n..][..n].copy_from_slice(&world.bytes(column)[slot * n..][..n]);
            }
            let mut row = infos.batch.row_mut(slot);
            let past = &self.slots[slot];
            #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
            row.set(infos.world, &[past.length as i32]);
            row.set(infos.world + 1, &past.actions);
            if infos.pixels.is_some() {
                row.set(infos.world + 2, &past.frames);
            }
        }
        Ok(&infos.batch)
    }
}

impl Infos {
    fn new(world: &Schema, past: usize, action: usize) -> Result<Self> {
        let mut columns = world.columns().to_vec();
        columns.push(ColumnSpec::new("history.length", DType::Int32, []));
        columns.push(ColumnSpec::new("history.action", DType::Float32, [past, action]));
        let pixels = world.find("pixels");
        if let Some(pixels) = pixels {
            let shape: Vec<usize> = [past].into_iter().chain(world.columns()[pixels].shape.iter().copied()).collect();
            columns.push(ColumnSpec::new("history.pixels", DType::U8, shape));
        }
        Ok(Self { batch: Batch::zeros(&Schema::new(columns)?, 0), pixels, world: world.columns().len() })
    }
}

/// Drops the first `n` items and puts `item` at the end.
fn shift_in<T: Copy>(items: &mut [T], item: &[T], n: usize) {
    if items.len() >= n && n > 0 {
        items.copy_within(n.., 0);
        let end = items.len() - n;
        items[end..].copy_from_slice(item);
    }
}
