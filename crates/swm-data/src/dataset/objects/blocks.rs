//! [`BlockCache`]: an in-memory cache of blocks of objects.
//!
//! A request takes as long as transferring a megabyte. Training reads small ranges in random order, so the cache
//! fetches whole blocks, several neighbouring blocks per request.

use bytes::{Bytes, BytesMut};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path as StorePath;
use object_store::{ObjectStore, ObjectStoreExt as _};
use std::collections::{HashMap, VecDeque};
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Capacity of the cache in bytes.
const CAPACITY: u64 = 1 << 30;

/// Block size in bytes if all blocks fit into the cache: each byte is then fetched at most once.
const LARGE: u64 = 1 << 20;

/// Block size in bytes if most blocks are evicted before they are read again.
const SMALL: u64 = 64 << 10;

/// Maximum number of neighbouring blocks per request.
const MAX_BLOCKS_PER_REQUEST: u64 = 8;

/// Ranges of one object to read.
pub(crate) struct ObjectRanges {
    /// Path of the object.
    pub path: StorePath,
    /// Size of the object in bytes.
    pub size: u64,
    /// Byte ranges.
    pub ranges: Vec<Range<u64>>,
}

/// Cached blocks of some objects; the oldest blocks are evicted first.
pub(crate) struct BlockCache {
    block: u64,
    capacity: u64,
    cached: Mutex<Cached>,
    /// Serialises fetches: after waiting, a reader often finds its blocks in the cache.
    fetching: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Cached {
    blocks: HashMap<(StorePath, u64), Bytes>,
    order: VecDeque<(StorePath, u64)>,
    bytes: u64,
}

impl BlockCache {
    /// Creates a cache for objects that have `total` bytes together.
    pub(crate) fn new(total: u64) -> Self {
        Self::with_block_size(if total <= CAPACITY { LARGE } else { SMALL }, CAPACITY)
    }

    fn with_block_size(block: u64, capacity: u64) -> Self {
        Self { block, capacity, cached: Mutex::default(), fetching: tokio::sync::Mutex::default() }
    }

    fn cached(&self) -> MutexGuard<'_, Cached> {
        self.cached.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads all ranges, returned in the given order.
    pub(crate) async fn read(
        &self,
        store: &dyn ObjectStore,
        objects: &[ObjectRanges],
    ) -> object_store::Result<Vec<Vec<Bytes>>> {
        let mut held = HashMap::new();
        if !self.hold_cached(objects, &mut held) {
            let _guard = self.fetching.lock().await;
            // Another reader may have fetched these blocks in the meantime.
            self.hold_cached(objects, &mut held);
            self.fetch(store, objects, &mut held).await?;
        }
        objects
            .iter()
            .map(|object| object.ranges.iter().map(|range| self.read_range(object, range, &held)).collect())
            .collect()
    }

    /// The indices of the blocks that overlap a range.
    fn block_indices(&self, range: &Range<u64>) -> Range<u64> {
        if range.is_empty() { 0..0 } else { range.start / self.block..range.end.div_ceil(self.block) }
    }

    /// Copies references to the requested cached blocks into `held`, so that they outlive eviction. Returns whether all
    /// requested blocks are cached.
    fn hold_cached(&self, objects: &[ObjectRanges], held: &mut HashMap<(StorePath, u64), Bytes>) -> bool {
        let cached = self.cached();
        let mut complete = true;
        for object in objects {
            for block in object.ranges.iter().flat_map(|range| self.block_indices(range)) {
                let key = (object.path.clone(), block);
                match cached.blocks.get(&key) {
                    Some(bytes) => drop(held.insert(key, bytes.clone())),
                    None => complete = false,
                }
            }
        }
        complete
    }

    /// Fetches the requested blocks that are not in `held`, several neighbouring blocks per request.
    async fn fetch(
        &self,
        store: &dyn ObjectStore,
        objects: &[ObjectRanges],
        held: &mut HashMap<(StorePath, u64), Bytes>,
    ) -> object_store::Result<()> {
        let mut requests: Vec<(&ObjectRanges, Range<u64>)> = vec![];
        for object in objects {
            let mut missing: Vec<u64> = object.ranges.iter().flat_map(|range| self.block_indices(range)).collect();
            missing.sort_unstable();
            missing.dedup();
            missing.retain(|&block| !held.contains_key(&(object.path.clone(), block)));
            for block in missing {
                match requests.last_mut() {
                    Some((last, run))
                        if last.path == object.path
                            && run.end == block
                            && run.end - run.start < MAX_BLOCKS_PER_REQUEST =>
                    {
                        run.end += 1;
                    }
                    _ => requests.push((object, block..block + 1)),
                }
            }
        }
        let ranges: Vec<(StorePath, Range<u64>)> = requests
            .iter()
            .map(|(object, run)| (object.path.clone(), run.start * self.block..(run.end * self.block).min(object.size)))
            .collect();
        let fetched: Vec<Bytes> = futures::stream::iter(ranges)
            .map(|(path, range)| async move { store.get_range(&path, range).await })
            .buffered(super::REQUESTS)
            .try_collect()
            .await?;
        let mut cached = self.cached();
        for ((object, run), bytes) in requests.into_iter().zip(fetched) {
            for (at, block) in run.enumerate() {
                let start = (at as u64 * self.block) as usize;
                // Copies the block, because a slice would keep the whole response in memory.
                let copy = Bytes::copy_from_slice(&bytes[start..bytes.len().min(start + self.block as usize)]);
                held.insert((object.path.clone(), block), copy.clone());
                cached.insert((object.path.clone(), block), copy, self.capacity);
            }
        }
        Ok(())
    }

    fn read_range(
        &self,
        object: &ObjectRanges,
        range: &Range<u64>,
        held: &HashMap<(StorePath, u64), Bytes>,
    ) -> object_store::Result<Bytes> {
        let mut parts = vec![];
        for block in self.block_indices(range) {
            let start = block * self.block;
            let (from, to) = (range.start.max(start) - start, range.end.min(start + self.block) - start);
            let bytes = held.get(&(object.path.clone(), block)).filter(|bytes| to <= bytes.len() as u64);
            let Some(bytes) = bytes else {
                return Err(object_store::Error::Generic {
                    store: "object",
                    source: "the object is shorter than expected".into(),
                });
            };
            parts.push(bytes.slice(from as usize..to as usize));
        }
        match parts.len() {
            1 => Ok(parts.swap_remove(0)),
            _ => {
                let mut joined = BytesMut::with_capacity((range.end - range.start) as usize);
                parts.iter().for_each(|part| joined.extend_from_slice(part));
                Ok(joined.freeze())
            }
        }
    }
}

impl Cached {
    fn insert(&mut self, key: (StorePath, u64), bytes: Bytes, capacity: u64) {
        self.bytes += bytes.len() as u64;
        if let Some(duplicate) = self.blocks.insert(key.clone(), bytes) {
            self.bytes -= duplicate.len() as u64;
        } else {
            self.order.push_back(key);
        }
        while self.bytes > capacity
            && let Some(oldest) = self.order.pop_front()
            && let Some(bytes) = self.blocks.remove(&oldest)
        {
            self.bytes -= bytes.len() as u64;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use object_store::memory::InMemory;
    use rand::Rng as _;
    use swm_core::Key;

    #[test]
    fn block_cache_reads_byte_ranges_within_its_capacity() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("creating the runtime");
        runtime.block_on(async {
            let store = InMemory::new();
            let contents: Vec<Vec<u8>> = [1000, 37, 256].map(|n| (0..n).map(|i| (i * i / 3) as u8).collect()).into();
            let paths = ["a", "b", "c"].map(StorePath::from);
            for (path, content) in paths.iter().zip(&contents) {
                store.put(path, content.clone().into()).await.expect("storing an object");
            }
            let blocks = BlockCache::with_block_size(16, 200);
            let mut rng = Key::new(3).rng();
            for _ in 0..50 {
                let objects: Vec<ObjectRanges> = (0..3)
                    .map(|index| {
                        let size = contents[index].len() as u64;
                        let ranges = (0..5).map(|_| {
                            let start = rng.random_range(0..=size);
                            start..rng.random_range(start..=size.min(start + 70))
                        });
                        ObjectRanges { path: paths[index].clone(), size, ranges: ranges.collect() }
                    })
                    .collect();
                let read = blocks.read(&store, &objects).await.expect("reading the ranges");
                for ((object, read), content) in objects.iter().zip(&read).zip(&contents) {
                    for (range, bytes) in object.ranges.iter().zip(read) {
                        assert_eq!(bytes, &content[range.start as usize..range.end as usize]);
                    }
                }
                let cached = blocks.cached();
                assert!(cached.bytes <= 200 && cached.order.len() == cached.blocks.len());
            }
            let missing = ObjectRanges { path: "none".into(), size: 10, ranges: vec![0..4, 5..6] };
            assert!(blocks.read(&store, &[missing]).await.is_err());
        });
    }
}
