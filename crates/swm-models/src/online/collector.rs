//! [`Collector`]: plays worlds side by side, and hands what happens to the replay buffer, a part of an episode at a time.
//!
//! A part ends with an observation that the next one begins with, so no transition is lost; of windows of several steps,
//! those across the border are.

use serde::{Deserialize, Serialize};
use swm_core::pool::Reset;
use swm_core::{Batch, EnvPool, Error, Key, Policy, ResetOptions, Result, Schema};
use swm_data::{Constants, ReplayBuffer};

/// Plays.
pub(super) struct Collector {
    pool: EnvPool,
    replay: ReplayBuffer,
    /// Of the recorded columns that are observed: where they are in the infos, and where in a recording.
    observed: Vec<(usize, usize)>,
    /// Where a recording has action, reward and termination.
    action: usize,
    reward: usize,
    terminated: usize,
    running: Vec<Running>,
    actions: Batch,
    active: Vec<bool>,
    key: Key,
    /// Steps of a part.
    part: usize,
    /// The number of the next episode.
    next: u64,
    /// Environment steps.
    pub steps: usize,
    /// Returns of the episodes that ended since somebody took them.
    pub returns: Vec<f64>,
}

/// An episode being played.
struct Running {
    number: u64,
    /// The part that is being recorded, and how many of its rows are.
    rows: Batch,
    length: usize,
    /// All actions of the episode, and its return.
    actions: Vec<f32>,
    total: f64,
}

/// Where a collector is: what it needs to play on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Place {
    steps: usize,
    next: u64,
    /// Number and actions of every running episode: worlds do the same again.
    running: Vec<(u64, Vec<f32>)>,
}

impl Collector {
    /// Records the columns of `replay` in the worlds of `pool`, in parts of `part` steps. What is played is decided by `key`.
    pub fn new(pool: EnvPool, replay: &ReplayBuffer, schema: &Schema, part: usize, key: Key) -> Result<Self> {
        let infos = pool.infos().schema();
        let mut observed = vec![];
        for (to, column) in schema.columns().iter().enumerate() {
            if !["action", "reward", "terminated"].contains(&column.name.as_str()) {
                observed.push((infos.index(&column.name)?, to));
            }
        }
        let slots = pool.len();
        let rows = || Batch::zeros(schema, 0);
        let running = (0..slots).map(|_| Running { number: 0, rows: rows(), length: 0, actions: vec![], total: 0.0 });
        Ok(Self {
            replay: replay.clone(),
            observed,
            action: schema.index("action")?,
            reward: schema.index("reward")?,
            terminated: schema.index("terminated")?,
            running: running.collect(),
            actions: Batch::zeros(&Schema::new(vec![pool.spec().action_column()])?, slots),
            active: vec![true; slots],
            pool,
            key,
            part,
            next: 0,
            steps: 0,
            returns: vec![],
        })
    }

    /// Starts an episode in every slot.
    pub fn start(&mut self) -> Result<()> {
        let slots: Vec<usize> = (0..self.pool.len()).collect();
        self.begin(&slots)
    }

    /// Tells a policy of the episodes that are running.
    pub fn introduce(&self, policy: &mut dyn Policy) {
        for (slot, running) in self.running.iter().enumerate() {
            policy.begin(slot, self.episode(running.number));
        }
    }

    /// One step of every world.
    pub fn play(&mut self, policy: &mut dyn Policy) -> Result<()> {
        policy.observe_envs(&self.pool, &self.active)?;
        policy.act(self.pool.infos(), &self.active, &mut self.actions)?;
        let ended = self.advance(true)?;
        self.begin(&ended)?;
        for &slot in &ended {
            policy.begin(slot, self.episode(self.running[slot].number));
        }
        Ok(())
    }

    /// Executes the actions in the active slots; returns those whose episode ended. Parts that are complete go to the replay
    /// buffer if they are `news`.
    fn advance(&mut self, news: bool) -> Result<Vec<usize>> {
        let Self { pool, running, observed, actions, active, .. } = self;
        for (slot, running) in running.iter_mut().enumerate().filter(|&(slot, _)| active[slot]) {
            running.observe(observed, pool.infos(), slot);
            let (rows, row) = (&mut running.rows, running.length - 1);
            let n = rows.schema().columns()[self.action].row_bytes();
            rows.bytes_mut(self.action)[row * n..][..n].copy_from_slice(&actions.bytes(0)[slot * n..][..n]);
            running.actions.extend_from_slice(actions.row(slot).at::<f32>(0));
        }
        pool.step(actions, active)?;
        let infos = pool.infos();
        let (rewards, terminated, truncated) =
            (infos.get::<f32>("reward")?, infos.get::<u8>("terminated")?, infos.get::<u8>("truncated")?);
        let mut ended = vec![];
        for (slot, running) in running.iter_mut().enumerate().filter(|&(slot, _)| active[slot]) {
            self.steps += 1;
            running.total += f64::from(rewards[slot]);
            let mut row = running.rows.row_mut(running.length - 1);
            row.set(self.reward, &[rewards[slot]]);
            row.set(self.terminated, &[terminated[slot]]);
            let over = terminated[slot] + truncated[slot] > 0;
            if over || running.length >= self.part {
                running.observe(observed, infos, slot);
                let mut row = running.rows.row_mut(running.length - 1);
                row.at::<f32>(self.action).fill(f32::NAN);
                row.set(self.reward, &[0.0f32]);
                row.set(self.terminated, &[0u8]);
                running.rows.resize(running.length);
                if news {
                    self.replay.add(&running.rows, &Constants::default())?;
                }
                running.length = 0;
            }
            if over {
                self.returns.push(running.total);
                ended.push(slot);
            }
        }
        Ok(ended)
    }

    /// Starts the next episodes in these slots.
    fn begin(&mut self, slots: &[usize]) -> Result<()> {
        for &slot in slots {
            self.running[slot].number = self.next;
            self.next += 1;
        }
        self.reset(slots)
    }

    /// Starts the episodes of these slots.
    fn reset(&mut self, slots: &[usize]) -> Result<()> {
        if slots.is_empty() {
            return Ok(());
        }
        let mut resets = vec![];
        for &slot in slots {
            let running = &mut self.running[slot];
            (running.length, running.total) = (0, 0.0);
            running.actions.clear();
            let seed = self.key.at(running.number).seed() >> 1;
            resets.push(Reset { slot, seed, options: ResetOptions::default() });
        }
        self.pool.reset(&resets)
    }

    fn episode(&self, number: u64) -> Key {
        self.key.at(number)
    }

    /// Where it is.
    pub fn place(&self) -> Place {
        let running = self.running.iter().map(|running| (running.number, running.actions.clone()));
        Place { steps: self.steps, next: self.next, running: running.collect() }
    }

    /// Goes to a place where a collector with the same key was.
    ///
    /// # Errors
    /// When it had another number of worlds, or they do not do the same again.
    pub fn go_to(&mut self, place: &Place) -> Result<()> {
        if place.running.len() != self.running.len() {
            let expected = format!("{}, as before", place.running.len());
            return Err(Error::mismatch("continuing", format!("{} worlds", self.running.len()), expected));
        }
        for (running, (number, _)) in self.running.iter_mut().zip(&place.running) {
            running.number = *number;
        }
        let slots: Vec<usize> = (0..self.running.len()).collect();
        self.reset(&slots)?;
        let width = self.pool.spec().action_dim();
        let longest = place.running.iter().map(|(_, actions)| actions.len() / width).max().unwrap_or(0);
        for step in 0..longest {
            for (slot, (_, actions)) in place.running.iter().enumerate() {
                let action = actions.get(step * width..(step + 1) * width);
                self.active[slot] = action.is_some();
                if let Some(action) = action {
                    self.actions.row_mut(slot).set(0, action);
                }
            }
            if !self.advance(false)?.is_empty() {
                return Err(Error::mismatch(
                    "continuing",
                    "an episode that ends where it went on before",
                    "the worlds the run began with (the same version of this program)",
                ));
            }
        }
        self.active.fill(true);
        (self.steps, self.next) = (place.steps, place.next);
        self.returns.clear();
        Ok(())
    }
}

impl Running {
    /// Records what is observed as the next row.
    fn observe(&mut self, observed: &[(usize, usize)], infos: &Batch, slot: usize) {
        let row = self.length;
        self.length += 1;
        if self.rows.rows() < self.length {
            // Rows to spare, so that memory moves rarely.
            self.rows.resize((2 * self.length).max(64));
        }
        for &(from, to) in observed {
            let n = infos.schema().columns()[from].row_bytes();
            self.rows.bytes_mut(to)[row * n..][..n].copy_from_slice(&infos.bytes(from)[slot * n..][..n]);
        }
    }
}
