//! [`Pusher`]: the expert that plans pushes in a copy of the simulation.
//!
//! A plan is a path around the block to a point beside it, and a push from there: a direction, a strength and a number
//! of steps. Pushes from all around the block are tried in the model, and the expert chooses the push that reduces the
//! error fastest. If no push reduces the error enough, the expert searches for a push after which a good push is
//! possible. When the block is at its goal, the agent walks to its own goal.

use super::pace::Pace;
use super::paths::ShortestPaths;
use super::push_model::{Candidates, Observation, Push, PushModel};
use crate::push_t::TABLE;
use crate::push_t::physics::Vec2;
use crate::push_t::state::{State, checked};
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::policy::Expert;
use swm_core::{Key, Result, Rng, RowRef};

/// The pushes that are tried first.
const FINE: Candidates<'_> = Candidates { spacing: 20.0, angles: &[0.0, -0.45, 0.45], strengths: &[0.3, 1.0] };
/// The pushes that are tried after each random push.
const COARSE: Candidates<'_> = Candidates { spacing: 40.0, angles: &[0.0], strengths: &[1.0] };
/// The number of random pushes that are tried.
const DETOURS: usize = 40;
/// The least reduction of the error that a push must achieve, in pixels.
const MIN_PROGRESS: f64 = 0.5;
/// The least rate that a push must achieve: the reduction of the error (pixels) divided by the number of steps at full
/// speed, including the overhead of a push ([`super::push_model`]).
const MIN_RATE: f64 = 0.1;
/// The distance of the block from its goal (pixels, radians) below which the block is not pushed any more.
const IN_PLACE: (f64, f64) = (12.0, 0.28);
/// A waypoint counts as passed within this distance, in pixels.
const PASSED: f64 = 5.0;
/// A push starts within this distance of its starting point, in pixels.
const ARRIVED: f64 = 2.0;
/// A plan that has not ended after this time is abandoned, in steps at full speed.
const PATIENCE: f64 = 60.0;

/// The expert that plans pushes.
pub struct Pusher {
    /// Rounds an action to an action of the action space.
    round_action: fn([f64; 2]) -> [f64; 2],
    pace: Pace,
    rng: Rng,
    model: Option<PushModel>,
    plan: Plan,
    /// The preceding action of the episode.
    last: [f64; 2],
}

/// A path and the push at its end.
#[derive(Default)]
struct Plan {
    /// The remaining waypoints, in reverse order.
    waypoints: Vec<Vec2>,
    /// The action of the push.
    push: [f64; 2],
    /// The remaining steps of the push.
    steps: usize,
    /// Steps until the plan is abandoned.
    patience: usize,
}

impl From<Push> for Plan {
    fn from(push: Push) -> Self {
        Self { waypoints: push.waypoints, push: push.action, steps: push.steps, patience: 0 }
    }
}

impl Plan {
    /// Makes a plan of a path without a push.
    fn walk(waypoints: Vec<Vec2>) -> Self {
        Self { waypoints, ..Self::default() }
    }

    /// Drops the waypoints that the agent has reached.
    fn drop_reached(&mut self, agent: Vec2) {
        while let Some(&next) = self.waypoints.last() {
            let near = if self.waypoints.len() == 1 && self.steps > 0 { ARRIVED } else { PASSED };
            if (next - agent).length() >= near {
                break;
            }
            self.waypoints.pop();
        }
    }

    fn is_over(&self) -> bool {
        (self.waypoints.is_empty() && self.steps == 0) || self.patience == 0
    }
}

impl Pusher {
    /// Makes an expert of this pace for an environment that rounds actions by `round_action`.
    pub fn new(round_action: fn([f64; 2]) -> [f64; 2], pace: Pace) -> Self {
        Self { round_action, pace, rng: Key::new(0).rng(), model: None, plan: Plan::default(), last: [0.0; 2] }
    }
}

impl Expert for Pusher {
    fn begin(&mut self, key: Key) {
        self.rng = key.rng();
        self.plan = Plan::default();
        self.last = [0.0; 2];
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let state = checked(row.get::<f64>(STATE)?, STATE)?;
        let goal = checked(row.get::<f64>(GOAL_STATE)?, GOAL_STATE)?;
        let shapes: [f64; 4] = row.get::<f64>("shapes")?.try_into().unwrap_or_default();
        let now = Observation { state, agent_angle: row.get::<f64>("agent_pose")?[2] };
        let known = self.model.take().filter(|model| model.shapes == shapes);
        let model = self.model.insert(known.unwrap_or_else(|| PushModel::new(shapes, self.round_action, self.pace)));
        self.plan.drop_reached(now.agent());
        if self.plan.is_over() {
            model.pace = self.pace.drawn(&mut self.rng);
            let patience = model.pace.steps(PATIENCE);
            self.plan = Plan { patience, ..next_plan(model, &now, &goal, &mut self.rng) };
            self.plan.drop_reached(now.agent());
        }
        self.plan.patience = self.plan.patience.saturating_sub(1);
        let planned = match self.plan.waypoints.last() {
            Some(&next) => model.approach(&now, next, self.last),
            None if self.plan.steps > 0 => {
                self.plan.steps -= 1;
                model.pace.limited(self.plan.push, self.last)
            }
            None => [0.0; 2],
        };
        self.last = planned;
        action.copy_from_slice(&planned);
        Ok(())
    }
}

/// Makes the plan for the observed state.
fn next_plan(model: &mut PushModel, now: &Observation, goal: &State, rng: &mut Rng) -> Plan {
    let (distance, angle) = model.block_distance(&now.state, goal);
    if distance < IN_PLACE.0 && angle < IN_PLACE.1 {
        let space = model.configuration_space(now);
        let paths = ShortestPaths::from(&space, now.agent());
        let end = Vec2::new(goal[0], goal[1]);
        return Plan::walk(paths.to(end).map_or_else(|| vec![end], |(_, node)| paths.waypoints(end, node)));
    }
    let max_error = model.error(&now.state, goal) - MIN_PROGRESS;
    let is_good = |push: &Push| push.error < max_error && push.rate > MIN_RATE;
    if let Some(push) = model.best_push(now, goal, &FINE).filter(is_good) {
        return push.into();
    }
    match model.best_detour(now, goal, DETOURS, &COARSE, rng) {
        Some(push) => push.into(),
        // No push is possible, not even after a random push. One may be possible from the centre of the table.
        None => Plan::walk(vec![Vec2::new(TABLE / 2.0, TABLE / 2.0)]),
    }
}
