//! [`ControlTask`]: the interface that each classic-control environment implements.

use super::factors::{ColorFactor, PhysicsFactor};
use super::frame::Surface;
use swm_core::{Result, Rng, Space, Transition};

/// The dynamics, goal, controller and drawing of one classic-control environment, for the physical factors of one
/// episode.
pub trait ControlTask: Send + Sized + 'static {
    /// The registered id of the environment.
    const ID: &'static str;
    /// Steps after which an episode is truncated.
    const MAX_EPISODE_STEPS: usize;
    /// Bounds of the values of the `state` column, as the reference declares them.
    const STATE_BOUNDS: &'static [(f64, f64)];
    /// Width and height at which the reference draws the environment, in pixels.
    const FRAME_SIZE: (usize, usize);
    /// The factors `physics.*`, in sampling order.
    const PHYSICS_FACTORS: &'static [PhysicsFactor];
    /// The factors `visuals.*`, in the order in which their colours are replaced.
    const COLOR_FACTORS: &'static [ColorFactor];

    /// The state of the simulation as values.
    type State: Copy + Default + Send + AsRef<[f64]> + AsMut<[f64]>;

    /// The action space.
    fn action_space() -> Space;

    /// Makes the task with these values of [`ControlTask::PHYSICS_FACTORS`].
    fn new(physics: &[f32]) -> Self;

    /// Samples the start state of an episode.
    fn sample_start(rng: &mut Rng) -> Self::State;

    /// Samples the goal of an episode whose reset options contain no goal.
    fn sample_task_goal(rng: &mut Rng) -> Self::State;

    /// Advances the state by one step. A discrete action is the index of the choice.
    fn step(&self, state: &mut Self::State, action: f64) -> Transition;

    /// Writes the `state` column.
    fn observe(state: &Self::State, row: &mut [f32]);

    /// The space of the `state` columns that callers may give.
    fn state_space() -> Space;

    /// Reads a state from a `state` column within [`ControlTask::state_space`].
    fn read_state(observed: &[f64]) -> Self::State;

    /// Checks and reads a state from a `state` column.
    ///
    /// # Errors
    /// When the values are not a valid state.
    fn parse_state(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::state_space().check(what, observed)?;
        Ok(Self::read_state(observed))
    }

    /// Returns whether a goal is reached.
    fn is_reached(&self, state: &Self::State, goal: &Self::State) -> bool;

    /// Returns the distance to a goal, as [`swm_core::Env::goal_distance`] defines it.
    fn goal_distance(&self, state: &Self::State, goal: &Self::State) -> f64;

    /// Returns the expert's action.
    fn control(&self, state: &Self::State, goal: &Self::State) -> f64;

    /// Draws the static background on a white surface.
    fn draw_background(&self, surface: &mut Surface);

    /// Draws the moving parts, and the static parts in front of them.
    fn draw(&self, state: &Self::State, surface: &mut Surface);
}
