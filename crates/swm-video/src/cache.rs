//! A cache of the opened videos of a dataset, with a pool of decoders.

use crate::decode::{DecoderPool, FrameRequest};
use crate::video::{Source, Video};
use rayon::prelude::*;
use std::collections::{HashMap, VecDeque};
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::Result;

/// Limit of cached tables and videos in memory, in bytes.
const MAX_BYTES: usize = 256 << 20;

/// A cache of opened videos by key.
pub struct VideoCache<K> {
    decoders: DecoderPool,
    entries: Mutex<Entries<K>>,
}

struct Entries<K> {
    videos: HashMap<K, Arc<Video>>,
    /// Keys, the oldest first.
    order: VecDeque<K>,
    bytes: usize,
}

impl<K> Default for VideoCache<K> {
    fn default() -> Self {
        let entries = Entries { videos: HashMap::new(), order: VecDeque::new(), bytes: 0 };
        Self { decoders: DecoderPool::default(), entries: Mutex::new(entries) }
    }
}

impl<K: Clone + Eq + Hash + Send + Sync> VideoCache<K> {
    /// Returns a cached video, or opens and caches the video.
    ///
    /// # Errors
    /// When the video cannot be opened.
    pub fn get(&self, key: &K, source: impl FnOnce() -> Result<Source>) -> Result<Arc<Video>> {
        if let Some(video) = self.lock().videos.get(key) {
            return Ok(Arc::clone(video));
        }
        let video = Arc::new(Video::open(source()?)?);
        let mut entries = self.lock();
        if entries.videos.insert(key.clone(), Arc::clone(&video)).is_none() {
            entries.order.push_back(key.clone());
            entries.bytes += video.memory();
            while entries.bytes > MAX_BYTES
                && let Some(oldest) = entries.order.pop_front()
            {
                let freed = entries.videos.remove(&oldest).map_or(0, |video| video.memory());
                entries.bytes -= freed;
            }
        }
        Ok(video)
    }

    /// Returns the height and width of a video, after checking that the first frame has the size in the header.
    ///
    /// # Errors
    /// When the sizes differ, or the video cannot be opened.
    pub fn frame_size(&self, key: &K, source: impl FnOnce() -> Result<Source>) -> Result<(usize, usize)> {
        let video = self.get(key, source)?;
        self.decoders.check_size(&video)?;
        Ok(video.size())
    }

    /// Returns a description of the defect of an episode's video: the video cannot be opened, or its frame count
    /// differs from the episode's row count. Returns `None` if the video has no defect.
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

    /// Decodes frames, each requested as `(video key, frame description, memory)`. Requests with equal keys must be
    /// adjacent. `source` returns the source of a video, and `frame` the index of the described frame.
    ///
    /// # Errors
    /// When a video cannot be opened, lacks a requested frame, or is damaged.
    pub fn read<F: Sync>(
        &self,
        requests: Vec<(K, F, &mut [u8])>,
        source: impl Fn(&K) -> Result<Source> + Sync,
        frame: impl Fn(&Video, &F) -> Result<usize>,
    ) -> Result<()> {
        let mut keys: Vec<&K> = requests.iter().map(|(key, ..)| key).collect();
        keys.dedup();
        let videos: Result<Vec<Arc<Video>>> =
            keys.into_par_iter().with_max_len(1).map(|key| self.get(key, || source(key))).collect();
        let videos = videos?;
        let mut frames = Vec::with_capacity(requests.len());
        let mut rest = videos.iter();
        let mut last: Option<(K, &Video)> = None;
        for (key, description, out) in requests {
            let video = match &last {
                Some((known, video)) if *known == key => *video,
                _ => match rest.next() {
                    Some(video) => &**video,
                    None => break,
                },
            };
            frames.push(FrameRequest { video, frame: frame(video, &description)?, out });
            last = Some((key, video));
        }
        self.decoders.read(frames)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Entries<K>> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
