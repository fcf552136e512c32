//! [`Collector`]: steps environments with a policy and adds the transitions to the replay buffer, segment by segment.
//!
//! The last observation of a segment is the first observation of the next segment, so that no transition is lost. No
//! clip of several steps spans two segments.

use crate::train::metrics::null_is_nan;
use serde::{Deserialize, Serialize};
use swm_core::columns::{ACTION, REWARD, TERMINATED, TRUNCATED};
use swm_core::pool::Reset;
use swm_core::{Batch, EnvPool, Error, Key, Policy, ResetOptions, Result, Schema};
use swm_data::{Constants, ReplayBuffer};

/// Runs episodes in a pool of environments and adds the transitions to a replay buffer.
pub(super) struct Collector {
    pool: EnvPool,
    replay: ReplayBuffer,
    /// The index in the infos and the index in a recorded row of every observation column.
    observed: Vec<(usize, usize)>,
    /// Index of the action column in a recorded row.
    action: usize,
    reward: usize,
    terminated: usize,
    /// The episode of every slot.
    running: Vec<Running>,
    actions: Batch,
    active: Vec<bool>,
    key: Key,
    /// Steps of a segment.
    segment: usize,
    /// The index of the next episode.
    next: u64,
    /// Environment steps done.
    pub steps: usize,
    /// Undiscounted returns of the episodes that ended at the last step at which one did.
    pub returns: Vec<f64>,
}

/// A running episode.
struct Running {
    /// The index of the episode.
    episode: u64,
    /// The segment being recorded, with spare rows at the end.
    rows: Batch,
    /// Recorded rows of the segment.
    length: usize,
    /// All actions of the episode, row-major `[steps, action_dim]`.
    actions: Vec<f32>,
    /// The undiscounted return of the episode so far.
    total: f64,
}

/// The saved state of a [`Collector`], which [`Collector::restore`] reads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct CollectorState {
    /// The time limit of the episodes; `None` in the data of earlier programs.
    #[serde(default)]
    pub(super) max_steps: Option<usize>,
    steps: usize,
    next: u64,
    /// The index and the actions of every running episode; the environments are restored by repeating the actions.
    running: Vec<(u64, Vec<f32>)>,
    /// The returns of the last episodes that ended.
    #[serde(default, deserialize_with = "null_is_nan")]
    returns: Vec<f64>,
    /// What the policy remembers of the running episodes.
    #[serde(default)]
    pub(super) memory: Vec<Vec<f32>>,
}

impl Collector {
    /// Records the columns of `replay` in the environments of `pool`, in segments of `segment` steps. `key` determines
    /// the episodes.
    ///
    /// # Errors
    /// When the environments lack a column.
    pub fn new(pool: EnvPool, replay: &ReplayBuffer, schema: &Schema, segment: usize, key: Key) -> Result<Self> {
        let infos = pool.infos().schema();
        let mut observed = vec![];
        for (to, column) in schema.columns().iter().enumerate() {
            if ![ACTION, REWARD, TERMINATED].contains(&column.name.as_str()) {
                observed.push((infos.index(&column.name)?, to));
            }
        }
        let slots = pool.len();
        let rows = || Batch::zeros(schema, 0);
        let running = (0..slots).map(|_| Running { episode: 0, rows: rows(), length: 0, actions: vec![], total: 0.0 });
        Ok(Self {
            replay: replay.clone(),
            observed,
            action: schema.index(ACTION)?,
            reward: schema.index(REWARD)?,
            terminated: schema.index(TERMINATED)?,
            running: running.collect(),
            actions: Batch::zeros(&Schema::new(vec![pool.spec().action_column()])?, slots),
            active: vec![true; slots],
            pool,
            key,
            segment,
            next: 0,
            steps: 0,
            returns: vec![],
        })
    }

    /// Starts an episode in every slot.
    ///
    /// # Errors
    /// When an environment fails.
    pub fn start(&mut self) -> Result<()> {
        let slots: Vec<usize> = (0..self.pool.len()).collect();
        self.begin(&slots)
    }

    /// Calls `begin` of a new policy for every running episode.
    pub fn begin_policy(&self, policy: &mut dyn Policy) {
        for (slot, running) in self.running.iter().enumerate() {
            policy.begin(slot, self.key.at(running.episode));
        }
    }

    /// Makes one step of every environment.
    ///
    /// # Errors
    /// When the policy or an environment fails.
    pub fn step(&mut self, policy: &mut dyn Policy) -> Result<()> {
        policy.observe_envs(&self.pool, &self.active)?;
        policy.act(self.pool.infos(), &self.active, &mut self.actions)?;
        let ended = self.advance(true)?;
        self.begin(&ended)?;
        for &slot in &ended {
            policy.begin(slot, self.key.at(self.running[slot].episode));
        }
        Ok(())
    }

    /// Executes the actions in the active slots and returns the slots whose episode ended. With `record`, complete
    /// segments go to the replay buffer.
    fn advance(&mut self, record: bool) -> Result<Vec<usize>> {
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
            (infos.get::<f32>(REWARD)?, infos.get::<u8>(TERMINATED)?, infos.get::<u8>(TRUNCATED)?);
        let mut ended = vec![];
        for (slot, running) in running.iter_mut().enumerate().filter(|&(slot, _)| active[slot]) {
            self.steps += 1;
            running.total += f64::from(rewards[slot]);
            let mut row = running.rows.row_mut(running.length - 1);
            row.set(self.reward, &[rewards[slot]]);
            row.set(self.terminated, &[terminated[slot]]);
            let episode_ended = terminated[slot] + truncated[slot] > 0;
            if episode_ended || running.length >= self.segment {
                running.observe(observed, infos, slot);
                let mut row = running.rows.row_mut(running.length - 1);
                row.at::<f32>(self.action).fill(f32::NAN);
                row.set(self.reward, &[0.0f32]);
                row.set(self.terminated, &[0u8]);
                running.rows.resize(running.length);
                if record {
                    self.replay.add(&running.rows, &Constants::default())?;
                }
                running.length = 0;
            }
            if episode_ended {
                if ended.is_empty() {
                    self.returns.clear();
                }
                self.returns.push(running.total);
                ended.push(slot);
            }
        }
        Ok(ended)
    }

    /// Starts the next episodes in the slots `slots`.
    fn begin(&mut self, slots: &[usize]) -> Result<()> {
        for &slot in slots {
            self.running[slot].episode = self.next;
            self.next += 1;
        }
        self.reset(slots)
    }

    /// Resets the environments of the slots `slots` to the start of their episodes.
    fn reset(&mut self, slots: &[usize]) -> Result<()> {
        if slots.is_empty() {
            return Ok(());
        }
        let mut resets = vec![];
        for &slot in slots {
            let running = &mut self.running[slot];
            (running.length, running.total) = (0, 0.0);
            running.actions.clear();
            let seed = self.key.at(running.episode).seed() >> 1;
            resets.push(Reset { slot, seed, options: ResetOptions::default() });
        }
        self.pool.reset(&resets)
    }

    /// Returns the state from which a collector can continue with a policy that has this memory.
    pub fn state(&self, memory: Vec<Vec<f32>>) -> CollectorState {
        let running = self.running.iter().map(|running| (running.episode, running.actions.clone()));
        CollectorState {
            max_steps: Some(self.pool.max_episode_steps()),
            steps: self.steps,
            next: self.next,
            running: running.collect(),
            returns: self.returns.clone(),
            memory,
        }
    }

    /// The time limit of the episodes, in steps.
    pub fn max_episode_steps(&self) -> usize {
        self.pool.max_episode_steps()
    }

    /// Restores the state of a collector with the same key: repeats the actions of the running episodes.
    ///
    /// # Errors
    /// When the number of environments differs, or an episode ends earlier than in the saved run.
    pub fn restore(&mut self, state: &CollectorState) -> Result<()> {
        if state.running.len() != self.running.len() {
            let expected = format!("{}, as in the saved run", state.running.len());
            return Err(Error::mismatch(
                "continuing a training run",
                format!("{} environments", self.running.len()),
                expected,
            ));
        }
        for (running, (episode, _)) in self.running.iter_mut().zip(&state.running) {
            running.episode = *episode;
        }
        let slots: Vec<usize> = (0..self.running.len()).collect();
        self.reset(&slots)?;
        let dim = self.pool.spec().action_dim();
        let longest = state.running.iter().map(|(_, actions)| actions.len() / dim).max().unwrap_or(0);
        for step in 0..longest {
            for (slot, (_, actions)) in state.running.iter().enumerate() {
                let action = actions.get(step * dim..(step + 1) * dim);
                self.active[slot] = action.is_some();
                if let Some(action) = action {
                    self.actions.row_mut(slot).set(0, action);
                }
            }
            if !self.advance(false)?.is_empty() {
                return Err(Error::mismatch(
                    "continuing a training run",
                    "an episode that ends earlier than in the saved run",
                    "the environments with which the run began, and the same version of this program",
                ));
            }
        }
        self.active.fill(true);
        (self.steps, self.next) = (state.steps, state.next);
        self.returns.clone_from(&state.returns);
        Ok(())
    }
}

impl Running {
    /// Records the observation of a slot as the next row.
    fn observe(&mut self, observed: &[(usize, usize)], infos: &Batch, slot: usize) {
        let row = self.length;
        self.length += 1;
        if self.rows.rows() < self.length {
            // Doubling keeps reallocations rare.
            self.rows.resize((2 * self.length).max(64));
        }
        for &(from, to) in observed {
            let n = infos.schema().columns()[from].row_bytes();
            self.rows.bytes_mut(to)[row * n..][..n].copy_from_slice(&infos.bytes(from)[slot * n..][..n]);
        }
    }
}
