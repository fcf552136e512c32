//! Collection: writes every episode that a policy plays to a dataset.
//!
//! An episode is determined by its number: its reset seed is `Key::new(seed).with("episode").at(number).seed()` without
//! the highest bit, and the policy draws from the same key. The writer receives episodes in the order of their numbers,
//! not in the order in which slots finish, so the dataset has the same bytes for any number of environments and
//! threads, and after any interruption.
//!
//! # Rows
//! Row `t` holds the observation at `t`, the action taken from it, and the reward and flags of that step. The last row
//! holds the final observation: its action is NaN (-1 for integer actions), its reward and flags are 0. `success`
//! states whether the observation of the same row satisfies the goal.
//!
//! | column | |
//! | --- | --- |
//! | columns of the environment | the observation; a `/` in a name becomes `.`, because most formats cannot store `/` |
//! | `pixels` (and `goal`, if requested) | frames, of environments that render |
//! | `action`, `reward`, `terminated`, `truncated`, `success` | the step |
//! | `variation.<key>` | every factor of variation, constant over the episode |
//! | `episode_seed` | the reset seed, constant over the episode: three `int32` of 21 bits each, the lowest first |
//! | `policy_index` | of mixtures: the index of the episode's policy in the manifest's list, constant over the episode |
//!
//! The seed is split because datasets store values as `float32`, which represents integers up to 2^24. The column is
//! not called `seed`, because the reference implementation resets environments with a column of that name.

use crate::action_noise::{self, NoisyPolicy};
use crate::policy_mixture::PolicyChoice;
use crate::seeding::{episode_key, reset, reset_seed};
use crate::world::{Play, World};
use serde::Serialize;
use serde_json::json;
use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::{Builder, ScopedJoinHandle, scope};
use swm_core::columns::{self, ColumnIndices};
use swm_core::finite::not_finite;
use swm_core::pool::Reset;
use swm_core::run::{Control, Progress};
use swm_core::{
    Batch, ColumnSpec, DType, EnvPool, EnvSpec, Error, Key, Manifest, Policy, Result, Schema, VariationRequest, limits,
};
use swm_data::{Constants, Writer, check_storable};

/// Settings of a collection.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CollectConfig {
    /// The number of episodes of the complete dataset; episodes that it already contains are not played again.
    pub episodes: usize,
    /// The seed; an episode is determined by this seed and its number.
    pub seed: u64,
    /// The factors that are sampled and pinned.
    pub variation: VariationRequest,
    /// The names of the policies, for the manifest, and their weights, which determine the policy of every episode.
    pub policy: PolicyChoice,
    /// The standard deviation of the noise added to actions, in the units of the action space; 0 for none. The stored
    /// actions contain the noise.
    pub action_noise: f64,
    /// Whether to store the frame of the goal in every row.
    pub goal: bool,
    /// The number of the first episode; above 0 if several machines collect one part each.
    pub first: usize,
    /// Whether NaN and infinite values end the collection; they are stored and counted otherwise.
    pub strict_finite: bool,
}

/// The result of a collection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Collected {
    /// The number of episodes in the dataset.
    pub episodes: usize,
    /// The number of added episodes.
    pub added: usize,
    /// The number of environment steps in the added episodes.
    pub steps: usize,
}

/// The number of episodes per slot that may wait in memory for an earlier, unfinished episode.
const AHEAD: usize = 2;

/// The capacity of the queue to the writer, in episodes.
const QUEUE: usize = 2;

impl World {
    /// The columns of a dataset collected in this world.
    ///
    /// # Errors
    /// When a column of the environment has the name of a collected column, its actions cannot have the noise, or datasets
    /// cannot hold them.
    pub fn collect_schema(&self, config: &CollectConfig) -> Result<Schema> {
        action_noise::check(config.action_noise, self.spec())?;
        Layout::of(self.pool().infos().schema(), self.spec(), config).map(|layout| layout.schema)
    }

    /// The manifest of a dataset collected in this world.
    pub fn collect_manifest(&self, config: &CollectConfig) -> Manifest {
        let image = self.pool().image().map(|(height, width)| [height, width]);
        let mut settings = json!({
            "env": self.spec().id,
            "policy": config.policy,
            "episodes": config.episodes,
            "max_episode_steps": self.pool().max_episode_steps(),
            "variation": config.variation,
            "image": image,
            "views": self.pool().views().iter().map(ToString::to_string).collect::<Vec<_>>(),
            "goal": config.goal,
        });
        if config.action_noise != 0.0 {
            settings["action_noise"] = json!(config.action_noise);
        }
        Manifest { libraries: self.libraries(), ..Manifest::new("collect", config.seed, settings) }
    }

    /// Plays episodes until the dataset behind `writer` has `config.episodes`. The writer must have the columns of
    /// [`World::collect_schema`]; its existing episodes must be the first episodes of the same collection.
    ///
    /// # Errors
    /// When the policy, an environment or the writer fails, or the run is stopped ([`Error::Interrupted`]). The
    /// episodes up to the first unfinished one stay in the dataset; a resumed collection plays the later episodes
    /// again and stores the same bytes.
    pub fn collect(
        &mut self,
        policy: &mut dyn Policy,
        writer: Box<dyn Writer>,
        config: &CollectConfig,
        control: &mut Control<'_>,
    ) -> Result<Collected> {
        let layout = Layout::of(self.pool().infos().schema(), self.spec(), config)?;
        let mut noisy;
        let policy: &mut dyn Policy = if config.action_noise == 0.0 {
            policy
        } else {
            noisy = NoisyPolicy::new(policy, config.action_noise, self.spec(), self.pool().len())?;
            &mut noisy
        };
        limits::EPISODES.check(config.episodes)?;
        let first = writer.episodes();
        let threads = self.pool().threads().clone();
        let mut check = FiniteCheck::new(&layout, config);
        let collected = scope(|scope| {
            let (to_writer, from_world) = sync_channel::<Finished>(QUEUE);
            let (back, written) = channel();
            let check = &mut check;
            let write = move || write_all(writer, check, config.episodes, &from_world, &back, &threads);
            let writing = Builder::new().name("swm-write".to_owned()).spawn_scoped(scope, write);
            let writing = writing.map_err(|e| Error::external("starting the thread that stores episodes", e))?;
            let mut collection = Collection {
                layout,
                config,
                first,
                next: first,
                recordings: (0..self.pool().len()).map(|_| None).collect(),
                finished: VecDeque::new(),
                sent: first,
                stored: first,
                steps: 0,
                to_writer,
                written,
                spare: vec![],
            };
            let played = self.play(policy, &mut collection, control);
            collection.close(writing, control).and_then(|collected| played.map(|()| collected))
        });
        self.set_not_finite(check.counts);
        collected
    }
}

/// Writes the received episodes, up to `total`, and sends their batches back for reuse. Encoding runs on the world's
/// threads, so that one setting limits all threads.
fn write_all(
    mut writer: Box<dyn Writer>,
    check: &mut FiniteCheck,
    total: usize,
    episodes: &Receiver<Finished>,
    back: &Sender<Batch>,
    threads: &rayon::ThreadPool,
) -> Result<()> {
    for Finished { rows: episode, constants } in episodes {
        check.episode(&episode, writer.episodes())?;
        threads.install(|| writer.write_episode_with(&episode, &constants))?;
        // The receiver is dropped if the world fails. The episodes that are already finished are stored nevertheless.
        let _ = back.send(episode);
    }
    if writer.episodes() < total { writer.pause() } else { writer.finish() }
}

/// Counts the NaN and infinite values of the stored episodes.
struct FiniteCheck {
    /// The indices of the columns that should be finite: all but the action, which is NaN in the last row. Policies'
    /// actions are checked when the environment receives them.
    columns: Vec<usize>,
    /// Whether such values are errors.
    strict: bool,
    /// The counts of the columns that have any.
    counts: BTreeMap<String, u64>,
}

impl FiniteCheck {
    fn new(layout: &Layout, config: &CollectConfig) -> Self {
        let columns = (0..layout.schema.columns().len()).filter(|&column| column != layout.action).collect();
        Self { columns, strict: config.strict_finite, counts: BTreeMap::new() }
    }

    /// Counts the values of an episode.
    fn episode(&mut self, rows: &Batch, number: usize) -> Result<()> {
        for &index in &self.columns {
            let column = &rows.schema().columns()[index];
            let count = not_finite(column.dtype, rows.bytes(index));
            if count == 0 {
                continue;
            }
            if self.strict {
                return Err(Error::NotFinite {
                    what: format!("column '{}' of episode {number}", column.name),
                    given: format!("{count} of {} values", rows.rows() * column.len()),
                    fix: "fix the environment, or collect without --strict-finite (strict_finite=True)".to_owned(),
                });
            }
            *self.counts.entry(column.name.clone()).or_default() += count as u64;
        }
        Ok(())
    }
}

/// The columns of an episode and their sources.
struct Layout {
    schema: Schema,
    /// The copied columns: `(index in the infos, index in the episode)`.
    observed: Vec<(usize, usize)>,
    /// The indices of the standard columns in the episode.
    columns: ColumnIndices,
    action: usize,
    /// The index of the first factor column; the columns of all other factors follow.
    factors: usize,
    episode_seed: usize,
    /// The index of the column of the policy; `None` for one policy.
    policy_index: Option<usize>,
    /// The indices of the standard columns in the infos.
    infos: ColumnIndices,
}

impl Layout {
    fn of(infos: &Schema, spec: &EnvSpec, config: &CollectConfig) -> Result<Self> {
        check_storable(spec)?;
        let mut columns: Vec<ColumnSpec> = vec![];
        let mut observed = vec![];
        let copied = |name: &str| match name {
            columns::REWARD | columns::TERMINATED | columns::TRUNCATED | columns::STEP_IDX => false,
            columns::GOAL => config.goal,
            _ => true,
        };
        for (from, column) in infos.columns().iter().enumerate().filter(|(_, column)| copied(&column.name)) {
            observed.push((from, columns.len()));
            columns.push(ColumnSpec { name: columns::collected(&column.name), ..column.clone() });
        }
        let action = columns.len();
        columns.push(spec.action_column());
        columns.push(ColumnSpec::new(columns::REWARD, DType::Float32, []));
        columns.push(ColumnSpec::new(columns::TERMINATED, DType::Bool, []));
        columns.push(ColumnSpec::new(columns::TRUNCATED, DType::Bool, []));
        let factors = columns.len();
        for factor in spec.variation_space.factors() {
            columns.push(ColumnSpec::new(columns::factor(&factor.key), factor.space.dtype(), factor.space.shape()));
        }
        let episode_seed = columns.len();
        columns.push(ColumnSpec::new(columns::EPISODE_SEED, DType::Int32, [3]));
        let policy_index = config.policy.is_mixture().then_some(columns.len());
        columns.extend(policy_index.map(|_| ColumnSpec::new(columns::POLICY_INDEX, DType::Int32, [])));
        let schema = Schema::new(columns)?;
        let (columns, infos) = (ColumnIndices::of(&schema)?, ColumnIndices::of(infos)?);
        Ok(Self { schema, observed, columns, action, factors, episode_seed, policy_index, infos })
    }

    /// Copies the observation of a slot to a row, which may be one past the last.
    fn observe(&self, episode: &mut Batch, row: usize, infos: &Batch, slot: usize) {
        if row == episode.rows() {
            episode.resize(row + 1);
        }
        for &(from, to) in &self.observed {
            let n = self.schema.columns()[to].row_bytes();
            episode.bytes_mut(to)[row * n..][..n].copy_from_slice(&infos.bytes(from)[slot * n..][..n]);
        }
    }

    /// Writes the columns that are constant over an episode to all its rows.
    fn fill_constants(&self, episode: &mut Batch, pool: &EnvPool, slot: usize, key: Key, policy: &PolicyChoice) {
        if let Some(column) = self.policy_index {
            fill(episode, column, &[policy.draw(key) as f64]);
        }
        let factors = pool.env(slot).factors();
        for (i, (_, value)) in factors.iter().enumerate() {
            fill(episode, self.factors + i, value);
        }
        let elements = columns::split_seed(reset_seed(key));
        for row in 0..episode.rows() {
            episode.row_mut(row).set(self.episode_seed, &elements);
        }
    }
}

/// Writes a value to all rows of a column, converted to the column's type.
fn fill(batch: &mut Batch, column: usize, value: &[f64]) {
    fn write_converted<T: bytemuck::Pod>(bytes: &mut [u8], value: &[f64], convert: impl Fn(f64) -> T) {
        let size = size_of::<T>();
        for (to, &from) in bytes.chunks_exact_mut(size).zip(value.iter().cycle()) {
            to.copy_from_slice(bytemuck::bytes_of(&convert(from)));
        }
    }
    let dtype = batch.schema().columns()[column].dtype;
    let bytes = batch.bytes_mut(column);
    match dtype {
        DType::Bool | DType::U8 => write_converted(bytes, value, |v| v as u8),
        DType::Int32 => write_converted(bytes, value, |v| v as i32),
        DType::Int64 => write_converted(bytes, value, |v| v as i64),
        DType::Float32 => write_converted(bytes, value, |v| v as f32),
        DType::Float64 => write_converted(bytes, value, |v| v),
    }
}

/// An episode in progress. The batch may contain rows of an older episode, which are overwritten one by one, because
/// clearing the batch first would take as long as recording the episode.
struct Recording {
    number: usize,
    /// The number of recorded rows; the batch may have more until the episode is finished.
    length: usize,
    rows: Batch,
}

/// A finished episode, to be written.
struct Finished {
    rows: Batch,
    constants: Constants,
}

/// A collection in progress.
struct Collection<'a> {
    layout: Layout,
    config: &'a CollectConfig,
    /// The number of episodes in the dataset before this run.
    first: usize,
    /// The number of the next episode to start.
    next: usize,
    recordings: Vec<Option<Recording>>,
    /// The episodes from number `sent` on; `None` for unfinished episodes.
    finished: VecDeque<Option<Finished>>,
    /// The number of episodes sent to the writer.
    sent: usize,
    /// The number of episodes the writer has stored.
    stored: usize,
    steps: usize,
    to_writer: SyncSender<Finished>,
    written: Receiver<Batch>,
    /// Unused batches, with arbitrary content.
    spare: Vec<Batch>,
}

impl Collection<'_> {
    fn finish(&mut self, Recording { number, rows, .. }: Recording, constants: Constants) -> Result<()> {
        let index = number - self.sent;
        if self.finished.len() <= index {
            self.finished.resize_with(index + 1, || None);
        }
        self.finished[index] = Some(Finished { rows, constants });
        while let Some(Some(_)) = self.finished.front() {
            let episode = self.finished.pop_front().flatten();
            // The channel closes only if the writer failed; `close` then returns the writer's error instead of
            // this error.
            let received = episode.is_none_or(|episode| self.to_writer.send(episode).is_ok());
            if !received {
                return Err(Error::Interrupted);
            }
            self.sent += 1;
        }
        Ok(())
    }

    fn count_stored(&mut self, rows: Batch, control: &mut Control<'_>) {
        self.spare.push(rows);
        self.stored += 1;
        control.progress(Progress {
            stage: "collect",
            done: self.stored,
            total: self.config.episodes,
            unit: "episodes",
            metrics: &[("steps", self.steps as f64)],
        });
    }

    /// Waits for the writer. An error of the writer is returned first, because it causes all other errors.
    fn close(mut self, writing: ScopedJoinHandle<'_, Result<()>>, control: &mut Control<'_>) -> Result<Collected> {
        let (closed, _) = sync_channel(0);
        drop(std::mem::replace(&mut self.to_writer, closed));
        while let Ok(rows) = self.written.recv() {
            self.count_stored(rows, control);
        }
        match writing.join() {
            Ok(outcome) => outcome?,
            Err(panic) => return Err(Error::panicked("the thread that stores episodes panicked", &*panic)),
        }
        Ok(Collected { episodes: self.stored, added: self.stored - self.first, steps: self.steps })
    }
}

impl Play for Collection<'_> {
    fn next(&mut self) -> Option<usize> {
        if !self.more() {
            return None;
        }
        self.next += 1;
        Some(self.next - 1)
    }

    fn more(&self) -> bool {
        self.next < self.config.episodes && self.next < self.sent + AHEAD * self.recordings.len()
    }

    fn key(&self, episode: usize) -> Key {
        episode_key(self.config.seed, self.config.first + episode)
    }

    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        let mut resets: Vec<Reset> = Vec::with_capacity(starting.len());
        for &(slot, number) in starting {
            resets.push(reset(slot, self.key(number), &self.config.variation));
            let rows = self.spare.pop().unwrap_or_else(|| Batch::zeros(&self.layout.schema, 0));
            self.recordings[slot] = Some(Recording { number, length: 0, rows });
        }
        pool.reset(&resets)
    }

    fn started(&mut self, _: usize, _: &EnvPool, _: &mut Control<'_>) -> Result<bool> {
        Ok(true)
    }

    fn acted(&mut self, slot: usize, pool: &EnvPool, actions: &Batch) {
        let Some(recording) = &mut self.recordings[slot] else { return };
        let row = recording.length;
        recording.length += 1;
        self.layout.observe(&mut recording.rows, row, pool.infos(), slot);
        let n = self.layout.schema.columns()[self.layout.action].row_bytes();
        let action = &actions.bytes(0)[slot * n..][..n];
        recording.rows.bytes_mut(self.layout.action)[row * n..][..n].copy_from_slice(action);
    }

    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        while let Ok(rows) = self.written.try_recv() {
            self.count_stored(rows, control);
        }
        let Some(mut recording) = self.recordings[slot].take() else { return Ok(false) };
        let (layout, indices, infos) = (&self.layout, self.layout.infos, pool.infos());
        let last = infos.row(slot);
        let (terminated, truncated) = (last.at::<u8>(indices.terminated)[0], last.at::<u8>(indices.truncated)[0]);
        let mut row = recording.rows.row_mut(recording.length - 1);
        row.set(layout.columns.reward, last.at::<f32>(indices.reward));
        row.set(layout.columns.terminated, &[terminated]);
        row.set(layout.columns.truncated, &[truncated]);
        self.steps += 1;
        if terminated + truncated == 0 {
            self.recordings[slot] = Some(recording);
            return Ok(true);
        }
        layout.observe(&mut recording.rows, recording.length, infos, slot);
        let mut row = recording.rows.row_mut(recording.length);
        recording.length += 1;
        match layout.schema.columns()[layout.action].dtype {
            DType::Float32 => row.at::<f32>(layout.action).fill(f32::NAN),
            _ => row.at::<i64>(layout.action).fill(-1),
        }
        row.set(layout.columns.reward, &[0.0f32]);
        row.set(layout.columns.terminated, &[0u8]);
        row.set(layout.columns.truncated, &[0u8]);
        let key = self.key(recording.number);
        recording.rows.resize(recording.length);
        layout.fill_constants(&mut recording.rows, pool, slot, key, &self.config.policy);
        self.finish(recording, pool.env(slot).constants())?;
        Ok(false)
    }
}
