//! [`PointTask`]: the interface that each point-agent environment implements.

use super::position::Position;
use swm_core::{EnvSpec, FactorValues, FrameMut, Key, Result, Rng, RowMut, VariationRequest, VariationSpace};

/// The dynamics, goal rule and drawing of one point-agent environment, for the factors of one episode.
pub trait PointTask: Sized + Send + 'static {
    /// The registered id of the environment.
    const ID: &'static str;
    /// Side of the square of valid positions, in the environment's unit of length.
    const SIZE: f64;
    /// The factor that gives the goal position of an episode.
    const GOAL_FACTOR: &'static str;
    /// The maximal number of candidates that [`PointTask::find_goal`] draws.
    const GOAL_TRIES: usize;

    /// The renderer, which draws frames and caches their static parts.
    type Renderer: Default + Send;

    /// Describes the actions, columns and factors of the environment.
    fn spec() -> EnvSpec;

    /// Builds the task of an episode from its factors.
    fn new(factors: &FactorValues) -> Self;

    /// Sets the factors of another episode. Overridden by tasks that cache data derived from the factors.
    fn set_factors(&mut self, factors: &FactorValues) {
        *self = Self::new(factors);
    }

    /// Resolves the factors of an episode.
    ///
    /// # Errors
    /// When the request names unknown factors or impossible values.
    fn resolve_factors(space: &VariationSpace, request: &VariationRequest, seed: u64) -> Result<FactorValues> {
        space.resolve(request, Key::new(seed))
    }

    /// Returns the position after one step with an action, which is clipped to the action space.
    fn advance(&self, from: Position, action: [f32; 2]) -> Position;

    /// Returns whether an agent at a position has reached the goal.
    fn is_reached(&self, agent: Position, goal: Position) -> bool;

    /// Returns the reward of a step.
    fn reward(&self, reached: bool) -> f64;

    /// Writes the columns of [`PointTask::spec`] into a row.
    fn observe(&self, agent: Position, goal: Position, row: &mut RowMut<'_>);

    /// Moves the drawn goal, and drops data cached for the previous goal.
    fn set_goal(&mut self, goal: Position);

    /// Draws a frame with the agent at a position.
    fn draw(&self, agent: Position, renderer: &mut Self::Renderer, frame: FrameMut<'_>);

    /// Draws a reachable goal position that an agent at `agent` has not reached; `None` when no candidate qualifies.
    fn find_goal(&self, factors: &FactorValues, agent: Position, rng: &mut Rng) -> Option<Position>;

    /// Returns the length of the path to the goal, as [`swm_core::Env::goal_distance`] defines it.
    fn goal_distance(&self, agent: Position, goal: Position) -> f64;
}

/// Draws up to `tries` goal candidates until one is at least `wanted` away. Returns the farthest candidate.
///
/// `candidate` returns a distance (in steps or in units of length) with its position, and `None` for a candidate that
/// does not qualify.
pub fn farthest_goal<D: PartialOrd + Copy>(
    tries: usize,
    wanted: D,
    mut candidate: impl FnMut() -> Option<(D, Position)>,
) -> Option<Position> {
    let mut farthest: Option<(D, Position)> = None;
    for _ in 0..tries {
        let Some((distance, goal)) = candidate() else { continue };
        if farthest.is_none_or(|(known, _)| distance > known) {
            farthest = Some((distance, goal));
        }
        if distance >= wanted {
            break;
        }
    }
    farthest.map(|(_, goal)| goal)
}
