//! A dataset in memory, whose content tests compare byte by byte.

use std::sync::{Arc, Mutex};
use swm_core::{Batch, ColumnSpec, DType, Error, Manifest, Result, Schema};
use swm_data::{Constants, Episode, Reader, StepRange, Writer};

#[derive(Clone, Default)]
pub struct Memory {
    pub episodes: Arc<Mutex<Vec<Batch>>>,
    /// The number of episodes after which writing fails.
    pub full_at: Option<usize>,
    pub finished: Arc<Mutex<usize>>,
    pub paused: Arc<Mutex<usize>>,
}

impl Memory {
    /// How often a writer was finished, and paused.
    pub fn ends(&self) -> (usize, usize) {
        (*self.finished.lock().expect("no thread has panicked"), *self.paused.lock().expect("no thread has panicked"))
    }

    pub fn writer(&self) -> Box<dyn Writer> {
        Box::new(self.clone())
    }

    pub fn len(&self) -> usize {
        self.episodes.lock().expect("no thread has panicked").len()
    }

    /// The content of all episodes.
    pub fn bytes(&self) -> Vec<u8> {
        let mut all = vec![];
        for episode in self.episodes.lock().expect("no thread has panicked").iter() {
            all.extend((episode.rows() as u64).to_le_bytes());
            (0..episode.schema().columns().len()).for_each(|column| all.extend(episode.bytes(column)));
        }
        all
    }

    pub fn reader(&self) -> MemoryReader {
        let batches = self.episodes.lock().expect("no thread has panicked").clone();
        let episodes = batches.iter().enumerate().map(|(i, b)| Episode { index: i as i64, length: b.rows() }).collect();
        let mut columns = vec![ColumnSpec::new("episode_idx", DType::Int64, [])];
        columns.extend(batches[0].schema().columns().iter().cloned());
        MemoryReader { schema: Schema::new(columns).expect("creating the schema"), batches, episodes }
    }
}

impl Writer for Memory {
    fn write_episode_with(&mut self, episode: &Batch, _constants: &Constants) -> Result<()> {
        let mut episodes = self.episodes.lock().expect("no thread has panicked");
        if self.full_at == Some(episodes.len()) {
            let full = std::io::Error::from(std::io::ErrorKind::StorageFull);
            return Err(Error::io("memory", "writing an episode", full));
        }
        episodes.push(episode.clone());
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.len()
    }

    fn finish(self: Box<Self>) -> Result<()> {
        *self.finished.lock().expect("no thread has panicked") += 1;
        Ok(())
    }

    fn pause(self: Box<Self>) -> Result<()> {
        *self.paused.lock().expect("no thread has panicked") += 1;
        Ok(())
    }
}

pub struct MemoryReader {
    schema: Schema,
    batches: Vec<Batch>,
    episodes: Vec<Episode>,
}

impl Reader for MemoryReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let n = self.schema.column(column)?.row_bytes();
        let mut at = 0;
        for range in ranges {
            let bytes = match column {
                "episode_idx" => (range.episode as i64).to_le_bytes().repeat(range.length),
                _ => {
                    let batch = &self.batches[range.episode];
                    batch.bytes(batch.schema().index(column)?)[range.start * n..][..range.length * n].to_vec()
                }
            };
            out[at..at + bytes.len()].copy_from_slice(&bytes);
            at += bytes.len();
        }
        Ok(())
    }

    fn manifest(&self) -> Option<Manifest> {
        None
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok("memory".to_owned())
    }
}
