//! [`World`]: a pool of environments of one kind and the loop that plays a policy in them.
//!
//! Collections and evaluations implement `Play`, which selects the episodes and consumes their steps.

use crate::seeding::{episode_key, reset};
use std::collections::BTreeMap;
use swm_core::pool::{Reset, threads};
use swm_core::run::Control;
use swm_core::{
    Batch, CameraView, Env, EnvChoice, EnvPool, EnvSpec, Error, Key, Policy, Result, Schema, VariationRequest, limits,
};

/// The size of a world and the frames it renders.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorldConfig {
    /// Environments played at the same time.
    pub envs: usize,
    /// The `(height, width)` of frames, in pixels; `None` for no frames.
    pub image: Option<(usize, usize)>,
    /// Camera views to render in addition to the RGB frames of the default camera, at the same size.
    pub views: Vec<CameraView>,
    /// The time limit of an episode, in steps; `None` for the environment's time limit.
    pub max_episode_steps: Option<usize>,
    /// Worker threads; 0 for the number of cores.
    pub threads: usize,
}

impl Default for WorldConfig {
    /// Eight environments at the paper's frame size, on all cores.
    fn default() -> Self {
        Self { envs: 8, image: Some((224, 224)), views: vec![], max_episode_steps: None, threads: 0 }
    }
}

/// Many environments of one kind.
pub struct World {
    pool: EnvPool,
    /// One row of actions for each slot.
    actions: Batch,
    /// The NaN and infinite values of the last collection, by column.
    not_finite: BTreeMap<String, u64>,
}

impl World {
    /// A world of `config.envs` environments.
    ///
    /// # Errors
    /// When there are no environments, frames have no pixels, episodes have no steps, or threads cannot be started.
    pub fn new(env: impl Into<EnvChoice>, config: WorldConfig) -> Result<Self> {
        let env = env.into();
        Self::of(|| env.env(), config)
    }

    /// Creates a world of environments that `make` creates, such as wrapped or unregistered environments.
    ///
    /// # Errors
    /// As [`World::new`], or when `make` fails.
    pub fn of(make: impl FnMut() -> Result<Box<dyn Env>>, config: WorldConfig) -> Result<Self> {
        if let Some((height, width)) = config.image
            && (height == 0 || width == 0)
        {
            let given = format!("{height} x {width}");
            return Err(Error::config(
                "frame size",
                given,
                "choose at least one pixel in each dimension, or no frames",
            ));
        }
        limits::ENVS.check(config.envs)?;
        limits::THREADS.check(config.threads)?;
        let (height, width) = config.image.unwrap_or_default();
        limits::IMAGE_SIDE.check(height.max(width))?;
        limits::STEPS.check(config.max_episode_steps.unwrap_or_default())?;
        if config.max_episode_steps == Some(0) {
            return Err(Error::config("steps of an episode", "0", "choose at least 1"));
        }
        let envs: Result<Vec<Box<dyn Env>>> = std::iter::repeat_with(make).take(config.envs).collect();
        let pool =
            EnvPool::with_views(envs?, config.image, config.views, config.max_episode_steps, threads(config.threads)?)?;
        let actions = Batch::zeros(&Schema::new([pool.spec().action_column()])?, pool.len());
        Ok(Self { pool, actions, not_finite: BTreeMap::new() })
    }

    /// The pool of environments.
    pub fn pool(&self) -> &EnvPool {
        &self.pool
    }

    /// The specification of the environments.
    pub fn spec(&self) -> &EnvSpec {
        self.pool.spec()
    }

    /// The versions of the libraries that determine results. The renderer is included only if frames are rendered.
    pub fn libraries(&self) -> BTreeMap<String, String> {
        let mut libraries = self.pool.env(0).libraries();
        if self.pool.image().is_none() && self.pool.views().is_empty() {
            libraries.remove("renderer");
        }
        libraries
    }

    /// The number of NaN and infinite values that the last collection stored, by column, also if it was interrupted.
    /// Empty if all values were finite.
    pub fn not_finite(&self) -> &BTreeMap<String, u64> {
        &self.not_finite
    }

    pub(crate) fn set_not_finite(&mut self, counts: BTreeMap<String, u64>) {
        self.not_finite = counts;
    }

    /// Starts an episode in every slot, keyed by the slot, for custom loops.
    ///
    /// # Errors
    /// When an environment rejects the request.
    pub fn reset(&mut self, seed: u64, variation: &VariationRequest) -> Result<()> {
        let resets: Vec<Reset> =
            (0..self.pool.len()).map(|slot| reset(slot, episode_key(seed, slot), variation)).collect();
        self.pool.reset(&resets)
    }

    /// Computes the policy's actions for the active slots and steps them.
    ///
    /// # Errors
    /// When the policy or an environment fails.
    pub fn step(&mut self, policy: &mut dyn Policy, active: &[bool]) -> Result<()> {
        self.act(policy, active)?;
        self.pool.step(&self.actions, active)
    }

    /// The actions of all slots. A custom loop writes them before it calls [`World::advance`].
    pub fn actions_mut(&mut self) -> &mut Batch {
        &mut self.actions
    }

    /// Steps the active slots with the actions in [`World::actions_mut`].
    ///
    /// # Errors
    /// When an environment fails.
    pub fn advance(&mut self, active: &[bool]) -> Result<()> {
        self.pool.step(&self.actions, active)
    }

    /// The pool of environments, for changes between steps.
    pub(crate) fn pool_mut(&mut self) -> &mut EnvPool {
        &mut self.pool
    }

    /// Starts new episodes in some slots.
    ///
    /// # Errors
    /// When an environment rejects its options.
    pub fn restart(&mut self, resets: &[Reset]) -> Result<()> {
        self.pool.reset(resets)
    }

    /// Modifies environments in place, then observes them as after a reset.
    ///
    /// # Errors
    /// When `modify` fails.
    pub fn modify(&mut self, slots: &[usize], modify: impl Fn(usize, &mut dyn Env) -> Result<()> + Sync) -> Result<()> {
        self.pool.restart(slots, modify)
    }

    /// Computes the policy's actions for the active slots into [`World::actions_mut`], without stepping.
    ///
    /// The policy runs on the pool's threads, so that one setting limits all threads.
    ///
    /// # Errors
    /// When the policy fails.
    pub fn act(&mut self, policy: &mut dyn Policy, active: &[bool]) -> Result<()> {
        policy.observe_envs(&self.pool, active)?;
        let (infos, actions) = (self.pool.infos(), &mut self.actions);
        if policy.uses_threads() {
            self.pool.threads().install(|| policy.act(infos, active, actions))
        } else {
            policy.act(infos, active, actions)
        }
    }

    /// As [`World::act`]; `control` interrupts a policy that takes long, such as a planner between two iterations.
    ///
    /// # Errors
    /// When the policy fails, and the error of `control`.
    pub fn act_until(&mut self, policy: &mut dyn Policy, active: &[bool], control: &mut Control<'_>) -> Result<()> {
        policy.observe_envs(&self.pool, active)?;
        let (infos, actions) = (self.pool.infos(), &mut self.actions);
        if policy.uses_threads() {
            control.install(Some(self.pool.threads()), |interrupt| policy.act_until(infos, active, actions, interrupt))
        } else {
            control.on_this_thread(|interrupt| policy.act_until(infos, active, actions, interrupt))
        }
    }

    /// Plays the episodes of `play`. A free slot starts the next episode.
    pub(crate) fn play(
        &mut self,
        policy: &mut dyn Policy,
        play: &mut impl Play,
        control: &mut Control<'_>,
    ) -> Result<()> {
        let slots = self.pool.len();
        let mut episodes: Vec<Option<usize>> = vec![None; slots];
        let mut active = vec![false; slots];
        let mut starting: Vec<(usize, usize)> = Vec::with_capacity(slots);
        while !play.over() {
            control.check()?;
            starting.clear();
            for (slot, episode) in episodes.iter_mut().enumerate().filter(|(_, episode)| episode.is_none()) {
                *episode = play.next();
                starting.extend(episode.map(|episode| (slot, episode)));
            }
            if !starting.is_empty() {
                play.start(&mut self.pool, &starting)?;
                for &(slot, episode) in &starting {
                    if play.started(slot, &self.pool, control)? {
                        policy.begin(slot, play.key(episode));
                    } else {
                        episodes[slot] = None;
                    }
                }
                if episodes.iter().any(Option::is_none) && play.more() {
                    continue;
                }
            }
            for (active, episode) in active.iter_mut().zip(&episodes) {
                *active = episode.is_some();
            }
            if !active.contains(&true) {
                break;
            }
            self.act_until(policy, &active, control)?;
            for slot in (0..slots).filter(|&slot| active[slot]) {
                play.acted(slot, &self.pool, &self.actions);
            }
            self.pool.step(&self.actions, &active)?;
            for slot in (0..slots).filter(|&slot| active[slot]) {
                if !play.stepped(slot, &self.pool, control)? {
                    episodes[slot] = None;
                }
            }
        }
        Ok(())
    }
}

/// Selects the episodes that a world plays and consumes their steps.
pub(crate) trait Play {
    /// Returns the next episode to start; `None` if no episode can start now.
    fn next(&mut self) -> Option<usize>;

    /// Whether [`Play::next`] would return an episode now.
    fn more(&self) -> bool;

    /// Whether playing can stop, even if episodes are still running.
    fn over(&self) -> bool {
        false
    }

    /// The key of an episode.
    fn key(&self, episode: usize) -> Key;

    /// Starts episodes in slots: `(slot, episode)`.
    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()>;

    /// Consumes the first observation of a slot; returns whether to play the episode.
    fn started(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool>;

    /// Consumes the observation and the action of a slot, before the step.
    fn acted(&mut self, slot: usize, pool: &EnvPool, actions: &Batch);

    /// Consumes the result of a step; returns whether the episode continues.
    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool>;
}
