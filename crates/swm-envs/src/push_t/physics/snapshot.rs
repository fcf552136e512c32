//! A world as bytes and back: bodies, trees, pairs and what contacts remember, everything the next step depends on.

use super::World;
use bytemuck::Pod;

impl World {
    /// Appends the state to `bytes`. What never changes in an episode (shapes, walls) is not part of it.
    pub fn save(&self, bytes: &mut Vec<u8>) {
        put(bytes, &self.bodies);
        put(bytes, &self.tree.nodes);
        put(bytes, &[self.tree.root, self.tree.spare, self.tree_stamp, self.stamp]);
        put(bytes, &self.pairs);
        put(bytes, &self.arbiters);
        put(bytes, &self.active);
    }

    /// Reads a state that [`World::save`] wrote for a world of the same shapes; what follows it stays in `bytes`.
    /// Returns `None`, with the world in an unspecified state, when the bytes are none.
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

/// Appends a number of items and the items.
pub fn put<T: Pod>(bytes: &mut Vec<u8>, items: &[T]) {
    bytes.extend_from_slice(&(items.len() as u64).to_le_bytes());
    bytes.extend_from_slice(bytemuck::cast_slice(items));
}

/// Reads what [`put`] wrote.
pub fn take<T: Pod>(bytes: &mut &[u8], items: &mut Vec<T>) -> Option<()> {
    items.clear();
    items.extend(take_items::<T>(bytes)?);
    Some(())
}

/// Reads `N` items that [`put`] wrote.
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
