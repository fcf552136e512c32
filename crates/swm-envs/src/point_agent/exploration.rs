//! [`Explorer`]: the expert `explore`, a smooth random walk for training data that covers the whole environment.
//!
//! The walk consists of legs: each leads to a random position, at a random pace, for a limited number of steps. Noise
//! that changes slowly from step to step is added to every action.

use super::position::Position64;
use rand::Rng as _;
use swm_core::policy::Expert;
use swm_core::{Key, Result, Rng, RowRef};

/// Factor by which the noise decays per step.
const NOISE_DECAY: f64 = 0.8;
/// Half-width of the uniform draw added to the noise per step, as a share of the largest action.
const NOISE_WIDTH: f64 = 0.2;

/// One leg of a random walk.
#[derive(Clone, Copy, Debug, Default)]
pub struct Leg {
    /// The position to which the leg leads, in the environment's unit of length.
    pub to: Position64,
    /// Length of the action before noise, as a share of the largest action. If it is above 1, the action is clipped.
    pub pace: f64,
    /// Steps until the next leg is drawn.
    pub steps: u32,
    /// True if the leg leads around walls; false if it leads straight, possibly into walls.
    pub avoids_walls: bool,
}

/// The parts of a random walk that depend on the environment.
pub trait RandomWalk: Default + Send + 'static {
    /// Largest value of an action component.
    const ACTION_SCALE: f64;

    /// The values of the columns that the walk depends on.
    type Observed;

    /// Reads the values from a row.
    ///
    /// # Errors
    /// When the row lacks one of the columns.
    fn read(row: RowRef<'_>) -> Result<Self::Observed>;

    /// Draws the next leg.
    fn draw_leg(rng: &mut Rng) -> Leg;

    /// Returns whether a leg ends before its steps are used up, because the agent is near the end of the leg.
    fn has_arrived(observed: &Self::Observed, leg: &Leg) -> bool;

    /// Returns the action along a leg before noise, as shares of the largest action, `[x, y]`.
    fn action(&mut self, observed: &Self::Observed, leg: &Leg) -> [f64; 2];
}

/// Walks randomly, one [`Leg`] after another.
pub struct Explorer<W> {
    rng: Rng,
    walk: W,
    leg: Leg,
    /// An autoregressive process, added to every action.
    noise: [f64; 2],
}

impl<W: RandomWalk> Explorer<W> {
    /// Makes an explorer; [`Expert::begin`] sets the seed of an episode.
    pub fn new() -> Self {
        Self::seeded(Key::new(0))
    }

    fn seeded(key: Key) -> Self {
        Self { rng: key.rng(), walk: W::default(), leg: Leg::default(), noise: [0.0; 2] }
    }
}

impl<W: RandomWalk> Expert for Explorer<W> {
    fn begin(&mut self, key: Key) {
        *self = Self::seeded(key);
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let observed = W::read(row)?;
        if self.leg.steps == 0 || W::has_arrived(&observed, &self.leg) {
            self.leg = W::draw_leg(&mut self.rng);
        }
        self.leg.steps -= 1;
        let planned = self.walk.action(&observed, &self.leg);
        for (i, planned) in planned.into_iter().enumerate() {
            self.noise[i] = NOISE_DECAY * self.noise[i] + NOISE_WIDTH * self.rng.random_range(-1.0..1.0);
            action[i] = (planned + self.noise[i]).clamp(-1.0, 1.0) * W::ACTION_SCALE;
        }
        Ok(())
    }
}
