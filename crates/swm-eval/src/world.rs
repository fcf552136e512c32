//! [`World`]: a pool of environments of one kind and the loop that plays a policy in them.

use crate::Starts;
use std::collections::BTreeMap;
use swm_core::pool::{Reset, threads};
use swm_core::run::Control;
use swm_core::{
    Batch, CameraView, Env, EnvChoice, EnvPool, EnvSpec, Error, Key, Policy, ResetOptions, Result, Schema,
    VariationRequest,
};

/// How big a world is and what it draws.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorldConfig {
    /// Environments played at the same time.
    pub envs: usize,
    /// The `(height, width)` of pictures, if any are drawn.
    pub image: Option<(usize, usize)>,
    /// What is drawn besides the default camera's colours, at the same size.
    pub views: Vec<CameraView>,
    /// Steps after which an episode is truncated; the environment's own number for `None`.
    pub max_episode_steps: Option<usize>,
    /// Worker threads; as many as the machine offers for 0.
    pub threads: usize,
}

impl Default for WorldConfig {
    /// Eight environments at the paper's picture size, on all cores.
    fn default() -> Self {
        Self { envs: 8, image: Some((224, 224)), views: vec![], max_episode_steps: None, threads: 0 }
    }
}

/// Many environments of one kind.
pub struct World {
    pool: EnvPool,
    /// One action row a slot.
    actions: Batch,
}

impl World {
    /// A world of `config.envs` environments.
    ///
    /// # Errors
    /// When no environment is asked for, pictures have no pixels, episodes have no steps, or threads cannot
    /// be started.
    pub fn new(env: impl Into<EnvChoice>, config: WorldConfig) -> Result<Self> {
        let env = env.into();
        Self::of(|| env.env(), config)
    }

    /// As [`World::new`], of environments that `make` makes: with wrappers around them, or of none of the registry.
    ///
    /// # Errors
    /// As [`World::new`], and what `make` returns.
    pub fn of(make: impl FnMut() -> Result<Box<dyn Env>>, config: WorldConfig) -> Result<Self> {
        if let Some((height, width)) = config.image
            && (height == 0 || width == 0)
        {
            let given = format!("{height} x {width}");
            return Err(Error::config("picture size", given, "ask for at least one pixel each way, or no pictures"));
        }
        if config.max_episode_steps == Some(0) {
            return Err(Error::config("steps of an episode", "0", "ask for at least 1"));
        }
        let envs: Result<Vec<Box<dyn Env>>> = std::iter::repeat_with(make).take(config.envs).collect();
        let pool =
            EnvPool::with_views(envs?, config.image, config.views, config.max_episode_steps, threads(config.threads)?)?;
        let actions = Batch::zeros(&Schema::new([pool.spec().action_column()])?, pool.len());
        Ok(Self { pool, actions })
    }

    /// The environments.
    pub fn pool(&self) -> &EnvPool {
        &self.pool
    }

    /// What never changes about the environments.
    pub fn spec(&self) -> &EnvSpec {
        self.pool.spec()
    }

    /// What decides its numbers and pictures, with versions; a renderer where there are pictures.
    pub fn libraries(&self) -> BTreeMap<String, String> {
        let mut libraries = self.pool.env(0).libraries();
        if self.pool.image().is_none() && self.pool.views().is_empty() {
            libraries.remove("renderer");
        }
        libraries
    }

    /// Starts an episode in every slot, keyed by the slot, for loops of one's own.
    ///
    /// # Errors
    /// When an environment refuses the request.
    pub fn reset(&mut self, seed: u64, variation: &VariationRequest) -> Result<()> {
        let resets: Vec<Reset> =
            (0..self.pool.len()).map(|slot| reset(slot, episode_key(seed, slot), variation)).collect();
        self.pool.reset(&resets)
    }

    /// Lets the policy act in the active slots and steps them.
    ///
    /// The policy runs on the pool's threads, so one setting bounds the threads of everything.
    ///
    /// # Errors
    /// When the policy or an environment fails.
    pub fn step(&mut self, policy: &mut dyn Policy, active: &[bool]) -> Result<()> {
        self.act(policy, active)?;
        self.pool.step(&self.actions, active)
    }

    /// The action of every slot, for loops of one's own: filled before [`World::advance`].
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

    /// Lets the policy fill the active slots of [`World::actions_mut`], without stepping.
    ///
    /// # Errors
    /// When the policy fails.
    pub fn ask(&mut self, policy: &mut dyn Policy, active: &[bool]) -> Result<()> {
        self.act(policy, active)
    }

    /// Starts some of these episodes in slots: `(slot, episode)`.
    pub(crate) fn start(&mut self, starts: &Starts, starting: &[(usize, usize)]) -> Result<()> {
        starts.start(&mut self.pool, starting)
    }

    /// Starts new episodes in some slots.
    ///
    /// # Errors
    /// When an environment refuses its options.
    pub fn restart(&mut self, resets: &[Reset]) -> Result<()> {
        self.pool.reset(resets)
    }

    /// Changes environments in place, then shows them as after a reset.
    ///
    /// # Errors
    /// What `change` returns.
    pub fn change(&mut self, slots: &[usize], change: impl Fn(usize, &mut dyn Env) -> Result<()> + Sync) -> Result<()> {
        self.pool.restart(slots, change)
    }

    fn act(&mut self, policy: &mut dyn Policy, active: &[bool]) -> Result<()> {
        policy.observe_envs(&self.pool, active)?;
        let (infos, actions) = (self.pool.infos(), &mut self.actions);
        if policy.uses_threads() {
            self.pool.threads().install(|| policy.act(infos, active, actions))
        } else {
            policy.act(infos, active, actions)
        }
    }

    /// Plays episodes until `play` has no more, each slot taking the next one when it is free.
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
            self.act(policy, &active)?;
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

/// What is done with the episodes a world plays.
pub(crate) trait Play {
    /// The next episode to start; none when there is none, or none yet.
    fn next(&mut self) -> Option<usize>;

    /// Whether [`Play::next`] would name an episode now.
    fn more(&self) -> bool;

    /// Whether nothing more needs to be played, whatever is still running.
    fn over(&self) -> bool {
        false
    }

    /// The key of an episode.
    fn key(&self, episode: usize) -> Key;

    /// Starts episodes in slots: `(slot, episode)`.
    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()>;

    /// The slot shows its first observation; whether the episode is to be played.
    fn started(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool>;

    /// The policy acted on what the slot shows; the step comes next.
    fn acted(&mut self, slot: usize, pool: &EnvPool, actions: &Batch);

    /// The slot was stepped; whether the episode goes on.
    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool>;
}

/// The key of an episode: all its randomness, the policy's included.
pub fn episode_key(seed: u64, episode: usize) -> Key {
    Key::new(seed).with("episode").at(episode as u64)
}

/// The seed an environment is reset with. The highest bit is left out so that signed integers hold it: it is
/// written to results and datasets, and Gymnasium takes no negative seeds.
pub fn reset_seed(key: Key) -> u64 {
    key.seed() >> 1
}

/// A reset of a slot to the start of an episode.
pub(crate) fn reset(slot: usize, key: Key, variation: &VariationRequest) -> Reset {
    let options = ResetOptions { variation: variation.clone(), ..ResetOptions::default() };
    Reset { slot, seed: reset_seed(key), options }
}
