//! The worlds of classic control, as Gymnasium has them and the reference wraps them.
//!
//! A [`World`] is what tells them apart: equations of motion, a task, a controller, a picture. [`Classic`] makes an
//! environment of any of them.

pub mod acrobot;
mod angle;
pub mod cart_pole;
mod env;
mod expert;
mod factors;
#[cfg(test)]
mod measure;
pub mod mountain_car;
pub mod pendulum;
mod picture;

use env::Classic;
use expert::Controller;
use factors::{Paint, Parameter};
use picture::Surface;
use swm_core::{Result, Rng, Space, Transition};

/// One world with the physics of an episode.
trait World: Send + Sized + 'static {
    /// Its registered id.
    const ID: &'static str;
    /// Steps after which an episode is truncated.
    const LIMIT: usize;
    /// Bounds of the numbers of the `state` column.
    const OBSERVED: &'static [(f64, f64)];
    /// Width and height the reference draws it at.
    const SIZE: (usize, usize);
    /// The factors `physics.*`, in sampling order.
    const PHYSICS: &'static [Parameter];
    /// The factors `visuals.*`, in the order their colours are swapped.
    const VISUALS: &'static [Paint];

    /// Everything that changes from step to step, as numbers.
    type State: Copy + Default + Send + AsRef<[f64]> + AsMut<[f64]>;

    /// The actions.
    fn action_space() -> Space;

    /// The world with these values of [`World::PHYSICS`].
    fn new(physics: &[f32]) -> Self;

    /// Draws the start of an episode.
    fn start(rng: &mut Rng) -> Self::State;

    /// The goal of an episode nobody gave one to.
    fn task(rng: &mut Rng) -> Self::State;

    /// Moves the world by one step. Discrete actions come as the number of their choice.
    fn step(&self, state: &mut Self::State, action: f64) -> Transition;

    /// Fills the `state` column.
    fn observe(state: &Self::State, row: &mut [f32]);

    /// The values a `state` column may have, as one asks for them at a reset.
    fn states() -> Space;

    /// The state that a `state` column of [`World::states`] shows.
    fn shown(observed: &[f64]) -> Self::State;

    /// The state that a `state` column shows.
    ///
    /// # Errors
    /// When there is none.
    fn parse(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::states().check(what, observed)?;
        Ok(Self::shown(observed))
    }

    /// Whether a goal is reached.
    fn reached(&self, state: &Self::State, goal: &Self::State) -> bool;

    /// How far a goal is, as [`swm_core::Env::goal_distance`] says.
    fn distance(&self, state: &Self::State, goal: &Self::State) -> f64;

    /// What the expert does to reach a goal.
    fn control(&self, state: &Self::State, goal: &Self::State) -> f64;

    /// Draws what keeps still, on white.
    fn draw_background(&self, surface: &mut Surface);

    /// Draws what moves, and what hides it.
    fn draw(&self, state: &Self::State, surface: &mut Surface);
}

/// A vector turned against the clock.
///
/// As pygame does it, angles within a millionth of a quarter turn count as quarter turns: whole pixels depend on it.
fn turned([x, y]: [f64; 2], angle: f64) -> [f64; 2] {
    const HAIR: f64 = 1e-6;
    let quarter = std::f64::consts::FRAC_PI_2;
    let angle = angle.rem_euclid(4.0 * quarter);
    if (angle + HAIR) % quarter < 2.0 * HAIR {
        #[allow(clippy::cast_possible_truncation)]
        return match ((angle + HAIR) / quarter) as i32 {
            1 => [-y, x],
            2 => [-x, -y],
            3 => [y, -x],
            _ => [x, y],
        };
    }
    let (sin, cos) = angle.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}
