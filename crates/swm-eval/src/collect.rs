//! Collecting: every episode a policy plays goes to a dataset.
//!
//! Episodes are numbered, and an episode's number decides everything in it: its seed is
//! `Key::new(seed).with("episode").at(number).seed()` without the highest bit, and the policy draws from the same
//! key. They are handed to the writer in the order of their numbers, whichever slot finishes first, so the
//! dataset is the same bytes for any number of environments and threads, interrupted and resumed or not.
//!
//! # Rows
//! Row `t` holds the observation at `t`, the action taken from it, and the reward and flags of that step. The
//! last row holds the final observation: its action is NaN (-1 where actions are integers), its reward and
//! flags are 0. `success` says whether the goal is reached in the observation of its own row.
//!
//! | column | |
//! | --- | --- |
//! | those of the environment | the observation; a `/` in a name becomes `.`, because most formats cannot hold it |
//! | `pixels` (and `goal`, if asked for) | pictures, in worlds that draw |
//! | `action`, `reward`, `terminated`, `truncated`, `success` | the step |
//! | `variation.<key>` | every factor of variation, constant over the episode |
//! | `episode_seed` | what the environment was reset with, constant over the episode: three `int32` of 21 bits each, the lowest first |
//!
//! The seed is split because datasets store numbers as `float32`, which holds whole numbers up to 2^24; and it is
//! not called `seed` because the reference resets environments with a column of that name.

use crate::world::{Play, World, episode_key, reset, reset_seed};
use serde::Serialize;
use serde_json::json;
use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::{ScopedJoinHandle, scope};
use swm_core::columns::{self, ColumnIndices};
use swm_core::pool::Reset;
use swm_core::run::{Control, Progress};
use swm_core::{
    Batch, ColumnSpec, DType, EnvPool, EnvSpec, Error, Key, Manifest, Policy, Result, Schema, VariationRequest,
};
use swm_data::{Constants, Writer};

/// What to collect.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CollectConfig {
    /// Episodes the dataset shall have in the end; those it has already are not played again.
    pub episodes: usize,
    /// What decides every episode, together with its number.
    pub seed: u64,
    /// Factors to sample and to pin.
    pub variation: VariationRequest,
    /// Who acts, for the manifest.
    pub policy: String,
    /// Whether to store the picture of the goal in every row.
    pub goal: bool,
    /// The number of the first episode: above 0 where several machines collect a part each.
    pub first: usize,
}

/// What was collected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Collected {
    /// Episodes in the dataset now.
    pub episodes: usize,
    /// Episodes added.
    pub added: usize,
    /// Environment steps in what was added.
    pub steps: usize,
}

/// Episodes finished ahead of an unfinished earlier one wait in memory, at most this many for each slot.
const AHEAD: usize = 2;

/// Episodes on their way to the writer.
const UNDERWAY: usize = 2;

impl World {
    /// The columns of a dataset collected here.
    ///
    /// # Errors
    /// When the environment names a column as a collected one is named.
    pub fn collect_schema(&self, goal: bool) -> Result<Schema> {
        Layout::of(&self.pool().infos().schema().clone(), self.spec(), goal).map(|layout| layout.schema)
    }

    /// Where a dataset collected here comes from.
    pub fn collect_manifest(&self, config: &CollectConfig) -> Manifest {
        let image = self.pool().image().map(|(height, width)| [height, width]);
        let what = json!({
            "env": self.spec().id,
            "policy": config.policy,
            "episodes": config.episodes,
            "max_episode_steps": self.pool().max_episode_steps(),
            "variation": config.variation,
            "image": image,
            "views": self.pool().views().iter().map(ToString::to_string).collect::<Vec<_>>(),
            "goal": config.goal,
        });
        Manifest { libraries: self.libraries(), ..Manifest::new("collect", config.seed, what) }
    }

    /// Plays episodes until the dataset behind `writer` has `config.episodes`. The writer must have the columns
    /// of [`World::collect_schema`]; the episodes it holds already are taken for the first ones of the same
    /// collection.
    ///
    /// # Errors
    /// When the policy, an environment or the writer fails, or the run is stopped ([`Error::Interrupted`]). In
    /// all cases the finished episodes are kept, up to the first unfinished one; resuming plays that one
    /// and what follows it again, to the same bytes.
    pub fn collect(
        &mut self,
        policy: &mut dyn Policy,
        writer: Box<dyn Writer>,
        config: &CollectConfig,
        control: &mut Control<'_>,
    ) -> Result<Collected> {
        let layout = Layout::of(self.pool().infos().schema(), self.spec(), config.goal)?;
        let first = writer.episodes();
        let threads = self.pool().threads().clone();
        scope(|scope| {
            let (to_writer, from_world) = sync_channel::<Finished>(UNDERWAY);
            let (back, written) = channel();
            let writing = scope.spawn(move || write_all(writer, &from_world, &back, &threads));
            let mut collecting = Collecting {
                layout,
                config,
                first,
                next: first,
                recordings: (0..self.pool().len()).map(|_| None).collect(),
                finished: VecDeque::new(),
                handed: first,
                stored: first,
                steps: 0,
                to_writer,
                written,
                spare: vec![],
            };
            let played = self.play(policy, &mut collecting, control);
            collecting.close(writing, control).and_then(|collected| played.map(|()| collected))
        })
    }
}

/// Checks that a collection may be continued: its dataset comes from the same environment, policy, seed and
/// request, whatever number of episodes was wanted then.
///
/// # Errors
/// When something differs; names it.
pub fn check_continues(stored: &Manifest, wanted: &Manifest) -> Result<()> {
    let differs = |what: &str, stored: String, wanted: String| {
        Err(Error::config(
            format!("continuing a collection with {what} {wanted}"),
            format!("its episodes were collected with {stored}"),
            "ask for the same again, or collect into another dataset",
        ))
    };
    if stored.seed != wanted.seed {
        return differs("seed", stored.seed.to_string(), wanted.seed.to_string());
    }
    for what in ["env", "policy", "max_episode_steps", "variation", "image", "views", "goal"] {
        let (stored, wanted) = (&stored.config[what], &wanted.config[what]);
        if stored != wanted && !(what == "views" && stored.is_null()) {
            return differs(what, stored.to_string(), wanted.to_string());
        }
    }
    Ok(())
}

/// The writer's side: stores what comes and sends the batches back. Works on the world's threads, so
/// that its setting bounds the encoding of pictures as well.
fn write_all(
    mut writer: Box<dyn Writer>,
    episodes: &Receiver<Finished>,
    back: &Sender<Batch>,
    threads: &rayon::ThreadPool,
) -> Result<()> {
    for Finished { rows: episode, constants } in episodes {
        threads.install(|| writer.write_episode_with(&episode, &constants))?;
        // Nobody listens any more when the world failed; what it finished is stored nevertheless.
        let _ = back.send(episode);
    }
    writer.finish()
}

/// Where the columns of an episode come from.
struct Layout {
    schema: Schema,
    /// `(place in the infos, place in the episode)` of what is copied.
    observed: Vec<(usize, usize)>,
    /// The standard columns of the episode.
    columns: ColumnIndices,
    action: usize,
    /// The first factor column; one for each factor follows.
    factors: usize,
    episode_seed: usize,
    /// The standard columns of the infos.
    infos: ColumnIndices,
}

impl Layout {
    fn of(infos: &Schema, spec: &EnvSpec, goal: bool) -> Result<Self> {
        let mut columns: Vec<ColumnSpec> = vec![];
        let mut observed = vec![];
        let copied = |name: &str| match name {
            columns::REWARD | columns::TERMINATED | columns::TRUNCATED | columns::STEP_IDX => false,
            columns::GOAL => goal,
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
        let schema = Schema::new(columns)?;
        let (columns, infos) = (ColumnIndices::of(&schema)?, ColumnIndices::of(infos)?);
        Ok(Self { schema, observed, columns, action, factors, episode_seed, infos })
    }

    /// Writes what a slot shows into a row, the first one behind those there are at most.
    fn observe(&self, episode: &mut Batch, row: usize, infos: &Batch, slot: usize) {
        if row == episode.rows() {
            episode.resize(row + 1);
        }
        for &(from, to) in &self.observed {
            let n = self.schema.columns()[to].row_bytes();
            episode.bytes_mut(to)[row * n..][..n].copy_from_slice(&infos.bytes(from)[slot * n..][..n]);
        }
    }

    /// Writes what is constant over an episode into all its rows.
    fn fill_constants(&self, episode: &mut Batch, pool: &EnvPool, slot: usize, seed: u64) {
        let factors = pool.env(slot).factors();
        for (i, (_, value)) in factors.iter().enumerate() {
            fill(episode, self.factors + i, value);
        }
        let elements = columns::split_seed(seed);
        for row in 0..episode.rows() {
            episode.row_mut(row).set(self.episode_seed, &elements);
        }
    }
}

/// Writes a value into all rows of a column, in the column's type.
fn fill(batch: &mut Batch, column: usize, value: &[f64]) {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn put<T: bytemuck::Pod>(bytes: &mut [u8], value: &[f64], convert: impl Fn(f64) -> T) {
        let size = size_of::<T>();
        for (to, &from) in bytes.chunks_exact_mut(size).zip(value.iter().cycle()) {
            to.copy_from_slice(bytemuck::bytes_of(&convert(from)));
        }
    }
    let dtype = batch.schema().columns()[column].dtype;
    let bytes = batch.bytes_mut(column);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    match dtype {
        DType::Bool | DType::U8 => put(bytes, value, |v| v as u8),
        DType::Int32 => put(bytes, value, |v| v as i32),
        DType::Int64 => put(bytes, value, |v| v as i64),
        DType::Float32 => put(bytes, value, |v| v as f32),
        DType::Float64 => put(bytes, value, |v| v),
    }
}

/// One episode being played. Batches come back from the writer with the rows of an older episode, which are
/// overwritten one by one: clearing them first would cost as much as recording them.
struct Recording {
    number: usize,
    /// Rows recorded; the batch may have more until the episode is finished.
    length: usize,
    rows: Batch,
}

/// An episode on its way to the writer.
struct Finished {
    rows: Batch,
    constants: Constants,
}

struct Collecting<'a> {
    layout: Layout,
    config: &'a CollectConfig,
    /// Episodes that were there before.
    first: usize,
    /// The next episode to start.
    next: usize,
    recordings: Vec<Option<Recording>>,
    /// Episodes `handed ..`, those that are finished.
    finished: VecDeque<Option<Finished>>,
    /// Episodes given to the writer.
    handed: usize,
    /// Episodes the writer has stored.
    stored: usize,
    steps: usize,
    to_writer: SyncSender<Finished>,
    written: Receiver<Batch>,
    /// Batches to record into, whatever they hold.
    spare: Vec<Batch>,
}

impl Collecting<'_> {
    fn finish(&mut self, Recording { number, rows, .. }: Recording, constants: Constants) -> Result<()> {
        let place = number - self.handed;
        if self.finished.len() <= place {
            self.finished.resize_with(place + 1, || None);
        }
        self.finished[place] = Some(Finished { rows, constants });
        while let Some(Some(_)) = self.finished.front() {
            let episode = self.finished.pop_front().flatten();
            // The writer hangs up only when it failed, and then its own error is the one to tell.
            let sent = episode.is_none_or(|episode| self.to_writer.send(episode).is_ok());
            if !sent {
                return Err(Error::Interrupted);
            }
            self.handed += 1;
        }
        Ok(())
    }

    fn note_stored(&mut self, rows: Batch, control: &mut Control<'_>) {
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

    /// Waits for the writer. Its error, if it has one, is the cause of every other.
    fn close(mut self, writing: ScopedJoinHandle<'_, Result<()>>, control: &mut Control<'_>) -> Result<Collected> {
        let (closed, _) = sync_channel(0);
        drop(std::mem::replace(&mut self.to_writer, closed));
        while let Ok(rows) = self.written.recv() {
            self.note_stored(rows, control);
        }
        match writing.join() {
            Ok(outcome) => outcome?,
            Err(panic) => std::panic::resume_unwind(panic),
        }
        Ok(Collected { episodes: self.stored, added: self.stored - self.first, steps: self.steps })
    }
}

impl Play for Collecting<'_> {
    fn next(&mut self) -> Option<usize> {
        if !self.more() {
            return None;
        }
        self.next += 1;
        Some(self.next - 1)
    }

    fn more(&self) -> bool {
        self.next < self.config.episodes && self.next < self.handed + AHEAD * self.recordings.len()
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
            self.note_stored(rows, control);
        }
        let Some(mut recording) = self.recordings[slot].take() else { return Ok(false) };
        let (layout, seen, infos) = (&self.layout, self.layout.infos, pool.infos());
        let last = infos.row(slot);
        let (terminated, truncated) = (last.at::<u8>(seen.terminated)[0], last.at::<u8>(seen.truncated)[0]);
        let mut row = recording.rows.row_mut(recording.length - 1);
        row.set(layout.columns.reward, last.at::<f32>(seen.reward));
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
        let seed = reset_seed(self.key(recording.number));
        recording.rows.resize(recording.length);
        layout.fill_constants(&mut recording.rows, pool, slot, seed);
        self.finish(recording, pool.env(slot).constants())?;
        Ok(false)
    }
}
