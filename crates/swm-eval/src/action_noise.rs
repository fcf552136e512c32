//! [`NoisyPolicy`]: adds Gaussian noise to the actions of a policy.

use rand::Rng as _;
use rand_distr::StandardNormal;
use swm_core::columns::ACTION;
use swm_core::run::Interrupt;
use swm_core::{Batch, EnvPool, EnvSpec, Error, Key, Policy, Result, Rng, Space};

/// A policy whose actions get independent Gaussian noise and are clipped to the action space. The noise of an episode
/// depends on the key of the episode only.
pub struct NoisyPolicy<'a> {
    policy: &'a mut dyn Policy,
    /// The standard deviation of the noise, in the units of the action space.
    std: f64,
    /// The bounds of every component of an action.
    bounds: Vec<(f64, f64)>,
    rngs: Vec<Rng>,
}

impl<'a> NoisyPolicy<'a> {
    /// Adds noise of the standard deviation `std` to a policy for `slots` environments.
    ///
    /// # Errors
    /// When [`check`] fails.
    pub fn new(policy: &'a mut dyn Policy, std: f64, spec: &EnvSpec, slots: usize) -> Result<Self> {
        check(std, spec)?;
        let bounds = (0..spec.action_dim()).map(|i| spec.action_space.bounds(i)).collect();
        Ok(Self { policy, std, bounds, rngs: vec![Key::new(0).rng(); slots] })
    }
}

/// Checks that actions can have noise of a standard deviation; 0 is no noise.
///
/// # Errors
/// When the standard deviation is negative or not finite, or actions are discrete.
pub fn check(std: f64, spec: &EnvSpec) -> Result<()> {
    if !(std >= 0.0 && std.is_finite()) {
        let fix = "give a standard deviation of at least 0, in the units of the action space";
        return Err(Error::config("action noise", std.to_string(), fix));
    }
    if std > 0.0 && !matches!(spec.action_space, Space::Box { .. }) {
        let problem = format!("the actions of {} are discrete", spec.id);
        let fix = "remove the noise, or mix with the random policy (--policy expert:0.7 --policy random:0.3)";
        return Err(Error::config("action noise", problem, fix));
    }
    Ok(())
}

impl Policy for NoisyPolicy<'_> {
    fn begin(&mut self, slot: usize, key: Key) {
        self.rngs[slot] = key.with("action noise").rng();
        self.policy.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.policy.act(infos, active, actions)?;
        self.add_noise(active, actions)
    }

    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: &dyn Interrupt,
    ) -> Result<()> {
        self.policy.act_until(infos, active, actions, interrupt)?;
        self.add_noise(active, actions)
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> Result<()> {
        self.policy.observe_envs(envs, active)
    }

    fn uses_threads(&self) -> bool {
        self.policy.uses_threads()
    }

    fn take_latencies(&mut self) -> Vec<f64> {
        self.policy.take_latencies()
    }
}

impl NoisyPolicy<'_> {
    /// Adds noise to the actions of the active slots.
    fn add_noise(&mut self, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(ACTION)?;
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let rng = &mut self.rngs[slot];
            for (value, &(low, high)) in actions.row_mut(slot).at::<f32>(column).iter_mut().zip(&self.bounds) {
                let noise = self.std * rng.sample::<f64, _>(StandardNormal);
                *value = (f64::from(*value) + noise).clamp(low, high) as f32;
            }
        }
        Ok(())
    }
}
