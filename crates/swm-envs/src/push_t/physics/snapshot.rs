//! Converts the state of a [`Simulation`] to bytes and back: bodies, trees, pairs and contacts, on which the next step
//! depends.

use super::simulation::Simulation;
use bytemuck::Pod;

impl Simulation {
    /// Appends the state to `bytes`, without the shapes and walls, which never change during an episode.
    pub fn save(&self, bytes: &mut Vec<u8>) {
        append_items(bytes, &self.bodies);
        append_items(bytes, &self.tree.nodes);
        append_items(bytes, &[self.tree.root, self.tree.spare, self.tree_stamp, self.stamp]);
        append_items(bytes, &self.pairs);
        append_items(bytes, &self.arbiters);
        append_items(bytes, &self.active);
    }

    /// Reads a state that [`Simulation::save`] wrote for the same shapes, and advances `bytes` past it. Returns `None`,
    /// and leaves the simulation in an unspecified state, when the bytes are invalid.
    pub fn load(&mut self, bytes: &mut &[u8]) -> Option<()> {
        self.bodies = take_array(bytes)?;
        take(bytes, &mut self.tree.nodes)?;
        [self.tree.root, self.tree.spare, self.tree_stamp, self.stamp] = take_array(bytes)?;
        take(bytes, &mut self.pairs)?;
        take(bytes, &mut self.arbiters)?;
        take(bytes, &mut self.active)?;
        for i in 0..self.shapes.len() {
            let shape = &mut self.shapes[i];
            shape.update(&self.bodies[shape.body]);
        }
        Some(())
    }
}

/// Appends the number of items, then the items.
pub fn append_items<T: Pod>(bytes: &mut Vec<u8>, items: &[T]) {
    bytes.extend_from_slice(&(items.len() as u64).to_le_bytes());
    bytes.extend_from_slice(bytemuck::cast_slice(items));
}

/// Reads items that [`append_items`] wrote into a vector.
pub fn take<T: Pod>(bytes: &mut &[u8], items: &mut Vec<T>) -> Option<()> {
    items.clear();
    items.extend(take_items::<T>(bytes)?);
    Some(())
}

/// Reads exactly `N` items that [`append_items`] wrote.
pub fn take_array<T: Pod, const N: usize>(bytes: &mut &[u8]) -> Option<[T; N]> {
    let mut items = take_items(bytes)?;
    let mut array = [T::zeroed(); N];
    for item in &mut array {
        *item = items.next()?;
    }
    items.next().is_none().then_some(array)
}

fn take_items<'a, T: Pod>(bytes: &mut &'a [u8]) -> Option<impl Iterator<Item = T> + use<'a, T>> {
    let (head, rest) = bytes.split_first_chunk::<8>()?;
    let len = usize::try_from(u64::from_le_bytes(*head)).ok()?.checked_mul(size_of::<T>())?;
    let (body, rest) = rest.split_at_checked(len)?;
    *bytes = rest;
    Some(body.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned::<T>))
}
