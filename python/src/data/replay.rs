//! [`ReplayBuffer`]: the latest episodes of a running collection.

use super::dataset::Dataset;
use super::{BatchMemory, Column, columns, schema};
use crate::arrays;
use crate::errors::{json, to_py_err};
use crate::exit;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use std::sync::Arc;
use swm::core::Key;
use swm::data::{ClipSpec, GoalSpec, ReplayConfig, ReplayLoader};

/// The latest episodes, with at most `capacity` rows in total.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct ReplayBuffer(swm::data::ReplayBuffer);

/// The settings of a sampler, from JSON.
#[derive(Deserialize)]
struct Options {
    num_steps: usize,
    frameskip: usize,
    columns: Vec<String>,
    goals: Vec<GoalSpec>,
    batch_size: usize,
    recent: Option<usize>,
}

/// Samples batches from a buffer.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct ReplaySampler {
    loader: ReplayLoader,
    key: Key,
}

#[pymethods]
impl ReplayBuffer {
    #[new]
    fn new(columns: Vec<Column>, capacity: usize) -> PyResult<Self> {
        swm::data::ReplayBuffer::new(&schema(columns)?, capacity).map(Self).map_err(to_py_err)
    }

    /// Adds an episode (arrays `[rows, ..]` with the schema's columns in order) and its constants. Removes the oldest
    /// episodes until the new one fits.
    fn add(&self, py: Python<'_>, episode: &Bound<'_, PyDict>, constants: &Bound<'_, PyDict>) -> PyResult<()> {
        let (episode, constants) = (arrays::batch(episode)?, super::constants(constants)?);
        exit::detached(py, || self.0.add(&episode, &constants)).map_err(to_py_err)
    }

    /// The number of rows in the buffer.
    fn rows(&self) -> usize {
        self.0.rows()
    }

    /// The number of episodes in the buffer.
    fn episodes(&self) -> usize {
        self.0.episodes()
    }

    /// The number of episodes added since the buffer was created.
    fn added(&self) -> u64 {
        self.0.added()
    }

    /// An immutable view of the current content.
    fn snapshot(&self, py: Python<'_>) -> PyResult<Dataset> {
        let reader = self.0.snapshot();
        Dataset::of(py, Arc::new(move || Ok(Arc::clone(&reader))))
    }

    /// Creates a sampler with settings in JSON.
    fn sampler(&self, config: &str, seed: u64) -> PyResult<ReplaySampler> {
        let Options { num_steps, frameskip, columns, goals, batch_size, recent } = json("sampler", config)?;
        let clip = ClipSpec { num_steps, frameskip, columns };
        let config = ReplayConfig { clip, goals, batch_size, recent, threads: 0, ..ReplayConfig::default() };
        let loader = self.0.loader(config).map_err(to_py_err)?;
        Ok(ReplaySampler { loader, key: Key::new(seed).with("replay") })
    }
}

#[pymethods]
impl ReplaySampler {
    /// Samples batch `index`, which depends only on the seed, the index and the content of the buffer.
    fn sample<'py>(&self, py: Python<'py>, index: u64) -> PyResult<Bound<'py, PyDict>> {
        let batch = exit::detached(py, || self.loader.sample(self.key.at(index))).map_err(to_py_err)?;
        columns(py, BatchMemory::Loaded(batch))
    }
}
