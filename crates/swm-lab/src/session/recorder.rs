//! Demonstrations: the episodes that are played in a session, stored in a dataset with the columns of a collection.

use crate::folders::new_dataset;
use serde_json::{Map, Value};
use std::path::Path;
use swm_core::columns::{self, ColumnIndices};
use swm_core::{Batch, DType, Error, Manifest, Result, Schema};
use swm_data::{CommitPolicy, Location, WriteMode, WriteOptions, Writer};
use swm_eval::{CollectConfig, World};

/// The kind of the manifest of recorded datasets.
const KIND: &str = "record";

/// A dataset that is recorded, and the episode in progress.
pub struct Recorder {
    name: String,
    writer: Box<dyn Writer>,
    schema: Schema,
    standard: ColumnIndices,
    rows: Batch,
    /// The reset seed of the episode in progress; `None` before the first reset.
    seed: Option<u64>,
    complete: bool,
}

impl Recorder {
    /// Begins to record into a dataset, which is created, or continued if it was recorded in the same environment. One without
    /// episodes, which an earlier recording left, is replaced. `settings` are further ones of its manifest.
    ///
    /// # Errors
    /// When the name is invalid, or names a dataset that was not recorded in this environment.
    pub fn start(folder: &Path, name: &str, world: &World, settings: &Map<String, Value>) -> Result<Self> {
        let path = new_dataset(folder, name)?;
        let config = CollectConfig::default();
        let mut manifest = Manifest { kind: KIND.to_owned(), ..world.collect_manifest(&config) };
        for setting in ["episodes", "variation"] {
            manifest.config.as_object_mut().and_then(|config| config.remove(setting));
        }
        manifest.config["policy"] = serde_json::json!("demonstrations");
        for (key, value) in settings {
            manifest.config[key] = value.clone();
        }
        let location = Location::from(path.clone());
        let mode = match path.exists() && !swm_data::has_no_dataset(&path) {
            true => mode_of(&location, &manifest)?,
            false => WriteMode::Append,
        };
        let schema = world.collect_schema(&config)?;
        let options = WriteOptions {
            mode,
            manifest: Some(manifest),
            commit: CommitPolicy { episodes: 1, ..CommitPolicy::default() },
            exclusive: true,
            ..WriteOptions::default()
        };
        std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating the folder", error))?;
        let writer = swm_data::create(location, &schema, options)?;
        let (standard, rows) = (ColumnIndices::of(&schema)?, Batch::zeros(&schema, 0));
        Ok(Self { name: name.to_owned(), writer, schema, standard, rows, seed: None, complete: false })
    }

    /// The name of the dataset.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The number of stored episodes.
    pub fn episodes(&self) -> usize {
        self.writer.episodes()
    }

    /// The rows of the episode in progress.
    pub fn rows(&self) -> usize {
        self.rows.rows()
    }

    /// Whether the episode has ended.
    pub fn is_complete(&self) -> bool {
        self.complete
    }

    /// Begins an episode at the state of the world; an episode that was not kept is dropped.
    pub fn begin(&mut self, world: &World, seed: u64) {
        self.rows.resize(0);
        (self.seed, self.complete) = (Some(seed), false);
        self.observe(world);
    }

    /// Copies the observation of the world to a new row.
    fn observe(&mut self, world: &World) {
        let row = self.rows.rows();
        self.rows.resize(row + 1);
        let infos = world.pool().infos();
        for (from, column) in infos.schema().columns().iter().enumerate() {
            let to = self.schema.find(&columns::collected(&column.name));
            let is_step = [columns::REWARD, columns::TERMINATED, columns::TRUNCATED].contains(&column.name.as_str());
            let Some(to) = to.filter(|_| !is_step) else { continue };
            let bytes = self.schema.columns()[to].row_bytes();
            self.rows.bytes_mut(to)[row * bytes..][..bytes].copy_from_slice(&infos.bytes(from)[..bytes]);
        }
    }

    /// Adds a step: the action to the last row, then the new observation. `ended` completes the episode.
    ///
    /// # Errors
    /// When the world has other columns than those that are recorded.
    pub fn step(&mut self, world: &World, actions: &Batch, ended: bool) -> Result<()> {
        if self.seed.is_none() || self.complete {
            return Ok(());
        }
        let (last, infos) = (self.rows.rows() - 1, world.pool().infos());
        let action = self.schema.index(columns::ACTION)?;
        let bytes = self.schema.columns()[action].row_bytes();
        self.rows.bytes_mut(action)[last * bytes..][..bytes].copy_from_slice(&actions.bytes(0)[..bytes]);
        let reward = infos.row(0).to_f64(columns::REWARD)?;
        let flag = |name| infos.row(0).to_f64(name).map(|values| values.first().is_some_and(|&value| value > 0.0));
        let (terminated, truncated) = (flag(columns::TERMINATED)?, flag(columns::TRUNCATED)?);
        let mut row = self.rows.row_mut(last);
        row.set(self.standard.reward, &[reward.first().copied().unwrap_or_default() as f32]);
        row.bytes(self.standard.terminated).fill(u8::from(terminated));
        row.bytes(self.standard.truncated).fill(u8::from(truncated));
        self.observe(world);
        self.complete = ended;
        Ok(())
    }

    /// Stores the episode in progress, and waits until it is stored.
    ///
    /// # Errors
    /// When there is no step to store, or writing fails.
    pub fn keep(&mut self, world: &World) -> Result<()> {
        let Some(seed) = self.seed.filter(|_| self.rows.rows() > 1) else {
            let fix = "reset the environment, act, then keep the episode";
            return Err(Error::config("the recorded episode", "it has no steps", fix));
        };
        let (last, action) = (self.rows.rows() - 1, self.schema.index(columns::ACTION)?);
        let mut row = self.rows.row_mut(last);
        row.set(self.standard.reward, &[0.0_f32]);
        row.bytes(self.standard.terminated).fill(0);
        row.bytes(self.standard.truncated).fill(0);
        match self.schema.columns()[action].dtype {
            DType::Float32 => row.at::<f32>(action).fill(f32::NAN),
            _ => row.at::<i64>(action).fill(-1),
        }
        for (key, value) in world.pool().env(0).factors().iter() {
            let column = self.schema.index(&columns::factor(key))?;
            fill(&mut self.rows, column, value);
        }
        let seed_column = self.schema.index(columns::EPISODE_SEED)?;
        for row in 0..self.rows.rows() {
            self.rows.row_mut(row).set(seed_column, &columns::split_seed(seed));
        }
        self.writer.write_episode_with(&self.rows, &world.pool().env(0).constants())?;
        // What the page calls kept survives a kill.
        self.writer.sync()?;
        self.discard();
        Ok(())
    }

    /// Drops the episode in progress.
    pub fn discard(&mut self) {
        self.rows.resize(0);
        (self.seed, self.complete) = (None, false);
    }

    /// Ends recording; the episode in progress is dropped.
    ///
    /// # Errors
    /// When writing fails.
    pub fn finish(self) -> Result<()> {
        self.writer.finish()
    }
}

/// Returns how to write to an existing dataset: one that was recorded in the same environment with the same frames is continued,
/// another recording without episodes is replaced.
fn mode_of(location: &Location, new: &Manifest) -> Result<WriteMode> {
    swm_data::recover(location)?;
    let reader = swm_data::open(location.clone())?;
    if let Some(stored) = reader.manifest().filter(|stored| stored.kind == KIND) {
        match (stored.config == new.config, reader.episodes().is_empty()) {
            (true, _) => return Ok(WriteMode::Append),
            (false, true) => return Ok(WriteMode::Overwrite),
            (false, false) => {}
        }
    }
    let problem = "it exists, and was not recorded in this environment at this frame size";
    Err(Error::config(format!("dataset {location}"), problem, "choose another name"))
}

/// Writes a value to all rows of a column, converted to the column's type.
fn fill(rows: &mut Batch, column: usize, value: &[f64]) {
    let dtype = rows.schema().columns()[column].dtype;
    for index in 0..rows.rows() {
        let mut row = rows.row_mut(index);
        match dtype {
            DType::Bool | DType::U8 => convert(row.bytes(column), value, |v| v as u8),
            DType::Int32 => convert(row.at::<i32>(column), value, |v| v as i32),
            DType::Int64 => convert(row.at::<i64>(column), value, |v| v as i64),
            DType::Float32 => convert(row.at::<f32>(column), value, |v| v as f32),
            DType::Float64 => convert(row.at::<f64>(column), value, |v| v),
        }
    }
}

fn convert<T>(to: &mut [T], from: &[f64], convert: impl Fn(f64) -> T) {
    to.iter_mut().zip(from).for_each(|(to, &from)| *to = convert(from));
}
