//! [`StartsHash`]: hashes of the initial states and goals of an evaluation.
//!
//! Seeds and dataset rows identify the requested starts. The hashes cover the states after the reset, so they detect a
//! changed reset of an environment.

use crate::starts::Starts;
use crate::world::World;
use std::collections::BTreeMap;
use swm_core::columns::STATE;
use swm_core::{Result, manifest};

/// The bytes of all initial states and goals.
#[derive(Clone, Debug, Default)]
pub struct StartsHash {
    starts: Vec<u8>,
    goals: Vec<u8>,
}

impl StartsHash {
    /// Resets the world to every start and adds its state: the column `state` and the factors of variation to the
    /// starts, the columns whose name starts with `goal` to the goals.
    ///
    /// # Errors
    /// When an environment rejects a start.
    pub fn add(&mut self, world: &mut World, starts: &Starts) -> Result<()> {
        let slots = world.pool().len();
        let columns = &world.spec().columns;
        let state = columns.iter().position(|column| column.name == STATE);
        let goals: Vec<usize> = (0..columns.len()).filter(|&i| columns[i].name.starts_with("goal")).collect();
        for first in (0..starts.len()).step_by(slots) {
            let starting: Vec<(usize, usize)> = (0..slots.min(starts.len() - first)).map(|i| (i, first + i)).collect();
            starts.start(world.pool_mut(), &starting)?;
            for &(slot, _) in &starting {
                let infos = world.pool().infos();
                let bytes = |column: usize| {
                    let n = infos.schema().columns()[column].row_bytes();
                    &infos.bytes(column)[slot * n..][..n]
                };
                self.starts.extend(state.into_iter().flat_map(bytes));
                for (key, values) in world.pool().env(slot).factors().iter() {
                    self.starts.extend_from_slice(key.as_bytes());
                    self.starts.extend(values.iter().flat_map(|value| value.to_le_bytes()));
                }
                self.goals.extend(goals.iter().flat_map(|&column| bytes(column)));
            }
        }
        Ok(())
    }

    /// The BLAKE3 hashes for a manifest: `starts`, and `goals` if the environment has goal columns.
    pub fn hashes(&self) -> BTreeMap<String, String> {
        let named = [("starts", &self.starts), ("goals", &self.goals)];
        let present = named.into_iter().filter(|(_, bytes)| !bytes.is_empty());
        present.map(|(name, bytes)| (name.to_owned(), manifest::hash(bytes))).collect()
    }
}
