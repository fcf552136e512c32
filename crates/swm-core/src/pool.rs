//! [`EnvPool`]: many environments of one kind, stepped and drawn on a fixed set of threads.
//!
//! Everything the environments produce lands in one [`Batch`], `infos`, written in place: the environment's own
//! columns, then `reward`, `terminated`, `truncated`, `success`, `step_idx`, and, where pictures are asked for,
//! `pixels`, `goal` and other views. What an environment produces depends on its seed and its actions only, never on the
//! number of threads or of neighbours.

use crate::batch::{Batch, ColumnSpec, DType, RowMut, Schema};
use crate::pace::Pace;
use crate::share;
use crate::{Action, Env, EnvSpec, Error, FrameMut, Next, ResetOptions, Result, View};
use std::sync::Arc;
use std::time::Instant;

/// One slot of a pool to reset.
#[derive(Clone)]
pub struct Reset {
    /// Which slot.
    pub slot: usize,
    /// The seed of its episode.
    pub seed: u64,
    /// Factors, start and goal.
    pub options: ResetOptions,
}

/// Columns the pool adds behind the environment's own.
struct Places {
    reward: usize,
    terminated: usize,
    truncated: usize,
    success: usize,
    step: usize,
    pixels: Option<(usize, usize, usize)>,
    /// The views behind `pixels` and `goal`.
    views: Vec<View>,
}

/// Many environments of one kind.
pub struct EnvPool {
    slots: Vec<Slot>,
    infos: Batch,
    places: Places,
    threads: Arc<rayon::ThreadPool>,
    max_episode_steps: usize,
    pace: Pace,
}

struct Slot {
    env: Box<dyn Env>,
    steps: usize,
    failed: Option<Error>,
}

/// A pool of worker threads: `n` of them, or as many as the machine offers for 0.
///
/// # Errors
/// When the system refuses to start them.
pub fn threads(n: usize) -> Result<Arc<rayon::ThreadPool>> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(n).thread_name(|i| format!("swm-{i}")).build();
    pool.map(Arc::new).map_err(|error| Error::external("starting worker threads", error))
}

impl EnvPool {
    /// A pool of these environments. `image` is the `(height, width)` of `pixels` and `goal`, if wanted.
    ///
    /// # Errors
    /// When there is no environment.
    pub fn new(
        envs: Vec<Box<dyn Env>>,
        image: Option<(usize, usize)>,
        max_episode_steps: Option<usize>,
        threads: Arc<rayon::ThreadPool>,
    ) -> Result<Self> {
        Self::with_views(envs, image, vec![], max_episode_steps, threads)
    }

    /// As [`EnvPool::new`], with further views of the worlds, each in its own [`View::column`] behind `goal`.
    ///
    /// # Errors
    /// As [`EnvPool::new`], and when views are asked for without a picture's size, or one of them twice.
    pub fn with_views(
        envs: Vec<Box<dyn Env>>,
        image: Option<(usize, usize)>,
        views: Vec<View>,
        max_episode_steps: Option<usize>,
        threads: Arc<rayon::ThreadPool>,
    ) -> Result<Self> {
        if image.is_none() && !views.is_empty() {
            return Err(Error::config("views", "asked for without a size", "give the size of the pictures"));
        }
        let Some(first) = envs.first() else {
            return Err(Error::config("number of environments", "0", "ask for at least 1"));
        };
        let spec = first.spec();
        let mut columns = spec.columns.clone();
        let reward = columns.len();
        columns.push(ColumnSpec::new("reward", DType::Float32, []));
        columns.push(ColumnSpec::new("terminated", DType::Bool, []));
        columns.push(ColumnSpec::new("truncated", DType::Bool, []));
        columns.push(ColumnSpec::new("success", DType::Bool, []));
        columns.push(ColumnSpec::new("step_idx", DType::Int32, []));
        if let Some((height, width)) = image {
            columns.push(ColumnSpec::image("pixels", height, width));
            columns.push(ColumnSpec::image("goal", height, width));
            columns.extend(views.iter().map(|view| view.column(height, width)));
        }
        let places = Places {
            reward,
            terminated: reward + 1,
            truncated: reward + 2,
            success: reward + 3,
            step: reward + 4,
            pixels: image.map(|(height, width)| (reward + 5, height, width)),
            views,
        };
        let max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        let schema = Schema::new(columns)?;
        Ok(Self {
            infos: Batch::zeros(&schema, envs.len()),
            slots: envs.into_iter().map(|env| Slot { env, steps: 0, failed: None }).collect(),
            places,
            threads,
            max_episode_steps,
            pace: Pace::default(),
        })
    }

    /// How many environments.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Whether there is none (never).
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// What never changes about the environments.
    pub fn spec(&self) -> &EnvSpec {
        self.slots[0].env.spec()
    }

    /// What the last reset or step of every slot produced.
    pub fn infos(&self) -> &Batch {
        &self.infos
    }

    /// The `(height, width)` of the pictures, if there are any.
    pub fn image(&self) -> Option<(usize, usize)> {
        self.places.pixels.map(|(_, height, width)| (height, width))
    }

    /// What is drawn besides `pixels` and `goal`.
    pub fn views(&self) -> &[View] {
        &self.places.views
    }

    /// The worker threads.
    pub fn threads(&self) -> &Arc<rayon::ThreadPool> {
        &self.threads
    }

    /// One environment.
    pub fn env(&self, slot: usize) -> &dyn Env {
        &*self.slots[slot].env
    }

    /// Steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> usize {
        self.max_episode_steps
    }

    /// Starts episodes in some slots.
    ///
    /// # Errors
    /// When an environment refuses its options.
    pub fn reset(&mut self, resets: &[Reset]) -> Result<()> {
        let mut wanted: Vec<Option<&Reset>> = vec![None; self.slots.len()];
        for reset in resets {
            wanted[reset.slot] = Some(reset);
        }
        for (slot, reset) in self.slots.iter_mut().zip(&wanted) {
            if let Some(reset) = reset {
                slot.env.announce(Next::Reset(reset.seed, &reset.options));
            }
        }
        self.each(Some(resets.len()), |i, slot, places, row| {
            let Some(reset) = wanted[i] else { return Ok(()) };
            slot.env.reset(reset.seed, &reset.options)?;
            slot.start(places, row)
        })
    }

    /// Changes environments in place (a restore, a new goal), then observes and draws them as after a reset.
    ///
    /// # Errors
    /// What `change` returns.
    pub fn restart(
        &mut self,
        slots: &[usize],
        change: impl Fn(usize, &mut dyn Env) -> Result<()> + Sync,
    ) -> Result<()> {
        self.each(Some(slots.len()), |i, slot, places, row| {
            if !slots.contains(&i) {
                return Ok(());
            }
            change(i, &mut *slot.env)?;
            slot.start(places, row)
        })
    }

    /// Steps the slots whose `active` is true with their row of `actions` (the column of
    /// [`EnvSpec::action_column`]); the others keep their infos.
    ///
    /// # Errors
    /// When `actions` is not of that form, or an environment refuses an action.
    pub fn step(&mut self, actions: &Batch, active: &[bool]) -> Result<()> {
        if actions.rows() != self.len() || active.len() != self.len() {
            return Err(Error::mismatch(
                "stepping a pool",
                format!("{} actions, {} flags", actions.rows(), active.len()),
                format!("{} of each", self.len()),
            ));
        }
        let column = actions.schema().index("action")?;
        let dtype = actions.schema().columns()[column].dtype;
        let wanted = self.spec().action_column();
        if actions.schema().columns()[column] != wanted {
            return Err(Error::mismatch(
                "stepping a pool",
                format!("actions {} {:?}", dtype.name(), actions.schema().columns()[column].shape),
                format!("{} {:?}", wanted.dtype.name(), wanted.shape),
            ));
        }
        let limit = self.max_episode_steps;
        let begun = Instant::now();
        let stepping = active.iter().filter(|&&active| active).count();
        let action = |i| match dtype {
            DType::Float32 => Action::Continuous(actions.row(i).at::<f32>(column)),
            _ => Action::Discrete(actions.row(i).at::<i64>(column)),
        };
        let mut elsewhere = true;
        for (i, slot) in self.slots.iter_mut().enumerate().filter(|(i, _)| active[*i]) {
            elsewhere &= slot.env.announce(Next::Step(action(i)));
        }
        // To wait for what others do, one thread is enough; pictures are scaled and changed here.
        let alone = self.pace.alone(stepping) || (elsewhere && self.places.pixels.is_none());
        let stepped = self.each((!alone).then_some(stepping), |i, slot, places, row| {
            if !active[i] {
                return Ok(());
            }
            let mut transition = slot.env.step(action(i))?;
            slot.steps += 1;
            transition.truncated |= slot.steps >= limit && !transition.terminated;
            #[allow(clippy::cast_possible_truncation)]
            row.set(places.reward, &[transition.reward as f32]);
            row.set(places.terminated, &[u8::from(transition.terminated)]);
            row.set(places.truncated, &[u8::from(transition.truncated)]);
            slot.look(places, row)
        });
        self.pace.note(begun, if alone { 1 } else { self.threads.current_num_threads() }, stepping);
        stepped
    }

    /// Runs `work` on every slot; the first slot's error wins, whatever finished first. In parallel where it is said how many of them
    /// have something to do, which share the threads; on this thread otherwise.
    fn each(
        &mut self,
        busy: Option<usize>,
        work: impl Fn(usize, &mut Slot, &Places, &mut RowMut<'_>) -> Result<()> + Sync,
    ) -> Result<()> {
        let (places, slots, infos) = (&self.places, &mut self.slots, &mut self.infos);
        match busy {
            None => {
                for (i, slot) in slots.iter_mut().enumerate() {
                    slot.failed = work(i, slot, places, &mut infos.row_mut(i)).err();
                }
            }
            Some(busy) => {
                let threads = self.threads.current_num_threads().div_ceil(busy.max(1));
                self.threads.install(|| {
                    infos.par_zip_mut(slots, |i, mut row, slot| {
                        slot.failed = share::with(threads, || work(i, slot, places, &mut row)).err();
                    });
                });
            }
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

impl Slot {
    /// Fills a row after a reset.
    fn start(&mut self, places: &Places, row: &mut RowMut<'_>) -> Result<()> {
        self.steps = 0;
        row.set(places.reward, &[0.0f32]);
        row.set(places.terminated, &[0u8]);
        row.set(places.truncated, &[0u8]);
        self.look(places, row)?;
        match places.pixels {
            Some((pixels, height, width)) => {
                self.env.render_goal(FrameMut::new(width, height, row.at::<u8>(pixels + 1)))
            }
            None => Ok(()),
        }
    }

    /// Fills the parts of a row that follow the world.
    fn look(&mut self, places: &Places, row: &mut RowMut<'_>) -> Result<()> {
        self.env.observe(row);
        row.set(places.success, &[u8::from(self.env.is_success())]);
        #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
        row.set(places.step, &[self.steps as i32]);
        if let Some((pixels, height, width)) = places.pixels {
            self.env.render(FrameMut::new(width, height, row.at::<u8>(pixels)))?;
            for (i, view) in places.views.iter().enumerate() {
                self.env.render_view(view, height, width, row.bytes(pixels + 2 + i))?;
            }
        }
        Ok(())
    }
}
