//! [`PushModel`]: a copy of the simulation in which the expert tries pushes.

use super::configuration_space::ConfigurationSpace;
use super::pace::Pace;
use super::paths::ShortestPaths;
use crate::push_t::ACTION_SCALE;
use crate::push_t::physics::{AGENT, BLOCK, Pose, Simulation, Vec2};
use crate::push_t::shapes::BodyShape;
use crate::push_t::state::{State, angle_between, set_state, state_of};
use crate::push_t::table::{advance, assemble};
use rand::Rng as _;
use std::f64::consts::{PI, TAU};
use swm_core::Rng;

/// Distance between agent and block at which a push starts, in pixels.
const GAP: f64 = 4.0;
/// Corners of the polygon that approximates a round agent.
const CIRCLE_CORNERS: usize = 16;
/// Cost of one radian of rotation, in units of the block's radius of gyration. A push at this radius rotates the
/// block by one radian per two radii of distance.
const ROTATION_WEIGHT: f64 = 1.6;
/// Time added to the cost of every push, in steps at full speed, so that few long pushes are preferred to many short
/// ones.
const PUSH_OVERHEAD: f64 = 30.0;
/// The time for which a push is continued after the step with the best rate, in steps at full speed.
const PATIENCE: f64 = 3.0;

/// The part of the observation that the expert reads.
pub struct Observation {
    pub state: State,
    /// The agent's angle in radians, which `state` does not contain.
    pub agent_angle: f64,
}

impl Observation {
    /// The agent's position, in pixels.
    pub fn agent(&self) -> Vec2 {
        Vec2::new(self.state[0], self.state[1])
    }
}

/// A push that was tried in the model.
pub struct Push {
    /// The waypoints to the starting point of the push, in reverse order.
    pub waypoints: Vec<Vec2>,
    pub action: [f64; 2],
    pub steps: usize,
    /// The error after the push, in pixels (see [`PushModel::error`]).
    pub error: f64,
    /// Duration of the path and the push, in steps at full speed.
    pub time: f64,
    /// Reduction of the error per step at full speed, in pixels.
    pub rate: f64,
}

/// The set of pushes that are tried.
pub struct Candidates<'a> {
    /// Distance between the points at which pushes start, in pixels.
    pub spacing: f64,
    /// Angles between the push and the direction into the block, in radians.
    pub angles: &'a [f64],
    /// Lengths of the action, as shares of the largest action of the pace.
    pub strengths: &'a [f64],
}

/// A copy of the simulation, with a model of the agent's motion.
pub struct PushModel {
    /// The `shapes` column: agent shape and scale, block shape and scale.
    pub shapes: [f64; 4],
    /// Rounds an action to an action of the action space.
    round_action: fn([f64; 2]) -> [f64; 2],
    body_shapes: [BodyShape; 2],
    /// The simulation before any step.
    initial: Simulation,
    simulation: Simulation,
    /// Distance per step of an action component of 1, in pixels.
    speed: f64,
    /// Time for which the agent keeps its velocity, in seconds.
    drift: f64,
    /// Cost of one radian of rotation, in pixels.
    rotation_cost: f64,
    /// The maximal duration of a push, in steps at full speed.
    max_time: f64,
    /// The pace of the agent.
    pub pace: Pace,
}

impl PushModel {
    /// Makes a model for these shapes.
    pub fn new(shapes: [f64; 4], round_action: fn([f64; 2]) -> [f64; 2], pace: Pace) -> Self {
        let body_shapes = [0, 2].map(|i| BodyShape::new(shapes[i] as i64, shapes[i + 1]));
        let bodies = [body_shapes[AGENT].body(), body_shapes[BLOCK].body()];
        let gyration = bodies[BLOCK].inverse_inertia.sqrt().recip();
        let e = (-1.0f64).exp();
        // A round agent is a critically damped spring of 10 / s for 0.1 s: it covers 1 - 2 / e of the distance, and
        // moves velocity / 10 e farther. Other agents lose their velocity in every physics step: each step covers a
        // hundredth of the remaining distance.
        let (covered, drift, max_time) = if body_shapes[AGENT].is_circle() {
            (1.0 - 2.0 * e, 0.1 * e, 6.0)
        } else {
            (1.0 - 0.99f64.powi(10), 0.0, 24.0)
        };
        let initial = assemble(&body_shapes, bodies);
        Self {
            shapes,
            round_action,
            body_shapes,
            simulation: initial.clone(),
            initial,
            speed: covered * f64::from(ACTION_SCALE),
            drift,
            rotation_cost: ROTATION_WEIGHT * gyration,
            max_time,
            pace,
        }
    }

    /// Returns the action that moves the agent to a position, or towards it as far as the pace allows. `last` is the
    /// preceding action.
    pub fn approach(&self, now: &Observation, to: Vec2, last: [f64; 2]) -> [f64; 2] {
        let drift = Vec2::new(now.state[5], now.state[6]) * self.drift;
        let wanted = (to - now.agent() - drift) * (self.pace.approach / self.speed);
        self.pace.limited([wanted.x, wanted.y], last)
    }

    /// Returns the distance of the block from its goal: of its origin in pixels, and of its angle in radians.
    pub fn block_distance(&self, state: &State, goal: &State) -> (f64, f64) {
        let angle = angle_between(self.shapes[2] as i64, state[4], goal[4]);
        (Vec2::new(state[2] - goal[2], state[3] - goal[3]).length(), angle)
    }

    /// Returns the distance of the block from its goal as one value in pixels. It measures the centre of gravity, which
    /// a rotation leaves in place, and adds the cost of the rotation.
    pub fn error(&self, state: &State, goal: &State) -> f64 {
        let centre =
            |state: &State| Pose::new(Vec2::new(state[2], state[3]), state[4], -self.body_shapes[BLOCK].cog).origin;
        (centre(state) - centre(goal)).length() + self.rotation_cost * self.block_distance(state, goal).1
    }

    /// Returns the configuration space of the agent.
    pub fn configuration_space(&self, now: &Observation) -> ConfigurationSpace {
        let [agent, block] = &self.body_shapes;
        let mut body = block.body();
        body.set_angle(now.state[4]);
        body.set_position(Vec2::new(now.state[2], now.state[3]));
        let block: Vec<[Vec2; 4]> = block.rects.iter().map(|rect| rect.map(|corner| body.pose.point(corner))).collect();
        if !agent.is_circle() {
            let pose = Pose::new(Vec2::ZERO, now.agent_angle, Vec2::ZERO);
            let parts: Vec<_> = agent.rects.iter().map(|rect| rect.map(|corner| pose.point(corner)).to_vec()).collect();
            return ConfigurationSpace::new(&parts, &block);
        }
        let corner = |i: usize| {
            let (sin, cos) = (i as f64 * TAU / CIRCLE_CORNERS as f64).sin_cos();
            Vec2::new(cos, sin) * (agent.radius / (PI / CIRCLE_CORNERS as f64).cos())
        };
        ConfigurationSpace::new(&[(0..CIRCLE_CORNERS).map(corner).collect()], &block)
    }

    /// Returns the push that reduces the error fastest, or `None` if no starting point is reachable.
    pub fn best_push(&mut self, now: &Observation, goal: &State, candidates: &Candidates<'_>) -> Option<Push> {
        let space = self.configuration_space(now);
        let paths = ShortestPaths::from(&space, now.agent());
        let before = self.error(&now.state, goal);
        let mut best: Option<(Push, Vec2, usize)> = None;
        for (from, inward) in space.contact_points(GAP, candidates.spacing) {
            let Some((length, node)) = paths.to(from) else { continue };
            let angles = |strength| candidates.angles.iter().map(move |angle| (strength, angle));
            for (&strength, &angle) in candidates.strengths.iter().flat_map(angles) {
                let action = self.action(inward, angle, strength);
                let push = self.attempt(now, goal, from, action, before, length / self.speed);
                if best.as_ref().is_none_or(|(best, ..)| push.rate > best.rate) {
                    best = Some((push, from, node));
                }
            }
        }
        best.map(|(push, from, node)| Push { waypoints: paths.waypoints(from, node), ..push })
    }

    /// Returns the best of `samples` random pushes, rated by the error after the best push that follows. The returned
    /// error and rate are those after both pushes.
    pub fn best_detour(
        &mut self,
        now: &Observation,
        goal: &State,
        samples: usize,
        candidates: &Candidates<'_>,
        rng: &mut Rng,
    ) -> Option<Push> {
        let space = self.configuration_space(now);
        let paths = ShortestPaths::from(&space, now.agent());
        let before = self.error(&now.state, goal);
        let mut starts = space.contact_points(GAP, candidates.spacing);
        starts.retain(|&(from, _)| paths.to(from).is_some());
        let mut best: Option<Push> = None;
        for _ in 0..if starts.is_empty() { 0 } else { samples } {
            let (from, inward) = starts[rng.random_range(0..starts.len())];
            let action = self.action(inward, rng.random_range(-0.8..0.8), 1.0);
            let steps = rng.random_range(2..=self.pace.steps(self.max_time));
            self.set_start(now, from);
            let mut last = [0.0; 2];
            (0..steps).for_each(|_| last = self.advance(action, last));
            let after =
                Observation { state: state_of(&self.simulation), agent_angle: self.simulation.bodies[AGENT].angle };
            let (Some((length, node)), Some(next)) = (paths.to(from), self.best_push(&after, goal, candidates)) else {
                continue;
            };
            let time = length / self.speed + steps as f64 * self.pace.largest + next.time;
            let rate = (before - next.error) / (time + PUSH_OVERHEAD);
            if best.as_ref().is_none_or(|best| rate > best.rate) {
                let waypoints = paths.waypoints(from, node);
                best = Some(Push { waypoints, action, steps, error: next.error, time, rate });
            }
        }
        best
    }

    /// Returns the action of a push at an angle to the direction into the block.
    fn action(&self, inward: Vec2, angle: f64, strength: f64) -> [f64; 2] {
        let (sin, cos) = angle.sin_cos();
        let direction = inward * cos + inward.perp() * sin;
        let scale = strength * self.pace.largest / direction.x.abs().max(direction.y.abs());
        (self.round_action)([direction.x * scale, direction.y * scale])
    }

    /// Sets the simulation to the observed state, but with the agent at rest at `from`.
    fn set_start(&mut self, now: &Observation, from: Vec2) {
        let mut start = now.state;
        [start[0], start[1], start[5], start[6]] = [from.x, from.y, 0.0, 0.0];
        self.simulation.copy_from(&self.initial);
        if self.simulation.bodies[AGENT].is_dynamic() {
            self.simulation.bodies[AGENT].set_angle(now.agent_angle);
        }
        set_state(&mut self.simulation, &start);
    }

    /// Runs one step of a push, and returns the action that the pace allows after the action `last`.
    fn advance(&mut self, action: [f64; 2], last: [f64; 2]) -> [f64; 2] {
        let action = self.pace.limited(action, last);
        advance(&mut self.simulation, action.map(|v| v as f32));
        action
    }

    /// Tries a push from a position, and returns it with the best number of steps. `before` is the present error,
    /// `path` the time to the position, in steps at full speed.
    fn attempt(
        &mut self,
        now: &Observation,
        goal: &State,
        from: Vec2,
        action: [f64; 2],
        before: f64,
        path: f64,
    ) -> Push {
        self.set_start(now, from);
        let mut best = Push { waypoints: vec![], action, steps: 1, error: before, time: path, rate: f64::NEG_INFINITY };
        let (patience, mut last) = (self.pace.steps(PATIENCE), [0.0; 2]);
        for steps in 1..=self.pace.steps(self.max_time) {
            last = self.advance(action, last);
            let error = self.error(&state_of(&self.simulation), goal);
            let time = path + steps as f64 * self.pace.largest;
            let rate = (before - error) / (time + PUSH_OVERHEAD);
            if rate > best.rate {
                best = Push { steps, error, time, rate, ..best };
            } else if steps > best.steps + patience {
                break;
            }
        }
        best
    }
}
