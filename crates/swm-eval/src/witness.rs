//! [`Witness`]: hashes of the worlds that episodes begin in. Seeds and picks say what was asked for; these say what it
//! came to, so that a change in how a world resets does not pass as the same start.

use crate::{Starts, World};
use std::collections::BTreeMap;
use swm_core::{Result, manifest};

/// What the starts of some evaluations came to.
#[derive(Clone, Debug, Default)]
pub struct Witness {
    starts: Vec<u8>,
    goals: Vec<u8>,
}

impl Witness {
    /// Resets the world to every start and notes what it shows: the column `state` and the factors of variation as the
    /// start, the columns whose name begins with `goal` as the goal.
    ///
    /// # Errors
    /// When an environment refuses a start.
    pub fn note(&mut self, world: &mut World, starts: &Starts) -> Result<()> {
        let slots = world.pool().len();
        let columns = &world.spec().columns;
        let state = columns.iter().position(|column| column.name == "state");
        let goals: Vec<usize> = (0..columns.len()).filter(|&i| columns[i].name.starts_with("goal")).collect();
        for first in (0..starts.len()).step_by(slots) {
            let starting: Vec<(usize, usize)> = (0..slots.min(starts.len() - first)).map(|i| (i, first + i)).collect();
            world.start(starts, &starting)?;
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

    /// BLAKE3 hashes of all that was noted, for a manifest: `starts`, and `goals` where the world has columns of them.
    pub fn hashes(&self) -> BTreeMap<String, String> {
        let both = [("starts", &self.starts), ("goals", &self.goals)];
        let noted = both.into_iter().filter(|(_, bytes)| !bytes.is_empty());
        noted.map(|(what, bytes)| (what.to_owned(), manifest::hash(bytes))).collect()
    }
}
