//! [`Blocks`]: parts of objects kept in memory. A request costs as much as a megabyte, so small pieces in random order,
//! as training reads them, are not fetched one by one.

use bytes::{Bytes, BytesMut};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path as StorePath;
use object_store::{ObjectStore, ObjectStoreExt as _};
use std::collections::{HashMap, VecDeque};
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Bytes that are kept.
const ROOM: u64 = 1 << 30;

/// A block where all blocks fit: each is wanted sooner or later.
const LARGE: u64 = 1 << 20;

/// A block where most are gone before they are wanted again.
const SMALL: u64 = 64 << 10;

/// Neighbouring blocks that are fetched at once.
const JOINED: u64 = 8;

/// Pieces of one object that are wanted.
pub(crate) struct Pieces {
    /// The object.
    pub path: StorePath,
    /// Its bytes.
    pub size: u64,
    /// The pieces.
    pub ranges: Vec<Range<u64>>,
}

/// Parts of some objects, the first that were fetched leaving first.
pub(crate) struct Blocks {
    block: u64,
    room: u64,
    kept: Mutex<Kept>,
    /// One reader fetches at a time: what the next one wants has often come by then.
    fetching: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Kept {
    blocks: HashMap<(StorePath, u64), Bytes>,
    order: VecDeque<(StorePath, u64)>,
    bytes: u64,
}

impl Blocks {
    /// For objects of so many bytes together.
    pub(crate) fn new(total: u64) -> Self {
        Self::with(if total <= ROOM { LARGE } else { SMALL }, ROOM)
    }

    fn with(block: u64, room: u64) -> Self {
        Self { block, room, kept: Mutex::default(), fetching: tokio::sync::Mutex::default() }
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The bytes of all pieces, in the given order.
    pub(crate) async fn read(
        &self,
        store: &dyn ObjectStore,
        wanted: &[Pieces],
    ) -> object_store::Result<Vec<Vec<Bytes>>> {
        let mut held = HashMap::new();
        if !self.hold(wanted, &mut held) {
            let _one = self.fetching.lock().await;
            // What another reader fetched meanwhile need not be fetched again.
            self.hold(wanted, &mut held);
            self.fetch(store, wanted, &mut held).await?;
        }
        wanted
            .iter()
            .map(|pieces| pieces.ranges.iter().map(|range| self.piece(pieces, range, &held)).collect())
            .collect()
    }

    /// The blocks that a range touches.
    fn touched(&self, range: &Range<u64>) -> Range<u64> {
        if range.is_empty() { 0..0 } else { range.start / self.block..range.end.div_ceil(self.block) }
    }

    /// Takes hold of the kept blocks that are wanted, so that they stay while they are used; whether these were all.
    fn hold(&self, wanted: &[Pieces], held: &mut HashMap<(StorePath, u64), Bytes>) -> bool {
        let kept = self.kept();
        let mut complete = true;
        for pieces in wanted {
            for block in pieces.ranges.iter().flat_map(|range| self.touched(range)) {
                let key = (pieces.path.clone(), block);
                match kept.blocks.get(&key) {
                    Some(bytes) => drop(held.insert(key, bytes.clone())),
                    None => complete = false,
                }
            }
        }
        complete
    }

    /// Fetches the wanted blocks that are not held, neighbours together.
    async fn fetch(
        &self,
        store: &dyn ObjectStore,
        wanted: &[Pieces],
        held: &mut HashMap<(StorePath, u64), Bytes>,
    ) -> object_store::Result<()> {
        let mut requests: Vec<(&Pieces, Range<u64>)> = vec![];
        for pieces in wanted {
            let mut missing: Vec<u64> = pieces.ranges.iter().flat_map(|range| self.touched(range)).collect();
            missing.sort_unstable();
            missing.dedup();
            missing.retain(|&block| !held.contains_key(&(pieces.path.clone(), block)));
            for block in missing {
                match requests.last_mut() {
                    Some((of, run)) if of.path == pieces.path && run.end == block && run.end - run.start < JOINED => {
                        run.end += 1;
                    }
                    _ => requests.push((pieces, block..block + 1)),
                }
            }
        }
        let places: Vec<(StorePath, Range<u64>)> = requests
            .iter()
            .map(|(of, run)| (of.path.clone(), run.start * self.block..(run.end * self.block).min(of.size)))
            .collect();
        let fetched: Vec<Bytes> = futures::stream::iter(places)
            .map(|(path, range)| async move { store.get_range(&path, range).await })
            .buffered(super::REQUESTS)
            .try_collect()
            .await?;
        let mut kept = self.kept();
        for ((pieces, run), bytes) in requests.into_iter().zip(fetched) {
            for (at, block) in run.enumerate() {
                let start = (at as u64 * self.block) as usize;
                // A copy of its own: a part of the run would keep all of it.
                let part = Bytes::copy_from_slice(&bytes[start..bytes.len().min(start + self.block as usize)]);
                held.insert((pieces.path.clone(), block), part.clone());
                kept.keep((pieces.path.clone(), block), part, self.room);
            }
        }
        Ok(())
    }

    fn piece(
        &self,
        pieces: &Pieces,
        range: &Range<u64>,
        held: &HashMap<(StorePath, u64), Bytes>,
    ) -> object_store::Result<Bytes> {
        let mut parts = vec![];
        for block in self.touched(range) {
            let start = block * self.block;
            let (from, to) = (range.start.max(start) - start, range.end.min(start + self.block) - start);
            let bytes = held.get(&(pieces.path.clone(), block)).filter(|bytes| to <= bytes.len() as u64);
            let Some(bytes) = bytes else {
                return Err(object_store::Error::Generic { store: "object", source: "it ends too early".into() });
            };
            parts.push(bytes.slice(from as usize..to as usize));
        }
        match parts.len() {
            1 => Ok(parts.swap_remove(0)),
            _ => {
                let mut whole = BytesMut::with_capacity((range.end - range.start) as usize);
                parts.iter().for_each(|part| whole.extend_from_slice(part));
                Ok(whole.freeze())
            }
        }
    }
}

impl Kept {
    fn keep(&mut self, key: (StorePath, u64), bytes: Bytes, room: u64) {
        self.bytes += bytes.len() as u64;
        if let Some(twice) = self.blocks.insert(key.clone(), bytes) {
            self.bytes -= twice.len() as u64;
        } else {
            self.order.push_back(key);
        }
        while self.bytes > room
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
    fn pieces_come_back_and_the_room_is_kept() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        runtime.block_on(async {
            let store = InMemory::new();
            let contents: Vec<Vec<u8>> = [1000, 37, 256].map(|n| (0..n).map(|i| (i * i / 3) as u8).collect()).into();
            let paths = ["a", "b", "c"].map(StorePath::from);
            for (path, content) in paths.iter().zip(&contents) {
                store.put(path, content.clone().into()).await.expect("puts");
            }
            let blocks = Blocks::with(16, 200);
            let mut rng = Key::new(3).rng();
            for _ in 0..50 {
                let wanted: Vec<Pieces> = (0..3)
                    .map(|of| {
                        let size = contents[of].len() as u64;
                        let ranges = (0..5).map(|_| {
                            let start = rng.random_range(0..=size);
                            start..rng.random_range(start..=size.min(start + 70))
                        });
                        Pieces { path: paths[of].clone(), size, ranges: ranges.collect() }
                    })
                    .collect();
                let read = blocks.read(&store, &wanted).await.expect("reads");
                for ((pieces, read), content) in wanted.iter().zip(&read).zip(&contents) {
                    for (range, bytes) in pieces.ranges.iter().zip(read) {
                        assert_eq!(bytes, &content[range.start as usize..range.end as usize]);
                    }
                }
                let kept = blocks.kept();
                assert!(kept.bytes <= 200 && kept.order.len() == kept.blocks.len());
            }
            let gone = Pieces { path: "none".into(), size: 10, ranges: vec![0..4, 5..6] };
            assert!(blocks.read(&store, &[gone]).await.is_err());
        });
    }
}
