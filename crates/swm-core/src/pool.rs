//! [`EnvPool`]: many environments of one kind, stepped and rendered on a fixed set of threads.
//!
//! All output is written in place into one [`Batch`], the infos: the environment's own columns, then `reward`,
//! `terminated`, `truncated`, `success`, `step_idx`, and, if the pool renders, `pixels`, `goal` and further camera
//! views. The output of an environment depends on its seed and its actions only, not on the number of threads or
//! environments.
//!
//! The calling thread is one of the pool's threads. Small work stays on it: how long work takes in either way is
//! measured while the pool runs (`parallelism.rs`), so a pool of several threads is not slower than one of one thread.

use crate::batch::{Batch, ColumnSpec, DType, RowMut, Schema};
use crate::columns::{self, ColumnIndices};
use crate::parallelism::Parallelism;
use crate::thread_budget;
use crate::worker_threads::WorkerThreads;
use crate::{Action, CameraView, Env, EnvSpec, Error, FrameMut, PendingCall, ResetOptions, Result, limits};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

/// The shortest work that may be shared: less than waking a thread takes.
const HAND_OVER: Duration = Duration::from_micros(3);

/// The reset of one slot.
#[derive(Clone)]
pub struct Reset {
    /// The slot.
    pub slot: usize,
    /// The seed of its episode.
    pub seed: u64,
    /// Factors, initial state and goal.
    pub options: ResetOptions,
}

/// The columns that the pool adds after the columns of the environment.
struct PoolColumns {
    standard: ColumnIndices,
    step_idx: usize,
    frames: Option<FrameColumns>,
    /// The views that are rendered besides `pixels` and `goal`.
    views: Vec<CameraView>,
}

/// Indices of the columns that hold frames, and the size of a frame in pixels.
#[derive(Clone, Copy)]
struct FrameColumns {
    pixels: usize,
    goal: usize,
    /// The column of the first view; the columns of the other views follow it.
    first_view: usize,
    height: usize,
    width: usize,
}

impl PoolColumns {
    /// Appends the pool's columns to the columns of an environment.
    fn add(
        mut columns: Vec<ColumnSpec>,
        image: Option<(usize, usize)>,
        views: Vec<CameraView>,
    ) -> Result<(Schema, Self)> {
        columns.push(ColumnSpec::new(columns::REWARD, DType::Float32, []));
        columns.push(ColumnSpec::new(columns::TERMINATED, DType::Bool, []));
        columns.push(ColumnSpec::new(columns::TRUNCATED, DType::Bool, []));
        columns.push(ColumnSpec::new(columns::SUCCESS, DType::Bool, []));
        columns.push(ColumnSpec::new(columns::STEP_IDX, DType::Int32, []));
        if let Some((height, width)) = image {
            columns.push(ColumnSpec::image(columns::PIXELS, height, width));
            columns.push(ColumnSpec::image(columns::GOAL, height, width));
        }
        let first_view = columns.len();
        if let Some((height, width)) = image {
            columns.extend(views.iter().map(|view| view.column(height, width)));
        }
        let schema = Schema::new(columns)?;
        let frames = match image {
            None => None,
            Some((height, width)) => Some(FrameColumns {
                pixels: schema.index(columns::PIXELS)?,
                goal: schema.index(columns::GOAL)?,
                first_view,
                height,
                width,
            }),
        };
        let (standard, step_idx) = (ColumnIndices::of(&schema)?, schema.index(columns::STEP_IDX)?);
        Ok((schema, Self { standard, step_idx, frames, views }))
    }
}

/// Many environments of one kind.
pub struct EnvPool {
    slots: Vec<Slot>,
    infos: Batch,
    columns: PoolColumns,
    threads: Arc<rayon::ThreadPool>,
    max_episode_steps: usize,
    /// The threads that step with the calling thread; started when work is shared for the first time.
    workers: Option<WorkerThreads>,
    steps: Parallelism,
    resets: Parallelism,
}

struct Slot {
    env: Box<dyn Env>,
    steps: usize,
    failed: Option<Error>,
}

/// Starts a pool of `n` worker threads; 0 means one per core.
///
/// # Errors
/// When the operating system cannot start the threads.
pub fn threads(n: usize) -> Result<Arc<rayon::ThreadPool>> {
    limits::THREADS.check(n)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(n).thread_name(|i| format!("swm-{i}")).build();
    pool.map(Arc::new).map_err(|error| Error::external("starting worker threads", error))
}

impl EnvPool {
    /// Creates a pool of `envs`. `image` is the `(height, width)` of frames; with `None`, the pool does not render.
    /// `max_episode_steps` replaces the environment's own time limit.
    ///
    /// # Errors
    /// When `envs` is empty.
    pub fn new(
        envs: Vec<Box<dyn Env>>,
        image: Option<(usize, usize)>,
        max_episode_steps: Option<usize>,
        threads: Arc<rayon::ThreadPool>,
    ) -> Result<Self> {
        Self::with_views(envs, image, vec![], max_episode_steps, threads)
    }

    /// As [`EnvPool::new`], with further camera views, each in its own [`CameraView::column`] after `goal`.
    ///
    /// # Errors
    /// As [`EnvPool::new`], and when there are views without an `image` size, or a view occurs twice.
    pub fn with_views(
        envs: Vec<Box<dyn Env>>,
        image: Option<(usize, usize)>,
        views: Vec<CameraView>,
        max_episode_steps: Option<usize>,
        threads: Arc<rayon::ThreadPool>,
    ) -> Result<Self> {
        if image.is_none() && !views.is_empty() {
            return Err(Error::config("camera views", "no frame size is set", "set the frame size or omit the views"));
        }
        let Some(first) = envs.first() else {
            return Err(Error::config("number of environments", "0", "choose at least 1"));
        };
        let spec = first.spec();
        limits::ENVS.check(envs.len())?;
        let (height, width) = image.unwrap_or_default();
        limits::IMAGE_SIDE.check(height.max(width))?;
        let (schema, columns) = PoolColumns::add(spec.columns.clone(), image, views)?;
        limits::BATCH_BYTES.check(schema.row_bytes().saturating_mul(envs.len()))?;
        let max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        Ok(Self {
            infos: Batch::zeros(&schema, envs.len()),
            slots: envs.into_iter().map(|env| Slot { env, steps: 0, failed: None }).collect(),
            columns,
            threads,
            max_episode_steps,
            workers: None,
            steps: Parallelism::above(HAND_OVER),
            resets: Parallelism::above(HAND_OVER),
        })
    }

    /// The number of environments.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Whether the pool is empty; always false.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// The constant properties of the environments.
    pub fn spec(&self) -> &EnvSpec {
        self.slots[0].env.spec()
    }

    /// The output of the last reset or step of every slot, one row per slot.
    pub fn infos(&self) -> &Batch {
        &self.infos
    }

    /// The `(height, width)` of frames in pixels, if the pool renders.
    pub fn image(&self) -> Option<(usize, usize)> {
        self.columns.frames.map(|frames| (frames.height, frames.width))
    }

    /// The camera views rendered besides `pixels` and `goal`.
    pub fn views(&self) -> &[CameraView] {
        &self.columns.views
    }

    /// The threads of the policies that act in the pool's environments, as many as the pool has itself.
    pub fn threads(&self) -> &Arc<rayon::ThreadPool> {
        &self.threads
    }

    /// The environment of a slot.
    pub fn env(&self, slot: usize) -> &dyn Env {
        &*self.slots[slot].env
    }

    /// The time limit: steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> usize {
        self.max_episode_steps
    }

    /// Starts episodes in some slots.
    ///
    /// # Errors
    /// As [`Env::reset`].
    pub fn reset(&mut self, resets: &[Reset]) -> Result<()> {
        let mut by_slot: Vec<Option<&Reset>> = vec![None; self.slots.len()];
        for reset in resets {
            by_slot[reset.slot] = Some(reset);
        }
        for (slot, reset) in self.slots.iter_mut().zip(&by_slot) {
            if let Some(reset) = reset {
                slot.dispatch(PendingCall::Reset(reset.seed, &reset.options));
            }
        }
        let way = Way::measured(&self.resets, resets.len());
        let clock = self.resets.clock(resets.len());
        let done = self.for_each_slot("resetting an environment", way, |i, slot, columns, row| {
            let Some(reset) = by_slot[i] else { return Ok(()) };
            slot.env.reset(reset.seed, &reset.options)?;
            slot.start(columns, row)
        });
        if let Some(clock) = clock {
            self.resets.record(way == Way::Serial, resets.len(), clock.elapsed());
        }
        done
    }

    /// Changes environments in place by `change`, such as a restore or a new goal, then observes and renders them as
    /// after a reset.
    ///
    /// # Errors
    /// The errors of `change` and of [`Env::render`].
    pub fn restart(
        &mut self,
        slots: &[usize],
        change: impl Fn(usize, &mut dyn Env) -> Result<()> + Sync,
    ) -> Result<()> {
        self.for_each_slot("changing an environment", Way::Shared(slots.len()), |i, slot, columns, row| {
            if !slots.contains(&i) {
                return Ok(());
            }
            change(i, &mut *slot.env)?;
            slot.start(columns, row)
        })
    }

    /// Steps the slots whose `active` is true with their row of `actions`, a batch with the column
    /// [`EnvSpec::action_column`]; the infos of the other slots do not change.
    ///
    /// # Errors
    /// When the action column of `actions` has another type or shape, or `actions` does not have one row per slot; and
    /// as [`Env::step`] and [`Env::render`].
    pub fn step(&mut self, actions: &Batch, active: &[bool]) -> Result<()> {
        if actions.rows() != self.len() || active.len() != self.len() {
            return Err(Error::mismatch(
                "stepping a pool",
                format!("{} actions and {} active flags", actions.rows(), active.len()),
                format!("{0} of each, one for each environment", self.len()),
            ));
        }
        let column = actions.schema().index(columns::ACTION)?;
        let dtype = actions.schema().columns()[column].dtype;
        let expected = self.spec().action_column();
        if actions.schema().columns()[column] != expected {
            return Err(Error::mismatch(
                "stepping a pool",
                format!("actions {} {:?}", dtype.name(), actions.schema().columns()[column].shape),
                format!("{} {:?}", expected.dtype.name(), expected.shape),
            ));
        }
        let limit = self.max_episode_steps;
        let stepping = active.iter().filter(|&&active| active).count();
        let mut clock = self.steps.clock(stepping);
        let action = |i| match dtype {
            DType::Float32 => Action::Continuous(actions.row(i).at::<f32>(column)),
            _ => Action::Discrete(actions.row(i).at::<i64>(column)),
        };
        let mut dispatched = true;
        for (i, slot) in self.slots.iter_mut().enumerate().filter(|(i, _)| active[*i]) {
            dispatched &= slot.dispatch(PendingCall::Step(action(i)));
        }
        // Environments in worker processes step in parallel while one thread waits for them. Frames are resized in this
        // process, so steps with frames use several threads.
        let mut way = Way::measured(&self.steps, stepping);
        if dispatched && self.columns.frames.is_none() {
            (way, clock) = (Way::Serial, None);
        }
        let stepped = self.for_each_slot("stepping an environment", way, |i, slot, columns, row| {
            if !active[i] {
                return Ok(());
            }
            let mut transition = slot.env.step(action(i))?;
            slot.steps += 1;
            transition.truncated |= slot.steps >= limit && !transition.terminated;
            row.set(columns.standard.reward, &[transition.reward as f32]);
            row.set(columns.standard.terminated, &[u8::from(transition.terminated)]);
            row.set(columns.standard.truncated, &[u8::from(transition.truncated)]);
            slot.observe(columns, row)
        });
        if let Some(clock) = clock {
            self.steps.record(way == Way::Serial, stepping, clock.elapsed());
        }
        stepped
    }

    /// Runs `work`, which does `what`, on every slot and returns the error of the failed slot with the lowest index. A
    /// panic is an error as well.
    fn for_each_slot(
        &mut self,
        what: &str,
        way: Way,
        work: impl Fn(usize, &mut Slot, &PoolColumns, &mut RowMut<'_>) -> Result<()> + Sync,
    ) -> Result<()> {
        let threads = self.threads.current_num_threads();
        let Self { columns, slots, infos, workers, .. } = self;
        let work = |i: usize, mut row: RowMut<'_>, slot: &mut Slot| {
            let done = catch_unwind(AssertUnwindSafe(|| work(i, slot, columns, &mut row)));
            slot.failed = done.unwrap_or_else(|panic| Err(Error::panicked(what, &*panic))).err();
        };
        match way {
            Way::Shared(busy) if threads > 1 && busy >= threads => {
                let workers = match workers {
                    Some(workers) => workers,
                    None => workers.insert(
                        WorkerThreads::new(threads - 1).map_err(|e| Error::external("starting worker threads", e))?,
                    ),
                };
                let divided = infos.divided_zip_mut(slots, work);
                workers.run(threads - 1, &divided).map_err(|panic| Error::panicked(what, &*panic))?;
            }
            // An environment may draw a frame on several threads of the rayon pool.
            Way::Shared(busy) if threads > 1 => {
                let budget = threads.div_ceil(busy.max(1));
                let work =
                    |i: usize, row: RowMut<'_>, slot: &mut Slot| thread_budget::with(budget, || work(i, row, slot));
                self.threads.install(|| infos.par_zip_mut(slots, work));
            }
            Way::Shared(_) | Way::Serial => infos.zip_mut(slots, work),
        }
        match self.slots.iter_mut().find_map(|slot| slot.failed.take()) {
            None => Ok(()),
            Some(error) => {
                self.slots.iter_mut().for_each(|slot| slot.failed = None);
                Err(error)
            }
        }
    }
}

/// How work is divided among threads.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Way {
    /// The calling thread does all of it.
    Serial,
    /// The calling thread shares it. The value is the number of slots that have work.
    Shared(usize),
}

impl Way {
    /// The faster way for `busy` slots.
    fn measured(parallelism: &Parallelism, busy: usize) -> Self {
        if parallelism.is_serial(busy) { Self::Serial } else { Self::Shared(busy) }
    }
}

impl Slot {
    /// Dispatches a call to the environment's worker process, if there is one, and returns whether the work started.
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool {
        self.env.as_dispatch().is_some_and(|env| env.dispatch(call))
    }

    /// Fills the row of an episode's first observation.
    fn start(&mut self, columns: &PoolColumns, row: &mut RowMut<'_>) -> Result<()> {
        self.steps = 0;
        row.set(columns.standard.reward, &[0.0f32]);
        row.set(columns.standard.terminated, &[0u8]);
        row.set(columns.standard.truncated, &[0u8]);
        self.observe(columns, row)?;
        match columns.frames {
            Some(FrameColumns { goal, height, width, .. }) => {
                self.env.render_goal(FrameMut::new(width, height, row.at::<u8>(goal)))
            }
            None => Ok(()),
        }
    }

    /// Fills the observation, `success`, `step_idx` and the frames of a row.
    fn observe(&mut self, columns: &PoolColumns, row: &mut RowMut<'_>) -> Result<()> {
        self.env.observe(row);
        row.set(columns.standard.success, &[u8::from(self.env.is_success())]);
        row.set(columns.step_idx, &[self.steps as i32]);
        if let Some(FrameColumns { pixels, first_view, height, width, .. }) = columns.frames {
            self.env.render(FrameMut::new(width, height, row.at::<u8>(pixels)))?;
            for (i, view) in columns.views.iter().enumerate() {
                self.env.render_view(view, height, width, row.bytes(first_view + i))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
