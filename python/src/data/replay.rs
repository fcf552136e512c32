//! [`ReplayBuffer`]: the latest episodes of a running collection.

use super::dataset::Dataset;
use super::{Column, Kept, columns, constants, schema};
use crate::arrays;
use crate::errors::{json, raised};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use std::sync::Arc;
use swm::core::Key;
use swm::data::{ClipSpec, GoalSpec, ReplayConfig, ReplayLoader};

/// The latest episodes, of at most so many rows.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct ReplayBuffer(swm::data::ReplayBuffer);

/// What to draw, from JSON.
#[derive(Deserialize)]
struct Wanted {
    num_steps: usize,
    frameskip: usize,
    columns: Vec<String>,
    goals: Vec<GoalSpec>,
    batch_size: usize,
    recent: Option<usize>,
}

/// Draws batches of a buffer.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct ReplaySampler {
    loader: ReplayLoader,
    key: Key,
}

#[pymethods]
impl ReplayBuffer {
    #[new]
    fn new(columns: Vec<Column>, capacity: usize) -> PyResult<Self> {
        swm::data::ReplayBuffer::new(&schema(columns)?, capacity).map(Self).map_err(raised)
    }

    /// Adds an episode, arrays `[rows, ..]` of the schema's types in its order; the oldest ones leave to make room.
    fn add(&self, py: Python<'_>, episode: &Bound<'_, PyDict>, same: &Bound<'_, PyDict>) -> PyResult<()> {
        let (episode, same) = (arrays::batch(episode)?, constants(same)?);
        py.detach(|| self.0.add(&episode, &same)).map_err(raised)
    }

    /// Rows it holds.
    fn rows(&self) -> usize {
        self.0.rows()
    }

    /// Episodes it holds.
    fn episodes(&self) -> usize {
        self.0.episodes()
    }

    /// Episodes that ever came.
    fn added(&self) -> u64 {
        self.0.added()
    }

    /// What it holds now, which stays so.
    fn snapshot(&self, py: Python<'_>) -> PyResult<Dataset> {
        let reader = self.0.snapshot();
        Dataset::of(py, Arc::new(move || Ok(Arc::clone(&reader))))
    }

    /// Draws what the configuration, JSON, says.
    fn sampler(&self, config: &str, seed: u64) -> PyResult<ReplaySampler> {
        let Wanted { num_steps, frameskip, columns, goals, batch_size, recent } = json("sampler", config)?;
        let clip = ClipSpec { num_steps, frameskip, columns };
        let config = ReplayConfig { clip, goals, batch_size, recent, threads: 0, ..ReplayConfig::default() };
        let loader = self.0.loader(config).map_err(raised)?;
        Ok(ReplaySampler { loader, key: Key::new(seed).with("replay") })
    }
}

#[pymethods]
impl ReplaySampler {
    /// The batch of this number: a function of the seed, the number, and what the buffer holds.
    fn sample<'py>(&self, py: Python<'py>, number: u64) -> PyResult<Bound<'py, PyDict>> {
        let batch = py.detach(|| self.loader.sample(self.key.at(number))).map_err(raised)?;
        columns(py, Kept::Lent(batch))
    }
}
