//! A dataset in memory: images of 16 x 16 pixels with a dot that the actions move.

use std::sync::atomic::{AtomicUsize, Ordering};
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Manifest, Result, Schema};
use swm_data::{Episode, Reader, StepRange};

pub const SIDE: usize = 16;
const LENGTH: usize = 24;

/// Episodes of a moving dot with the columns `pixels`, `action` and `position` (in pixels).
pub struct Dots {
    rows: Batch,
    episodes: Vec<Episode>,
    seed: u64,
    /// The frames that were read so far.
    pub frames_read: AtomicUsize,
    /// See [`Dots::breaking_after`].
    readable: usize,
}

impl Dots {
    pub fn new(episodes: usize, seed: u64) -> Self {
        use rand::Rng as _;
        let schema = Schema::new([
            ColumnSpec::image("pixels", SIDE, SIDE),
            ColumnSpec::new("action", DType::Float32, [2]),
            ColumnSpec::new("position", DType::Float32, [2]),
        ])
        .expect("creating the schema");
        let mut rows = Batch::zeros(&schema, episodes * LENGTH);
        for episode in 0..episodes {
            let mut rng = Key::new(seed).at(episode as u64).rng();
            let mut at = [rng.random_range(2.0..13.0f32), rng.random_range(2.0..13.0f32)];
            for step in 0..LENGTH {
                let mut row = rows.row_mut(episode * LENGTH + step);
                draw(at, row.at::<u8>(0));
                let action = [rng.random_range(-1.0..1.0f32), rng.random_range(-1.0..1.0f32)];
                let last = step + 1 == LENGTH;
                row.set(1, &if last { [f32::NAN; 2] } else { action });
                row.set(2, &at);
                at = std::array::from_fn(|i| (at[i] + action[i]).clamp(1.0, 14.0));
            }
        }
        let episodes = (0..episodes).map(|i| Episode { index: i as i64, length: LENGTH }).collect();
        Self { rows, episodes, seed, frames_read: AtomicUsize::new(0), readable: usize::MAX }
    }
}

/// Draws a dot into `rgb`, `[SIDE, SIDE, 3]`; `at` is the position of the dot in pixels.
pub fn draw(at: [f32; 2], rgb: &mut [u8]) {
    for (i, pixel) in rgb.chunks_mut(3).enumerate() {
        let (dx, dy) = ((i % SIDE) as f32 - at[0], (i / SIDE) as f32 - at[1]);
        let value = (-(dx * dx + dy * dy) / 4.0).exp();
        pixel.fill((value * 255.0) as u8);
    }
}

impl Dots {
    /// The dataset, of which no more frames can be read after about `frames`. A loader reads each of the 24 frames of an episode once.
    pub fn breaking_after(self, frames: usize) -> Self {
        Self { readable: frames, ..self }
    }

    /// Multiplies the values of column 1 (`action`) or 2 (`position`).
    pub fn scaled(self, column: usize, factor: f32) -> Self {
        self.scaled_by(column, [factor; 2])
    }

    /// Multiplies the elements of column 1 or 2 by factors of their own.
    pub fn scaled_by(mut self, column: usize, factors: [f32; 2]) -> Self {
        for row in 0..self.episodes.len() * LENGTH {
            self.rows.row_mut(row).at::<f32>(column).iter_mut().zip(factors).for_each(|(value, by)| *value *= by);
        }
        self
    }

    /// Adds offsets to the elements of column 1 or 2.
    pub fn shifted(mut self, column: usize, offsets: [f32; 2]) -> Self {
        for row in 0..self.episodes.len() * LENGTH {
            self.rows.row_mut(row).at::<f32>(column).iter_mut().zip(offsets).for_each(|(value, by)| *value += by);
        }
        self
    }

    /// Stores a column as another type, with a function of its values.
    pub fn stored_as(mut self, column: usize, dtype: DType, value: impl Fn(f32) -> f64) -> Self {
        let mut columns = self.rows.schema().columns().to_vec();
        columns[column].dtype = dtype;
        let name = columns[column].name.clone();
        let values = self.rows.to_f32(&name).expect("the values").into_iter().map(value);
        let mut rows = Batch::zeros(&Schema::new(columns).expect("creating the schema"), self.rows.rows());
        for other in (0..rows.schema().columns().len()).filter(|other| *other != column) {
            rows.bytes_mut(other).copy_from_slice(self.rows.bytes(other));
        }
        let bytes: Vec<u8> = match dtype {
            DType::Float64 => values.flat_map(f64::to_ne_bytes).collect(),
            DType::Float32 => values.flat_map(|value| (value as f32).to_ne_bytes()).collect(),
            DType::U8 => values.map(|value| value as u8).collect(),
            other => panic!("{} is not supported", other.name()),
        };
        rows.bytes_mut(column).copy_from_slice(&bytes);
        self.rows = rows;
        self
    }

    /// Gives a column another name.
    pub fn renamed(mut self, column: usize, name: &str) -> Self {
        let mut columns = self.rows.schema().columns().to_vec();
        columns[column].name = name.to_owned();
        let mut rows = Batch::zeros(&Schema::new(columns).expect("creating the schema"), self.rows.rows());
        (0..rows.schema().columns().len()).for_each(|i| rows.bytes_mut(i).copy_from_slice(self.rows.bytes(i)));
        self.rows = rows;
        self
    }

    /// Sets the first action of an episode.
    pub fn with_action(self, episode: usize, action: [f32; 2]) -> Self {
        self.with_action_at([episode, 0], action)
    }

    /// Sets the action of an episode at a step.
    pub fn with_action_at(mut self, [episode, step]: [usize; 2], action: [f32; 2]) -> Self {
        self.rows.row_mut(episode * LENGTH + step).set(1, &action);
        self
    }
}

impl Reader for Dots {
    fn schema(&self) -> &Schema {
        self.rows.schema()
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.rows.schema().index(column)?;
        let n = self.rows.schema().columns()[index].row_bytes();
        let mut at = 0;
        for range in ranges {
            let (first, bytes) = (range.episode * LENGTH + range.start, range.length * n);
            out[at..at + bytes].copy_from_slice(&self.rows.bytes(index)[first * n..][..bytes]);
            at += bytes;
            let read = self.frames_read.fetch_add(if index == 0 { range.length } else { 0 }, Ordering::Relaxed);
            if index == 0 && read > self.readable {
                return Err(Error::corrupt("dots", "the disk is gone", "restore it"));
            }
        }
        Ok(())
    }

    fn manifest(&self) -> Option<Manifest> {
        Some(Manifest::new("collect", self.seed, serde_json::json!({ "env": "test/Dots-v0" })))
    }

    fn footprint(&self) -> std::result::Result<Vec<(String, u64)>, Error> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok(swm_core::manifest::hash(self.rows.bytes(0)))
    }
}
