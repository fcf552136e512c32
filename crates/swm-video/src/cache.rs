//! The videos of a dataset: their tables are read once and kept, and so are decoders.

use crate::decode::{DecoderPool, FrameRequest, Source, Video};
use rayon::prelude::*;
use std::collections::{HashMap, VecDeque};
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::Result;

/// Bytes of tables, and of videos that are held in memory, that are kept.
const KEPT_BYTES: usize = 256 << 20;

/// Videos by their key.
pub struct VideoCache<K> {
    decoders: DecoderPool,
    shelf: Mutex<Shelf<K>>,
}

struct Shelf<K> {
    videos: HashMap<K, Arc<Video>>,
    /// Oldest first.
    order: VecDeque<K>,
    bytes: usize,
}

impl<K> Default for VideoCache<K> {
    fn default() -> Self {
        let shelf = Shelf { videos: HashMap::new(), order: VecDeque::new(), bytes: 0 };
        Self { decoders: DecoderPool::default(), shelf: Mutex::new(shelf) }
    }
}

impl<K: Clone + Eq + Hash + Send + Sync> VideoCache<K> {
    /// A video, opened unless it is known.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub fn get(&self, key: &K, source: impl FnOnce() -> Result<Source>) -> Result<Arc<Video>> {
        if let Some(video) = self.lock().videos.get(key) {
            return Ok(Arc::clone(video));
        }
        let video = Arc::new(Video::open(source()?)?);
        let mut shelf = self.lock();
        if shelf.videos.insert(key.clone(), Arc::clone(&video)).is_none() {
            shelf.order.push_back(key.clone());
            shelf.bytes += video.memory();
            while shelf.bytes > KEPT_BYTES
                && let Some(oldest) = shelf.order.pop_front()
            {
                let freed = shelf.videos.remove(&oldest).map_or(0, |video| video.memory());
                shelf.bytes -= freed;
            }
        }
        Ok(video)
    }

    /// Height and width of a video's pictures: its first frame has the size that its header says.
    ///
    /// # Errors
    /// When it has not, or the video cannot be opened.
    pub fn frame_size(&self, key: &K, source: impl FnOnce() -> Result<Source>) -> Result<(usize, usize)> {
        let video = self.get(key, source)?;
        self.decoders.check_size(&video)?;
        Ok(video.size())
    }

    /// What is wrong with the video of an episode's column, in words: it cannot be opened, or has not a frame for every
    /// row.
    pub fn irregularity(
        &self,
        key: &K,
        source: impl FnOnce() -> Result<Source>,
        column: &str,
        rows: usize,
    ) -> Option<String> {
        match self.get(key, source) {
            Ok(video) if video.frames() == rows => None,
            Ok(video) => Some(format!("the video of '{column}' has {} frames for {rows} rows", video.frames())),
            Err(error) => Some(error.to_string()),
        }
    }

    /// Decodes rows of pictures. Each is wanted as `(its video, what says which frame, where to)`; equal videos follow
    /// each other. `source` opens a video, `frame` finds the frame in it.
    ///
    /// # Errors
    /// When a video cannot be opened, lacks the frame, or is damaged.
    pub fn read<F: Sync>(
        &self,
        wanted: Vec<(K, F, &mut [u8])>,
        source: impl Fn(&K) -> Result<Source> + Sync,
        frame: impl Fn(&Video, &F) -> Result<usize>,
    ) -> Result<()> {
        let mut keys: Vec<&K> = wanted.iter().map(|(key, ..)| key).collect();
        keys.dedup();
        let videos: Result<Vec<Arc<Video>>> =
            keys.into_par_iter().with_max_len(1).map(|key| self.get(key, || source(key))).collect();
        let videos = videos?;
        let mut frames = Vec::with_capacity(wanted.len());
        let mut rest = videos.iter();
        let mut last: Option<(K, &Video)> = None;
        for (key, which, out) in wanted {
            let video = match &last {
                Some((known, video)) if *known == key => *video,
                _ => match rest.next() {
                    Some(video) => &**video,
                    None => break,
                },
            };
            frames.push(FrameRequest { video, frame: frame(video, &which)?, out });
            last = Some((key, video));
        }
        self.decoders.read(frames)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Shelf<K>> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
