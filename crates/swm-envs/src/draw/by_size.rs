//! [`BySize`]: data derived from a background, cached for the few frame sizes that are in use.

use std::ops::{Index, IndexMut};

/// The maximal number of cached sizes; the size added first is dropped first.
const MAX_SIZES: usize = 4;

/// Values cached by frame size, each with a flag that is set while the value is up to date.
pub struct BySize<T> {
    /// Ordered from the most recently added size to the oldest.
    entries: Vec<Entry<T>>,
}

struct Entry<T> {
    size: (usize, usize),
    value: T,
    current: bool,
}

impl<T> Default for BySize<T> {
    fn default() -> Self {
        Self { entries: vec![] }
    }
}

impl<T> BySize<T> {
    /// Marks all values as outdated, because the background changed.
    pub fn invalidate(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.current = false);
    }

    /// Returns the index of the value for a frame size, valid until the next call. `create` makes the value of a new
    /// size, `update` brings an outdated value up to date.
    pub fn slot(
        &mut self,
        width: usize,
        height: usize,
        create: impl FnOnce() -> T,
        update: impl FnOnce(&mut T),
    ) -> usize {
        let size = (width, height);
        let slot = self.entries.iter().position(|entry| entry.size == size).unwrap_or_else(|| {
            self.entries.truncate(MAX_SIZES - 1);
            self.entries.insert(0, Entry { size, value: create(), current: false });
            0
        });
        let entry = &mut self.entries[slot];
        if !entry.current {
            update(&mut entry.value);
            entry.current = true;
        }
        slot
    }

    /// The values of all cached sizes.
    pub fn values_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.entries.iter_mut().map(|entry| &mut entry.value)
    }
}

impl<T> Index<usize> for BySize<T> {
    type Output = T;

    fn index(&self, slot: usize) -> &T {
        &self.entries[slot].value
    }
}

impl<T> IndexMut<usize> for BySize<T> {
    fn index_mut(&mut self, slot: usize) -> &mut T {
        &mut self.entries[slot].value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_updated_once_after_invalidation_and_the_oldest_size_is_dropped() {
        let mut cache = BySize::<u32>::default();
        let get = |cache: &mut BySize<u32>, width| {
            let slot = cache.slot(width, 1, || 0, |value| *value += 1);
            cache[slot]
        };
        assert_eq!([1, 1, 2, 1].map(|width| get(&mut cache, width)), [1, 1, 1, 1]);
        cache.invalidate();
        assert_eq!([1, 3, 4, 5].map(|width| get(&mut cache, width)), [2, 1, 1, 1]);
        assert_eq!(get(&mut cache, 1), 1, "the oldest size was dropped and is created again");
    }
}
